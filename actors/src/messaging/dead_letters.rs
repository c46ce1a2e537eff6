//! The dead-letter log: undelivered messages, readable from every thread.

use crate::messaging::message_log;
use crate::platform::lock;
use blastema_core::delivery::dead_letters::{DeadLetterCount, DeadLetters, DeadReason};
use blastema_core::{DeliveryError, NodeName, ObjectName};
use std::borrow::Cow;
use std::fmt;
use std::sync::{Arc, Mutex};

/// A handle on a node's record of undelivered messages; clones share it.
#[derive(Clone, Default)]
pub struct DeadLetterLog(Arc<Mutex<DeadLetters>>);

impl fmt::Debug for DeadLetterLog {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} dead letters", self.total())
    }
}

impl DeadLetterLog {
    /// Takes note of one message to an object of this node that was not delivered.
    pub(crate) fn record(
        &self,
        object: &ObjectName,
        contract: impl Into<Cow<'static, str>>,
        why: &DeliveryError,
    ) {
        self.take_for(None, object, contract, why);
    }

    /// The same of one to an object of that node.
    pub(crate) fn take_for(
        &self,
        node: Option<NodeName>,
        object: &ObjectName,
        contract: impl Into<Cow<'static, str>>,
        why: &DeliveryError,
    ) {
        self.take_many(node, object, contract, why.into(), 1);
    }

    /// The same of so many, given up together.
    pub(crate) fn take_many(
        &self,
        node: Option<NodeName>,
        object: &ObjectName,
        contract: impl Into<Cow<'static, str>>,
        reason: DeadReason,
        many: u64,
    ) {
        let contract = contract.into();
        message_log::lost(&contract, object, reason, many);
        lock(&self.0).handle((node, object.clone(), contract, reason), many);
    }

    /// How many messages were not delivered.
    pub fn total(&self) -> u64 {
        lock(&self.0).total()
    }

    /// How many messages to objects of this name, on whichever node, were not delivered for this
    /// reason.
    pub fn count(&self, object: &ObjectName, reason: DeadReason) -> u64 {
        lock(&self.0).count(object, reason)
    }

    /// The counts, by node, object, contract and reason.
    pub fn counts(&self) -> Vec<DeadLetterCount> {
        lock(&self.0).counts().collect()
    }

    /// How many more there are that were counted together, because there were too many kinds.
    pub(crate) fn beyond(&self) -> u64 {
        lock(&self.0).beyond()
    }
}
