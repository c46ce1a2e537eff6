//! What a scanner is shown, and what it has seen.

use crate::detection::{Finding, NodeCondition};
use crate::{Incarnation, Instant, ObjectName};
use std::sync::Arc;
use std::time::Duration;

/// The number of an arbiter.
pub type ArbiterId = u64;
/// The number of a component's place in the table of activity records.
pub type SlotId = u32;

/// When the scanner believes what it sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct HangDetectorConfig {
    /// How long a fenced arbiter may take to come back before its components are re-created
    /// elsewhere. Longer spares more restarts; the victims stand still meanwhile.
    pub grace: Duration,
    /// How far apart two looks may be. More means that the scanner itself was not scheduled, and
    /// what is more is not counted. Two of the usual intervals: shorter delays judgement on a
    /// machine that is merely busy.
    pub gap: Duration,
}

impl Default for HangDetectorConfig {
    fn default() -> Self {
        HangDetectorConfig { grace: Duration::from_millis(200), gap: Duration::from_millis(20) }
    }
}

/// A component that is judged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct JudgedComponent {
    /// The name of the component.
    pub object: ObjectName,
    /// The arbiter that it lives on.
    pub arbiter: ArbiterId,
    /// By what. Components with the same limits can share them.
    pub limits: Arc<HangLimits>,
}

/// How one component is judged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HangLimits {
    /// How long its handler may keep the arbiter.
    pub max_block: Duration,
    /// How long its handler may await something.
    pub max_wait: Duration,
    /// How long it may give no sign of life, if it is expected to.
    pub max_silence: Option<MaxSilence>,
    /// How long neither it nor its arbiter may make progress, if it is pinged: with progress, it
    /// could answer.
    pub max_unanswered: Option<Duration>,
    /// How long a message may wait in its queue.
    pub max_delay: Duration,
    /// How many of its rounds may be missed, in percent; 100 for any number.
    pub max_missed_percent: u8,
}

/// How long a component may give no sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaxSilence {
    /// From being at work to an incarnation's first sign.
    pub first: Duration,
    /// From then on, between two of them.
    pub between: Duration,
}

/// What an arbiter says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ArbiterSample {
    /// Counts up while the event loop turns.
    pub beat: u64,
    /// The component that is on the thread.
    pub running: Option<SlotId>,
    /// What that component says, read at the same time; `None` where it is no longer judged. An
    /// allowance that its handler has just announced counts from the next heartbeat on.
    pub activity: Option<ComponentSample>,
    /// The contract or hook that it has in service.
    pub during: &'static str,
    /// It has been fenced and has not come back yet.
    pub fenced: bool,
    /// How much of the processor its thread has used, if it is ready to run; `None` where it waits
    /// for something, or where that is not known. Asked only where a component is on the thread.
    pub used: Option<Duration>,
}

/// What a component says about itself.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ComponentSample {
    /// Odd while something is in service.
    pub turn: u64,
    /// Signs of life.
    pub alive: u64,
    /// The incarnation of the component.
    pub incarnation: Incarnation,
    /// It is at work: signs of life are to be expected, and its messages are served.
    pub speaks: bool,
    /// The component has announced that it takes up to so long; zero for as usual.
    pub allowance: Duration,
    /// How often a round is due; zero for never.
    pub interval: Duration,
    /// Rounds, and ticks of its timers, that were begun; begins again at zero.
    pub ticks: u32,
    /// Those that this incarnation has missed, because the one before still waited for its turn.
    pub missed_ticks: u64,
    /// Messages whose sender did not wait any more when their turn came.
    pub expired: u64,
}

impl ComponentSample {
    /// The part by which a component that rests is known to rest still.
    pub fn mark(&self) -> ActivityMark {
        let ComponentSample { turn, incarnation, expired, .. } = *self;
        ActivityMark { turn, incarnation, expired }
    }
}

/// What changes whenever a component with nothing in service takes something up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ActivityMark {
    /// As in [`ComponentSample`].
    pub turn: u64,
    /// As in [`ComponentSample`].
    pub incarnation: Incarnation,
    /// As in [`ComponentSample`].
    pub expired: u64,
}

/// How a component's queue is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct QueueReading {
    /// How many messages wait.
    pub queued: usize,
    /// How long the oldest of them has.
    pub oldest: Duration,
}

/// The samples that a hang detector reads.
pub trait Looked {
    /// What the component of a slot says.
    fn activity(&self, slot: SlotId) -> ComponentSample;
    /// The mark of what it says, for one that may rest: asked of every component at every look.
    fn mark(&self, slot: SlotId) -> ActivityMark {
        self.activity(slot).mark()
    }
    /// The contract or hook that it has in service. Asked only of one that awaits for too long.
    fn during(&self, slot: SlotId) -> &'static str;
    /// How its queue is. Asked only where something may wait.
    fn queue(&self, slot: SlotId) -> QueueReading;
}

/// A finding of the hang detector.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LivenessEvent {
    /// A component hangs, waits, is silent or overloaded, or is so no more.
    Component {
        /// The component; of an overload or hang the culprit.
        object: ObjectName,
        /// The incarnation that this was found in.
        incarnation: Incarnation,
        /// What was found.
        finding: Finding,
    },
    /// Components are late because their threads, ready to run, waited for a processor; or none is
    /// any more.
    Computer(NodeCondition),
    /// An arbiter that hung turns again.
    Resumed {
        /// The components that were blocked on it and still live there.
        objects: Arc<[ObjectName]>,
    },
    /// The grace time of a fenced arbiter is over.
    Lost {
        /// The arbiter whose thread does not return.
        arbiter: ArbiterId,
        /// The component whose handler keeps it.
        culprit: ObjectName,
        /// The components that still live on it and must be re-created elsewhere.
        victims: Arc<[ObjectName]>,
    },
    /// The scanner was not scheduled.
    Stalled {
        /// For how long.
        gap: Duration,
    },
}

/// The status of an arbiter, for display.
#[derive(Clone, Debug, PartialEq)]
pub struct ArbiterStatus {
    /// The share of the latest looks that found a component on its thread; `None` before the first.
    pub busy: Option<f32>,
    /// The component whose handler keeps it for longer than it may, and since when, at least.
    pub hangs: Option<(ObjectName, Instant)>,
}
