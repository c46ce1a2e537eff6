//! What nodes tell each other of their records.

use super::claims::EPOCH_MAX;
use super::types::{DirectoryMessage, DirectoryRecord, NameClaim};
use super::{
    CLAIMS_MAX, Directory, DirectoryKey, DirectoryOutput, DirectoryPeer, NAMES_MAX, PRESENT_MAX,
};
use crate::contract::codec;
use crate::sorted::SortedSet;
use crate::{Instant, NodeName};
use bytes::Bytes;

/// How many records go into one message; at 420 bytes each it stays below any limit.
const RECORDS_PER_MESSAGE: usize = 128;
/// The most bytes of one message.
pub(super) const MESSAGE_MAX: usize = 64 * 1024;

impl Directory {
    /// A node tells something.
    pub fn handle_message(&mut self, from: &NodeName, message: &[u8], now: Instant) {
        let Some(peer) = self.peers.get_mut(from).filter(|peer| peer.open) else { return };
        let Ok(message) = codec::decode_bounded::<DirectoryMessage, MESSAGE_MAX>(message) else {
            peer.refusals.malformed += 1;
            return;
        };
        peer.received_at = now;
        match message {
            DirectoryMessage::All { first, last, records } => {
                self.hear_all(from, (first, last), records, now)
            }
            DirectoryMessage::Changed { records, gone } => {
                gone.iter().for_each(|key| self.unhear(from, key, now));
                records.into_iter().for_each(|record| self.hear(from, record, now));
            }
            DirectoryMessage::Alive { sum } => {
                let again = self.config.lease / 4;
                let patient = peer.asked.is_some_and(|asked| now - asked < again);
                if sum != peer.table.sum && !patient {
                    peer.asked = Some(now);
                    self.ask_for_all(from.clone());
                }
            }
            // However often it asks: everything may be megabytes.
            DirectoryMessage::TellAll if now < peer.sent_all_at + self.config.lease / 8 => {
                peer.refusals.unexpected += 1;
            }
            DirectoryMessage::TellAll => self.tell_all(from, now),
        }
    }

    /// What it does not name in all the parts, it has no more. Until the last part, what was known
    /// holds: a record does not come and go because it is told again.
    fn hear_all(
        &mut self,
        from: &NodeName,
        (first, last): (bool, bool),
        records: Vec<DirectoryRecord>,
        now: Instant,
    ) {
        if let (true, Some(peer)) = (first, self.peers.get_mut(from)) {
            peer.telling = Some(SortedSet::new());
        }
        records.into_iter().for_each(|record| self.hear(from, record, now));
        let Some(peer) = self.peers.get_mut(from).filter(|_| last) else { return };
        let Some(told) = peer.telling.take() else { return };
        (peer.asked, peer.complete) = (None, true);
        let gone: Vec<_> =
            peer.table.records.keys().filter(|key| !told.contains(*key)).cloned().collect();
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
        let records = &peer.table.records;
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
        if peer.table.set(&key, Some(&claim)).as_ref() == Some(&claim) {
            return;
        }
        match &key {
            DirectoryKey::Name(name) => {
                self.believe(from, name, claim);
                self.look_at(name, now);
            }
            DirectoryKey::Object(_) | DirectoryKey::Publisher { .. } => self.show_record(from, key),
        }
    }

    pub(super) fn unhear(&mut self, from: &NodeName, key: &DirectoryKey, now: Instant) {
        let Some(peer) = self.peers.get_mut(from) else { return };
        if peer.table.set(key, None).is_none() {
            return;
        }
        if let Some(telling) = &mut peer.telling {
            telling.remove(key);
        }
        match key {
            DirectoryKey::Name(name) => {
                self.disbelieve(from, name);
                self.look_at(name, now);
            }
            DirectoryKey::Object(_) | DirectoryKey::Publisher { .. } => {
                let (node, key) = (from.clone(), key.clone());
                self.outputs.push_back(DirectoryOutput::RecordRemoved { node, key });
            }
        }
    }

    /// Forgets these records of a node.
    pub(super) fn clear(
        &mut self,
        node: &NodeName,
        now: Instant,
        is_cleared: impl Fn(&DirectoryKey) -> bool,
    ) {
        let records = self.peers.get(node).into_iter().flat_map(|peer| peer.table.records.keys());
        let keys: Vec<_> = records.filter(|key| is_cleared(key)).cloned().collect();
        keys.iter().for_each(|key| self.unhear(node, key, now));
    }

    /// Changes records of ours, and tells all nodes.
    pub(super) fn record(&mut self, changes: Vec<(DirectoryKey, Option<NameClaim>)>) {
        for part in changes.chunks(RECORDS_PER_MESSAGE) {
            let (mut records, mut gone) = (Vec::new(), Vec::new());
            for (key, claim) in part.iter().cloned() {
                if self.table.set(&key, claim.as_ref()) == claim {
                    continue;
                }
                match claim {
                    Some(claim) => records.push(DirectoryRecord { key, claim }),
                    None => gone.push(key),
                }
            }
            if !records.is_empty() || !gone.is_empty() {
                self.tell_everybody(&DirectoryMessage::Changed { records, gone });
            }
        }
    }

    /// Tells all nodes that this one is alive, and what its records add up to.
    pub(super) fn renew(&mut self, now: Instant) {
        self.renewed_at = now;
        self.tell_everybody(&DirectoryMessage::Alive { sum: self.table.sum });
    }

    fn tell_everybody(&mut self, message: &DirectoryMessage) {
        let message = Bytes::from(codec::encode_unbounded(message));
        for (node, _) in self.peers.iter().filter(|(_, peer)| peer.open) {
            let (to, message) = (node.clone(), message.clone());
            self.outputs.push_back(DirectoryOutput::Send { to, message });
        }
    }

    pub(super) fn tell_all(&mut self, to: &NodeName, now: Instant) {
        if let Some(peer) = self.peers.get_mut(to) {
            peer.sent_all_at = now;
        }
        let all = self.table.records.iter();
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
            self.send(to.clone(), &message);
        }
    }

    pub(super) fn ask_for_all(&mut self, node: NodeName) {
        self.send(node, &DirectoryMessage::TellAll);
    }

    fn send(&mut self, to: NodeName, message: &DirectoryMessage) {
        let message = codec::encode_unbounded(message).into();
        self.outputs.push_back(DirectoryOutput::Send { to, message });
    }

    /// Ends what nodes have told that have not renewed it.
    pub(super) fn expire_leases(&mut self, now: Instant) {
        let lapsed = |peer: &DirectoryPeer| now >= peer.received_at + self.config.lease;
        let gone = self.peers.iter().filter(|(_, peer)| lapsed(peer));
        let gone: Vec<_> = gone.map(|(node, peer)| (node.clone(), peer.open)).collect();
        for (node, open) in gone {
            match self.peers.get_mut(&node).filter(|_| open) {
                // It may speak again; then its sum differs, and it is asked.
                Some(peer) => {
                    peer.received_at = now;
                    self.clear(&node, now, |key| matches!(key, DirectoryKey::Name(_)));
                }
                None => self.handle_left(&node, now),
            }
        }
    }
}
