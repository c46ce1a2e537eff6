//! What a scanner is shown, and what it has seen.

use crate::{Incarnation, Instant, ObjectName};
use std::time::Duration;

/// The number of an arbiter.
pub type ArbiterId = u64;
/// The number of a component's place in the table of stamps.
pub type SlotId = u32;

/// When the scanner believes what it sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ScannerConfig {
    /// How long a fenced arbiter may take to come back before its components are re-created
    /// elsewhere. Longer spares more restarts; the victims stand still meanwhile.
    pub grace: Duration,
    /// How far apart two looks may be. More means that the scanner itself was not scheduled. Ten of
    /// the usual intervals: shorter voids good observations on a busy machine.
    pub gap: Duration,
    /// How long a beat may stand before the arbiter's components are no longer judged for silence.
    /// Several beats, and well below the shortest tolerance for silence.
    pub standstill: Duration,
}

impl Default for ScannerConfig {
    fn default() -> Self {
        ScannerConfig {
            grace: Duration::from_millis(200),
            gap: Duration::from_millis(100),
            standstill: Duration::from_millis(50),
        }
    }
}

/// How one component is judged.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Judged {
    /// Who.
    pub object: ObjectName,
    /// The arbiter that it lives on.
    pub arbiter: ArbiterId,
    /// How long its handler may keep the arbiter.
    pub max_block: Duration,
    /// How long its handler may await something.
    pub max_wait: Duration,
    /// How long it may give no sign of life, if it is expected to.
    pub max_silence: Option<MaxSilence>,
}

/// How long a component may give no sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MaxSilence {
    /// From being at work to a life's first sign.
    pub first: Duration,
    /// From then on, between two of them.
    pub between: Duration,
}

/// What an arbiter says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PulseReading {
    /// Counts up while the event loop turns.
    pub beat: u64,
    /// The component that is on the thread.
    pub running: Option<SlotId>,
    /// That component's turn; `None` where it is no longer judged.
    pub turn: Option<u64>,
    /// It has been fenced and has not come back yet.
    pub fenced: bool,
}

/// What a component says about itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct StampReading {
    /// Odd while something is in service.
    pub turn: u64,
    /// Signs of life.
    pub alive: u64,
    /// Which of its lives.
    pub incarnation: Incarnation,
    /// Signs of life are to be expected now.
    pub speaks: bool,
    /// The component has announced that it takes up to so long; zero for as usual.
    pub allowance: Duration,
}

/// What the scanner has seen.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Sighting {
    /// A handler keeps its arbiter.
    Hangs {
        /// The culprit's place.
        slot: SlotId,
        /// The culprit.
        object: ObjectName,
        /// Since when, at least.
        age: Duration,
        /// Who stands still behind it.
        victims: Vec<ObjectName>,
    },
    /// A handler awaits something for too long.
    Waits {
        /// Its component's place.
        slot: SlotId,
        /// Its component.
        object: ObjectName,
        /// Which life.
        incarnation: Incarnation,
        /// Since when, at least.
        age: Duration,
    },
    /// A component that should give signs of life gives none.
    Silent {
        /// Who.
        object: ObjectName,
        /// Which life.
        incarnation: Incarnation,
        /// For how long, at least.
        silent_for: Duration,
    },
    /// A component that was silent gives signs of life again.
    Spoke {
        /// Who.
        object: ObjectName,
        /// Which life.
        incarnation: Incarnation,
    },
    /// An arbiter that hung turns again.
    Resumed {
        /// Who stood still on it and still lives there.
        objects: Vec<ObjectName>,
    },
    /// The grace time of a fenced arbiter is over.
    Lost {
        /// Which.
        arbiter: ArbiterId,
        /// Whose handler keeps it.
        culprit: ObjectName,
        /// Who still lives on it and must be re-created elsewhere.
        victims: Vec<ObjectName>,
    },
    /// The scanner was not scheduled; everything seen before is void.
    Stalled {
        /// For how long.
        gap: Duration,
    },
}

/// What is known of an arbiter, for people.
#[derive(Clone, Debug, PartialEq)]
pub struct ArbiterSeen {
    /// The share of the latest looks that found a component on its thread; `None` before the first.
    pub busy: Option<f32>,
    /// Whose handler keeps it for longer than it may, and since when, at least.
    pub hangs: Option<(ObjectName, Instant)>,
}
