//! What drives a machine of `core` and restarts the middleware's own actors.

pub(crate) mod callbacks;
pub(crate) mod driver;
pub(crate) mod guardian;
pub(crate) mod pending_answer;
pub(crate) mod reports;
pub(crate) mod timekeeper;
