//! What lies below a link: the lanes of frames, the wire formats of CAN, and impairments of a
//! simulated medium.

pub mod can;
pub mod impairment;
pub mod lane;
