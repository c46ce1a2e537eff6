//! The services that this node carries, and their primaries.

use crate::directory::DirectoryTable;
use crate::platform;
use blastema_core::directory::DirectoryKey;
use blastema_core::service::{ReplicaConfig, Role, ServiceState, ServiceView, StandbyKind};
use blastema_core::sorted::SortedMap;
use blastema_core::{Instant, NodeName, ObjectName};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// One service of this node.
struct CarriedEntry {
    members: Vec<NodeName>,
    kind: StandbyKind,
    /// The last view of its replica.
    view: ServiceView,
    at: Instant,
    /// Since when it has been in that state.
    since: Instant,
}

/// One service as seen by one node that carries it, for display.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ServiceRow {
    /// The name of the service.
    pub name: ObjectName,
    /// The state of this node as a member of the service.
    pub state: ServiceState,
    /// For how long it has been in that state.
    pub since: Duration,
    /// What its standbys do until they take over.
    pub kind: StandbyKind,
    /// The greatest epoch that had a primary, or in which this node voted, as far as it knows; 0
    /// for none.
    pub epoch: u64,
    /// The primary, if this node knows of one.
    pub primary: Option<NodeName>,
    /// All nodes that carry it, by this node's configuration.
    pub members: Vec<NodeName>,
    /// The members that this node cannot reach.
    pub missing_members: Vec<NodeName>,
    /// This node serves, and too few others hold the state: the fault *service unreplicated* names
    /// them and what to do.
    pub unreplicated: bool,
    /// The age of this view. The replica updates it when its role or a fault changes, and twice a
    /// second.
    pub age: Duration,
}

/// The services of a node. Clones share them.
#[derive(Clone)]
pub(crate) struct Roster {
    /// Bounded by the services that the node carries.
    services: Arc<Mutex<SortedMap<ObjectName, CarriedEntry>>>,
    directory: DirectoryTable,
}

impl Roster {
    pub(crate) fn new(directory: DirectoryTable) -> Self {
        Roster { services: Arc::default(), directory }
    }

    /// Adds a service that this node carries.
    pub(crate) fn enter(&self, name: ObjectName, config: &ReplicaConfig) {
        let (members, kind, at) = (config.members.clone(), config.kind, platform::now());
        let entry = CarriedEntry { members, kind, view: ServiceView::default(), at, since: at };
        platform::lock(&self.services).insert(name, entry);
    }

    /// Stores the view of this node's replica.
    pub(crate) fn show(&self, name: &ObjectName, view: ServiceView, at: Instant) {
        if let Some(entry) = platform::lock(&self.services).get_mut(name) {
            if entry.view.state != view.state {
                entry.since = at;
            }
            (entry.view, entry.at) = (view, at);
        }
    }

    /// Returns the services of this node with their last views.
    pub(crate) fn rows(&self) -> Vec<ServiceRow> {
        let now = platform::now();
        let services = platform::lock(&self.services);
        let row = |(name, CarriedEntry { members, kind, view, at, since }): (&ObjectName, &_)| {
            ServiceRow {
                name: name.clone(),
                state: view.state,
                since: now - *since,
                kind: *kind,
                epoch: view.epoch,
                primary: view.primary.clone(),
                members: members.clone(),
                missing_members: view.unreachable.clone(),
                unreplicated: view.unreplicated,
                age: now - *at,
            }
        };
        services.iter().map(row).collect()
    }

    /// Returns the role of this node's replica, if it has one.
    pub(crate) fn role(&self, name: &ObjectName) -> Option<Role> {
        platform::lock(&self.services).get(name).map(|entry| entry.view.role.clone())
    }

    /// Returns the nodes that carry the service: those of this node's configuration, which may be
    /// wrong, and those of the directory.
    pub(crate) fn members(&self, name: &ObjectName) -> Vec<NodeName> {
        let mut members = platform::lock(&self.services)
            .get(name)
            .map_or_else(Vec::new, |entry| entry.members.clone());
        members.extend(self.carriers(name));
        members
    }

    /// Returns the other nodes that have an object of the service's name, by the directory.
    pub(crate) fn carriers(&self, name: &ObjectName) -> Vec<NodeName> {
        self.directory.nodes_with(&DirectoryKey::Object(name.clone()))
    }
}
