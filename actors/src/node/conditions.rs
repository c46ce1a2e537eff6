//! Conditions of a node, and what runs only while one holds.

use super::{Node, NodeState, Shared};
use crate::component::Component;
use crate::host::spec::ChildSpec;
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
pub struct Heartbeats(pub(super) actix_rt::task::JoinHandle<()>);

impl Drop for Heartbeats {
    fn drop(&mut self) {
        self.0.abort();
    }
}

/// Adds a component of the node whenever this holds, and removes it, whose name is given while it
/// runs, when it does no longer.
pub(super) async fn keep_while<C: Component, S>(
    node: NodeSlot,
    mut status: watch::Receiver<S>,
    holds: impl Fn(&S) -> bool,
    mut running: Option<String>,
    spec: impl Fn() -> ChildSpec<C>,
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
