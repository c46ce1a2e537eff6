//! Which services this node carries, and who serves them.

use crate::directory::DirectoryTable;
use crate::platform;
use blastema_core::directory::DirectoryKey;
use blastema_core::service::{ReplicaConfig, Role, ServiceState, ServiceView, StandbyKind};
use blastema_core::sorted::SortedMap;
use blastema_core::{Instant, NodeName, ObjectName};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// What is known of one service.
struct Entry {
    members: Vec<NodeName>,
    kind: StandbyKind,
    role: Role,
    shown: Option<Shown>,
}

/// What its replica has shown of itself last.
struct Shown {
    view: ServiceView,
    at: Instant,
    /// Since when it is in that state.
    since: Instant,
}

/// A service as a node that carries it sees it, for people.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ServiceRow {
    /// The service.
    pub name: ObjectName,
    /// What this node is to it.
    pub state: ServiceState,
    /// For how long it has been that.
    pub since: Duration,
    /// What its standbys do.
    pub kind: StandbyKind,
    /// The greatest epoch in which somebody served, or was voted for, as far as this node knows; 0
    /// for none.
    pub epoch: u64,
    /// Who serves, where this node knows of anybody.
    pub primary: Option<NodeName>,
    /// All nodes that carry it, as this one was told.
    pub members: Vec<NodeName>,
    /// Those of them that are not there with this service, as far as this node sees.
    pub missing_members: Vec<NodeName>,
    /// This node serves, and too few others hold the state: the fault *service unreplicated* says
    /// whom to look after.
    pub unreplicated: bool,
    /// How long ago the replica has said so: it does when its role or a fault changes, and twice a
    /// second.
    pub age: Duration,
}

/// The services of a node. Clones share them.
#[derive(Clone)]
pub(crate) struct Roster {
    /// As many as the node carries.
    services: Arc<Mutex<SortedMap<ObjectName, Entry>>>,
    directory: DirectoryTable,
}

impl Roster {
    pub(crate) fn new(directory: DirectoryTable) -> Self {
        Roster { services: Arc::default(), directory }
    }

    fn lock(&self) -> MutexGuard<'_, SortedMap<ObjectName, Entry>> {
        self.services.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// This node carries a service.
    pub(crate) fn enter(&self, name: ObjectName, config: &ReplicaConfig) {
        let role = Role::Standby { primary: None, in_step: false };
        let (members, kind) = (config.members.clone(), config.kind);
        self.lock().insert(name, Entry { members, kind, role, shown: None });
    }

    /// This node's replica shows itself.
    pub(crate) fn show(&self, name: &ObjectName, view: ServiceView, at: Instant) {
        if let Some(entry) = self.lock().get_mut(name) {
            let before = entry.shown.as_ref().filter(|shown| shown.view.state == view.state);
            let since = before.map_or(at, |shown| shown.since);
            entry.shown = Some(Shown { view, at, since });
        }
    }

    /// The services of this node, as their replicas have shown themselves.
    pub(crate) fn rows(&self) -> Vec<ServiceRow> {
        let now = platform::now();
        let services = self.lock();
        let rows = services.iter().filter_map(|(name, entry)| {
            let Shown { view, at, since } = entry.shown.as_ref()?;
            Some(ServiceRow {
                name: name.clone(),
                state: view.state,
                since: now - *since,
                kind: entry.kind,
                epoch: view.epoch,
                primary: view.primary.clone(),
                members: entry.members.clone(),
                missing_members: view.unheard.clone(),
                unreplicated: view.unprotected,
                age: now - *at,
            })
        });
        rows.collect()
    }

    /// The role of this node's replica has changed.
    pub(crate) fn note(&self, name: &ObjectName, role: Role) {
        if let Some(entry) = self.lock().get_mut(name) {
            entry.role = role;
        }
    }

    /// The role of this node's replica, if it has one.
    pub(crate) fn role(&self, name: &ObjectName) -> Option<Role> {
        self.lock().get(name).map(|entry| entry.role.clone())
    }

    /// Who serves, as far as this node's replica knows.
    pub(crate) fn primary(&self, name: &ObjectName, own: &NodeName) -> Option<NodeName> {
        match &self.lock().get(name)?.role {
            Role::Primary { .. } => Some(own.clone()),
            Role::Standby { primary, .. } => primary.clone(),
        }
    }

    /// The nodes that carry the service: as declared here, and as others say. What was declared
    /// here may be wrong.
    pub(crate) fn members(&self, name: &ObjectName) -> Vec<NodeName> {
        let mut members =
            self.lock().get(name).map_or_else(Vec::new, |entry| entry.members.clone());
        members.extend(self.carriers(name));
        members
    }

    /// The other nodes that have an object of the service's name, whatever was declared.
    pub(crate) fn carriers(&self, name: &ObjectName) -> Vec<NodeName> {
        self.directory.nodes_with(&DirectoryKey::Object(name.clone()))
    }
}
