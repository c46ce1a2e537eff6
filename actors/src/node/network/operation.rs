//! What an operator's node asks of the robot's other nodes, and orders there.

use crate::net::operator::{self, KeyStatus, OrderError};
use crate::node::Node;
use blastema_core::DeliveryError;
use std::time::Duration;

/// Operation of other nodes, by the right `operate`; with the feature `network`.
impl Node {
    /// Asks another node for the state of its keys: the roster that it uses, its fingerprint, and
    /// which of its networks are sealed. A node without keys serves no operator.
    ///
    /// # Errors
    /// There was no answer in time, or this node may not operate the other one.
    pub async fn key_status_of(
        &self,
        node: &str,
        within: Duration,
    ) -> Result<KeyStatus, DeliveryError> {
        operator::key_status(&self.0.environment.registry, node, within).await
    }

    /// Orders the node `to` to isolate `node`, as its program does by [`isolate`](Node::isolate).
    /// Its faults and its journal name this node and the reason, of which 160 bytes are kept. It stands
    /// until `to` [admits](Node::order_admission) the node.
    ///
    /// # Errors
    /// It was not carried out, or there was no answer in time.
    pub async fn order_isolation(
        &self,
        to: &str,
        node: &str,
        reason: &str,
        within: Duration,
    ) -> Result<(), OrderError> {
        let registry = &self.0.environment.registry;
        operator::order_isolation(registry, to, (node, true, reason), within).await
    }

    /// Orders the node `to` to admit `node` again.
    ///
    /// # Errors
    /// As [`order_isolation`](Node::order_isolation).
    pub async fn order_admission(
        &self,
        to: &str,
        node: &str,
        reason: &str,
        within: Duration,
    ) -> Result<(), OrderError> {
        let registry = &self.0.environment.registry;
        operator::order_isolation(registry, to, (node, false, reason), within).await
    }
}
