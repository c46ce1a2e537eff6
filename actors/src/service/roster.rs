//! Which services this node carries, and who serves them.

use actix::Recipient;
use blastema_contract::naming::FindObject;
use blastema_core::service::Role;
use blastema_core::{NodeName, ObjectName};
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};

/// What is known of one service.
struct Entry {
    members: Vec<NodeName>,
    role: Role,
}

/// The services of a node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Roster {
    /// As many as the node carries.
    services: Arc<Mutex<BTreeMap<ObjectName, Entry>>>,
    finder: Arc<OnceLock<Recipient<FindObject>>>,
}

impl Roster {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<ObjectName, Entry>> {
        self.services.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Objects of other nodes are found there.
    pub(crate) fn find_by(&self, finder: Recipient<FindObject>) {
        // A node has one network, or none.
        let _ = self.finder.set(finder);
    }

    /// This node carries a service.
    pub(crate) fn enter(&self, name: ObjectName, members: Vec<NodeName>) {
        let role = Role::Standby { primary: None, in_step: false };
        self.lock().insert(name, Entry { members, role });
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

    /// The nodes that carry the service: as declared here, and as others say. What was declared here may be
    /// wrong.
    pub(crate) async fn members(&self, name: &ObjectName) -> Vec<NodeName> {
        let mut members =
            self.lock().get(name).map_or_else(Vec::new, |entry| entry.members.clone());
        members.extend(self.carriers(name).await);
        members
    }

    /// The other nodes that have an object of the service's name, whatever was declared.
    pub(crate) async fn carriers(&self, name: &ObjectName) -> Vec<NodeName> {
        let Some(finder) = self.finder.get() else { return Vec::new() };
        let found = finder.send(FindObject { object: name.clone() }).await.unwrap_or_default();
        found.into_iter().map(|address| address.node).collect()
    }
}
