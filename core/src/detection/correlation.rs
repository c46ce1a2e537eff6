//! What depends on what, and so: which fault is a symptom of which.

use super::FaultLog;
use crate::sorted::{SortedMap, SortedSet};
use crate::{Fault, FaultId, FaultKind, FaultLocation, NodeName, ObjectAddress, ObjectName};
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
    /// The inverse: the objects that need each.
    users: SortedMap<ObjectAddress, SortedSet<ObjectName>>,
}

impl DependencyIndex {
    pub(super) fn new(node: NodeName) -> Self {
        DependencyIndex { node, needs: SortedMap::new(), users: SortedMap::new() }
    }

    /// Says what an object needs, in place of what was said before.
    pub(super) fn declare(&mut self, object: &ObjectName, needs: Arc<[ObjectAddress]>) {
        self.forget(object);
        for need in needs.iter() {
            self.users.entry(need.clone()).or_default().insert(object.clone());
        }
        if !needs.is_empty() {
            self.needs.insert(object.clone(), needs);
        }
    }

    pub(super) fn forget(&mut self, object: &ObjectName) {
        for need in self.needs.remove(object).iter().flat_map(|needs| needs.iter()) {
            if let Some(users) = self.users.get_mut(need) {
                users.remove(object);
                if users.is_empty() {
                    self.users.remove(need);
                }
            }
        }
    }

    /// Everything without which `location` cannot work, directly or through others; not itself,
    /// unless it stands on a cycle.
    pub(super) fn needs_of(&self, location: &FaultLocation) -> SortedSet<FaultLocation> {
        let mut found = SortedSet::new();
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
        let down =
            needs.iter().flat_map(|need| fault_log.open_faults_at(need)).filter(|f| is_down(f));
        down.filter(|fault| fault.location != *location).map(|fault| fault_log.root(fault.id)).min()
    }

    /// The objects of this node that cannot work without `location`, directly or through others.
    pub(super) fn users_of(&self, location: &FaultLocation) -> Dependents {
        let (mut objects, mut open) = (SortedSet::new(), Vec::new());
        match location {
            FaultLocation::Object(address) => open.extend(self.users.get(address)),
            FaultLocation::Node(node) => {
                let there = |(address, _): &(&ObjectAddress, _)| address.node == *node;
                open.extend(self.users.iter().filter(there).map(|(_, users)| users));
            }
            FaultLocation::Link { .. } => {}
        }
        while let Some(users) = open.pop() {
            for user in users {
                if objects.insert(user.clone()) {
                    let address = ObjectAddress::new(self.node.clone(), user.clone());
                    open.extend(self.users.get(&address));
                }
            }
        }
        let node = match location {
            FaultLocation::Node(node) => Some(node.clone()),
            FaultLocation::Object(_) | FaultLocation::Link { .. } => None,
        };
        Dependents { here: self.node.clone(), objects, node }
    }
}

/// Everything that cannot work without one place.
pub(super) struct Dependents {
    here: NodeName,
    objects: SortedSet<ObjectName>,
    /// The place, if it is a node: then all that is there, and all links that lead there, need it.
    node: Option<NodeName>,
}

impl Dependents {
    pub(super) fn contain(&self, location: &FaultLocation) -> bool {
        match location {
            FaultLocation::Object(address) if address.node == self.here => {
                self.objects.contains(&address.object)
            }
            FaultLocation::Object(address) => self.node.as_ref() == Some(&address.node),
            FaultLocation::Link { neighbour, .. } => self.node.is_some() && self.node == *neighbour,
            FaultLocation::Node(_) => false,
        }
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
        | FaultKind::NodeFaulty
        | FaultKind::NodeInSafeState
        | FaultKind::ServiceUnavailable
        | FaultKind::Unavailable
        | FaultKind::CrashLoop
        | FaultKind::RestartStorm => true,
        FaultKind::CheckFailed
        | FaultKind::Overload
        | FaultKind::ContractMismatch
        | FaultKind::LinkDegraded
        | FaultKind::NameTaken
        | FaultKind::CommanderGone
        | FaultKind::Unreplicated
        | FaultKind::StateLost
        | FaultKind::NodePaused
        | FaultKind::Insecure
        | FaultKind::Forbidden
        | FaultKind::ConnectionLost
        | FaultKind::Custom(_) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a name")
    }

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
        assert!(
            !dependencies
                .users_of(&FaultLocation::Object(here("b")))
                .contain(&FaultLocation::Object(here("a")))
        );
        assert!(
            dependencies
                .users_of(&FaultLocation::Object(here("c")))
                .contain(&FaultLocation::Object(here("a")))
        );

        dependencies.forget(&here("a").object);
        assert!(dependencies.users.is_empty() && dependencies.needs.is_empty());
    }

    proptest! {
        /// An object that needs a place is its user, and the other way round, whatever the
        /// dependencies.
        #[test]
        fn users_and_needs_are_the_same_relation(
            pairs in prop::collection::vec((0..6usize, prop::collection::vec(0..8usize, 0..4)), 0..8)
        ) {
            let names = ["a", "b", "c", "d", "e", "f", "n:x", "n:y"];
            let mut dependencies = DependencyIndex::new(node("m"));
            for (object, needs) in pairs {
                let parse = |name: usize| names[name].parse().unwrap_or_else(|_| here(names[name]));
                let needs = needs.into_iter().map(parse).collect();
                dependencies.declare(&here(names[object]).object, needs);
            }
            let mut locations: Vec<FaultLocation> = names[..6].iter().map(|n| FaultLocation::Object(here(n))).collect();
            locations.push(FaultLocation::Node(node("n")));
            for user in &locations[..6] {
                let needs = dependencies.needs_of(user);
                for need in &locations {
                    prop_assert_eq!(needs.contains(need), dependencies.users_of(need).contain(user));
                }
            }
        }
    }
}
