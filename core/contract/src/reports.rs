//! What guards, components and the sampler tell the monitor.
//!
//! ```text
//! guard ──Exited, StateReported──►┐
//! component ──FaultDeclared──► Monitor ──► Detector ──► Notifier ──► Recoverer
//! sampler ──LivenessReported──────┘
//! ```

use actix::Message;
pub use blastema_core::detection::ExitReason;
use blastema_core::detection::hang::LivenessEvent;
use blastema_core::{FaultKind, Incarnation, Lifecycle, ObjectName};
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
    /// The object that ended.
    pub object: ObjectName,
    /// The incarnation that ended.
    pub incarnation: Incarnation,
    /// How it ended.
    pub exit: ExitReason,
    /// The guard has used its grant: this incarnation has begun in the old one's place.
    pub restarted_as: Option<Incarnation>,
}

/// A change of an object's state, told by its guard.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct StateReported {
    /// The object whose state changed.
    pub object: ObjectName,
    /// The incarnation that is in that state.
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
    /// The object that declares it.
    pub object: ObjectName,
    /// The incarnation in which the object found it.
    pub incarnation: Incarnation,
    /// The kind of the fault.
    pub kind: FaultKind,
    /// The fault's particulars, for display.
    pub detail: String,
    /// How long it stands after it was declared last; `None` where its end is declared.
    pub hold: Option<Duration>,
}

/// What an object had declared is over.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct DeclaredFaultCleared {
    /// The object that had declared it.
    pub object: ObjectName,
    /// The object's present incarnation.
    pub incarnation: Incarnation,
    /// The kind of the fault.
    pub kind: FaultKind,
}

/// What the sampler found when it looked at arbiters and components.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct LivenessReported(pub LivenessEvent);
