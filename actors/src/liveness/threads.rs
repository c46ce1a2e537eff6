//! The threads that components run on, for display.

use super::sampler::{ArbiterResidents, SampledComponents};
use crate::arbiter::pool::{ArbiterPool, ArbiterThread, ThreadKind};
use crate::platform;
use blastema_core::ObjectName;
use std::fmt;
use std::time::Duration;

/// A thread that components live on. The middleware's own threads stand in the table by the objects
/// that live there, each of which is asked whether it resident.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct ThreadRow {
    /// Which: counted through the lifetime of the process.
    pub number: u64,
    /// Which components may run on it.
    pub kind: ThreadKind,
    /// How it is.
    pub state: ThreadState,
    /// The share of about the last second, 0 to 1, in which a component was on it: running, or
    /// blocking it. From looks every 10 ms; `None` before the first, and once it is abandoned.
    pub busy: Option<f32>,
    /// How long ago its event loop last turned, to a hundredth of a second; `None` for never.
    pub last_beat: Option<Duration>,
    /// The component that is on it right now.
    pub running: Option<ObjectName>,
    /// How many messages wait for the components that live on it.
    pub queued: usize,
    /// The components that run on it, in alphabetical order.
    pub components: Vec<ObjectName>,
}

/// How a thread is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ThreadState {
    /// Its event loop turns.
    Alive,
    /// A handler has kept it for longer than it may.
    Blocked {
        /// The component whose handler blocks the thread.
        by: ObjectName,
        /// For how long it has, at least.
        age: Duration,
    },
    /// A handler kept the thread past its grace: its components run elsewhere. The thread ends if
    /// the handler returns.
    Abandoned {
        /// The component whose handler keeps the thread.
        by: ObjectName,
    },
}

impl fmt::Display for ThreadState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ThreadState::Alive => f.write_str("alive"),
            ThreadState::Blocked { by, age } => write!(f, "blocked by {by} for {age:.1?}"),
            ThreadState::Abandoned { by } => write!(f, "abandoned to {by}"),
        }
    }
}

/// All threads, in the order in which they were begun.
pub(crate) fn rows(arbiters: &ArbiterPool, list: &SampledComponents) -> Vec<ThreadRow> {
    let (mut residents, seen) = (list.residents(), list.seen());
    let mut threads = arbiters.threads();
    if arbiters.are_here() {
        let starter = |of: &ArbiterResidents| {
            let (kind, heartbeat) = (ThreadKind::Starter, of.heartbeat.clone());
            ArbiterThread { kind, heartbeat, lost_to: None }
        };
        threads = residents.values().map(starter).collect();
    }
    threads.sort_by_key(|thread| thread.heartbeat.id());
    let now = platform::now();
    let row = |ArbiterThread { kind, heartbeat, lost_to }: ArbiterThread| {
        let number = heartbeat.id();
        let seen = seen.get(&number);
        let mut resident =
            residents.remove(&number).unwrap_or_else(|| ArbiterResidents::none(&heartbeat));
        resident.components.sort();
        ThreadRow {
            number,
            kind,
            state: match (lost_to, seen.and_then(|seen| seen.hangs.clone())) {
                (Some(by), _) => ThreadState::Abandoned { by },
                (None, Some((by, since))) => ThreadState::Blocked { by, age: now - since },
                (None, None) => ThreadState::Alive,
            },
            busy: seen.and_then(|seen| seen.busy),
            last_beat: heartbeat.last_beat().map(|at| now - at),
            running: resident.running,
            queued: resident.components.iter().map(|(_, queued)| queued).sum(),
            components: resident.components.into_iter().map(|(name, _)| name).collect(),
        }
    };
    threads.into_iter().map(row).collect()
}
