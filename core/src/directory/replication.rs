//! What nodes tell each other of their records.

use super::claims::EPOCH_MAX;
use super::types::{DirectoryMessage, DirectoryRecord, NameClaim};
use super::{
    CLAIMS_MAX, Directory, DirectoryKey, DirectoryOutput, DirectoryPeer, NAMES_MAX, PRESENT_MAX,
    Reachability,
};
use crate::contract::codec;
use crate::{Instant, NodeName};
use bytes::Bytes;
use std::collections::BTreeSet;

/// How many records go into one message; at 420 bytes each it stays below any limit.
const RECORDS_PER_MESSAGE: usize = 128;
/// The most bytes of one message.
pub(super) const MESSAGE_MAX: usize = 64 * 1024;

impl Directory {
    /// A node tells something.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let Some(peer) = self.peers.get_mut(from) else { return };
        let Ok(message) = codec::decode_bounded::<DirectoryMessage, MESSAGE_MAX>(message) else {
            peer.refusals.malformed += 1;
            return;
        };
        match message {
            DirectoryMessage::All { first, last, records } => {
                self.hear_all(from, first, last, records, now)
            }
            DirectoryMessage::Changed { records, gone } => {
                gone.iter().for_each(|key| self.unhear(from, key, now));
                records.into_iter().for_each(|record| self.hear(from, record, now));
            }
        }
    }

    /// What it does not name in all the parts, it has no more. Until the last part, what was known
    /// holds: a record does not come and go because it is told again.
    fn hear_all(
        &mut self,
        from: &NodeName,
        first: bool,
        last: bool,
        records: Vec<DirectoryRecord>,
        now: Instant,
    ) {
        if let (true, Some(peer)) = (first, self.peers.get_mut(from)) {
            peer.telling = Some(BTreeSet::new());
        }
        records.into_iter().for_each(|record| self.hear(from, record, now));
        let Some(peer) = self.peers.get_mut(from).filter(|_| last) else { return };
        let Some(told) = peer.telling.take() else { return };
        peer.complete = true;
        let gone: Vec<_> =
            peer.records.keys().filter(|key| !told.contains(*key)).cloned().collect();
        gone.iter().for_each(|key| self.unhear(from, key, now));
        let complete = |node| self.peers.get(node).is_some_and(|peer| peer.complete);
        if !self.config.expected.is_empty() && self.config.expected.iter().all(complete) {
            self.settle(now);
        }
    }

    pub(super) fn hear(&mut self, from: &NodeName, record: DirectoryRecord, now: Instant) {
        let Some(peer) = self.peers.get_mut(from) else { return };
        let DirectoryRecord { key, claim } = record;
        let full = match &key {
            DirectoryKey::Name(name) => {
                self.known.len() >= NAMES_MAX && !self.known.contains_key(name)
            }
            DirectoryKey::Object(_) | DirectoryKey::Publisher { .. } => false,
        };
        let records = &peer.records;
        let full = full || records.len() >= CLAIMS_MAX + PRESENT_MAX && !records.contains_key(&key);
        let malformed = claim.epoch.is_some_and(|epoch| epoch >= EPOCH_MAX) || !key.is_short();
        if full || malformed {
            peer.refusals.too_large += u64::from(full);
            peer.refusals.malformed += u64::from(malformed);
            return;
        }
        if let Some(telling) = &mut peer.telling {
            telling.insert(key.clone());
        }
        let before = peer.records.insert(key.clone(), claim.clone());
        if before.as_ref() != Some(&claim)
            && peer.reachability != Reachability::Gone
            && let DirectoryKey::Name(name) = &key
        {
            self.believe(from, name, claim);
            self.look_at(name, now);
        }
    }

    /// All that a node claims counts from now on.
    pub(super) fn count_claims(&mut self, from: &NodeName, now: Instant) {
        let records = self.peers.get(from).map(|peer| peer.records.clone());
        for (key, claim) in records.into_iter().flatten() {
            if let DirectoryKey::Name(name) = key {
                self.believe(from, &name, claim);
                self.look_at(&name, now);
            }
        }
    }

    pub(super) fn unhear(&mut self, from: &NodeName, key: &DirectoryKey, now: Instant) {
        let Some(peer) = self.peers.get_mut(from) else { return };
        if peer.records.remove(key).is_none() {
            return;
        }
        if let Some(telling) = &mut peer.telling {
            telling.remove(key);
        }
        self.discount(from, key, now);
    }

    /// A record counts no more.
    fn discount(&mut self, from: &NodeName, key: &DirectoryKey, now: Instant) {
        if let DirectoryKey::Name(name) = key {
            self.disbelieve(from, name);
            self.look_at(name, now);
        }
    }

    /// The records of a node count no more.
    pub(super) fn clear(&mut self, node: &NodeName, now: Instant) {
        let records = self.peers.get(node).into_iter().flat_map(|peer| peer.records.keys());
        let keys: Vec<_> = records.cloned().collect();
        keys.iter().for_each(|key| self.discount(node, key, now));
    }

    /// Changes records of ours, and tells all nodes.
    pub(super) fn record(&mut self, changes: Vec<(DirectoryKey, Option<NameClaim>)>) {
        for part in changes.chunks(RECORDS_PER_MESSAGE) {
            let (mut records, mut gone) = (Vec::new(), Vec::new());
            for (key, claim) in part.iter().cloned() {
                let before = match &claim {
                    Some(claim) => self.records.insert(key.clone(), claim.clone()),
                    None => self.records.remove(&key),
                };
                if before == claim {
                    continue;
                }
                match claim {
                    Some(claim) => records.push(DirectoryRecord { key, claim }),
                    None => gone.push(key),
                }
            }
            if !records.is_empty() || !gone.is_empty() {
                self.broadcast(&DirectoryMessage::Changed { records, gone });
            }
        }
    }

    fn broadcast(&mut self, message: &DirectoryMessage) {
        let message = Bytes::from(codec::encode_unbounded(message));
        for (node, _) in self.peers.iter().filter(|(_, peer)| !peer.ended) {
            let (to, message) = (node.clone(), message.clone());
            self.outputs.push_back(DirectoryOutput::Send { to, message });
        }
    }

    pub(super) fn tell_all(&mut self, to: &NodeName) {
        let all = self.records.iter();
        let all =
            all.map(|(key, claim)| DirectoryRecord { key: key.clone(), claim: claim.clone() });
        let all: Vec<DirectoryRecord> = all.collect();
        let mut parts: Vec<_> = all.chunks(RECORDS_PER_MESSAGE).map(<[_]>::to_vec).collect();
        if parts.is_empty() {
            parts.push(vec![]);
        }
        let count = parts.len();
        for (n, records) in parts.into_iter().enumerate() {
            let message = DirectoryMessage::All { first: n == 0, last: n + 1 == count, records };
            let (to, message) = (to.clone(), codec::encode_unbounded(&message).into());
            self.outputs.push_back(DirectoryOutput::Send { to, message });
        }
    }

    /// Ends what nodes have told that could not be reached for a lease.
    pub(super) fn expire_leases(&mut self, now: Instant) {
        let lapsed = |peer: &DirectoryPeer| matches!(peer.reachability, Reachability::Away { until } if now >= until);
        let gone = self.peers.iter().filter(|(_, peer)| lapsed(peer));
        let gone: Vec<_> = gone.map(|(node, _)| node.clone()).collect();
        for node in gone {
            self.clear(&node, now);
            match self.peers.get_mut(&node).filter(|peer| !peer.ended) {
                Some(peer) => peer.reachability = Reachability::Gone,
                None => drop(self.peers.remove(&node)),
            }
        }
    }
}
