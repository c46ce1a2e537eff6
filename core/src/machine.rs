//! The shape that every machine of the core has.

use crate::Instant;

/// Synchronous logic that is given the time.
///
/// Its driver calls typed `handle_*` methods with what happened, then drains [`poll_output`], then
/// wakes it again at [`poll_timeout`] through [`handle_timeout`]. The shape is that of
/// `quinn-proto`. A wake-up may come late, and may come when nothing is due: both must be harmless.
///
/// [`poll_output`]: Machine::poll_output
/// [`poll_timeout`]: Machine::poll_timeout
/// [`handle_timeout`]: Machine::handle_timeout
pub trait Machine {
    /// What the machine wants done.
    type Output;

    /// The next thing to do, in order; `None` when all is done.
    fn poll_output(&mut self) -> Option<Self::Output>;

    /// When the machine wants to be woken at the latest; `None` for never.
    fn poll_timeout(&self) -> Option<Instant>;

    /// Lets the machine act on everything that is due at `now`.
    fn handle_timeout(&mut self, now: Instant);
}
