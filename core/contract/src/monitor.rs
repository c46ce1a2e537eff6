//! What others may say to, and ask of, the monitor.
//!
//! ```text
//! node ── Register, Unregister, NodeEnding ──────┐
//! link, router ── LinkReported, NodeReported ────┼──► Monitor
//! supervisor ── IsolationReported ───────────────┤
//! any actor ── ReadTable ────────────────────────┘
//! ```
//! What guards, components and the watch thread tell it stands in [`reports`](crate::reports).

use crate::Confirmed;
use crate::reports::AreYouAlive;
use actix::{Message, Recipient};
use blastema_core::detection::{
    LinkCondition, MonitorRow, NodeCondition, Registration, RegistrationError,
};
use blastema_core::{Incarnation, NodeName, ObjectName};
use std::sync::Arc;

/// Watches an object from now on. Sent again for a known object, it changes how that is watched.
#[derive(Clone, Message)]
#[rtype(result = "Result<Confirmed, RegistrationError>")]
pub struct Register {
    /// The object, and how it is watched.
    pub registration: Registration,
    /// Where it answers the monitor's questions; `None` for one that is not asked.
    pub pings: Option<Recipient<AreYouAlive>>,
}

/// Forgets an object; what it still says is not listened to.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct Unregister {
    /// The object to forget.
    pub object: ObjectName,
}

/// Asks for the table of everything that is watched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<MonitorRow>")]
pub struct ReadTable;

/// This node ends: what goes away from now on goes with it, and is no fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct NodeEnding;

/// An object's sending and receiving was forbidden, or allowed again.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct IsolationReported {
    /// The object that was isolated or admitted.
    pub object: ObjectName,
    /// Whether it is isolated now.
    pub isolated: bool,
}

/// A link changed, told by the link or its router.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct LinkReported {
    /// The node that sees it.
    pub node: NodeName,
    /// The link's name in that node's configuration: one name, one link, one neighbour.
    pub link: Arc<str>,
    /// Who is at its other end, once known.
    pub neighbour: Option<NodeName>,
    /// How it is now.
    pub condition: LinkCondition,
}

/// Another node changed, told by the router.
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "()")]
pub struct NodeReported {
    /// The node that changed.
    pub node: NodeName,
    /// Its incarnation, as last heard.
    pub incarnation: Incarnation,
    /// How it is now.
    pub condition: NodeCondition,
}
