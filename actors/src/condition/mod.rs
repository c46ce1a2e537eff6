//! Conditions: is it still connected, and well enough?
//!
//! ```text
//!  topics, leases, links, sessions ─ readings ─► Conditions ─ machine ─► Condition: state, cause
//!  other nodes ◄─ echo, twice a second ──┘           └─ changes ─► faults of conditions/NAME
//! ```
//!
//! What stands is measured once: a topic by the events that arrive, a lease by its renewals, a link
//! by its hellos. Only the round trip to a node is asked for, and only where a latency is limited.

mod echo;
pub(crate) mod heartbeat;
mod source;
mod spec;
mod table;

pub use heartbeat::Heartbeat;
pub(crate) use source::ConditionWiring;
pub use spec::Connected;
#[cfg(feature = "trees")]
pub(crate) use table::ConditionUse;
pub(crate) use table::Conditions;

use crate::actuator::Commander;
use blastema_core::connection::ConditionState;
use blastema_core::{Contract, DeliveryError, Instant, NameError, ObjectName};
use std::fmt;
use std::sync::Arc;
use tokio::sync::watch;

/// How a condition is, and why.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ConditionStatus {
    /// How it is.
    pub state: ConditionState,
    /// When the state last changed.
    pub since: Instant,
    /// Which channels keep it from being connected, or all of them where it is, with the figures.
    pub cause: String,
}

/// A condition of a node: whether something is connected. From
/// [`Node::condition`](crate::Node::condition) and
/// [`Context::condition`](crate::Context::condition). Clones are the same condition.
///
/// ```
/// use blastema::prelude::*;
/// use blastema::{ConditionState, Connected};
/// use std::time::Duration;
///
/// # blastema::run(async {
/// let node = Node::builder("rover").start().await?;
/// let operator = node.condition("operator", Connected::heartbeat("operator/beat"))?;
/// assert!(!operator.is_connected()); // never heard
///
/// let beats = node.heartbeat("operator/beat", Duration::from_millis(100))?;
/// operator.connected().await;
/// drop(beats);
/// let mut changes = operator.changes();
/// assert_eq!(changes.next().await.unwrap().state, ConditionState::Lost); // 3 s later
/// # node.shutdown().await;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// # })?;
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone)]
pub struct Condition {
    name: Arc<str>,
    /// Until the node ends.
    pub(crate) status: watch::Receiver<ConditionStatus>,
}

impl fmt::Debug for Condition {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Condition {}, {}", self.name, self.state())
    }
}

/// Why a condition is not declared.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConditionError {
    /// The name of the condition does not parse.
    #[error("condition {condition:?}: {error}")]
    Name {
        /// The name that was given.
        condition: String,
        /// What is wrong with the name.
        error: NameError,
    },
    /// A condition of this name needs something else. Give one of them another name.
    #[error("condition {condition:?} is declared already, and needs something else: rename one")]
    Taken {
        /// The name that both conditions have.
        condition: String,
    },
    /// A name does not parse, a topic carries another contract, a number makes no sense, the node
    /// has too many conditions or has ended.
    #[error("condition {condition:?}: {reason}")]
    Refused {
        /// The name of the refused condition.
        condition: String,
        /// The channel that is wrong, by its place, from 0, and the setting of it, such as
        /// `max_loss`; empty for the channel itself.
        place: Option<(usize, &'static str)>,
        /// What is wrong, and what to write.
        reason: String,
    },
}

impl Condition {
    /// The name of the condition.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// How the condition is. It is lost once the node has ended.
    pub fn state(&self) -> ConditionState {
        let known = self.status.has_changed().map(|_| self.status.borrow().state);
        known.unwrap_or(ConditionState::Lost)
    }

    /// Whether what the condition needs is there, also beyond its limits.
    pub fn is_connected(&self) -> bool {
        self.state() != ConditionState::Lost
    }

    /// Whether what the condition needs is there, within all limits.
    pub fn is_acceptable(&self) -> bool {
        self.state() == ConditionState::Connected
    }

    /// How the condition is, since when, and why, with the figures of the last 50 ms.
    pub fn status(&self) -> ConditionStatus {
        self.status.borrow().clone()
    }

    /// Waits until what the condition needs is there, also beyond its limits.
    pub async fn connected(&self) {
        self.reached(|state| state != ConditionState::Lost).await;
    }

    /// Waits until what the condition needs is there, within all limits.
    pub async fn acceptable(&self) {
        self.reached(|state| state == ConditionState::Connected).await;
    }

    /// Waits until the condition is lost. A condition that was never connected is lost.
    pub async fn lost(&self) {
        let mut status = self.status.clone();
        // It is lost as well if its node has ended.
        let _ = status.wait_for(|status| status.state == ConditionState::Lost).await;
    }

    async fn reached(&self, wanted: impl Fn(ConditionState) -> bool) {
        if self.status.clone().wait_for(|status| wanted(status.state)).await.is_err() {
            // Its node has ended: it is never reached.
            std::future::pending::<()>().await;
        }
    }

    /// Follows the changes of the condition, from now on.
    pub fn changes(&self) -> ConditionChanges {
        let mut status = self.status.clone();
        let last = status.borrow_and_update().state;
        ConditionChanges { status, last }
    }
}

/// The changes of one condition: lost, restored, degraded. From [`Condition::changes`].
#[derive(Debug)]
pub struct ConditionChanges {
    status: watch::Receiver<ConditionStatus>,
    last: ConditionState,
}

impl ConditionChanges {
    /// Waits for the next change and returns what it led to. Of several changes since the last call
    /// the last is returned. `None` once the node has ended.
    pub async fn next(&mut self) -> Option<ConditionStatus> {
        let last = self.last;
        let status = self.status.wait_for(|status| status.state != last).await.ok()?.clone();
        self.last = status.state;
        Some(status)
    }
}

impl<M: Contract> Commander<M> {
    /// Lets this commander hold its lease only while the condition is connected: claims and
    /// commands are refused otherwise, and a lease that it holds is given back within a quarter of
    /// its span.
    pub fn only_while(&self, condition: &Condition) {
        let condition = condition.clone();
        self.guard(Arc::new(move || match condition.is_connected() {
            true => Ok(()),
            false => {
                let (name, cause) = (condition.name(), condition.status().cause);
                let reason = format!("the condition {name} does not hold: {cause}");
                Err(DeliveryError::CheckFailed { reason })
            }
        }));
    }
}

/// The object that the faults of a condition are found in.
pub(crate) fn object_of(condition: &str) -> Result<ObjectName, ConditionError> {
    ObjectName::new(&format!("conditions/{condition}"))
        .map_err(|error| ConditionError::Name { condition: condition.to_owned(), error })
}
