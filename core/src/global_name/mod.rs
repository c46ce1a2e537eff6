//! Global names: their claimants, holders and successors.
//!
//! An object's address names its node. A *claim* is a name without one, such as `map`: one node
//! holds it, others may stand by, and all know who does. There is no broker: each node tells every
//! other, over their session, what it claims.
//!
//! ```text
//!  session begins      All (in parts)        everything the node claims
//!  something changes   Changed               what came and went
//!  a quarter of the    Alive                 a sum over the claims, while there are any: a node
//!  lease has passed                          with another sum asks for all of them (TellAll)
//! ```
//!
//! What a node claims holds for a lease after it was last heard of. Every claim that is granted has
//! an epoch, greater than any that its node has seen; of two holders of one name, as two halves of
//! a network may bring them forth, the one of the greater epoch stays, and of equal ones the first
//! by name. A node that has just started grants itself nothing until it has heard the others, so
//! that it takes no name from its holder. That is enough for finding things. Where two at a time
//! would do harm, use a service, which needs a majority.
//!
//! Epochs do not run out, whatever a claimant tells. It is believed to hold the name under the
//! epoch that it tells, but how far that raises the epochs of others is bounded:
//!
//! ```text
//!  up to 2^60    all the way: clocks reach it until the year 2527, so that any epoch below it may
//!                be honest
//!  above it      by 2^10 for each claim: honest nodes come there by single steps alone
//!  from 2^62 on  refused
//! ```
//!
//! A hostile claimant takes 3 * 2^50 claims to use them up: a thousand years at 100,000 claims in a
//! second. It cannot be refused instead: a node that has just started cannot know which epochs the
//! others have reached. After such a claim the next holder's epoch may be the smaller one.

pub use self::types::{
    ClaimPolicy, ClaimRefused, ClaimRequest, GlobalNamesConfig, GlobalNamesOutput, Holder, NameHeld,
};
pub use self::unmet::UnmetClaims;

use self::types::{ClaimRecord, GlobalNameMessage, NameClaim};
use crate::contract::codec;
use crate::net::trust::access::AccessPolicy;
use crate::net::wire::Refusals;
use crate::sorted::{SortedMap, SortedSet};
use crate::timer::Timers;
use crate::{Incarnation, Instant, Machine, NodeName, ObjectName};
use bytes::Bytes;
use std::collections::VecDeque;

/// The most claims of one node: what a large robot has in all, ten times over.
pub const CLAIMS_MAX: usize = 10_000;
/// The most names that are known in all: some of several nodes that claim as much as they may.
pub const NAMES_MAX: usize = 100_000;
/// Epochs are below it.
const EPOCH_MAX: u64 = 1 << 62;
/// The greatest epoch that an incarnation begins with: the milliseconds of its clock times 2^16,
/// until the year 2527.
const EPOCH_OF_CLOCKS: u64 = 1 << 60;
/// How far one claim of another node raises epochs above that. Greater ones keep epochs in their
/// order for longer after a claimant has told one above it, and use them up sooner.
const EPOCH_STEP: u64 = 1 << 10;
/// How many claims go into one message; at 280 bytes each it stays below any limit.
const CLAIMS_PER_MESSAGE: usize = 200;
/// The most bytes of one message.
pub const MESSAGE_MAX: usize = 64 * 1024;

#[derive(Debug)]
struct Own {
    object: ObjectName,
    policy: ClaimPolicy,
    epoch: Option<u64>,
}

/// What is known of another node.
#[derive(Debug)]
struct Peer {
    incarnation: Incarnation,
    /// A session is open.
    open: bool,
    received_at: Instant,
    claims: SortedMap<ObjectName, NameClaim>,
    sum: u64,
    /// Which of them it has told of since it began to tell all of them.
    telling: Option<SortedSet<ObjectName>>,
    /// It has told all of them.
    complete: bool,
    /// When it was last asked for everything.
    asked: Option<Instant>,
    /// When it was last told everything.
    sent_all_at: Instant,
    refusals: Refusals,
}

/// The claims of all nodes, as one node knows them.
#[derive(Debug)]
pub struct GlobalNames {
    config: GlobalNamesConfig,
    own: SortedMap<ObjectName, Own>,
    sum: u64,
    peers: SortedMap<NodeName, Peer>,
    /// Who has claimed which name, or stands by.
    known: SortedMap<ObjectName, SortedMap<NodeName, NameClaim>>,
    /// Who was last told to hold which.
    shown: SortedMap<ObjectName, Holder>,
    /// Names without a holder that we stand by for, and when we take them.
    vacant: SortedMap<ObjectName, Instant>,
    last_epoch: u64,
    alive_at: Instant,
    /// Which nodes may claim which names; without one, all may.
    access: Option<AccessPolicy>,
    /// Until then nothing is granted; `None` once that is over.
    settles: Option<Instant>,
    /// In the place of another machine of the same incarnation: it has forgotten what it was
    /// record.
    forgetful: bool,
    outputs: VecDeque<GlobalNamesOutput>,
}

impl GlobalNames {
    /// Nothing is claimed yet.
    pub fn new(config: GlobalNamesConfig, now: Instant) -> Self {
        // Above what an earlier incarnation of this node gave out, should no node be left that
        // remembers.
        let last_epoch = config.incarnation.0.saturating_mul(1 << 16).min(EPOCH_OF_CLOCKS);
        let alive_at = now + config.lease / 4;
        let settles = (!config.settle.is_zero()).then(|| now + config.settle);
        GlobalNames {
            config,
            own: SortedMap::new(),
            sum: 0,
            peers: SortedMap::new(),
            known: SortedMap::new(),
            shown: SortedMap::new(),
            vacant: SortedMap::new(),
            last_epoch,
            alive_at,
            access: None,
            settles,
            forgetful: false,
            outputs: VecDeque::new(),
        }
    }

    /// Claims in the place of others of the same incarnation that were lost: with what that
    /// incarnation claims, and under which epochs. What others claim, they are asked when their
    /// sessions are told of again.
    pub fn restarted(
        config: GlobalNamesConfig,
        own: impl IntoIterator<Item = (ClaimRequest, Option<u64>)>,
        now: Instant,
    ) -> Self {
        // Two chances to hear what the others have, should the first be missed.
        let settle = config.lease / 2;
        let mut claims = GlobalNames::new(GlobalNamesConfig { settle, ..config }, now);
        claims.forgetful = true;
        for (ClaimRequest { name, object, policy }, epoch) in own {
            claims.last_epoch = claims.last_epoch.max(epoch.unwrap_or_default());
            claims.set_own(&name, Some(Own { object, policy, epoch }));
        }
        claims
    }

    /// Who holds a name, here or elsewhere.
    pub fn holder(&self, name: &ObjectName) -> Option<Holder> {
        let own = self.own.get(name).and_then(|own| Some((own.epoch?, &own.object)));
        let own = own.map(|(epoch, object)| (&self.config.node, epoch, Some(object)));
        let others = self.known.get(name).into_iter().flatten();
        let others =
            others.filter_map(|(node, stake)| Some((node, stake.epoch?, stake.object.as_ref())));
        let first = others.chain(own).reduce(|a, b| {
            // Of equal ones the first by name.
            if (b.1, a.0) > (a.1, b.0) { b } else { a }
        });
        first.map(|(node, epoch, object)| Holder {
            node: node.clone(),
            object: object.unwrap_or(name).clone(),
            epoch,
        })
    }

    /// How many names are known to be held, here and elsewhere.
    pub fn held(&self) -> usize {
        self.shown.len()
    }

    /// What was refused of each node: more claims than one may have, and nonsense.
    pub fn refusals(&self) -> impl Iterator<Item = (&NodeName, Refusals)> {
        self.peers.iter().map(|(node, peer)| (node, peer.refusals))
    }

    /// An object here claims a name. Answers the epoch, or nothing where it stands by, or has to
    /// wait: it is told later then.
    ///
    /// # Errors
    /// [`ClaimRefused`] where another claimant holds it and the policy is to be refused, and where
    /// this node may not claim it.
    pub fn handle_claim(
        &mut self,
        wanted: ClaimRequest,
        now: Instant,
    ) -> Result<Option<u64>, ClaimRefused> {
        let ClaimRequest { name, object, policy } = wanted;
        self.may_claim(&self.config.node, &name).map_err(|denied| ClaimRefused::from(&*denied))?;
        if self.own.len() >= CLAIMS_MAX && !self.own.contains_key(&name) {
            return Err(ClaimRefused::TooMany { limit: CLAIMS_MAX });
        }
        if let Some(Own { epoch: Some(epoch), .. }) = self.own.get(&name) {
            return Ok(Some(*epoch));
        }
        match (self.holder(&name), policy) {
            (Some(Holder { node: holder, epoch, .. }), ClaimPolicy::Refuse) => {
                Err(NameHeld { name, holder, epoch }.into())
            }
            (None, _) if self.settles.is_none() => {
                self.set_own(&name, Some(Own { object, policy, epoch: None }));
                Ok(self.take(&name))
            }
            _ => {
                self.set_own(&name, Some(Own { object, policy, epoch: None }));
                self.look_at(&name, now);
                Ok(None)
            }
        }
    }

    /// An object here gives a name back, or stands by no more.
    pub fn handle_withdrawn(&mut self, name: &ObjectName) {
        self.vacant.remove(name);
        self.set_own(name, None);
    }

    /// A session with a node has begun: it is told everything again, whatever it knew.
    pub fn handle_opened(&mut self, node: NodeName, incarnation: Incarnation, now: Instant) {
        if self.peers.get(&node).is_some_and(|peer| peer.incarnation != incarnation) {
            self.handle_left(&node, now);
        }
        let fresh = Peer {
            incarnation,
            open: true,
            received_at: now,
            claims: SortedMap::new(),
            sum: 0,
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
            self.send(node, &GlobalNameMessage::TellAll);
        }
    }

    /// The session with a node has ended. Its claims hold until their lease is over.
    pub fn handle_ended(&mut self, node: &NodeName) {
        if let Some(peer) = self.peers.get_mut(node) {
            peer.open = false;
        }
    }

    /// A node has ended in order, or was restarted: its claims are over.
    pub fn handle_left(&mut self, node: &NodeName, now: Instant) {
        self.clear(node, now);
        self.peers.remove(node);
    }

    /// A node tells something.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let Some(peer) = self.peers.get_mut(from).filter(|peer| peer.open) else { return };
        let Ok(message) = codec::decode_bounded::<GlobalNameMessage, MESSAGE_MAX>(message) else {
            peer.refusals.malformed += 1;
            return;
        };
        peer.received_at = now;
        match message {
            GlobalNameMessage::All { first, last, claims } => {
                self.hear_all(from, (first, last), claims, now)
            }
            GlobalNameMessage::Changed { claims, gone } => {
                gone.iter().for_each(|name| self.unhear(from, name, now));
                claims.into_iter().for_each(|record| self.hear(from, record, now));
            }
            GlobalNameMessage::Alive { sum } => {
                let again = self.config.lease / 4;
                let patient = peer.asked.is_some_and(|asked| now - asked < again);
                if sum != peer.sum && !patient {
                    peer.asked = Some(now);
                    self.send(from.clone(), &GlobalNameMessage::TellAll);
                }
            }
            // However often it asks: everything may be megabytes.
            GlobalNameMessage::TellAll if now < peer.sent_all_at + self.config.lease / 8 => {
                peer.refusals.unexpected += 1;
            }
            GlobalNameMessage::TellAll => self.tell_all(from, now),
        }
    }

    /// What it does not name in all the parts, it claims no more. Until the last part, what was
    /// known holds: a name does not come and go because it is told again.
    fn hear_all(
        &mut self,
        from: &NodeName,
        (first, last): (bool, bool),
        claims: Vec<ClaimRecord>,
        now: Instant,
    ) {
        if let (true, Some(peer)) = (first, self.peers.get_mut(from)) {
            peer.telling = Some(SortedSet::new());
        }
        claims.into_iter().for_each(|record| self.hear(from, record, now));
        let Some(peer) = self.peers.get_mut(from).filter(|_| last) else { return };
        let Some(names) = peer.telling.take() else { return };
        (peer.asked, peer.complete) = (None, true);
        let gone: Vec<_> =
            peer.claims.keys().filter(|name| !names.contains(*name)).cloned().collect();
        gone.iter().for_each(|name| self.unhear(from, name, now));
        let complete = |node| self.peers.get(node).is_some_and(|peer| peer.complete);
        if !self.config.expected.is_empty() && self.config.expected.iter().all(complete) {
            self.settle(now);
        }
    }

    fn hear(&mut self, from: &NodeName, record: ClaimRecord, now: Instant) {
        let Some(peer) = self.peers.get_mut(from) else { return };
        let ClaimRecord { name, stake } = record;
        let full = peer.claims.len() >= CLAIMS_MAX && !peer.claims.contains_key(&name)
            || self.known.len() >= NAMES_MAX && !self.known.contains_key(&name);
        let beyond = stake.epoch.is_some_and(|epoch| epoch >= EPOCH_MAX);
        if full || beyond {
            peer.refusals.too_large += u64::from(full);
            peer.refusals.malformed += u64::from(beyond);
            return;
        }
        if let Some(telling) = &mut peer.telling {
            telling.insert(name.clone());
        }
        let before = peer.claims.insert(name.clone(), stake.clone());
        peer.sum = peer.sum.wrapping_add(stake.sum(&name));
        if let Some(before) = &before {
            peer.sum = peer.sum.wrapping_sub(before.sum(&name));
        }
        if before.as_ref() == Some(&stake) {
            return;
        }
        self.believe(from, &name, stake);
        self.look_at(&name, now);
    }

    fn unhear(&mut self, from: &NodeName, name: &ObjectName, now: Instant) {
        if let Some(peer) = self.peers.get_mut(from)
            && let Some(stake) = peer.claims.remove(name)
        {
            peer.sum = peer.sum.wrapping_sub(stake.sum(name));
            if let Some(telling) = &mut peer.telling {
                telling.remove(name);
            }
        }
        self.disbelieve(from, name);
        self.look_at(name, now);
    }

    fn clear(&mut self, node: &NodeName, now: Instant) {
        let names: Vec<_> =
            self.peers.get(node).into_iter().flat_map(|peer| peer.claims.keys().cloned()).collect();
        names.iter().for_each(|name| self.unhear(node, name, now));
    }

    /// Something new is known of a name: it is shown, and may concern us.
    fn look_at(&mut self, name: &ObjectName, now: Instant) {
        let holder = self.holder(name);
        self.show(name, holder.clone());
        let Some(own) = self.own.get(name) else { return };
        let (policy, ours) = (own.policy, own.epoch);
        match (holder, ours) {
            (Some(Holder { node, epoch, .. }), Some(_)) if node != self.config.node => {
                let object = own.object.clone();
                let stands_by = policy == ClaimPolicy::Standby;
                self.set_own(name, stands_by.then_some(Own { object, policy, epoch: None }));
                let (name, to) = (name.clone(), node);
                self.outputs.push_back(GlobalNamesOutput::Lost { name, to, epoch, stands_by });
            }
            (Some(Holder { node: holder, epoch, .. }), None) if policy == ClaimPolicy::Refuse => {
                self.handle_withdrawn(name);
                let refused = NameHeld { name: name.clone(), holder, epoch }.into();
                let name = name.clone();
                self.outputs.push_back(GlobalNamesOutput::Refused { name, refused });
            }
            (Some(_), Some(_)) => {}
            (Some(_), None) => {
                self.vacant.remove(name);
                self.outputs.push_back(GlobalNamesOutput::StandsBy { name: name.clone() });
            }
            (None, _) if self.settles.is_some() || self.vacant.contains_key(name) => {}
            (None, _) => {
                // Those before us by name have their turn first.
                let others = self.known.get(name).into_iter().flat_map(SortedMap::keys);
                let before = others.filter(|node| **node < self.config.node).count();
                let turns = u32::try_from(before).unwrap_or(u32::MAX);
                let due = now + (self.config.lease / 4).saturating_mul(turns);
                self.vacant.insert(name.clone(), due);
            }
        }
    }

    fn show(&mut self, name: &ObjectName, holder: Option<Holder>) {
        if self.shown.get(name) == holder.as_ref() {
            return;
        }
        match &holder {
            Some(holder) => self.shown.insert(name.clone(), holder.clone()),
            None => self.shown.remove(name),
        };
        self.outputs.push_back(GlobalNamesOutput::Held { name: name.clone(), holder });
    }

    /// The others have been heard: waiting claims are granted, if the name has no holder.
    fn settle(&mut self, now: Instant) {
        if self.settles.take().is_some() {
            let waiting = self.own.iter().filter(|(_, own)| own.epoch.is_none());
            let waiting: Vec<_> = waiting.map(|(name, _)| name.clone()).collect();
            waiting.iter().for_each(|name| self.look_at(name, now));
        }
    }

    /// Takes a name that is wanted here and that has no holder.
    fn take(&mut self, name: &ObjectName) -> Option<u64> {
        self.vacant.remove(name);
        let Own { object, policy, .. } = self.own.get(name)?;
        let (object, policy) = (object.clone(), *policy);
        self.last_epoch = (self.last_epoch + 1).min(EPOCH_MAX - 1);
        let epoch = self.last_epoch;
        self.set_own(name, Some(Own { object, policy, epoch: Some(epoch) }));
        self.outputs.push_back(GlobalNamesOutput::Granted { name: name.clone(), epoch });
        Some(epoch)
    }

    /// Changes a claim of ours, and tells everybody.
    fn set_own(&mut self, name: &ObjectName, own: Option<Own>) {
        let stake = own.as_ref().map(|own| own.stake(name));
        let before = match own {
            Some(own) => self.own.insert(name.clone(), own),
            None => self.own.remove(name),
        };
        if let Some(before) = &before {
            self.sum = self.sum.wrapping_sub(before.stake(name).sum(name));
        }
        let changed = match stake {
            Some(stake) => {
                self.sum = self.sum.wrapping_add(stake.sum(name));
                GlobalNameMessage::Changed {
                    claims: vec![ClaimRecord { name: name.clone(), stake }],
                    gone: vec![],
                }
            }
            None if before.is_some() => {
                GlobalNameMessage::Changed { claims: vec![], gone: vec![name.clone()] }
            }
            None => return,
        };
        self.tell_everybody(&changed);
        let holder = self.holder(name);
        self.show(name, holder);
    }

    fn tell_everybody(&mut self, message: &GlobalNameMessage) {
        let message = Bytes::from(codec::encode_unbounded(message));
        for (node, _) in self.peers.iter().filter(|(_, peer)| peer.open) {
            let (to, message) = (node.clone(), message.clone());
            self.outputs.push_back(GlobalNamesOutput::Send { to, message });
        }
    }

    fn tell_all(&mut self, to: &NodeName, now: Instant) {
        if let Some(peer) = self.peers.get_mut(to) {
            peer.sent_all_at = now;
        }
        let record = |(name, own): (&ObjectName, &Own)| ClaimRecord {
            name: name.clone(),
            stake: own.stake(name),
        };
        let all: Vec<ClaimRecord> = self.own.iter().map(record).collect();
        let mut parts: Vec<_> = all.chunks(CLAIMS_PER_MESSAGE).map(<[_]>::to_vec).collect();
        if parts.is_empty() {
            parts.push(vec![]);
        }
        let count = parts.len();
        for (n, claims) in parts.into_iter().enumerate() {
            let message = GlobalNameMessage::All { first: n == 0, last: n + 1 == count, claims };
            self.send(to.clone(), &message);
        }
    }

    fn send(&mut self, to: NodeName, message: &GlobalNameMessage) {
        let message = codec::encode_unbounded(message).into();
        self.outputs.push_back(GlobalNamesOutput::Send { to, message });
    }
}

impl Own {
    fn stake(&self, name: &ObjectName) -> NameClaim {
        let object = (self.object != *name).then(|| self.object.clone());
        NameClaim { epoch: self.epoch, object }
    }
}

impl Machine for GlobalNames {
    type Output = GlobalNamesOutput;

    fn poll_output(&mut self) -> Option<GlobalNamesOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.next_due()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.fire_due(now);
    }
}

mod access;
#[cfg(test)]
mod tests;
mod timers;
mod types;
mod unmet;
