//! Conditions of a node, and what runs only while one holds.

use super::{Node, NodeState, Shared};
use crate::component::Component;
use crate::component::spec_error::SpecError;
use crate::condition::heartbeat;
use crate::condition::{Condition, ConditionError, ConditionStatus, Connected, Heartbeat};
use crate::host::spec::ChildSpec;
use crate::platform;
use blastema_core::DeliveryError;
use blastema_core::connection::ConditionState;
use std::sync::{Arc, OnceLock, Weak};
use std::time::Duration;
use tokio::sync::watch;
use tracing::warn;

/// How often it is tried again to add a component that was refused.
const ADD_INTERVAL: Duration = Duration::from_secs(1);

/// The node, from when it is put together until it is dropped.
pub(super) type NodeSlot = Arc<OnceLock<Weak<Shared>>>;

/// Publishes heartbeats for as long as it exists. From [`Node::heartbeat`].
#[derive(Debug)]
#[must_use = "the heartbeats end when this is dropped"]
pub struct Heartbeats(actix_rt::task::JoinHandle<()>);

impl Drop for Heartbeats {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl Node {
    /// Returns the condition of this name, which needs this; declares it if it is new. It is looked
    /// at until the node ends. Its changes are faults of `conditions/NAME`:
    /// [`ConnectionLost`](crate::FaultKind::ConnectionLost), and
    /// [`CheckFailed`](crate::FaultKind::CheckFailed) while it is degraded.
    ///
    /// # Errors
    /// [`ConditionError`] says what to write instead.
    pub fn condition(&self, name: &str, needs: Connected) -> Result<Condition, ConditionError> {
        self.0.environment.conditions().declare(name, &needs, platform::now(), None)
    }

    /// Publishes a [`Heartbeat`] on this topic every `interval`, 10 ms to an hour, for as long as
    /// this thread turns and what is returned exists. A component does so by
    /// [`Context::heartbeat`](crate::Context::heartbeat), as long as it lives itself.
    ///
    /// # Errors
    /// As [`publisher`](Self::publisher), and [`DeliveryError::CheckFailed`] for an interval out of
    /// range.
    #[track_caller]
    pub fn heartbeat(&self, topic: &str, interval: Duration) -> Result<Heartbeats, DeliveryError> {
        let publisher = self.publisher::<Heartbeat>(topic)?;
        Ok(Heartbeats(actix_rt::spawn(heartbeat::publish(publisher, interval)?)))
    }

    /// Runs a component under the root supervisor only while the condition is
    /// [acceptable](Condition::is_acceptable): it is [added](Self::add_child) whenever the condition
    /// becomes so, and [removed](Self::remove_child) in order when it is no longer. Returns once it
    /// runs for the first time, or cannot be added at all; await it in a task of its own where the
    /// condition may take long. Connections of its ports are made again whenever it is added.
    ///
    /// # Errors
    /// As [`add_child`](Self::add_child), for the first time. A later one is logged, and it is
    /// tried again every second while the condition holds.
    pub async fn add_child_while<C: Component>(
        &self,
        condition: &Condition,
        spec: impl Fn() -> ChildSpec<C> + 'static,
    ) -> Result<(), SpecError> {
        condition.acceptable().await;
        let name = self.add_child(spec()).await?.name().to_string();
        self.0.environment.registry.keep_connections(&name);
        let (node, status) =
            (Arc::new(OnceLock::from(Arc::downgrade(&self.0))), condition.status.clone());
        let holds = |status: &ConditionStatus| status.state == ConditionState::Connected;
        actix_rt::spawn(keep_while(node, status, holds, (Some(name), spec)));
        Ok(())
    }
}

/// Adds a component of the node whenever this holds, and removes it, whose name is given while it
/// runs, when it does no longer.
pub(super) async fn keep_while<C: Component, S>(
    node: NodeSlot,
    mut status: watch::Receiver<S>,
    holds: impl Fn(&S) -> bool,
    (mut running, spec): (Option<String>, impl Fn() -> ChildSpec<C>),
) {
    loop {
        let wanted = holds(&status.borrow_and_update());
        if wanted != running.is_some() {
            // A rung may be due before its node is put together, and waits for it.
            let present = node.get().map(|node| node.upgrade().map(Node));
            let done = match (present, running.take()) {
                (None, _) => Ok(None),
                (Some(None), _) => return,
                (Some(Some(node)), _) if node.state() == NodeState::Stopped => return,
                (Some(Some(node)), Some(name)) => {
                    node.remove_child(&name).await.map(|()| None).map_err(|why| why.to_string())
                }
                (Some(Some(node)), None) => {
                    let added = node.add_child(spec()).await;
                    added.map(|child| Some(child.name().to_string())).map_err(|w| w.to_string())
                }
            };
            match done {
                Ok(name) => running = name,
                Err(why) => warn!(why, wanted, "a component is not added or removed"),
            }
        }
        let retry = if wanted == running.is_some() { Duration::MAX } else { ADD_INTERVAL };
        if let Ok(Err(_)) = tokio::time::timeout(retry, status.changed()).await {
            return;
        }
    }
}
