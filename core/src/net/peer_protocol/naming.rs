//! Which objects which node has.
//!
//! Each node tells every other what it has, over their session: everything at first, then who comes
//! and goes. Sessions keep the order, so that what was added up is right; when one ends, its node's
//! names are forgotten and told again with the next. An address of the form `node:object` works
//! without all this.

use crate::net::wire::node_id::NodeId;
use crate::sorted::{SortedMap, SortedSet};
use crate::{Incarnation, NodeName, ObjectAddress, ObjectName};

/// The most names of one node that are remembered: what a large robot has, ten times over.
pub const NAMES_MAX: usize = 10_000;
/// How many names go into one message; at 128 bytes each it stays well below any limit.
const NAMES_PER_MESSAGE: usize = 256;

/// The names of all nodes, as one node knows them.
#[derive(Debug, Default)]
pub struct NodeDirectory {
    own: SortedSet<ObjectName>,
    nodes: SortedMap<NodeId, NodeNames>,
    /// Names that were refused because a node has too many.
    refused: u64,
}

#[derive(Debug)]
struct NodeNames {
    node: NodeName,
    incarnation: Incarnation,
    objects: SortedSet<ObjectName>,
}

/// What is to be told: every peer, or one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DirectoryUpdate {
    /// Everything said before is void.
    pub complete: bool,
    /// Who came.
    pub added: Vec<ObjectName>,
    /// Who went.
    pub removed: Vec<ObjectName>,
}

impl NodeDirectory {
    /// This node now has exactly these objects. Answers what every peer has to be told.
    pub fn handle_own(&mut self, objects: SortedSet<ObjectName>) -> Vec<DirectoryUpdate> {
        let added: Vec<_> = objects.difference(&self.own).cloned().collect();
        let removed: Vec<_> = self.own.difference(&objects).cloned().collect();
        self.own = objects;
        let coming = added.chunks(NAMES_PER_MESSAGE).map(|added| DirectoryUpdate {
            complete: false,
            added: added.to_vec(),
            removed: vec![],
        });
        let going = removed.chunks(NAMES_PER_MESSAGE).map(|removed| DirectoryUpdate {
            complete: false,
            added: vec![],
            removed: removed.to_vec(),
        });
        going.chain(coming).collect()
    }

    /// A session has begun. Answers what this peer has to be told.
    pub fn handle_opened(
        &mut self,
        node: NodeName,
        incarnation: Incarnation,
    ) -> Vec<DirectoryUpdate> {
        let names = NodeNames { node, incarnation, objects: SortedSet::new() };
        self.nodes.insert(NodeId::of(&names.node), names);
        let own: Vec<_> = self.own.iter().cloned().collect();
        let mut chunks: Vec<_> = own.chunks(NAMES_PER_MESSAGE).map(<[_]>::to_vec).collect();
        if chunks.is_empty() {
            chunks.push(vec![]);
        }
        let updates = chunks.into_iter().enumerate();
        updates
            .map(|(n, added)| DirectoryUpdate { complete: n == 0, added, removed: vec![] })
            .collect()
    }

    /// A session has ended: what its node said is void.
    pub fn handle_ended(&mut self, node: NodeId) {
        self.nodes.remove(&node);
    }

    /// A peer told which objects it has.
    pub fn handle_announcement(&mut self, node: NodeId, announcement: DirectoryUpdate) {
        let Some(names) = self.nodes.get_mut(&node) else { return };
        let DirectoryUpdate { complete, added, removed } = announcement;
        if complete {
            names.objects.clear();
        }
        for name in removed {
            names.objects.remove(&name);
        }
        for name in added {
            if names.objects.len() >= NAMES_MAX {
                self.refused += 1;
            } else {
                names.objects.insert(name);
            }
        }
    }

    /// Where objects of this name are, other nodes only.
    pub fn find(&self, object: &ObjectName) -> Vec<ObjectAddress> {
        let having = self.nodes.values().filter(|names| names.objects.contains(object));
        having.map(|names| ObjectAddress::new(names.node.clone(), object.clone())).collect()
    }

    /// Every node that a session is open with, in which incarnation, and its objects.
    pub fn nodes(&self) -> impl Iterator<Item = (&NodeName, Incarnation, &SortedSet<ObjectName>)> {
        self.nodes.values().map(|names| (&names.node, names.incarnation, &names.objects))
    }

    /// How many names were refused because a node had too many.
    pub fn refused(&self) -> u64 {
        self.refused
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn object(name: &str) -> ObjectName {
        ObjectName::new(name).unwrap()
    }

    fn objects(names: &[&str]) -> SortedSet<ObjectName> {
        names.iter().map(|name| object(name)).collect()
    }

    /// Two nodes; whatever one says, the other hears.
    fn tell(to: &mut NodeDirectory, from: NodeId, announcements: Vec<DirectoryUpdate>) {
        announcements.into_iter().for_each(|updates| to.handle_announcement(from, updates));
    }

    #[test]
    fn names_come_and_go_with_their_objects_and_their_node() {
        let (here, there) = (NodeName::new("here").unwrap(), NodeName::new("there").unwrap());
        let id = NodeId::of(&there);
        let (mut ours, mut theirs) = (NodeDirectory::default(), NodeDirectory::default());
        theirs.handle_own(objects(&["arm", "leg"]));

        ours.handle_opened(there.clone(), Incarnation(1));
        tell(&mut ours, id, theirs.handle_opened(here, Incarnation(1)));
        let arm = ObjectAddress::new(there, object("arm"));
        assert_eq!(ours.find(&object("arm")), [arm]);

        tell(&mut ours, id, theirs.handle_own(objects(&["arm", "eye"])));
        assert_eq!(ours.find(&object("leg")), []);
        assert_eq!(ours.nodes().next().unwrap().2, &objects(&["arm", "eye"]));

        ours.handle_ended(id);
        assert_eq!(ours.find(&object("arm")), []);
    }

    #[test]
    fn thousands_of_names_are_told_in_parts_and_too_many_are_refused() {
        let node = NodeName::new("hostile").unwrap();
        let mut theirs = NodeDirectory::default();
        let many = (0..NAMES_MAX + 5).map(|n| object(&format!("object{n}"))).collect();
        theirs.handle_own(many);
        let updates = theirs.handle_opened(node.clone(), Incarnation(1));
        assert_eq!(updates.len(), 40);
        assert_eq!(updates.iter().filter(|updates| updates.complete).count(), 1);

        let mut ours = NodeDirectory::default();
        ours.handle_opened(node.clone(), Incarnation(1));
        tell(&mut ours, NodeId::of(&node), updates);

        assert_eq!(ours.nodes().next().unwrap().2.len(), NAMES_MAX);
        assert_eq!(ours.refused(), 5);
    }
}
