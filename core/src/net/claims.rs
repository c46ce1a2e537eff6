//! Names of the whole robot: who claims them, and who is next.
//!
//! An object's address names its node. A *claim* is a name without one, such as `map`: one node holds
//! it, others may stand by, and all know who does. There is no broker: each node tells every other,
//! over their session, what it claims.
//!
//! ```text
//!  session begins      All (in parts)        everything the node claims
//!  something changes   Changed               what came and went
//!  a quarter of the    Alive                 a sum over the claims: whoever has another sum
//!  lease has passed                          asks for all of them (TellAll)
//! ```
//!
//! What a node claims holds for a lease after it was last heard of. Every claim that is granted has an
//! epoch, greater than any that its node has seen; of two holders of one name, as two halves of a
//! network may bring them forth, the one of the greater epoch stays, and of equal ones the first by
//! name. That is enough for finding things. Where two at a time would do harm, use a service, which
//! needs a majority.

use crate::codec;
use crate::{Incarnation, Instant, Machine, NodeName, ObjectName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// The most claims of one node: what a large robot has in all, ten times over.
pub const CLAIMS_MAX: usize = 10_000;
/// How many claims go into one message; at 140 bytes each it stays below any limit.
const CLAIMS_PER_MESSAGE: usize = 200;
/// The most bytes of one message.
const MESSAGE_MAX: usize = 64 * 1024;

/// What a claimant wants where somebody else holds the name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ClaimPolicy {
    /// To be told so, and to go without.
    Refuse,
    /// To take its place when it has gone.
    Standby,
}

/// How claims are held.
#[derive(Clone, Debug)]
pub struct ClaimsConfig {
    /// Our name.
    pub node: NodeName,
    /// Our life.
    pub incarnation: Incarnation,
    /// How long a claim holds after its node was last heard of; it is heard of four times as often.
    /// Longer costs less traffic, and keeps the names of a node that died for longer.
    pub lease: Duration,
}

/// The name is somebody else's.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{name} is claimed by {holder}, under epoch {epoch}: stand by, or take another name")]
pub struct NameHeld {
    /// The name.
    pub name: ObjectName,
    /// Who holds it.
    pub holder: NodeName,
    /// Since which claim.
    pub epoch: u64,
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum ClaimsOutput {
    /// Tell this node.
    Send {
        /// Whom.
        to: NodeName,
        /// What.
        message: Bytes,
    },
    /// A name is ours.
    Granted {
        /// Which.
        name: ObjectName,
        /// Under which epoch.
        epoch: u64,
    },
    /// A name that was ours is another's: two had claimed it, out of each other's sight.
    Lost {
        /// Which.
        name: ObjectName,
        /// Whose it is.
        to: NodeName,
        /// Under which epoch.
        epoch: u64,
    },
}

#[derive(Serialize, Deserialize)]
enum Message {
    All { first: bool, last: bool, claims: Vec<Told> },
    Changed { claims: Vec<Told>, gone: Vec<ObjectName> },
    Alive { sum: u64 },
    TellAll,
}

/// A claim as it is told; without an epoch it stands by.
#[derive(Clone, Serialize, Deserialize)]
struct Told {
    name: ObjectName,
    epoch: Option<u64>,
}

#[derive(Debug)]
struct Own {
    policy: ClaimPolicy,
    epoch: Option<u64>,
}

/// What is known of another node.
#[derive(Debug)]
struct Peer {
    incarnation: Incarnation,
    /// A session is open.
    open: bool,
    heard: Instant,
    claims: BTreeMap<ObjectName, Option<u64>>,
    sum: u64,
    /// When it was last asked for everything.
    asked: Option<Instant>,
}

/// The claims of all nodes, as one node knows them.
#[derive(Debug)]
pub struct Claims {
    config: ClaimsConfig,
    own: BTreeMap<ObjectName, Own>,
    sum: u64,
    peers: BTreeMap<NodeName, Peer>,
    /// Who has claimed which name, or stands by.
    known: BTreeMap<ObjectName, BTreeMap<NodeName, Option<u64>>>,
    /// Names that we stand by for and that nobody holds, and when we take them.
    vacant: BTreeMap<ObjectName, Instant>,
    last_epoch: u64,
    alive_at: Instant,
    refused: u64,
    outputs: VecDeque<ClaimsOutput>,
}

impl Claims {
    /// Nothing is claimed yet.
    pub fn new(config: ClaimsConfig, now: Instant) -> Self {
        // Above what an earlier life of this node gave out, should nobody be left who remembers.
        let last_epoch = config.incarnation.0.saturating_mul(1 << 16);
        let alive_at = now + config.lease / 4;
        Claims {
            config,
            own: BTreeMap::new(),
            sum: 0,
            peers: BTreeMap::new(),
            known: BTreeMap::new(),
            vacant: BTreeMap::new(),
            last_epoch,
            alive_at,
            refused: 0,
            outputs: VecDeque::new(),
        }
    }

    /// Who holds a name, here or elsewhere, and under which epoch.
    pub fn holder(&self, name: &ObjectName) -> Option<(&NodeName, u64)> {
        let own = self.own.get(name).and_then(|own| own.epoch);
        let own = own.map(|epoch| (&self.config.node, epoch));
        let others = self.known.get(name).into_iter().flatten();
        let others = others.filter_map(|(node, epoch)| Some((node, (*epoch)?)));
        others.chain(own).reduce(|a, b| if precedes(b, a) { b } else { a })
    }

    /// How many names are known to be held, here and elsewhere.
    pub fn held(&self) -> usize {
        let own = self.own.iter().filter(|(_, own)| own.epoch.is_some());
        let own = own.filter(|(name, _)| !self.known.contains_key(*name)).count();
        own + self.known.keys().filter(|name| self.holder(name).is_some()).count()
    }

    /// What was refused because a node claims too much, or speaks nonsense.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// An object here claims a name. Answers the epoch, or nothing where it stands by.
    ///
    /// # Errors
    /// [`NameHeld`] where somebody else holds it and the policy is to be refused.
    pub fn handle_claim(
        &mut self,
        name: &ObjectName,
        policy: ClaimPolicy,
        now: Instant,
    ) -> Result<Option<u64>, NameHeld> {
        let holder = self.holder(name).map(|(holder, epoch)| (holder.clone(), epoch));
        match (holder, policy) {
            (None, _) => Ok(Some(self.take(name, policy))),
            (Some((holder, epoch)), _) if holder == self.config.node => Ok(Some(epoch)),
            (Some((holder, epoch)), ClaimPolicy::Refuse) => {
                Err(NameHeld { name: name.clone(), holder, epoch })
            }
            (Some(_), ClaimPolicy::Standby) => {
                self.set_own(name, Some(Own { policy, epoch: None }));
                self.look_at(name, now);
                Ok(None)
            }
        }
    }

    /// An object here gives a name back, or stands by no more.
    pub fn handle_withdrawn(&mut self, name: &ObjectName) {
        self.vacant.remove(name);
        self.set_own(name, None);
    }

    /// A session with a node has begun: it is told everything anew, whatever it knew.
    pub fn handle_opened(&mut self, node: NodeName, incarnation: Incarnation, now: Instant) {
        if self.peers.get(&node).is_some_and(|peer| peer.incarnation != incarnation) {
            self.forget(&node, now);
        }
        let fresh = Peer {
            incarnation,
            open: true,
            heard: now,
            claims: BTreeMap::new(),
            sum: 0,
            asked: None,
        };
        let peer = self.peers.entry(node.clone()).or_insert(fresh);
        (peer.open, peer.heard) = (true, now);
        self.tell_all(&node);
    }

    /// The session with a node has ended. Its claims hold until their lease is over.
    pub fn handle_ended(&mut self, node: &NodeName) {
        if let Some(peer) = self.peers.get_mut(node) {
            peer.open = false;
        }
    }

    /// A node tells something.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let Some(peer) = self.peers.get_mut(from).filter(|peer| peer.open) else { return };
        let Ok(message) = codec::decode_bounded::<Message, MESSAGE_MAX>(message) else {
            self.refused += 1;
            return;
        };
        peer.heard = now;
        match message {
            Message::All { first, last, claims } => {
                if first {
                    self.clear(from, now);
                }
                claims.into_iter().for_each(|told| self.hear(from, told, now));
                if let (true, Some(peer)) = (last, self.peers.get_mut(from)) {
                    peer.asked = None;
                }
            }
            Message::Changed { claims, gone } => {
                gone.iter().for_each(|name| self.unhear(from, name, now));
                claims.into_iter().for_each(|told| self.hear(from, told, now));
            }
            Message::Alive { sum } => {
                let again = self.config.lease / 4;
                let patient = peer.asked.is_some_and(|asked| now - asked < again);
                if sum != peer.sum && !patient {
                    peer.asked = Some(now);
                    self.send(from.clone(), &Message::TellAll);
                }
            }
            Message::TellAll => self.tell_all(from),
        }
    }

    fn hear(&mut self, from: &NodeName, told: Told, now: Instant) {
        let Some(peer) = self.peers.get_mut(from) else { return };
        let Told { name, epoch } = told;
        if peer.claims.len() >= CLAIMS_MAX && !peer.claims.contains_key(&name) {
            self.refused += 1;
            return;
        }
        let before = peer.claims.insert(name.clone(), epoch);
        peer.sum = peer.sum.wrapping_add(hash(&name, epoch));
        if let Some(before) = before {
            peer.sum = peer.sum.wrapping_sub(hash(&name, before));
        }
        self.last_epoch = self.last_epoch.max(epoch.unwrap_or_default());
        self.known.entry(name.clone()).or_default().insert(from.clone(), epoch);
        self.look_at(&name, now);
    }

    fn unhear(&mut self, from: &NodeName, name: &ObjectName, now: Instant) {
        if let Some(peer) = self.peers.get_mut(from)
            && let Some(epoch) = peer.claims.remove(name)
        {
            peer.sum = peer.sum.wrapping_sub(hash(name, epoch));
        }
        if let Some(claimants) = self.known.get_mut(name) {
            claimants.remove(from);
            if claimants.is_empty() {
                self.known.remove(name);
            }
        }
        self.look_at(name, now);
    }

    fn clear(&mut self, node: &NodeName, now: Instant) {
        let names: Vec<_> =
            self.peers.get(node).into_iter().flat_map(|peer| peer.claims.keys().cloned()).collect();
        names.iter().for_each(|name| self.unhear(node, name, now));
    }

    fn forget(&mut self, node: &NodeName, now: Instant) {
        self.clear(node, now);
        self.peers.remove(node);
    }

    /// Something is known anew of a name that may concern us.
    fn look_at(&mut self, name: &ObjectName, now: Instant) {
        let Some(own) = self.own.get(name) else { return };
        let (policy, ours) = (own.policy, own.epoch);
        let holder = self.holder(name).map(|(holder, epoch)| (holder.clone(), epoch));
        match (holder, ours) {
            (Some((holder, epoch)), Some(_)) if holder != self.config.node => {
                let stays = policy == ClaimPolicy::Standby;
                self.set_own(name, stays.then_some(Own { policy, epoch: None }));
                let name = name.clone();
                self.outputs.push_back(ClaimsOutput::Lost { name, to: holder, epoch });
            }
            (Some(_), _) => drop(self.vacant.remove(name)),
            (None, _) if self.vacant.contains_key(name) => {}
            (None, _) => {
                // Those before us by name have their turn first.
                let others = self.known.get(name).into_iter().flat_map(BTreeMap::keys);
                let before = others.filter(|node| **node < self.config.node).count();
                let turns = u32::try_from(before).unwrap_or(u32::MAX);
                let due = now + (self.config.lease / 4).saturating_mul(turns);
                self.vacant.insert(name.clone(), due);
            }
        }
    }

    fn take(&mut self, name: &ObjectName, policy: ClaimPolicy) -> u64 {
        self.last_epoch += 1;
        let epoch = self.last_epoch;
        self.vacant.remove(name);
        self.set_own(name, Some(Own { policy, epoch: Some(epoch) }));
        self.outputs.push_back(ClaimsOutput::Granted { name: name.clone(), epoch });
        epoch
    }

    /// Changes a claim of ours, and tells everybody.
    fn set_own(&mut self, name: &ObjectName, own: Option<Own>) {
        let epoch = own.as_ref().map(|own| own.epoch);
        let before = match own {
            Some(own) => self.own.insert(name.clone(), own),
            None => self.own.remove(name),
        };
        if let Some(before) = &before {
            self.sum = self.sum.wrapping_sub(hash(name, before.epoch));
        }
        let changed = match epoch {
            Some(epoch) => {
                self.sum = self.sum.wrapping_add(hash(name, epoch));
                let told = Told { name: name.clone(), epoch };
                Message::Changed { claims: vec![told], gone: vec![] }
            }
            None if before.is_some() => {
                Message::Changed { claims: vec![], gone: vec![name.clone()] }
            }
            None => return,
        };
        self.tell_everybody(&changed);
    }

    fn tell_everybody(&mut self, message: &Message) {
        let message = Bytes::from(codec::encode_unbounded(message));
        for (node, _) in self.peers.iter().filter(|(_, peer)| peer.open) {
            let (to, message) = (node.clone(), message.clone());
            self.outputs.push_back(ClaimsOutput::Send { to, message });
        }
    }

    fn tell_all(&mut self, to: &NodeName) {
        let told = |(name, own): (&ObjectName, &Own)| Told { name: name.clone(), epoch: own.epoch };
        let all: Vec<Told> = self.own.iter().map(told).collect();
        let mut parts: Vec<_> = all.chunks(CLAIMS_PER_MESSAGE).map(<[_]>::to_vec).collect();
        if parts.is_empty() {
            parts.push(vec![]);
        }
        let count = parts.len();
        for (n, claims) in parts.into_iter().enumerate() {
            let message = Message::All { first: n == 0, last: n + 1 == count, claims };
            self.send(to.clone(), &message);
        }
    }

    fn send(&mut self, to: NodeName, message: &Message) {
        let message = codec::encode_unbounded(message).into();
        self.outputs.push_back(ClaimsOutput::Send { to, message });
    }
}

impl Machine for Claims {
    type Output = ClaimsOutput;

    fn poll_output(&mut self) -> Option<ClaimsOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let lapses = self.peers.values().map(|peer| peer.heard + self.config.lease);
        let turns = self.vacant.values().copied();
        lapses.chain(turns).chain([self.alive_at]).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        if now >= self.alive_at {
            self.alive_at = now + self.config.lease / 4;
            let sum = self.sum;
            self.tell_everybody(&Message::Alive { sum });
        }
        let lapsed = |peer: &Peer| now >= peer.heard + self.config.lease;
        let gone: Vec<_> = self.peers.iter().filter(|(_, peer)| lapsed(peer)).collect();
        let gone: Vec<_> = gone.into_iter().map(|(node, peer)| (node.clone(), peer.open)).collect();
        for (node, open) in gone {
            match self.peers.get_mut(&node).filter(|_| open) {
                // It may speak again; then its sum differs, and it is asked.
                Some(peer) => {
                    peer.heard = now;
                    self.clear(&node, now);
                }
                None => self.forget(&node, now),
            }
        }
        let due: Vec<_> = self
            .vacant
            .iter()
            .filter(|(_, due)| now >= **due)
            .map(|(name, _)| name.clone())
            .collect();
        for name in due {
            if let Some(policy) = self.own.get(&name).map(|own| own.policy) {
                self.take(&name, policy);
            }
        }
    }
}

/// Whether the first claim goes before the second.
fn precedes(one: (&NodeName, u64), other: (&NodeName, u64)) -> bool {
    (one.1, other.0) > (other.1, one.0)
}

/// FNV-1a over the claim, as for contracts: against accidents, not against intent.
fn hash(name: &ObjectName, epoch: Option<u64>) -> u64 {
    let epoch = epoch.unwrap_or_default().to_le_bytes();
    let bytes = name.as_str().as_bytes().iter().chain(&epoch);
    bytes.fold(0xcbf2_9ce4_8422_2325, |hash: u64, byte| {
        (hash ^ u64::from(*byte)).wrapping_mul(0x0000_0100_0000_01b3)
    })
}

#[cfg(test)]
mod tests;
