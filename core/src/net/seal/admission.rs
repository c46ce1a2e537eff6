//! What happens to a handshake's frame before any arithmetic on curves: repeats, rates, cookies.
//!
//! The bounds hold for all peers of a node together, so that frames of nodes without a key take a
//! fixed amount of memory and of time.

use super::noise::{MacKey, SeedGenerator};
use crate::Instant;
use crate::net::wire::node_id::NodeId;
use std::collections::VecDeque;
use std::hash::{Hash, Hasher};
use std::time::Duration;

/// Handshakes that are remembered, of all peers and of one. Who repeats an older one must have
/// listened for so many hours.
pub(super) const REPEATS_MAX: usize = 256;
const REPEATS_OF_ONE: usize = 64;

/// The handshakes that were seen lately.
#[derive(Debug, Default)]
pub(super) struct RepeatMemory {
    /// The oldest first: the peer, and what is different in each handshake.
    seen: VecDeque<(NodeId, u64)>,
}

impl RepeatMemory {
    pub(super) fn contains(&self, peer: NodeId, unique: u64) -> bool {
        self.seen.contains(&(peer, unique))
    }

    pub(super) fn insert(&mut self, peer: NodeId, unique: u64) {
        let of_peer = self.seen.iter().filter(|(of, _)| *of == peer).count();
        let oldest = if of_peer >= REPEATS_OF_ONE {
            self.seen.iter().position(|(of, _)| *of == peer)
        } else {
            (self.seen.len() >= REPEATS_MAX).then_some(0)
        };
        oldest.map(|at| self.seen.remove(at));
        self.seen.push_back((peer, unique));
    }
}

/// So many handshakes a node takes part in within [`BUDGET_PERIOD`], of all peers together: 26 ms
/// of processor time, and as many as a robot's nodes when all are switched on together.
pub(super) const BUDGET: u32 = 64;
pub(super) const BUDGET_PERIOD: Duration = Duration::from_secs(1);

/// Makes cookies: who shows one has received what was sent to its address (RFC 7296, 2.6).
#[derive(Debug)]
pub(super) struct CookieJar {
    secret: MacKey,
    since: Instant,
}

impl CookieJar {
    /// How long a cookie is good for.
    pub(super) const GOOD_FOR: Duration = Duration::from_secs(120);

    pub(super) fn new(seeds: &mut SeedGenerator, now: Instant) -> Self {
        CookieJar { secret: MacKey::new(&seeds.next_seed()), since: now }
    }

    /// The cookie of this peer at this address.
    pub(super) fn cookie(
        &mut self,
        peer: NodeId,
        address: &impl Hash,
        seeds: &mut SeedGenerator,
        now: Instant,
    ) -> [u8; 16] {
        if now - self.since >= Self::GOOD_FOR {
            *self = CookieJar::new(seeds, now);
        }
        let mut bytes = HashedBytes(Vec::with_capacity(32));
        address.hash(&mut bytes);
        let mac = self.secret.mac(&[&peer.0.to_be_bytes(), &bytes.0]);
        *mac.first_chunk().expect("16 of 32 bytes")
    }
}

/// What an address hashes, as bytes.
struct HashedBytes(Vec<u8>);

impl Hasher for HashedBytes {
    fn write(&mut self, bytes: &[u8]) {
        self.0.extend_from_slice(bytes);
    }

    fn finish(&self) -> u64 {
        0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::at;

    #[test]
    fn the_last_64_of_a_peer_and_256_of_all_are_remembered() {
        let mut memory = RepeatMemory::default();
        for unique in 0..100 {
            memory.insert(NodeId(1), unique);
        }
        assert!(!memory.contains(NodeId(1), 35) && memory.contains(NodeId(1), 36));
        assert!(!memory.contains(NodeId(2), 99));

        for peer in 2..100 {
            for unique in 0..10 {
                memory.insert(NodeId(peer), unique);
            }
        }
        assert_eq!(memory.seen.len(), REPEATS_MAX);
        assert!(!memory.contains(NodeId(1), 99) && memory.contains(NodeId(99), 0));
    }

    #[test]
    fn a_cookie_is_of_its_peer_address_and_time() {
        let mut seeds = SeedGenerator::new([1; 32]);
        let mut jar = CookieJar::new(&mut seeds, at(0));
        let mut cookie = |peer, address: &str, millis| {
            jar.cookie(NodeId(peer), &address, &mut seeds, at(millis))
        };
        let first = cookie(1, "a", 0);

        assert_eq!(cookie(1, "a", 119_999), first);
        assert_ne!(cookie(1, "b", 0), first);
        assert_ne!(cookie(2, "a", 0), first);
        assert_ne!(cookie(1, "a", 120_000), first);
    }
}
