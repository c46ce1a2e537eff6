//! What overtakes what on its way to a medium.

/// Frames of one lane stay in order; those of an earlier one overtake those of a later one.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub enum FrameLane {
    /// Hellos, the signs of life without which a link falls. Links see that they are few.
    Hello,
    /// What must not wait: acknowledgements, what routers tell each other, control.
    Urgent,
    /// All frames of no other lane.
    #[default]
    Usual,
}

impl FrameLane {
    /// All of them, by their numbers.
    pub const ALL: [FrameLane; 3] = [FrameLane::Hello, FrameLane::Urgent, FrameLane::Usual];
}
