//! What a supervisor knows of one child.

use super::Ticket;
use crate::recovery::{ChildRules, Restart};
use crate::{Fault, FaultKind, Incarnation, Instant, ObjectName};
use serde::{Deserialize, Serialize};

/// What is known of the life that is to be replaced. It decides how that life is ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// It has ended already: there is nothing to stop. Whether that was an orderly end, the child's
    /// guard has said.
    Died,
    /// It does not answer: it is given up without being asked.
    Stuck,
    /// It stands still behind somebody else's hang: it is given up too, and that its life is replaced
    /// is not held against it or its supervisor.
    Behind,
    /// It lives and answers: it is stopped in order. If it has ended by now, that was no orderly end.
    Faulty,
    /// A person, or the application, wants its next life: if it lives, it is stopped in order. That is not
    /// held against it or its supervisor either.
    Asked,
}

impl Cause {
    /// What a fault says about the life that it struck.
    pub fn of(fault: &Fault) -> Self {
        match fault.kind {
            FaultKind::Panic | FaultKind::UnexpectedExit | FaultKind::InitializationFailed => {
                Cause::Died
            }
            FaultKind::Hang if fault.symptom_of.is_some() => Cause::Behind,
            FaultKind::Hang | FaultKind::Silence => Cause::Stuck,
            _ => Cause::Faulty,
        }
    }
}

/// Where a child stands with its supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ChildState {
    /// It has no life, and waits for its turn or for its supervisor to begin.
    Waiting,
    /// It was told to start.
    Starting,
    /// It is at work.
    Running,
    /// Something that it needs, such as its device, is not there yet: it tries again by itself.
    Unavailable,
    /// It was told to reset itself.
    Resetting,
    /// It was told to stop.
    Stopping,
    /// Its life has ended, and the recoverer has not yet said what is to be done.
    Failed,
    /// It was put in safe rest.
    Resting,
    /// Its end was final, as its rules say.
    Finished,
}

/// One row of the supervisor's table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildStatus {
    /// Its name.
    pub name: ObjectName,
    /// Which of its lives; 0 before the first.
    pub incarnation: Incarnation,
    /// Where it stands.
    pub state: ChildState,
    /// How often it was restarted, by itself or with its group.
    pub restarts: u64,
    /// Its sending and receiving is forbidden.
    pub isolated: bool,
}

/// A child's place in the start order; never given twice.
pub(super) type Key = u64;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum State {
    Down,
    Starting {
        due: Instant,
    },
    Running,
    /// It waits for something that is not there yet, for as long as that takes.
    Unavailable,
    Resetting {
        due: Instant,
        ticket: Ticket,
    },
    Stopping {
        due: Instant,
    },
}

/// What a child is to come to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Goal {
    Run,
    Rest,
    Finished,
    Leave,
}

#[derive(Clone, Debug)]
pub(super) struct Kept {
    pub(super) name: ObjectName,
    pub(super) rules: ChildRules,
    pub(super) incarnation: Incarnation,
    pub(super) state: State,
    pub(super) goal: Goal,
    /// Its life ended for this reason, and nobody has decided yet.
    pub(super) failed: Option<String>,
    pub(super) restarts: u64,
    pub(super) isolated: bool,
    /// Its guard holds a standing order.
    pub(super) ordered: bool,
    /// When its guard restarted it by itself, as far back as it counts; never more than the intensity
    /// allows, and one.
    pub(super) on_the_spot: Vec<Instant>,
}

impl Kept {
    pub(super) fn new(name: ObjectName, rules: ChildRules) -> Self {
        Kept {
            name,
            rules,
            incarnation: Incarnation::default(),
            state: State::Down,
            goal: Goal::Run,
            failed: None,
            restarts: 0,
            isolated: false,
            ordered: false,
            on_the_spot: Vec::new(),
        }
    }

    pub(super) fn lives(&self) -> bool {
        self.state != State::Down
    }

    pub(super) fn due(&self) -> Option<Instant> {
        match self.state {
            State::Starting { due } | State::Resetting { due, .. } | State::Stopping { due } => {
                Some(due)
            }
            State::Down | State::Running | State::Unavailable => None,
        }
    }

    /// Whether its rules let it be after such an end.
    pub(super) fn may_end(&self, in_order: bool) -> bool {
        match self.rules.restart {
            Restart::Permanent => false,
            Restart::Transient => in_order,
            Restart::Temporary => true,
        }
    }

    pub(super) fn status(&self) -> ChildStatus {
        let state = match self.state {
            State::Starting { .. } => ChildState::Starting,
            State::Running => ChildState::Running,
            State::Unavailable => ChildState::Unavailable,
            State::Resetting { .. } => ChildState::Resetting,
            State::Stopping { .. } => ChildState::Stopping,
            State::Down => match self.goal {
                Goal::Run if self.failed.is_some() => ChildState::Failed,
                Goal::Run | Goal::Leave => ChildState::Waiting,
                Goal::Rest => ChildState::Resting,
                Goal::Finished => ChildState::Finished,
            },
        };
        ChildStatus {
            name: self.name.clone(),
            incarnation: self.incarnation,
            state,
            restarts: self.restarts,
            isolated: self.isolated,
        }
    }
}
