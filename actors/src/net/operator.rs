//! What operators ask of other nodes, and order there: by the right `operate`.
//!
//! ```text
//!  operator ── ReadKeyStatus ────► net/keys of a node      its roster, its key, its networks
//!           ── OrderIsolation ───► net/orders              whether that node isolates a third
//!           ── ComponentOrder ───► net/components          its life cycles (node/order.rs)
//! ```
//!
//! The peer protocol checks the right when the contract is bound. A node without keys serves none
//! of this.

use super::keys::NodeKeys;
use crate::registry::Registry;
use crate::registry::access::{AccessControl, MessageOrigin};
use blastema_core::{DeliveryError, NodeName};
use blastema_macros::{Request, Structure};
use std::time::Duration;

/// Under which names nodes are asked. They are no objects that others can see.
const KEYS: &str = "net/keys";
pub(crate) const ISOLATION: &str = "net/orders";

/// Asks for the state of a node's keys.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/key-status", version = 1, reply = KeyStatus)]
struct ReadKeyStatus;

/// The keys of a node, as it says itself.
#[derive(Clone, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
#[non_exhaustive]
pub struct KeyStatus {
    /// The serial number of the roster that it uses.
    pub serial: u64,
    /// The fingerprint of its own keys, as `blastema keys show` prints it.
    pub fingerprint: String,
    /// Its networks, in the order of its description.
    pub networks: Vec<NetworkSeal>,
}

/// Whether a network of a node is sealed.
#[derive(Clone, Debug, PartialEq, Eq, Structure)]
#[contract(crate = "crate")]
#[non_exhaustive]
pub struct NetworkSeal {
    /// The network.
    pub network: String,
    /// Whether its frames are sealed. One within a process is not.
    pub sealed: bool,
}

/// Orders a node to isolate another one, or to admit it again.
#[derive(Clone, Debug, Request)]
#[contract(crate = "crate", name = "blastema/order-isolation", version = 1, reply = IsolationOrdered)]
pub(crate) struct OrderIsolation {
    pub(crate) node: String,
    pub(crate) isolated: bool,
    pub(crate) reason: String,
}

/// What came of it.
#[derive(Clone, Debug, Structure)]
#[contract(crate = "crate")]
pub(crate) struct IsolationOrdered {
    /// Why nothing was done.
    pub(crate) refused: Option<String>,
}

/// Why an order to another node was not carried out.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OrderError {
    /// It did not arrive, or there was no answer in time. [`DeliveryError::Forbidden`] says that
    /// this node has no right to operate the other.
    #[error(transparent)]
    Delivery(#[from] DeliveryError),
    /// The order is on the other node itself, or the other node knows no such node.
    #[error("{0}")]
    Refused(String),
}

/// Serves the operators of the robot.
pub(super) fn serve(registry: &Registry, keys: &NodeKeys, networks: Vec<NetworkSeal>) {
    let (access, fingerprint) = (registry.access(), keys.fingerprint());
    registry.serve_hidden::<ReadKeyStatus>(KEYS, move |_, _, answer| {
        let serial = access.policy().map_or(0, |policy| policy.serial());
        let (fingerprint, networks) = (fingerprint.clone(), networks.clone());
        answer.give(KeyStatus { serial, fingerprint, networks });
    });
}

/// The node that has sent it.
pub(crate) fn operator(access: &AccessControl, from: MessageOrigin) -> Option<NodeName> {
    access.policy()?.name_of(from.peer?).cloned()
}

/// Asks another node for the state of its keys.
pub(crate) async fn key_status(
    registry: &Registry,
    node: &str,
    within: Duration,
) -> Result<KeyStatus, DeliveryError> {
    let sender = registry.sender::<ReadKeyStatus>(&format!("{node}:{KEYS}"))?;
    sender.ask_within(ReadKeyStatus, within).await.map_err(|error| error.kind)
}

/// Orders another node to isolate a third one, or to admit it again.
pub(crate) async fn order_isolation(
    registry: &Registry,
    to: &str,
    node: &str,
    isolated: bool,
    reason: &str,
    within: Duration,
) -> Result<(), OrderError> {
    let order = OrderIsolation { node: node.to_owned(), isolated, reason: reason.to_owned() };
    let sender = registry.sender::<OrderIsolation>(&format!("{to}:{ISOLATION}"))?;
    let ordered = sender.ask_within(order, within).await.map_err(|error| error.kind)?;
    ordered.refused.map_or(Ok(()), |why| Err(OrderError::Refused(why)))
}
