//! The monitor's table, as it is read.

use super::ObjectKind;
#[cfg(doc)]
use crate::FaultKind;
use crate::{FaultLocation, Incarnation, Lifecycle};
use std::fmt;
use std::time::Duration;

/// The state of one object, link or node, each value with its age.
///
/// A row is a picture of the moment in which it was read. Nothing in it is an instant, so that it
/// can be sent to another node, and nothing old in it looks current: see
/// [`last_sign`](MonitorRow::last_sign).
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct MonitorRow {
    /// The object, link or node of the row.
    pub location: FaultLocation,
    /// The kind of the object.
    pub kind: ObjectKind,
    /// Which incarnation everything else in the row is about; zero for a link.
    pub incarnation: Incarnation,
    /// Where it stands in its incarnation, as last reported; `None` for links, nodes and what has
    /// reported nothing yet.
    pub state: Option<Lifecycle>,
    /// The resource that it needs to become active: the reason that its hook gave for being
    /// [unavailable](FaultKind::Unavailable). The fault list has it too, as long.
    pub waiting_for: Option<String>,
    /// The monitor's opinion of it.
    pub opinion: Opinion,
    /// How long ago it last gave a sign of life of whatever sort; `None` for never in this
    /// incarnation, and for a node that has no link to here.
    ///
    /// Of a component that gives signs of life by itself, the last of them. Of any other, when its
    /// thread last showed that it turns, or, while a handler keeps that, when the handler began. Of
    /// a link, its last hello; of a node, the last hello on any link to it.
    pub last_sign: Option<Duration>,
    /// How many incarnations it has begun since it was registered, without the first.
    pub restarts: u32,
    /// How often it was suspect in this incarnation.
    pub suspicions: u32,
    /// Its queue as it was sampled last; `None` for what has no queue.
    pub queue: Option<QueueSample>,
    /// Rounds that it has missed in this incarnation: the next one was due, and it had not begun.
    /// Each that was due is run or missed. Ticks of its timers are counted likewise.
    pub missed_rounds: u64,
    /// How late its rounds have begun in this incarnation; `None` before the first.
    pub round_lateness: Option<RoundLateness>,
    /// The handler or hook that takes too long.
    pub current: Option<CurrentHandler>,
    /// Its sending and receiving is forbidden.
    pub isolated: bool,
    /// Why it is in error, has ended, or what it has declared; the `STATUS=` of a program at work;
    /// or a link's or node's condition. It goes when its cause does.
    pub note: Option<String>,
}

impl MonitorRow {
    /// A row of which nothing is known yet.
    #[doc(hidden)]
    pub fn blank(location: FaultLocation, kind: ObjectKind) -> Self {
        MonitorRow {
            location,
            kind,
            incarnation: Incarnation::default(),
            state: None,
            waiting_for: None,
            opinion: Opinion::Unheard,
            last_sign: None,
            restarts: 0,
            suspicions: 0,
            queue: None,
            missed_rounds: 0,
            round_lateness: None,
            current: None,
            isolated: false,
            note: None,
        }
    }
}

/// The monitor's opinion of an object.
///
/// | opinion | meaning | what follows |
/// | --- | --- | --- |
/// | unheard | never heard in this incarnation, and its start-up time is not over | nothing |
/// | trusted | its signs of life come | nothing |
/// | suspect | it waits behind another component that hangs | it is counted and shown |
/// | failed | it was overdue for longer than is tolerated, or its end was reported | a fault |
/// | stopped | its incarnation ended as it should | nothing |
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Opinion {
    /// No sign of life in this incarnation yet.
    Unheard,
    /// The object gives signs of life.
    Trusted,
    /// It waits behind another component that hangs; nothing is torn down yet.
    Suspect,
    /// The object has ended, or was silent for longer than is tolerated.
    Failed,
    /// The object was stopped; no sign of life is expected.
    Stopped,
}

impl fmt::Display for Opinion {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Opinion::Unheard => "unheard",
            Opinion::Trusted => "trusted",
            Opinion::Suspect => "suspect",
            Opinion::Failed => "failed",
            Opinion::Stopped => "stopped",
        })
    }
}

/// A queue, as it was when it was looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct QueueSample {
    /// How many messages waited.
    pub queued: usize,
    /// How long the oldest had waited by then.
    pub oldest: Duration,
    /// How long ago that was.
    pub age: Duration,
}

/// How long after they were due the rounds of a component have begun. Rounds that were missed have
/// not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RoundLateness {
    /// Half of them were no later; up to a quarter above the true value.
    pub p50: Duration,
    /// 99 of 100 were no later; up to a quarter above the true value.
    pub p99: Duration,
    /// The latest of them.
    pub max: Duration,
}

/// A handler that was seen to take long.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CurrentHandler {
    /// The contract or hook in service.
    pub during: &'static str,
    /// For how long it has been, at least.
    pub age: Duration,
}
