//! What anyone may ask about the objects of other nodes.

use actix::Message;
use blastema_core::{Incarnation, NodeName, ObjectAddress, ObjectName};
use std::collections::BTreeMap;

/// Where are objects of this name?
#[derive(Clone, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<FoundObject>")]
pub struct FindObject {
    /// The name.
    pub object: ObjectName,
}

/// An object on a node that a session is open with.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FoundObject {
    /// Where it is.
    pub address: ObjectAddress,
    /// A path leads there now: a session outlives its paths.
    pub reachable: bool,
}

/// Asks for every node that a session is open with, and its objects.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "Vec<NodeRow>")]
pub struct ReadNames;

/// Which contracts do nodes not mean alike?
#[derive(Clone, Copy, Debug, PartialEq, Eq, Message)]
#[rtype(result = "BTreeMap<NodeName, Vec<String>>")]
pub struct ReadDifferences;

/// One node, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeRow {
    /// Which.
    pub node: NodeName,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// What it has.
    pub objects: Vec<ObjectAddress>,
}
