//! Neighbours that are not described: found by the beacons that they send.
//!
//! A node sends its address by multicast. A received address is tried, if its name is admitted, as
//! a link that takes that name alone. A neighbour that does not prove itself soon is given up, and
//! one that was down for long is forgotten.
//!
//! A beacon without keys proves nothing: how many addresses are tried at a time, and how many are
//! kept in all, is bounded. Those beyond the bound are counted.

use super::wire::Refusals;
use crate::sorted::SortedMap;
use crate::{Instant, NodeName};
use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

/// The most neighbours that are learned on one network: with as many that are described, a router's
/// announcement still holds all of them.
pub const LEARNED_MAX: usize = 32;
/// The most of them that are tried at a time: each costs a hello every so often, sent to who may
/// never have asked for it.
const TRIED_MAX: usize = 16;
/// Addresses that did not prove themselves; the oldest is forgotten first.
const FAILED_MAX: usize = 256;

/// Which nodes are admitted as neighbours that are not described.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryAdmission {
    /// Each node whose beacon is received.
    AnyNode,
    /// These, and no others.
    Only(BTreeSet<NodeName>),
}

impl DiscoveryAdmission {
    fn admits(&self, node: &NodeName) -> bool {
        match self {
            DiscoveryAdmission::AnyNode => true,
            DiscoveryAdmission::Only(names) => names.contains(node),
        }
    }
}

/// How neighbours are learned on one network.
#[derive(Clone, Debug)]
pub struct DiscoveryConfig {
    /// The name of this node.
    pub node: NodeName,
    /// Who is admitted.
    pub admission: DiscoveryAdmission,
    /// How long what was learned may take to prove itself; after that it is not tried again for six
    /// times as long. Longer suits slow media; a forged address is sent hellos for as long.
    pub prove_within: Duration,
    /// How long a learned neighbour that is down is still tried. Longer finds it again after longer
    /// absences, and costs hellos for as long.
    pub forget_after: Duration,
}

impl DiscoveryConfig {
    /// The usual behaviour for this node.
    pub fn new(node: NodeName, admission: DiscoveryAdmission) -> Self {
        DiscoveryConfig {
            node,
            admission,
            // A link that has failed often needs 48 hellos, of 50 ms: and as much again.
            prove_within: Duration::from_secs(5),
            forget_after: Duration::from_secs(600),
        }
    }
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryOutput {
    /// Make a link.
    Connect {
        /// The node at the link's other end.
        node: NodeName,
        /// Where its beacon says that it is, as its medium writes it.
        address: String,
    },
    /// Give a link up that was made.
    Disconnect {
        /// The node at the link's other end.
        node: NodeName,
    },
}

#[derive(Debug)]
struct KnownNeighbour {
    address: String,
    up: bool,
    /// Since when it is up, or is not.
    since: Instant,
    /// How it came to be known.
    origin: Origin,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Origin {
    /// By this node's configuration.
    Described,
    /// By a beacon, and still to prove itself.
    Tried,
    /// By a beacon, and it has been up.
    Learned,
}

/// The neighbours of one node on one network, described and learned.
#[derive(Debug)]
pub struct Discovery {
    config: DiscoveryConfig,
    neighbours: SortedMap<NodeName, KnownNeighbour>,
    /// Addresses that did not prove themselves, and until when they are not tried.
    failed: SortedMap<String, Instant>,
    refusals: Refusals,
    outputs: VecDeque<DiscoveryOutput>,
}

impl Discovery {
    /// No node is known yet.
    pub fn new(config: DiscoveryConfig) -> Self {
        Discovery {
            config,
            neighbours: SortedMap::new(),
            failed: SortedMap::new(),
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
        }
    }

    /// What was refused of beacons.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// A link to a neighbour is up, or is not: it was described, or has gone down.
    pub fn handle_link(&mut self, node: NodeName, address: String, up: bool, now: Instant) {
        let origin = Origin::Described;
        let fresh = KnownNeighbour { address, up: false, since: now, origin };
        let known = self.neighbours.entry(node).or_insert(fresh);
        if known.up != up {
            (known.up, known.since) = (up, now);
            if known.origin == Origin::Tried {
                known.origin = Origin::Learned;
            }
        }
    }

    /// This one was learned by the machine before this, and has a link.
    pub fn handle_learned(&mut self, node: NodeName, address: String, now: Instant) {
        let known = KnownNeighbour { address, up: false, since: now, origin: Origin::Learned };
        self.neighbours.insert(node, known);
    }

    /// A beacon that could not be read.
    pub fn handle_noise(&mut self) {
        self.refusals.malformed += 1;
    }

    /// The beacon of a node says where it is.
    pub fn handle_beacon(&mut self, node: NodeName, address: String, now: Instant) {
        if node == self.config.node || !self.config.admission.admits(&node) {
            return;
        }
        if self.failed.get(&address).is_some_and(|until| now < *until) {
            return;
        }
        match self.neighbours.get(&node) {
            None => {}
            Some(known) if known.origin == Origin::Described || known.up => return,
            Some(known) if known.address == address => return,
            // It has been away for a while, and may have come back elsewhere.
            Some(known) if now < known.since + self.config.prove_within => return,
            Some(_) => {
                self.neighbours.remove(&node);
                self.outputs.push_back(DiscoveryOutput::Disconnect { node: node.clone() });
            }
        }
        let here = |origins: &[Origin]| {
            self.neighbours.values().filter(|known| origins.contains(&known.origin)).count()
        };
        let full = here(&[Origin::Tried, Origin::Learned]) >= LEARNED_MAX;
        if full || here(&[Origin::Tried]) >= TRIED_MAX {
            self.refusals.too_large += 1;
            return;
        }
        let (up, since, origin) = (false, now, Origin::Tried);
        let known = KnownNeighbour { address: address.clone(), up, since, origin };
        self.neighbours.insert(node.clone(), known);
        self.outputs.push_back(DiscoveryOutput::Connect { node, address });
    }

    fn fail(&mut self, address: String, now: Instant) {
        if self.failed.len() >= FAILED_MAX
            && let Some(first) = self.failed.iter().min_by_key(|(_, until)| **until)
        {
            let first = first.0.clone();
            self.failed.remove(&first);
        }
        self.failed.insert(address, now + self.config.prove_within * 6);
    }

    /// The next thing to do, in order.
    pub fn poll_output(&mut self) -> Option<DiscoveryOutput> {
        self.outputs.pop_front()
    }

    /// Time passes: a neighbour that has not proved to be there is given up, and one that was down
    /// for long is forgotten.
    pub fn handle_time(&mut self, now: Instant) {
        self.failed.retain(|_, until| now < *until);
        let is_over = |end: Option<Instant>| end.is_some_and(|end| now >= end);
        let gone = self.neighbours.iter().filter(|(_, known)| is_over(self.ends(known)));
        let gone: Vec<_> =
            gone.map(|(node, known)| (node.clone(), known.address.clone(), known.origin)).collect();
        for (node, address, origin) in gone {
            self.neighbours.remove(&node);
            if origin == Origin::Tried {
                self.fail(address, now);
            }
            self.outputs.push_back(DiscoveryOutput::Disconnect { node });
        }
    }

    /// When it is given up as what it is now; never what was described, nor who is up.
    fn ends(&self, known: &KnownNeighbour) -> Option<Instant> {
        match known.origin {
            Origin::Tried => Some(known.since + self.config.prove_within),
            Origin::Learned if !known.up => Some(known.since + self.config.forget_after),
            Origin::Learned | Origin::Described => None,
        }
    }
}

#[cfg(test)]
mod tests;
