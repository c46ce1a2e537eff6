//! What one end of a link thinks of it.

/// What one end of a link thinks of it. Both ends must be ready before either uses it, and one that
/// gives it up takes the other along: no end sends what the other would not take (as in BFD, RFC
/// 5880).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HelloState {
    /// It knows nothing yet: it has just been started, or restarted.
    Unproved,
    /// It has given the link up, which has not proved itself since.
    Down,
    /// It uses the link, or would if the other did.
    Ready,
}
