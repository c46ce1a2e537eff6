//! What depends on what, and so: which fault is a symptom of which.

use super::FaultLog;
use crate::sorted::SortedMap;
use crate::{FaultId, FaultLocation, NodeName, ObjectAddress, ObjectName};
use std::collections::BTreeSet;
use std::sync::Arc;

/// The dependencies of this node's objects.
///
/// Declared ones lead from an object to objects, here or elsewhere. Two more are given by nature:
/// what is on another node needs that node, and a link needs the node at its other end. A cycle of
/// dependencies is allowed and harmless.
#[derive(Clone, Debug)]
pub(super) struct DependencyIndex {
    node: NodeName,
    needs: SortedMap<ObjectName, Arc<[ObjectAddress]>>,
}

impl DependencyIndex {
    pub(super) fn new(node: NodeName) -> Self {
        DependencyIndex { node, needs: SortedMap::new() }
    }

    /// Says what an object needs, in place of what was said before.
    pub(super) fn declare(&mut self, object: &ObjectName, needs: Arc<[ObjectAddress]>) {
        match needs.is_empty() {
            true => self.forget(object),
            false => drop(self.needs.insert(object.clone(), needs)),
        }
    }

    pub(super) fn forget(&mut self, object: &ObjectName) {
        self.needs.remove(object);
    }

    /// Everything without which `location` cannot work, directly or through others; not itself,
    /// unless it stands on a cycle.
    pub(super) fn needs_of(&self, location: &FaultLocation) -> BTreeSet<FaultLocation> {
        let mut found = BTreeSet::new();
        let mut open = vec![location.clone()];
        while let Some(next) = open.pop() {
            for need in self.direct_needs(&next) {
                if found.insert(need.clone()) {
                    open.push(need);
                }
            }
        }
        found
    }

    fn direct_needs(&self, location: &FaultLocation) -> Vec<FaultLocation> {
        match location {
            FaultLocation::Object(address) if address.node == self.node => {
                let needs = self.needs.get(&address.object);
                needs
                    .into_iter()
                    .flat_map(|needs| needs.iter().cloned())
                    .map(FaultLocation::Object)
                    .collect()
            }
            FaultLocation::Object(address) => vec![FaultLocation::Node(address.node.clone())],
            FaultLocation::Link { neighbour: Some(node), .. } => {
                vec![FaultLocation::Node(node.clone())]
            }
            FaultLocation::Link { neighbour: None, .. } | FaultLocation::Node(_) => Vec::new(),
        }
    }

    /// The root of what a fault at `location` would be a symptom of: of everything needed that is
    /// down, what was found first.
    pub(super) fn root_above(
        &self,
        location: &FaultLocation,
        fault_log: &FaultLog,
    ) -> Option<FaultId> {
        let needs = self.needs_of(location);
        let down = needs
            .iter()
            .flat_map(|need| fault_log.open_faults_at(need))
            .filter(|f| f.kind.is_down());
        down.filter(|fault| fault.location != *location).map(|fault| fault_log.root(fault.id)).min()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::node;

    fn here(name: &str) -> ObjectAddress {
        ObjectAddress::new(node("m"), ObjectName::new(name).expect("a name"))
    }

    fn dependencies(pairs: &[(&str, &[&str])]) -> DependencyIndex {
        let mut dependencies = DependencyIndex::new(node("m"));
        for (object, needs) in pairs {
            let needs = needs.iter().map(|need| need.parse().unwrap_or_else(|_| here(need)));
            dependencies.declare(&here(object).object, needs.collect());
        }
        dependencies
    }

    #[test]
    fn needs_are_followed_through_objects_nodes_and_cycles() {
        let dependencies = dependencies(&[("a", &["b"]), ("b", &["c", "n:x"]), ("c", &["a"])]);

        let needs = dependencies.needs_of(&FaultLocation::Object(here("a")));

        let needs: Vec<String> = needs.iter().map(FaultLocation::to_string).collect();
        assert_eq!(needs, ["m:a", "m:b", "m:c", "n:x", "n"]);
    }

    #[test]
    fn what_is_declared_again_replaces_what_was_said_before() {
        let mut dependencies = dependencies(&[("a", &["b"])]);

        dependencies.declare(&here("a").object, [here("c")].into());
        let a = FaultLocation::Object(here("a"));
        assert_eq!(dependencies.needs_of(&a), [FaultLocation::Object(here("c"))].into());

        dependencies.forget(&here("a").object);
        assert!(dependencies.needs.is_empty());
    }
}
