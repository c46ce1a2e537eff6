//! Neighbours that are not described: found by the beacons that they send.
//!
//! A node sends its address by multicast. A received address is tried, if its name is admitted, as
//! a link that takes that name alone. A neighbour that does not prove itself soon is given up, and
//! one that was down for long is forgotten.
//!
//! A beacon without keys proves nothing: how many addresses are tried at a time, and how many are
//! kept in all, is bounded for every network. Those beyond the bound are counted.

use super::wire::Refusals;
use crate::sorted::{SortedMap, SortedSet};
use crate::timer::Timers;
use crate::{Instant, Machine, NodeName};
use std::collections::VecDeque;
use std::time::Duration;

/// The most neighbours that are learned on one network: with as many that are described, a router's
/// announcement still holds all of them.
pub const LEARNED_MAX: usize = 32;
/// The most of them that are tried at a time: each costs a hello every so often, sent to who may
/// never have asked for it.
const TRIED_MAX: usize = 16;
/// Addresses that did not prove themselves; the oldest is forgotten first.
const FAILED_MAX: usize = 256;

/// How long what was learned may take to prove itself; after that it is not tried again for six
/// times as long. A link that has failed often needs 48 hellos, of 50 ms: and as much again.
const PROVE_WITHIN: Duration = Duration::from_secs(5);
/// How long a learned neighbour that is down is still tried.
const FORGET_AFTER: Duration = Duration::from_secs(600);

/// Which nodes are admitted as neighbours that are not described.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryAdmission {
    /// Each node whose beacon is received.
    AnyNode,
    /// These, and no others.
    Only(SortedSet<NodeName>),
}

impl DiscoveryAdmission {
    fn admits(&self, node: &NodeName) -> bool {
        match self {
            DiscoveryAdmission::AnyNode => true,
            DiscoveryAdmission::Only(names) => names.contains(node),
        }
    }
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryOutput {
    /// Make a link.
    Connect {
        /// The network, by its place.
        domain: usize,
        /// The node at the link's other end.
        node: NodeName,
        /// Where its beacon says that it is, as its medium writes it.
        address: String,
    },
    /// Give a link up that was made.
    Disconnect {
        /// The network, by its place.
        domain: usize,
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

/// The neighbours of one node, described and learned.
#[derive(Debug)]
pub struct Discovery {
    /// The name of this node.
    node: NodeName,
    /// Which nodes are admitted on each network, by the network's place.
    admissions: Vec<DiscoveryAdmission>,
    neighbours: SortedMap<(usize, NodeName), KnownNeighbour>,
    /// Addresses that did not prove themselves, and until when they are not tried.
    failed: SortedMap<(usize, String), Instant>,
    refusals: Refusals,
    outputs: VecDeque<DiscoveryOutput>,
}

impl Discovery {
    /// Of this node, which knows no other yet. The admissions are those of its networks, by their
    /// places.
    pub fn new(node: NodeName, admissions: Vec<DiscoveryAdmission>) -> Self {
        Discovery {
            node,
            admissions,
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

    /// A link to a neighbour of a network is up, or is not: it was described, or has gone down.
    pub fn handle_link(&mut self, at: (usize, NodeName), address: String, up: bool, now: Instant) {
        let origin = Origin::Described;
        let fresh = KnownNeighbour { address, up: false, since: now, origin };
        let known = self.neighbours.entry(at).or_insert(fresh);
        if known.up != up {
            (known.up, known.since) = (up, now);
            if known.origin == Origin::Tried {
                known.origin = Origin::Learned;
            }
        }
    }

    /// This one was learned by the machine before this, and has a link.
    pub fn handle_learned(&mut self, domain: usize, node: NodeName, address: String, now: Instant) {
        let known = KnownNeighbour { address, up: false, since: now, origin: Origin::Learned };
        self.neighbours.insert((domain, node), known);
    }

    /// A beacon that could not be read.
    pub fn handle_noise(&mut self) {
        self.refusals.malformed += 1;
    }

    /// The beacon of a node says where it is.
    pub fn handle_beacon(&mut self, domain: usize, node: NodeName, address: String, now: Instant) {
        let is_admitted = |admission: &DiscoveryAdmission| admission.admits(&node);
        if node == self.node || !self.admissions.get(domain).is_some_and(is_admitted) {
            return;
        }
        if self.failed.get(&(domain, address.clone())).is_some_and(|until| now < *until) {
            return;
        }
        let key = (domain, node.clone());
        match self.neighbours.get(&key) {
            None => {}
            Some(known) if known.origin == Origin::Described || known.up => return,
            Some(known) if known.address == address => return,
            // It has been away for a while, and may have come back elsewhere.
            Some(known) if now < known.since + PROVE_WITHIN => return,
            Some(_) => {
                self.neighbours.remove(&key);
                self.outputs.push_back(DiscoveryOutput::Disconnect { domain, node: node.clone() });
            }
        }
        let here = |origins: &[Origin]| {
            let all = self.neighbours.iter();
            all.filter(|((n, _), known)| *n == domain && origins.contains(&known.origin)).count()
        };
        let full = here(&[Origin::Tried, Origin::Learned]) >= LEARNED_MAX;
        if full || here(&[Origin::Tried]) >= TRIED_MAX {
            self.refusals.too_large += 1;
            return;
        }
        let (up, since, origin) = (false, now, Origin::Tried);
        self.neighbours.insert(key, KnownNeighbour { address: address.clone(), up, since, origin });
        self.outputs.push_back(DiscoveryOutput::Connect { domain, node, address });
    }

    fn fail(&mut self, domain: usize, address: String, now: Instant) {
        if self.failed.len() >= FAILED_MAX
            && let Some(first) = self.failed.iter().min_by_key(|(_, until)| **until)
        {
            let first = first.0.clone();
            self.failed.remove(&first);
        }
        self.failed.insert((domain, address), now + PROVE_WITHIN * 6);
    }

    /// When it is given up as what it is now; never what was described, nor who is up.
    fn ends(&self, known: &KnownNeighbour) -> Option<Instant> {
        match known.origin {
            Origin::Tried => Some(known.since + PROVE_WITHIN),
            Origin::Learned if !known.up => Some(known.since + FORGET_AFTER),
            Origin::Learned | Origin::Described => None,
        }
    }
}

impl Machine for Discovery {
    type Output = DiscoveryOutput;

    fn poll_output(&mut self) -> Option<DiscoveryOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.next_due()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.fire_due(now);
    }
}

#[cfg(test)]
mod tests;
mod timers;
