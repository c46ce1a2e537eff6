//! What lies below a link: the wire formats of CAN, and impairments of a simulated medium.

pub mod can;
pub mod impairment;
