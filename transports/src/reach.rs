//! How far the frames of a medium travel, and so which processes can send to a node over it.

use std::fmt;

/// The widest circle of processes that can send to a node over a medium and read what it sends.
///
/// Ordered: a later variant reaches further.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[non_exhaustive]
pub enum Reach {
    /// This process alone.
    Process,
    /// Processes of this computer whose user the medium has checked.
    CheckedUsers,
    /// Every process of this computer, of any user.
    Computer,
    /// Other computers, and every device on the cable, the bus or the radio.
    Network,
}

impl Reach {
    /// Whether frames leave this computer.
    pub fn leaves_computer(self) -> bool {
        self == Reach::Network
    }
}

impl fmt::Display for Reach {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Reach::Process => "this process",
            Reach::CheckedUsers => "checked users",
            Reach::Computer => "this computer",
            Reach::Network => "network",
        })
    }
}
