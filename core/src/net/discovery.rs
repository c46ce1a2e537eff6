//! Neighbours that are not described: learned from those that are.
//!
//! ```text
//!  A ──── B ──── C      A and C are described to know B, which tells each of the other:
//!  └ ─ ─ ─ ─ ─ ─ ┘      when B has gone, they have a link of their own
//! ```
//!
//! A node tells each neighbour, over their session, where its others on the same medium are
//! (*gossip*); or nodes say by multicast where they are themselves (*beacons*). What is learned is
//! tried, if its name is admitted, as a link that takes that name alone; what does not prove
//! itself soon is given up, and what was down for long is forgotten.
//!
//! Nothing that is told is trusted: how much is tried at a time, and in all, is bounded for every
//! network, as is how often a neighbour is listened to. What goes beyond is counted, by who said
//! it.

use super::wire::Refusals;
use crate::contract::codec;
use crate::sorted::{SortedMap, SortedSet};
use crate::timer::Timers;
use crate::{Instant, Machine, NodeName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;
use std::time::Duration;

/// The most neighbours that are learned on one network: with as many that are described, a router's
/// announcement still holds all of them.
pub const LEARNED_MAX: usize = 32;
/// The most of them that are tried at a time: each costs a hello every so often, sent to who may
/// never have asked for it.
const TRIED_MAX: usize = 16;
/// The most neighbours that one message names: a node has no more.
const REPORTED_MAX: usize = 64;
/// The longest address, in bytes: a path of a socket.
const ADDRESS_MAX: usize = 108;
/// Addresses that did not prove themselves; the oldest is forgotten first.
const FAILED_MAX: usize = 256;
/// The most bytes of one message.
pub const MESSAGE_MAX: usize = 32 * 1024;

/// Which nodes are admitted as neighbours that are not described.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryAdmission {
    /// Each node that is heard of.
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

/// One network on which neighbours are learned, and told of.
#[derive(Clone, Debug)]
pub struct DiscoveryDomain {
    /// Its name in this node's configuration.
    pub name: String,
    /// What it is made of, such as `udp`.
    pub medium: String,
    /// Who is admitted.
    pub admission: DiscoveryAdmission,
}

/// How neighbours are learned.
#[derive(Clone, Debug)]
pub struct DiscoveryConfig {
    /// Our name.
    pub node: NodeName,
    /// The networks, by their place.
    pub domains: Vec<DiscoveryDomain>,
    /// How long what was learned may take to prove itself; after that it is not tried again for six
    /// times as long. Longer suits slow media; a forged address is sent hellos for as long.
    pub prove_within: Duration,
    /// How long a learned neighbour that is down is still tried. Longer finds it again after longer
    /// absences, and costs hellos for as long.
    pub forget_after: Duration,
    /// How often neighbours are told what nothing has changed in.
    pub repeat: Duration,
}

impl DiscoveryConfig {
    /// The usual behaviour for this node.
    pub fn new(node: NodeName, domains: Vec<DiscoveryDomain>) -> Self {
        DiscoveryConfig {
            node,
            domains,
            // A link that has failed often needs 48 hellos, of 50 ms: and as much again.
            prove_within: Duration::from_secs(5),
            forget_after: Duration::from_secs(600),
            repeat: Duration::from_secs(10),
        }
    }
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum DiscoveryOutput {
    /// Tell this neighbour.
    Send {
        /// Whom.
        to: NodeName,
        /// What.
        message: Bytes,
    },
    /// Make a link.
    Connect {
        /// On which network, by its place.
        domain: usize,
        /// To whom.
        node: NodeName,
        /// Where it is said to be, as its medium writes it.
        address: String,
    },
    /// Give a link up that was made.
    Disconnect {
        /// On which network.
        domain: usize,
        /// To whom.
        node: NodeName,
    },
}

/// The neighbours on one network.
#[derive(Serialize, Deserialize)]
struct Gossip {
    network: String,
    medium: String,
    neighbours: Vec<(NodeName, String)>,
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
    /// Told, and still to prove itself.
    Tried,
    /// Told, and it has been up.
    Learned,
}

/// What is known of who tells us.
#[derive(Debug, Default)]
struct Teller {
    received_at: Option<Instant>,
    refusals: Refusals,
}

/// The neighbours of one node, described and learned.
#[derive(Debug)]
pub struct Discovery {
    config: DiscoveryConfig,
    neighbours: SortedMap<(usize, NodeName), KnownNeighbour>,
    /// Addresses that did not prove themselves, and until when they are not tried.
    failed: SortedMap<(usize, String), Instant>,
    /// Neighbours that were up once; as many as there are.
    tellers: SortedMap<NodeName, Teller>,
    /// Beacons from unknown nodes.
    beacons: Refusals,
    tell_at: Option<Instant>,
    repeat_at: Instant,
    outputs: VecDeque<DiscoveryOutput>,
}

impl Discovery {
    /// Changes that come together are told together.
    const TOGETHER: Duration = Duration::from_millis(20);
    /// A neighbour is listened to no more often.
    const LISTEN: Duration = Duration::from_millis(10);

    /// No node is known yet.
    pub fn new(config: DiscoveryConfig, now: Instant) -> Self {
        let repeat_at = now + config.repeat;
        Discovery {
            config,
            neighbours: SortedMap::new(),
            failed: SortedMap::new(),
            tellers: SortedMap::new(),
            beacons: Refusals::default(),
            tell_at: None,
            repeat_at,
            outputs: VecDeque::new(),
        }
    }

    /// What was refused of each neighbour, and of beacons.
    pub fn refusals(&self) -> impl Iterator<Item = (Option<&NodeName>, Refusals)> {
        let counted = self.tellers.iter().map(|(node, teller)| (Some(node), teller.refusals));
        counted.chain([(None, self.beacons)])
    }

    /// A link to a neighbour is up.
    pub fn handle_up(&mut self, domain: usize, node: NodeName, address: String, now: Instant) {
        self.tellers.entry(node.clone()).or_default();
        self.note((domain, node), address, true, now);
    }

    /// A link to a neighbour is not up: it was described, or has gone down.
    pub fn handle_down(&mut self, domain: usize, node: NodeName, address: String, now: Instant) {
        self.note((domain, node), address, false, now);
    }

    fn note(&mut self, link: (usize, NodeName), address: String, up: bool, now: Instant) {
        let origin = Origin::Described;
        let fresh = KnownNeighbour { address, up: false, since: now, origin };
        let known = self.neighbours.entry(link).or_insert(fresh);
        if known.up != up {
            (known.up, known.since) = (up, now);
            if known.origin == Origin::Tried {
                known.origin = Origin::Learned;
            }
            self.tell_at.get_or_insert(now + Self::TOGETHER);
        }
    }

    /// A session has begun: its peer is told.
    pub fn handle_opened(&mut self, now: Instant) {
        self.tell_at.get_or_insert(now + Self::TOGETHER);
    }

    /// This one was learned by the machine before this, and has a link.
    pub fn handle_learned(&mut self, domain: usize, node: NodeName, address: String, now: Instant) {
        let known = KnownNeighbour { address, up: false, since: now, origin: Origin::Learned };
        self.neighbours.insert((domain, node), known);
    }

    /// A neighbour tells who its others are.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let near = self.neighbours.iter().any(|((_, node), known)| node == from && known.up);
        let Some(teller) = self.tellers.get_mut(from) else { return };
        if !near || teller.received_at.is_some_and(|received_at| now < received_at + Self::LISTEN) {
            teller.refusals.unexpected += 1;
            return;
        }
        teller.received_at = Some(now);
        let Ok(gossips) = codec::decode_bounded::<Vec<Gossip>, MESSAGE_MAX>(message) else {
            teller.refusals.malformed += 1;
            return;
        };
        let mut left = REPORTED_MAX;
        for Gossip { network, medium, neighbours } in gossips {
            let domains = self.grounds_with(from, &network, &medium);
            for (node, address) in neighbours {
                let Some(rest) = left.checked_sub(1) else {
                    self.refuse(Some(from), |refusals| &mut refusals.too_large);
                    continue;
                };
                left = rest;
                for domain in &domains {
                    self.sight(*domain, node.clone(), address.clone(), Some(from), now);
                }
            }
        }
    }

    /// A node itself says where it is.
    pub fn handle_beacon(&mut self, domain: usize, node: NodeName, address: String, now: Instant) {
        self.sight(domain, node, address, None, now);
    }

    /// A beacon that could not be read.
    pub fn handle_noise(&mut self) {
        self.beacons.malformed += 1;
    }

    /// What was told is no address on its medium.
    pub fn handle_unusable(&mut self, domain: usize, node: &NodeName, now: Instant) {
        let key = (domain, node.clone());
        if let Some(known) = self.neighbours.get(&key)
            && known.origin != Origin::Described
        {
            let address = known.address.clone();
            self.neighbours.remove(&key);
            self.fail(domain, address, now);
        }
    }

    /// Our networks of this kind on which we have the teller ourselves: that of the same name, or
    /// all.
    fn grounds_with(&self, from: &NodeName, network: &str, medium: &str) -> Vec<usize> {
        let domains = self.config.domains.iter().enumerate();
        let there =
            |n: usize| self.neighbours.get(&(n, from.clone())).is_some_and(|known| known.up);
        let alike = domains.filter(|(n, domain)| domain.medium == medium && there(*n));
        let alike: Vec<_> = alike.collect();
        let same: Vec<_> =
            alike.iter().filter(|(_, g)| g.name == network).map(|(n, _)| *n).collect();
        if same.is_empty() { alike.into_iter().map(|(n, _)| n).collect() } else { same }
    }

    fn refuse(&mut self, by: Option<&NodeName>, which: fn(&mut Refusals) -> &mut u64) {
        let refusals = match by {
            Some(node) => self.tellers.get_mut(node).map(|teller| &mut teller.refusals),
            None => Some(&mut self.beacons),
        };
        if let Some(refusals) = refusals {
            *which(refusals) += 1;
        }
    }

    fn sight(
        &mut self,
        domain: usize,
        node: NodeName,
        address: String,
        by: Option<&NodeName>,
        now: Instant,
    ) {
        let Some(DiscoveryDomain { admission, .. }) = self.config.domains.get(domain) else {
            return;
        };
        if node == self.config.node || !admission.admits(&node) {
            return;
        }
        if address.is_empty() || address.len() > ADDRESS_MAX {
            return self.refuse(by, |refusals| &mut refusals.malformed);
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
            Some(known) if now < known.since + self.config.prove_within => return,
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
            return self.refuse(by, |refusals| &mut refusals.too_large);
        }
        let fresh = KnownNeighbour {
            address: address.clone(),
            up: false,
            since: now,
            origin: Origin::Tried,
        };
        self.neighbours.insert(key, fresh);
        self.outputs.push_back(DiscoveryOutput::Connect { domain, node, address });
    }

    fn fail(&mut self, domain: usize, address: String, now: Instant) {
        if self.failed.len() >= FAILED_MAX
            && let Some(first) = self.failed.iter().min_by_key(|(_, until)| **until)
        {
            let first = first.0.clone();
            self.failed.remove(&first);
        }
        self.failed.insert((domain, address), now + self.config.prove_within * 6);
    }

    /// When it is given up as what it is now; never what was described, nor who is up.
    fn ends(&self, known: &KnownNeighbour) -> Option<Instant> {
        match known.origin {
            Origin::Tried => Some(known.since + self.config.prove_within),
            Origin::Learned if !known.up => Some(known.since + self.config.forget_after),
            Origin::Learned | Origin::Described => None,
        }
    }

    /// Tells every neighbour of the others that are up on the same network.
    fn tell(&mut self) {
        let up = || self.neighbours.iter().filter(|(_, known)| known.up);
        let nodes: SortedSet<&NodeName> = up().map(|((_, node), _)| node).collect();
        for to in nodes {
            let gossip = |(n, domain): (usize, &DiscoveryDomain)| {
                up().find(|((m, node), _)| *m == n && node == to)?;
                let others = up().filter(|((m, node), _)| *m == n && node != to);
                let others = others.map(|((_, node), known)| (node.clone(), known.address.clone()));
                let neighbours: Vec<_> = others.take(REPORTED_MAX).collect();
                let (network, medium) = (domain.name.clone(), domain.medium.clone());
                (!neighbours.is_empty()).then_some(Gossip { network, medium, neighbours })
            };
            let told: Vec<_> = self.config.domains.iter().enumerate().filter_map(gossip).collect();
            if !told.is_empty() {
                let message = codec::encode_unbounded(&told).into();
                self.outputs.push_back(DiscoveryOutput::Send { to: to.clone(), message });
            }
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
