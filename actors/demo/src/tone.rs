//! What the lines of the demo mean, which decides how they are shown.

/// The meaning of a progress line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineTone {
    /// A fault was injected.
    Injection,
    /// A fault was found.
    Finding,
    /// The fault is recovered.
    Relief,
    /// A promise is broken.
    Alarm,
    /// Anything else.
    Remark,
}
