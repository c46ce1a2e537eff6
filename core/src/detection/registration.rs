//! What the monitor is told of an object, and how a component wants to be watched.

use crate::{Incarnation, ObjectAddress, ObjectName};
use serde::{Deserialize, Serialize};
use std::sync::Arc;
use std::time::Duration;

/// The registration of an object with the monitor.
///
/// ```
/// use blastema_core::ObjectName;
/// use blastema_core::detection::Registration;
///
/// let registration = Registration::new(ObjectName::new("laser")?)
///     .depends_on(["module1:power".parse()?]);
/// assert_eq!(registration.depends_on.len(), 1);
/// # Ok::<(), blastema_core::NameError>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct Registration {
    /// The name of the object.
    pub object: ObjectName,
    /// What kind of object it is.
    pub kind: ObjectKind,
    /// Which incarnation is about to begin, or lives already. Zero: its guard will report when its
    /// first incarnation begins, and nothing is expected of it before.
    pub incarnation: Incarnation,
    /// The objects, here or elsewhere, without which it cannot work: what it suffers while one of
    /// them is down is taken for a symptom.
    pub depends_on: Arc<[ObjectAddress]>,
    /// The object may end itself in order without a fault: a transient or temporary child.
    pub may_end: bool,
}

impl Registration {
    /// A component in its first incarnation that depends on nothing.
    pub fn new(object: ObjectName) -> Self {
        Registration {
            object,
            kind: ObjectKind::Component,
            incarnation: Incarnation::FIRST,
            depends_on: Arc::new([]),
            may_end: false,
        }
    }

    /// Sets what it cannot work without.
    #[must_use]
    pub fn depends_on(mut self, objects: impl IntoIterator<Item = ObjectAddress>) -> Self {
        self.depends_on = objects.into_iter().collect();
        self
    }
}

/// Why an object is not watched.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RegistrationError {
    /// Dismiss what is no longer needed, or raise the limit.
    #[error("{object} is not watched: the monitor's table already has {limit} rows")]
    TableFull {
        /// The object that was to be registered.
        object: ObjectName,
        /// How many rows there may be.
        limit: usize,
    },
}

/// The kind of object in a row of the monitor's table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum ObjectKind {
    /// An object of the application.
    Component,
    /// An object of the middleware itself.
    Middleware,
    /// A link to a neighbour.
    Link,
    /// Another node.
    Node,
}

/// How an object's signs of life come.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Liveness {
    /// Its guard reports its end, and the sampler its hangs. The object reports nothing itself.
    Guard,
    /// The object reports signs of life by itself.
    Push(Push),
    /// The object must finish something, or its thread must turn.
    Pull(Pull),
}

impl Liveness {
    /// A sign of life every `interval`; `tolerance` of them in a row may be lost.
    pub fn push(interval: Duration, tolerance: u32) -> Self {
        Liveness::Push(Push { interval, tolerance, ..Push::default() })
    }

    /// A question every `interval`, to be answered `within` that time.
    pub fn pull(interval: Duration, within: Duration) -> Self {
        Liveness::Pull(Pull { interval, within, ..Pull::default() })
    }
}

/// The push model: an object reports signs of life by itself.
///
/// ```text
///  beat            suspect                       failed
///   │───────┬────────│────────┬──────────────┬─────│──────►
///   0    interval   1½      2 (n)          3 (n)   tolerance + ½ intervals
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Push {
    /// How often a sign of life comes. Shorter finds silence sooner and costs more messages.
    pub interval: Duration,
    /// How many signs in a row may fail to come; at least 1. More gives fewer false alarms, and
    /// finds a real one later.
    pub tolerance: u32,
    /// How long a new incarnation may take until its first sign. Longer suits slow devices; an
    /// incarnation that never begins is noticed that much later.
    pub start_up: Duration,
}

impl Default for Push {
    fn default() -> Self {
        // The paper's interval; three lost in a row are tolerated and half an interval of lateness
        // (ITU-T G.8013); a component that loads a map takes a second or two to begin.
        let (interval, start_up) = (Duration::from_millis(100), Duration::from_secs(5));
        Push { interval, tolerance: 3, start_up }
    }
}

/// The pull model: an object is asked whether it is alive.
///
/// A component need not be disturbed for it: one that finishes anything, or lives on a thread that
/// turns, could answer. So a flooded one is alive, however long its queue; that its messages wait
/// is [an overload](crate::FaultKind::Overload), and another fact.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Pull {
    /// How often it is asked. There is never more than one open question.
    pub interval: Duration,
    /// Within which time it must answer; when it has passed, the object is suspect.
    pub within: Duration,
    /// After how many times [`within`](Pull::within) the suspect has failed; at least 1.
    pub tolerance: u32,
}

impl Default for Pull {
    fn default() -> Self {
        // An answer takes microseconds; one that takes as long as two intervals of the paper's is
        // no matter of load.
        Pull {
            interval: Duration::from_millis(100),
            within: Duration::from_millis(100),
            tolerance: 2,
        }
    }
}
