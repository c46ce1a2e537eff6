//! What a component does now, sampled from another thread: activity, limits of time, the table of
//! threads.

pub(crate) mod activity;
pub(crate) mod label;
pub(crate) mod lateness;
pub(crate) mod limits;
pub(crate) mod sampler;
pub(crate) mod threads;
