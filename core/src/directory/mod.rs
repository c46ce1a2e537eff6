//! The directory of the robot: what each node has, and who holds which global name.
//!
//! One table of records. Each node writes its own and tells every other node of them, over their
//! session; there is no broker. Its records are the objects that it has, the topics that it
//! publishes on, and the global names that it claims. (What a node listens to its subscriptions
//! say.)
//!
//! ```text
//!  a session begins      All (in parts)     everything the node has
//!  something changes     Changed            what came and went
//! ```
//!
//! A session delivers each message once and in order, so that none is repeated. Records are void a
//! lease after the last path to their node was lost, or the session with it. When the path is back
//! within the same session they count again.
//!
//! An object's address names its node. A *claim* is of a name without one, such as `map`: one node
//! holds it, others may stand by, and all know who does. Every claim that is granted has an epoch,
//! greater than any that its node has seen; of two holders of one name, as two halves of a network
//! may bring them forth, the one of the greater epoch stays, and of equal ones the first by name. A
//! node that has just started grants itself nothing until it has heard the others, so that it takes
//! no name from its holder. That is enough for finding things. Where two at a time would do harm,
//! use a service, which needs a majority.

pub use self::types::{
    ClaimPolicy, ClaimRefused, ClaimRequest, DirectoryConfig, DirectoryKey, DirectoryOutput,
    Holder, NameHeld,
};
pub use self::unmet::UnmetClaims;

use self::claims::OwnClaim;
use self::types::NameClaim;
use crate::net::trust::access::AccessPolicy;
use crate::net::wire::Refusals;
use crate::sorted::SortedMap;
use crate::timer::Timers;
use crate::{Incarnation, Instant, Machine, NodeName, ObjectName};
use std::collections::{BTreeSet, VecDeque};

/// The most claims of one node: what a large robot has in all, ten times over.
pub const CLAIMS_MAX: usize = 10_000;
/// The most objects and publishers of one node that others are told of. An address of the form
/// `node:object` works without.
pub const PRESENT_MAX: usize = 20_000;
/// The most bytes of their names: with as many claims as a node may have, they are less than what
/// may be on the way to another node.
const PRESENT_BYTES_MAX: usize = 1024 * 1024;
/// The most global names that are known in all: some of several nodes that claim as much as they
/// may.
pub const NAMES_MAX: usize = 100_000;

/// What is known of another node.
#[derive(Debug)]
struct DirectoryPeer {
    incarnation: Incarnation,
    reachability: Reachability,
    /// The session with it has ended: what comes next tells everything.
    ended: bool,
    records: SortedMap<DirectoryKey, NameClaim>,
    /// Which of them it has told of since it began to tell all of them.
    telling: Option<BTreeSet<DirectoryKey>>,
    /// It has told all of them.
    complete: bool,
    refusals: Refusals,
}

/// Whether a node's records count.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Reachability {
    /// They do.
    Here,
    /// The node cannot be reached; they count until then.
    Away { until: Instant },
    /// They do not, until the node is back.
    Gone,
}

/// The records of all nodes, as one node knows them.
#[derive(Debug)]
pub struct Directory {
    config: DirectoryConfig,
    /// What this node claims.
    own: SortedMap<ObjectName, OwnClaim>,
    /// What others are told of this node.
    records: SortedMap<DirectoryKey, NameClaim>,
    peers: SortedMap<NodeName, DirectoryPeer>,
    /// Who has claimed which name, or stands by.
    known: SortedMap<ObjectName, SortedMap<NodeName, NameClaim>>,
    /// Who was last told to hold which, and when.
    shown: SortedMap<ObjectName, (Holder, Instant)>,
    last_epoch: u64,
    /// Which nodes may claim which names; without one, all may.
    access: Option<AccessPolicy>,
    /// Until then nothing is granted; `None` once that is over.
    settles: Option<Instant>,
    outputs: VecDeque<DirectoryOutput>,
}

impl Directory {
    /// Nothing is known yet.
    pub fn new(config: DirectoryConfig, now: Instant) -> Self {
        // Above what an earlier incarnation of this node gave out, should no node be left that
        // remembers.
        let last_epoch = claims::first_epoch(config.incarnation);
        let settles = (!config.settle.is_zero()).then(|| now + config.settle);
        Directory {
            config,
            own: SortedMap::new(),
            records: SortedMap::new(),
            peers: SortedMap::new(),
            known: SortedMap::new(),
            shown: SortedMap::new(),
            last_epoch,
            access: None,
            settles,
            outputs: VecDeque::new(),
        }
    }

    /// A directory in the place of this one, which has panicked: with what this node claims, and
    /// under which epochs, and with what others have told. It tells all of them everything again.
    pub fn rebuilt(mut self, now: Instant) -> Self {
        self.known.clear();
        self.shown.clear();
        self.outputs.clear();
        let own: Vec<_> = self.own.iter().map(|(name, own)| (name.clone(), own.epoch)).collect();
        for (name, epoch) in own {
            if let Some(epoch) = epoch {
                let name = name.clone();
                self.outputs.push_back(DirectoryOutput::Granted { name, epoch });
            }
            self.look_at(&name, now);
        }
        let peers = self.peers.iter();
        let peers: Vec<_> =
            peers.map(|(node, peer)| (node.clone(), peer.reachability, peer.ended)).collect();
        for (node, reachability, ended) in peers {
            if reachability != Reachability::Gone {
                self.count_claims(&node, now);
            }
            if !ended {
                self.tell_all(&node);
            }
        }
        self
    }

    /// The incarnation of a node that is known, this one or another.
    pub fn incarnation_of(&self, node: &NodeName) -> Incarnation {
        match self.peers.get(node) {
            Some(peer) => peer.incarnation,
            None if *node == self.config.node => self.config.incarnation,
            None => Incarnation::default(),
        }
    }

    /// The names that are held, here and elsewhere: by which node, and since when this one knows.
    pub fn holders(&self) -> impl Iterator<Item = (&ObjectName, &Holder, Instant)> {
        self.shown.iter().map(|(name, (holder, since))| (name, holder, *since))
    }

    /// The other nodes that can be reached, and what each has.
    pub fn nodes(
        &self,
    ) -> impl Iterator<Item = (&NodeName, Incarnation, impl Iterator<Item = &DirectoryKey>)> {
        let here = self.peers.iter().filter(|(_, peer)| peer.reachability == Reachability::Here);
        here.map(|(node, peer)| {
            (node, peer.incarnation, peer.records.keys().filter(|key| self.has(node, key)))
        })
    }

    /// The other nodes that can be reached and have this.
    pub fn nodes_with(&self, key: &DirectoryKey) -> Vec<NodeName> {
        let here = self.peers.iter().filter(|(_, peer)| peer.reachability == Reachability::Here);
        let having = here.filter(|(_, peer)| peer.records.contains_key(key));
        having.map(|(node, _)| node).filter(|node| self.has(node, key)).cloned().collect()
    }

    /// What was refused of each node: more records than one may have, and nonsense.
    pub fn refusals(&self) -> impl Iterator<Item = (&NodeName, Refusals)> {
        self.peers.iter().map(|(node, peer)| (node, peer.refusals))
    }

    /// This node has exactly these objects and publishers now. Returns how many of them others are
    /// not told of, because there are too many.
    pub fn handle_present(&mut self, present: BTreeSet<DirectoryKey>) -> usize {
        let (all, mut bytes) = (present.len(), 0);
        let fits = |key: &DirectoryKey| {
            bytes += key.bytes();
            bytes <= PRESENT_BYTES_MAX
        };
        let present = present.into_iter().take(PRESENT_MAX).take_while(fits);
        let present: BTreeSet<DirectoryKey> = present.collect();
        let beyond = all - present.len();
        let told = self.records.keys().filter(|key| !matches!(key, DirectoryKey::Name(_)));
        let gone: Vec<_> = told.filter(|key| !present.contains(*key)).cloned().collect();
        let new = present.into_iter().filter(|key| !self.records.contains_key(key));
        let new: Vec<_> = new.map(|key| (key, Some(NameClaim::default()))).collect();
        self.record(gone.into_iter().map(|key| (key, None)).chain(new).collect());
        beyond
    }

    /// A session with a node has begun: it is told everything, whatever it knew.
    pub fn handle_opened(&mut self, node: NodeName, incarnation: Incarnation, now: Instant) {
        if self.peers.get(&node).is_some_and(|peer| peer.incarnation != incarnation) {
            self.handle_left(&node, now);
        }
        let fresh = DirectoryPeer {
            incarnation,
            reachability: Reachability::Here,
            ended: false,
            records: SortedMap::new(),
            telling: None,
            complete: false,
            refusals: Refusals::default(),
        };
        self.peers.entry(node.clone()).or_insert(fresh).ended = false;
        self.handle_reachable(&node, now);
        self.tell_all(&node);
    }

    /// A path leads to a node; if its session goes on, its records count again.
    pub fn handle_reachable(&mut self, node: &NodeName, now: Instant) {
        let Some(peer) = self.peers.get_mut(node).filter(|peer| !peer.ended) else { return };
        if std::mem::replace(&mut peer.reachability, Reachability::Here) == Reachability::Gone {
            self.count_claims(node, now);
        }
    }

    /// No path leads to a node: its records hold for a lease. What changes is sent meanwhile, for
    /// its session may go on.
    pub fn handle_unreachable(&mut self, node: &NodeName, now: Instant) {
        let until = now + self.config.lease;
        if let Some(peer) = self.peers.get_mut(node)
            && peer.reachability == Reachability::Here
        {
            peer.reachability = Reachability::Away { until };
        }
    }

    /// The session with a node has ended: its records hold for a lease after that, or after the
    /// path was lost.
    pub fn handle_ended(&mut self, node: &NodeName, now: Instant) {
        self.handle_unreachable(node, now);
        let Some(peer) = self.peers.get_mut(node) else { return };
        peer.ended = true;
        if peer.reachability == Reachability::Gone {
            self.handle_left(node, now);
        }
    }

    /// A node has ended in order, or was restarted: its records are void.
    pub fn handle_left(&mut self, node: &NodeName, now: Instant) {
        self.clear(node, now);
        self.peers.remove(node);
    }
}

impl Machine for Directory {
    type Output = DirectoryOutput;

    fn poll_output(&mut self) -> Option<DirectoryOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.next_due()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.fire_due(now);
    }
}

mod claims;
mod replication;
#[cfg(test)]
mod tests;
mod timers;
mod types;
mod unmet;
