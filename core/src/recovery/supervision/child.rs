//! A supervisor's record of one child.

use super::CallId;
use crate::recovery::{ChildRules, Restart};
use crate::{Fault, FaultKind, Incarnation, Instant, ObjectName};
use serde::{Deserialize, Serialize};
use std::time::Duration;

/// The state of the incarnation to be replaced. It decides how that incarnation is ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ReplacementCause {
    /// It has ended already: there is nothing to stop. Whether that was an orderly end, the child's
    /// guard has said.
    Died,
    /// The child does not answer: its incarnation is abandoned without an order to stop.
    Stuck,
    /// It waits behind another component that hangs: it is abandoned, too, and its replacement
    /// counts neither against it nor against its supervisor.
    Behind,
    /// It lives and answers: it is stopped in order. If it has ended by now, that was no orderly
    /// end.
    Faulty,
    /// A person, or the application, wants its next incarnation: if it lives, it is stopped in
    /// order. That is not held against it or its supervisor either.
    Asked,
}

impl ReplacementCause {
    /// What a fault says about the incarnation that it struck.
    pub fn of(fault: &Fault) -> Self {
        match fault.kind {
            FaultKind::Panic | FaultKind::UnexpectedExit => ReplacementCause::Died,
            FaultKind::Hang if fault.symptom_of.is_some() => ReplacementCause::Behind,
            FaultKind::Hang | FaultKind::Silence => ReplacementCause::Stuck,
            _ => ReplacementCause::Faulty,
        }
    }

    /// The same in words, where nothing more exact is known yet.
    fn as_str(self) -> &'static str {
        match self {
            ReplacementCause::Died => "it died",
            ReplacementCause::Stuck | ReplacementCause::Behind => "it did not answer",
            ReplacementCause::Faulty => "it was faulty",
            ReplacementCause::Asked => "it was asked to",
        }
    }
}

/// Where a child stands with its supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum ChildState {
    /// It has no incarnation, and waits for its turn or for its supervisor to begin.
    Waiting,
    /// The child was ordered to start.
    Starting,
    /// The child is active.
    Running,
    /// Something that it needs, such as its device, is not there yet: it tries again by itself.
    Unavailable,
    /// The child was ordered to reset itself, or will be when it is its turn.
    Resetting,
    /// The child was ordered to stop.
    Stopping,
    /// The incarnation has ended, or could not be reset, and the recoverer has not decided yet.
    Failed,
    /// The child was put into the safe state.
    Resting,
    /// Its end was final, as its rules say.
    Finished,
}

/// One row of the supervisor's table.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildStatus {
    /// The child's name.
    pub name: ObjectName,
    /// The child's present incarnation; 0 before the first.
    pub incarnation: Incarnation,
    /// Where it stands.
    pub state: ChildState,
    /// How often it was restarted, by itself or with its group.
    pub restarts: u64,
    /// Its sending and receiving is forbidden.
    pub isolated: bool,
}

/// A child's place in the start order; never given twice.
pub(super) type ChildKey = u64;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ChildPhase {
    /// It was not started, or its incarnation has ended or was abandoned.
    Down,
    /// It starts, and is to be ready when this is due.
    Starting { due: Instant },
    /// Its start has failed, and its last hooks run.
    Failing { due: Instant },
    /// It was ready, and has not ended; it may be in error.
    Running,
    /// It waits for something that is not there yet, for as long as that takes.
    Unavailable,
    /// It is in error, and is to be reset when it is its turn in the order of its group.
    AwaitsReset { call: CallId },
    /// It is being reset for this call, and is to be ready when this is due.
    Resetting { due: Instant, call: CallId },
    /// It was asked to stop, and is to have ended when this is due.
    Stopping { due: Instant },
}

/// What a child is to come to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ChildTarget {
    Run,
    Rest,
    Finished,
    Leave,
}

#[derive(Clone, Debug)]
pub(super) struct SupervisedChild {
    pub(super) name: ObjectName,
    pub(super) rules: ChildRules,
    pub(super) incarnation: Incarnation,
    pub(super) state: ChildPhase,
    pub(super) goal: ChildTarget,
    /// Its incarnation ended, or could not be reset while its group waits, for this reason, and the
    /// recoverer has not decided yet.
    pub(super) failed: Option<String>,
    /// It was added while the supervisor is at work, and has not come to work yet: a start that fails
    /// undoes that.
    pub(super) joins: bool,
    /// Its present or last incarnation has come to work, or waits for what is not there yet.
    pub(super) worked: bool,
    pub(super) restarts: u64,
    pub(super) isolated: bool,
    /// Its guard may restart it by itself, once.
    pub(super) granted: bool,
}

impl SupervisedChild {
    pub(super) fn new(name: ObjectName, rules: ChildRules) -> Self {
        SupervisedChild {
            name,
            rules,
            incarnation: Incarnation::default(),
            state: ChildPhase::Down,
            goal: ChildTarget::Run,
            failed: None,
            joins: false,
            worked: false,
            restarts: 0,
            isolated: false,
            granted: false,
        }
    }

    /// That it was restarted too often, and why it failed last: of a supervisor, which of its
    /// children was the cause. The recoverer may order the restart before its guard reports the end.
    pub(super) fn excess(
        &self,
        cause: ReplacementCause,
        intensity: u32,
        period: Duration,
    ) -> String {
        let SupervisedChild { name, failed, .. } = self;
        let why = failed.as_deref().unwrap_or(cause.as_str());
        format!("{name} needed more than {intensity} restarts in {period:?}: {why}")
    }

    pub(super) fn is_alive(&self) -> bool {
        self.state != ChildPhase::Down
    }

    pub(super) fn due(&self) -> Option<Instant> {
        match self.state {
            ChildPhase::Starting { due }
            | ChildPhase::Failing { due }
            | ChildPhase::Resetting { due, .. }
            | ChildPhase::Stopping { due } => Some(due),
            ChildPhase::Down
            | ChildPhase::Running
            | ChildPhase::Unavailable
            | ChildPhase::AwaitsReset { .. } => None,
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
            ChildPhase::Starting { .. } | ChildPhase::Failing { .. } => ChildState::Starting,
            ChildPhase::Running if self.failed.is_some() => ChildState::Failed,
            ChildPhase::Running => ChildState::Running,
            ChildPhase::Unavailable => ChildState::Unavailable,
            ChildPhase::AwaitsReset { .. } | ChildPhase::Resetting { .. } => ChildState::Resetting,
            ChildPhase::Stopping { .. } => ChildState::Stopping,
            ChildPhase::Down => match self.goal {
                ChildTarget::Run if self.failed.is_some() => ChildState::Failed,
                ChildTarget::Run | ChildTarget::Leave => ChildState::Waiting,
                ChildTarget::Rest => ChildState::Resting,
                ChildTarget::Finished => ChildState::Finished,
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
