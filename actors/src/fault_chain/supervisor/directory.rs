//! Which supervisor keeps which object.

use super::SupervisorActor;
use crate::platform::lock;
use actix::Addr;
use blastema_core::sorted::SortedMap;
use blastema_core::{ObjectName, suggestion};
use std::sync::{Arc, Mutex, MutexGuard};

/// Kept by the supervisors themselves, read by the strategies; holds as many entries as the node
/// has supervised objects.
#[derive(Clone, Default)]
pub(crate) struct SupervisorDirectory(Arc<Mutex<Entries>>);

#[derive(Default)]
struct Entries {
    /// Of each object its supervisor's name: an address for each would be two allocations of actix.
    supervisor_of: SortedMap<ObjectName, ObjectName>,
    supervisors: SortedMap<ObjectName, Addr<SupervisorActor>>,
}

impl SupervisorDirectory {
    /// The supervisor `name` has come up and keeps `children`.
    pub(crate) fn enter<'a>(
        &self,
        name: &ObjectName,
        address: Addr<SupervisorActor>,
        children: impl Iterator<Item = &'a ObjectName>,
    ) {
        let mut entries = self.entries();
        entries.supervisors.insert(name.clone(), address);
        entries.supervisor_of.extend(children.map(|child| (child.clone(), name.clone())));
    }

    /// The supervisor `name` keeps one more child.
    pub(crate) fn add(&self, name: &ObjectName, child: ObjectName) {
        let mut entries = self.entries();
        if entries.supervisors.contains_key(name) {
            entries.supervisor_of.insert(child, name.clone());
        }
    }

    /// Removes a child that has no supervisor any more.
    pub(crate) fn remove(&self, child: &ObjectName) {
        self.entries().supervisor_of.remove(child);
    }

    /// The supervisor `name` ends, and none of its children has a supervisor any more.
    pub(crate) fn forget(&self, name: &ObjectName) {
        let mut entries = self.entries();
        entries.supervisors.remove(name);
        entries.supervisor_of.retain(|_, of| of != name);
    }

    /// An object and all below it: each supervisor before its children.
    pub(crate) fn subtree(&self, top: &ObjectName) -> Vec<ObjectName> {
        let entries = self.entries();
        let mut found = vec![top.clone()];
        let mut next = 0;
        while let Some(name) = found.get(next) {
            if let Some((name, _)) = entries.supervisors.get_key_value(name) {
                let below = entries.supervisor_of.iter().filter(|(_, of)| *of == name);
                found.extend(below.map(|(child, _)| child.clone()));
            }
            next += 1;
        }
        found
    }

    /// The supervisor of this object.
    pub(crate) fn supervisor_of(&self, object: &ObjectName) -> Option<Addr<SupervisorActor>> {
        let entries = self.entries();
        entries.supervisors.get(entries.supervisor_of.get(object)?).cloned()
    }

    /// The child whose name is spelt most like this one.
    pub(crate) fn nearest(&self, name: &str) -> Option<ObjectName> {
        let entries = self.entries();
        let nearest =
            suggestion::nearest(name, entries.supervisor_of.keys().map(ObjectName::as_str))?;
        entries.supervisor_of.get_key_value(nearest).map(|(name, _)| name.clone())
    }

    /// The supervisor whose name is spelt most like this one.
    pub(crate) fn nearest_supervisor(&self, name: &str) -> Option<ObjectName> {
        let entries = self.entries();
        let names = entries.supervisors.keys().map(ObjectName::as_str);
        let nearest = suggestion::nearest(name, names)?;
        entries.supervisors.get_key_value(nearest).map(|(name, _)| name.clone())
    }

    /// The supervisor of this name.
    pub(crate) fn supervisor(&self, name: &ObjectName) -> Option<Addr<SupervisorActor>> {
        self.entries().supervisors.get(name).cloned()
    }

    fn entries(&self) -> MutexGuard<'_, Entries> {
        // No change runs code that may panic: none is left half done.
        lock(&self.0)
    }
}
