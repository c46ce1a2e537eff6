//! The statuses of nodes.

use std::fmt;

/// The status of a node; `NodeStatus` of BehaviorTree.CPP.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Status {
    /// Not started, or halted. No node may answer it.
    #[default]
    Idle,
    /// Started and not finished.
    Running,
    /// Finished: the node's task is done.
    Success,
    /// Finished: the node's task is not done.
    Failure,
    /// Not started, because of a condition of the node.
    Skipped,
}

impl Status {
    const ALL: [Status; 5] =
        [Status::Idle, Status::Running, Status::Success, Status::Failure, Status::Skipped];

    /// The name in XML files.
    pub const fn name(self) -> &'static str {
        match self {
            Status::Idle => "IDLE",
            Status::Running => "RUNNING",
            Status::Success => "SUCCESS",
            Status::Failure => "FAILURE",
            Status::Skipped => "SKIPPED",
        }
    }

    /// The status of this name in XML files.
    pub fn from_name(name: &str) -> Option<Status> {
        Status::ALL.into_iter().find(|status| status.name() == name)
    }

    /// Whether it is `Success` or `Failure`.
    pub const fn is_completed(self) -> bool {
        matches!(self, Status::Success | Status::Failure)
    }
}

impl From<bool> for Status {
    /// `Success` for true, `Failure` for false.
    fn from(holds: bool) -> Status {
        if holds { Status::Success } else { Status::Failure }
    }
}

impl fmt::Display for Status {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}
