//! What drives a machine of `core` and restarts the middleware's own actors.

pub(crate) mod driver;
pub(crate) mod guardian;
