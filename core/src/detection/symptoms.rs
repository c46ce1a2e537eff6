//! What depends on what, and so: which fault is a symptom of which.

use super::Chronicle;
use crate::{Fault, FaultId, FaultKind, NodeName, ObjectAddress, ObjectName, Place};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The dependencies of this node's objects.
///
/// Declared ones lead from an object to objects, here or elsewhere. Two more are given by nature: what
/// is on another node needs that node, and a link needs the node at its other end. A cycle of
/// dependencies is allowed and harmless.
#[derive(Clone, Debug)]
pub(super) struct Dependencies {
    node: NodeName,
    declared: BTreeMap<ObjectName, Arc<[ObjectAddress]>>,
}

impl Dependencies {
    pub(super) fn new(node: NodeName) -> Self {
        Dependencies { node, declared: BTreeMap::new() }
    }

    pub(super) fn declare(&mut self, object: ObjectName, needs: Arc<[ObjectAddress]>) {
        if needs.is_empty() {
            self.declared.remove(&object);
        } else {
            self.declared.insert(object, needs);
        }
    }

    pub(super) fn forget(&mut self, object: &ObjectName) {
        self.declared.remove(object);
    }

    /// Everything without which `place` cannot work, directly or through others; not itself, unless it
    /// stands on a cycle.
    pub(super) fn needs_of(&self, place: &Place) -> BTreeSet<Place> {
        let mut found = BTreeSet::new();
        let mut open = vec![place.clone()];
        while let Some(next) = open.pop() {
            for need in self.direct_needs(&next) {
                if found.insert(need.clone()) {
                    open.push(need);
                }
            }
        }
        found
    }

    fn direct_needs(&self, place: &Place) -> Vec<Place> {
        match place {
            Place::Object(address) if address.node == self.node => {
                let declared = self.declared.get(&address.object);
                declared
                    .into_iter()
                    .flat_map(|needs| needs.iter().cloned())
                    .map(Place::Object)
                    .collect()
            }
            Place::Object(address) => vec![Place::Node(address.node.clone())],
            Place::Link { neighbour: Some(node), .. } => vec![Place::Node(node.clone())],
            Place::Link { neighbour: None, .. } | Place::Node(_) => Vec::new(),
        }
    }

    /// The root of what a fault at `place` would be a symptom of: of everything needed that is down,
    /// what was found first.
    pub(super) fn root_above(&self, place: &Place, chronicle: &Chronicle) -> Option<FaultId> {
        let needs = self.needs_of(place);
        let down = needs.iter().flat_map(|need| chronicle.standing_at(need)).filter(|f| is_down(f));
        down.filter(|fault| fault.place != *place).map(|fault| chronicle.root(fault.id)).min()
    }
}

/// Whether a place with this fault no longer serves those that depend on it.
pub(super) fn is_down(fault: &Fault) -> bool {
    match fault.kind {
        FaultKind::Panic
        | FaultKind::UnexpectedExit
        | FaultKind::Hang
        | FaultKind::Silence
        | FaultKind::ErrorState
        | FaultKind::InitializationFailed
        | FaultKind::Fatal
        | FaultKind::LinkDown
        | FaultKind::NodeLost
        | FaultKind::RestartStorm => true,
        FaultKind::CheckFailed
        | FaultKind::Overload
        | FaultKind::ContractMismatch
        | FaultKind::LinkDegraded
        | FaultKind::Custom(_) => false,
    }
}
