//! What other nodes may do with the objects of this one, and what they were refused.
//!
//! Without keys, everything is open.

use super::MessageMetadata;
use crate::platform::{self, lock};
use blastema_core::net::NodeId;
use blastema_core::net::trust::access::{AccessDenied, AccessPolicy, RefusalLog, RefusalRow};
use blastema_core::net::trust::policy::Verb;
use blastema_core::{DeliveryError, NodeName, ObjectName};
use std::sync::{Arc, Mutex, PoisonError, RwLock};
use std::time::Duration;
use tracing::warn;

/// The rights of other nodes at this one. Clones are the same.
#[derive(Clone, Default)]
pub(crate) struct AccessControl(Arc<Rights>);

#[derive(Default)]
struct Rights {
    policy: RwLock<Option<Arc<AccessPolicy>>>,
    log: Mutex<RefusalLog>,
}

/// Where a message comes from: an object of this node, or another node.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct MessageOrigin {
    pub(crate) peer: Option<NodeId>,
}

impl MessageOrigin {
    /// Whether that is another node.
    pub(crate) fn is_elsewhere(self) -> bool {
        self != MessageOrigin::default()
    }

    /// Whether an object of this name, such as `base:planner`, may have sent it.
    pub(crate) fn may_be(self, object: &str) -> bool {
        let node = object.split_once(':').and_then(|(node, _)| NodeName::new(node).ok());
        self.peer.is_none_or(|peer| node.is_some_and(|node| NodeId::of(&node) == peer))
    }
}

impl From<&MessageMetadata> for MessageOrigin {
    fn from(metadata: &MessageMetadata) -> Self {
        MessageOrigin { peer: metadata.from }
    }
}

/// What another node wanted to do here, and may not by the robot's roster.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct AccessRefusal {
    /// The node that was refused.
    pub node: NodeName,
    /// What it wanted: a verb of the policy, such as `lease`.
    pub verb: &'static str,
    /// At which object, as the policy names it: `base/wheels`; or which topic or name.
    pub object: String,
    /// By which contract; empty where there is none.
    pub contract: String,
    /// The line of the policy that gives it to others, from 1 on; `None` if the node's role
    /// does not have it.
    pub policy_line: Option<usize>,
    /// How often it was refused.
    pub times: u64,
    /// How long ago for the first time.
    pub first: Duration,
    /// How long ago for the last time.
    pub last: Duration,
}

impl AccessControl {
    /// Whether a message may do this at an object of this node, by this contract.
    ///
    /// # Errors
    /// [`DeliveryError::Forbidden`].
    pub(crate) fn check(
        &self,
        from: MessageOrigin,
        verb: Verb,
        object: &ObjectName,
        contract: impl FnOnce() -> String,
    ) -> Result<(), DeliveryError> {
        let (Some(peer), Some(policy)) = (from.peer, self.policy()) else { return Ok(()) };
        if policy.is_open(peer, verb) {
            return Ok(());
        }
        policy.check(peer, verb, &policy.object(object), &contract()).map_err(|denied| {
            let why = DeliveryError::from(&*denied);
            self.record(*denied);
            why
        })
    }

    /// Whether a node, this one or another, may serve under a name of the robot.
    pub(crate) fn may_claim(&self, node: &NodeName, name: &ObjectName) -> bool {
        self.policy().is_none_or(|policy| policy.may_claim(node, name))
    }

    /// A peer was refused something.
    pub(crate) fn record(&self, denied: AccessDenied) {
        let mut log = lock(&self.0.log);
        let Some(times) = log.handle_refused(denied.clone(), platform::now()) else { return };
        drop(log);
        let AccessDenied { peer, verb, object, contract, line, serial } = denied;
        warn!(
            target: "blastema::audit",
            node = %peer, %verb, object, contract, line, roster = serial, times,
            "refused: the node may not do this"
        );
    }

    /// From now on this policy counts.
    pub(crate) fn replace(&self, policy: AccessPolicy) {
        let policy = Some(Arc::new(policy));
        *self.0.policy.write().unwrap_or_else(PoisonError::into_inner) = policy;
    }

    /// The policy that counts.
    pub(crate) fn policy(&self) -> Option<Arc<AccessPolicy>> {
        self.0.policy.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The refusal of a program that was last, and when.
    pub(crate) fn newest_of_a_program(&self) -> Option<RefusalRow> {
        let log = lock(&self.0.log);
        log.rows().filter(|row| row.denied.is_of_a_program()).max_by_key(|row| row.last)
    }

    /// Nodes that were refused so much, or more, since this was asked last.
    pub(crate) fn take_floods(&self, least: u64) -> Vec<NodeName> {
        let mut log = lock(&self.0.log);
        log.take_floods(least)
    }

    /// What was refused, in the order of nodes.
    pub(crate) fn refusals(&self) -> Vec<AccessRefusal> {
        let now = platform::now();
        let log = lock(&self.0.log);
        let row = |row: RefusalRow| AccessRefusal {
            node: row.denied.peer,
            verb: row.denied.verb.word(),
            object: row.denied.object,
            contract: row.denied.contract,
            policy_line: row.denied.line,
            times: row.times,
            first: now - row.first,
            last: now - row.last,
        };
        log.rows().map(row).collect()
    }
}
