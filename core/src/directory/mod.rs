//! The directory of the robot: what each node has, and who holds which global name.
//!
//! One table of records. Each node writes its own and tells every other node of them, over their
//! session; there is no broker. Its records are the objects that it has, the topics that it
//! publishes on, and the global names that it claims. (What a node listens to its subscriptions
//! say.)
//!
//! ```text
//!  session begins      All (in parts)        everything the node has
//!  something changes   Changed               what came and went
//!  a quarter of the    Alive                 a sum over the records: a node with another sum asks
//!  lease has passed                          for all of them (TellAll); rarely, where no name is
//!                                            claimed
//! ```
//!
//! Records are void once the session with their node has ended and a lease has passed since it was
//! last heard of.
//!
//! An object's address names its node. A *claim* is of a name without one, such as `map`: one node
//! holds it, others may stand by, and all know who does. What a node claims holds for a lease after
//! it was last heard of. Every claim that is granted has an epoch, greater than any that its node
//! has seen; of two holders of one name, as two halves of a network may bring them forth, the one
//! of the greater epoch stays, and of equal ones the first by name. A node that has just started
//! grants itself nothing until it has heard the others, so that it takes no name from its holder.
//! That is enough for finding things. Where two at a time would do harm, use a service, which needs
//! a majority.
//!
//! An epoch of 2^62 or more is refused, so that a claim always has a greater one after it. The
//! policy says which nodes may claim: one that claims to spend epochs is not given the right.

pub use self::types::{
    ClaimPolicy, ClaimRefused, ClaimRequest, DirectoryConfig, DirectoryKey, DirectoryOutput,
    Holder, NameHeld,
};
pub use self::unmet::UnmetClaims;

use self::claims::OwnClaim;
use self::types::NameClaim;
use crate::net::trust::access::AccessPolicy;
use crate::net::wire::Refusals;
use crate::sorted::{SortedMap, SortedSet};
use crate::timer::Timers;
use crate::{Incarnation, Instant, Machine, NodeName, ObjectName};
use std::collections::VecDeque;

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
    /// A session is open.
    open: bool,
    received_at: Instant,
    table: RecordTable,
    /// Which of them it has told of since it began to tell all of them.
    telling: Option<SortedSet<DirectoryKey>>,
    /// It has told all of them.
    complete: bool,
    /// When it was last asked for everything.
    asked: Option<Instant>,
    /// When it was last told everything.
    sent_all_at: Instant,
    refusals: Refusals,
}

impl DirectoryPeer {
    /// Names are the last of all keys.
    fn claims_names(&self) -> bool {
        let last = self.table.records.last_key_value();
        last.is_some_and(|(key, _)| matches!(key, DirectoryKey::Name(_)))
    }
}

/// The records of one node, and a sum over them.
#[derive(Debug, Default)]
struct RecordTable {
    records: SortedMap<DirectoryKey, NameClaim>,
    sum: u64,
}

impl RecordTable {
    /// Sets a record, or removes it. Returns the one before.
    fn set(&mut self, key: &DirectoryKey, claim: Option<&NameClaim>) -> Option<NameClaim> {
        let before = match claim {
            Some(claim) => self.records.insert(key.clone(), claim.clone()),
            None => self.records.remove(key),
        };
        let sum = |claim: Option<&NameClaim>| claim.map_or(0, |claim| claim.sum(key));
        self.sum = self.sum.wrapping_add(sum(claim)).wrapping_sub(sum(before.as_ref()));
        before
    }
}

/// The records of all nodes, as one node knows them.
#[derive(Debug)]
pub struct Directory {
    config: DirectoryConfig,
    /// What this node claims.
    own: SortedMap<ObjectName, OwnClaim>,
    /// What others are told of this node.
    table: RecordTable,
    peers: SortedMap<NodeName, DirectoryPeer>,
    /// Who has claimed which name, or stands by.
    known: SortedMap<ObjectName, SortedMap<NodeName, NameClaim>>,
    /// Who was last told to hold which.
    shown: SortedMap<ObjectName, Holder>,
    last_epoch: u64,
    /// When the others were last told that this node is alive.
    renewed_at: Instant,
    /// Which nodes may claim which names; without one, all may.
    access: Option<AccessPolicy>,
    /// Until then nothing is granted; `None` once that is over.
    settles: Option<Instant>,
    /// In the place of another machine of the same incarnation: it has forgotten what it was told.
    forgetful: bool,
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
            table: RecordTable::default(),
            peers: SortedMap::new(),
            known: SortedMap::new(),
            shown: SortedMap::new(),
            last_epoch,
            renewed_at: now,
            access: None,
            settles,
            forgetful: false,
            outputs: VecDeque::new(),
        }
    }

    /// A directory in the place of another of the same incarnation that was lost: with what that
    /// incarnation claims, and under which epochs. What others have, they are asked when their
    /// sessions are told of again.
    pub fn restarted(
        config: DirectoryConfig,
        own: impl IntoIterator<Item = (ClaimRequest, Option<u64>)>,
        now: Instant,
    ) -> Self {
        // Two chances to hear what the others have, should the first be missed.
        let settle = config.lease / 2;
        let mut directory = Directory::new(DirectoryConfig { settle, ..config }, now);
        directory.forgetful = true;
        for (ClaimRequest { name, object, policy }, epoch) in own {
            directory.last_epoch = directory.last_epoch.max(epoch.unwrap_or_default());
            directory.set_own(&name, Some(OwnClaim { object, policy, epoch, take_at: None }));
        }
        directory
    }

    /// What was refused of each node: more records than one may have, and nonsense.
    pub fn refusals(&self) -> impl Iterator<Item = (&NodeName, Refusals)> {
        self.peers.iter().map(|(node, peer)| (node, peer.refusals))
    }

    /// This node has exactly these objects and publishers now. Returns how many of them others are
    /// not told of, because there are too many.
    pub fn handle_present(&mut self, present: SortedSet<DirectoryKey>) -> usize {
        let (all, mut bytes) = (present.len(), 0);
        let fits = |key: &DirectoryKey| {
            bytes += key.bytes();
            bytes <= PRESENT_BYTES_MAX
        };
        let present = present.into_iter().take(PRESENT_MAX).take_while(fits);
        let present: SortedSet<DirectoryKey> = present.collect();
        let beyond = all - present.len();
        let told = self.table.records.keys().filter(|key| !matches!(key, DirectoryKey::Name(_)));
        let gone: Vec<_> = told.filter(|key| !present.contains(*key)).cloned().collect();
        let new = present.into_iter().filter(|key| !self.table.records.contains_key(key));
        let new: Vec<_> = new.map(|key| (key, Some(NameClaim::default()))).collect();
        self.record(gone.into_iter().map(|key| (key, None)).chain(new).collect());
        beyond
    }

    /// A session with a node has begun: it is told everything again, whatever it knew.
    pub fn handle_opened(&mut self, node: NodeName, incarnation: Incarnation, now: Instant) {
        if self.peers.get(&node).is_some_and(|peer| peer.incarnation != incarnation) {
            self.handle_left(&node, now);
        }
        let fresh = DirectoryPeer {
            incarnation,
            open: true,
            received_at: now,
            table: RecordTable::default(),
            telling: None,
            complete: false,
            asked: None,
            sent_all_at: now,
            refusals: Refusals::default(),
        };
        let peer = self.peers.entry(node.clone()).or_insert(fresh);
        (peer.open, peer.received_at, peer.telling) = (true, now, None);
        self.tell_all(&node, now);
        if self.forgetful {
            self.ask_for_all(node);
        }
    }

    /// The session with a node has ended. Its records hold until their lease is over.
    pub fn handle_ended(&mut self, node: &NodeName) {
        if let Some(peer) = self.peers.get_mut(node) {
            peer.open = false;
        }
    }

    /// A node has ended in order, or was restarted: its records are void.
    pub fn handle_left(&mut self, node: &NodeName, now: Instant) {
        self.clear(node, now, |_| true);
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
