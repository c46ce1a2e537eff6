//! What guards, components and the watch thread tell the monitor.
//!
//! ```text
//! guard ──Exited, StateReported──►┐
//! component ──FaultDeclared──► Monitor ──► Detector ──► Notifier ──► Recoverer
//! watch thread ──Sighted──────────┘
//! ```

use actix::Message;
pub use blastema_core::detection::ExitReason;
use blastema_core::detection::hang::OverloadFigures;
use blastema_core::{FaultKind, Incarnation, Lifecycle, ObjectName};
use std::sync::Arc;
use std::time::Duration;

/// Asked of an object of the middleware. Components are not asked: what they do is seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Alive")]
pub struct AreYouAlive;

/// The answer to [`AreYouAlive`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, actix::MessageResponse)]
pub struct Alive {
    /// Which incarnation answers.
    pub incarnation: Incarnation,
    /// Where it stands.
    pub state: Lifecycle,
}

/// The end of an incarnation, told by its guard at once.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Exited {
    /// Who.
    pub object: ObjectName,
    /// Which incarnation.
    pub incarnation: Incarnation,
    /// How.
    pub exit: ExitReason,
    /// The guard has carried out its standing order: this incarnation has begun in the old one's
    /// place.
    pub restarted_as: Option<Incarnation>,
}

/// A change of an object's state, told by its guard.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct StateReported {
    /// Who.
    pub object: ObjectName,
    /// Which incarnation.
    pub incarnation: Incarnation,
    /// Where it now stands.
    pub state: Lifecycle,
    /// For `Error` and `Fatal`: why, as the component said it. For `Active`: what a program says of
    /// itself.
    pub reason: Option<String>,
}

/// A fault that an object found in itself or in its data.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct FaultDeclared {
    /// Who declares it.
    pub object: ObjectName,
    /// Which incarnation.
    pub incarnation: Incarnation,
    /// What it is.
    pub kind: FaultKind,
    /// The particulars.
    pub detail: String,
}

/// What an object had declared is over.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct DeclaredFaultCleared {
    /// Who had declared it.
    pub object: ObjectName,
    /// Which incarnation it is in now.
    pub incarnation: Incarnation,
    /// What it was.
    pub kind: FaultKind,
}

/// What the watch thread saw when it looked at arbiters and components.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub enum LivenessReported {
    /// This object's handler keeps its arbiter from turning.
    Hangs {
        /// The culprit.
        object: ObjectName,
        /// Which incarnation.
        incarnation: Incarnation,
        /// The contract or hook in service.
        during: &'static str,
        /// Since when, at least.
        age: Duration,
        /// Who stands still behind it.
        victims: Arc<[ObjectName]>,
    },
    /// This object's handler awaits something for longer than it may; its arbiter turns.
    Waits {
        /// Who.
        object: ObjectName,
        /// Which incarnation.
        incarnation: Incarnation,
        /// The contract or hook in service.
        during: &'static str,
        /// Since when, at least.
        age: Duration,
    },
    /// An arbiter that stood still turns again before anyone was re-created elsewhere.
    Resumed {
        /// Who stood still on it.
        objects: Arc<[ObjectName]>,
    },
    /// The grace time is over and the arbiter still stands: these must be re-created elsewhere.
    Lost {
        /// Whose handler keeps it.
        culprit: ObjectName,
        /// Who stood still behind it.
        victims: Arc<[ObjectName]>,
    },
    /// This object works, and is, or makes others, later than they may be.
    Overloaded {
        /// Who.
        object: ObjectName,
        /// Which incarnation.
        incarnation: Incarnation,
        /// How much.
        figures: OverloadFigures,
        /// Who is late behind it, on the same thread.
        victims: Arc<[ObjectName]>,
    },
    /// Objects of this node are late because their threads waited for a processor.
    ComputerOverloaded {
        /// For which share of the time the worst of these threads waited.
        waited_percent: u8,
        /// How late they are.
        figures: OverloadFigures,
        /// Who is late.
        victims: Arc<[ObjectName]>,
    },
    /// No object is late any more because of that.
    ComputerRelieved,
    /// An object that was overloaded has caught up, and so have those behind it.
    Flows {
        /// Who.
        object: ObjectName,
        /// Which incarnation.
        incarnation: Incarnation,
    },
    /// This object should give signs of life and gives none.
    Silent {
        /// Who.
        object: ObjectName,
        /// Which incarnation.
        incarnation: Incarnation,
        /// For how long, at least.
        silent_for: Duration,
    },
    /// An object that was silent gives signs of life again.
    Spoke {
        /// Who.
        object: ObjectName,
        /// Which incarnation.
        incarnation: Incarnation,
    },
    /// The watch itself was not scheduled for so long: every silence up to now is void.
    Stalled {
        /// For how long.
        gap: Duration,
    },
}
