//! Conditions of a node, and what runs only while one holds.

use super::{Node, Shared};
use crate::component::Component;
use crate::component::spec_error::SpecError;
use crate::condition::heartbeat;
use crate::condition::{Condition, ConditionError, Connected, Heartbeat};
use crate::host::spec::ChildSpec;
use crate::platform;
use crate::settings::HEARTBEAT_INTERVAL;
use blastema_core::DeliveryError;
use std::sync::{Arc, Weak};
use std::time::Duration;
use tracing::warn;

/// Publishes heartbeats for as long as it exists. From [`Node::heartbeat`].
#[derive(Debug)]
#[must_use = "the heartbeats end when this is dropped"]
pub struct Heartbeats(#[expect(dead_code, reason = "it ends when it is dropped")] OwnedTask);

/// A task of this thread, which ends when this is dropped.
#[derive(Debug)]
pub(super) struct OwnedTask(actix_rt::task::JoinHandle<()>);

impl OwnedTask {
    pub(super) fn spawn(work: impl Future<Output = ()> + 'static) -> Self {
        OwnedTask(actix_rt::spawn(work))
    }
}

impl Drop for OwnedTask {
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
        self.0.environment.conditions().declare(name, &needs, platform::now())
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
        HEARTBEAT_INTERVAL.check(interval).map_err(|error| DeliveryError::CheckFailed {
            reason: format!("{} {}: {}", error.setting, error.value, error.cure),
        })?;
        let publisher = self.publisher::<Heartbeat>(topic)?;
        Ok(Heartbeats(OwnedTask::spawn(heartbeat::publish(publisher, interval))))
    }

    /// Runs a component under the root supervisor only while the condition is
    /// [acceptable](Condition::is_acceptable): it is [added](Self::add_child) whenever the condition
    /// becomes so, and [removed](Self::remove_child) in order when it is no longer. Returns once it
    /// runs for the first time, or cannot be added at all; await it in a task of its own where the
    /// condition may take long.
    ///
    /// # Errors
    /// As [`add_child`](Self::add_child), for the first time. A later one is logged, and the
    /// component is added again when the condition holds the next time.
    pub async fn add_child_while<C: Component>(
        &self,
        condition: &Condition,
        spec: impl Fn() -> ChildSpec<C> + 'static,
    ) -> Result<(), SpecError> {
        condition.acceptable().await;
        let name = self.add_child(spec()).await?.name().to_string();
        let (node, condition) = (Arc::downgrade(&self.0), condition.clone());
        actix_rt::spawn(async move { keep_while(node, condition, name, spec).await });
        Ok(())
    }
}

/// Removes the component when the condition ends, and adds it again when it holds.
async fn keep_while<C: Component>(
    node: Weak<Shared>,
    condition: Condition,
    name: String,
    spec: impl Fn() -> ChildSpec<C>,
) {
    let mut changes = condition.changes();
    let mut runs = true;
    loop {
        if runs != condition.is_acceptable() {
            let Some(node) = node.upgrade().map(Node) else { return };
            let done = match runs {
                true => node.remove_child(&name).await.map_err(|why| why.to_string()),
                false => node.add_child(spec()).await.map(|_| ()).map_err(|why| why.to_string()),
            };
            match done {
                Ok(()) => {}
                Err(why) => warn!(name, condition = condition.name(), why, "the child is left"),
            }
            runs = !runs;
        } else if changes.next().await.is_none() {
            return;
        }
    }
}
