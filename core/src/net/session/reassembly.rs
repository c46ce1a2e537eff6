//! Puts pieces together, within bounds of space and time.

use crate::net::wire::segment::{Fragment, PIECES_MAX};
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant};
use bytes::{Bytes, BytesMut};
use std::time::Duration;

/// Things of which some pieces have arrived, by a key.
#[derive(Debug)]
pub(crate) struct Reassembly<K> {
    open: SortedMap<K, Pieces>,
    bytes: usize,
    bytes_max: usize,
    patience: Duration,
    /// Things that were given up, incomplete.
    pub(crate) given_up: u64,
}

/// What a piece costs beside its bytes, so that no number of empty ones is free.
const PIECE_OVERHEAD: usize = 64;

#[derive(Debug)]
struct Pieces {
    count: u16,
    arrived: SortedMap<u16, Bytes>,
    bytes: usize,
    since: Instant,
}

impl<K: Ord + Copy> Reassembly<K> {
    pub(crate) fn new(bytes_max: usize, patience: Duration) -> Self {
        Reassembly { open: SortedMap::new(), bytes: 0, bytes_max, patience, given_up: 0 }
    }

    /// A piece has arrived. Answers with the whole when it was the last one missing.
    pub(crate) fn handle(
        &mut self,
        key: K,
        piece: Fragment,
        bytes: Bytes,
        now: Instant,
    ) -> Option<Bytes> {
        self.expire(now);
        if self.open.get(&key).is_some_and(|pieces| pieces.count != piece.count) {
            // It was sent again and cut differently.
            self.remove(key);
        }
        let pieces = self.open.entry(key).or_insert_with(|| Pieces {
            count: piece.count,
            arrived: SortedMap::new(),
            bytes: 0,
            since: now,
        });
        if !pieces.arrived.contains_key(&piece.index) {
            let weight = bytes.len() + PIECE_OVERHEAD;
            pieces.arrived.insert(piece.index, bytes);
            pieces.bytes += weight;
            self.bytes += weight;
        }
        if pieces.arrived.len() == usize::from(piece.count) {
            let mut whole = BytesMut::with_capacity(pieces.bytes);
            pieces.arrived.values().for_each(|piece| whole.extend_from_slice(piece));
            self.remove(key);
            return Some(whole.freeze());
        }
        while self.bytes > self.bytes_max
            && let Some(oldest) = self.oldest()
        {
            self.given_up += 1;
            self.remove(oldest);
        }
        None
    }

    /// Gives up what has been incomplete for too long.
    pub(crate) fn expire(&mut self, now: Instant) {
        while let Some(oldest) = self.oldest()
            && self.open[&oldest].since + self.patience <= now
        {
            self.given_up += 1;
            self.remove(oldest);
        }
    }

    fn oldest(&self) -> Option<K> {
        self.open.iter().min_by_key(|(_, pieces)| pieces.since).map(|(key, _)| *key)
    }

    fn remove(&mut self, key: K) {
        if let Some(pieces) = self.open.remove(&key) {
            self.bytes -= pieces.bytes;
        }
    }
}

/// One whole, or pieces of at most `capacity` bytes.
pub(crate) fn pieces_of(
    payload: &GatherBuffer,
    capacity: usize,
) -> Vec<(Option<Fragment>, GatherBuffer)> {
    if payload.len() <= capacity {
        return vec![(None, payload.clone())];
    }
    let count = payload.len().div_ceil(capacity).min(PIECES_MAX.into()) as u16;
    let size = payload.len().div_ceil(count.into());
    (0..count)
        .map(|index| {
            let start = (usize::from(index) * size).min(payload.len());
            let end = (start + size).min(payload.len());
            (Some(Fragment { index, count }), payload.slice(start..end))
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn piece(index: u16, count: u16) -> Fragment {
        Fragment { index, count }
    }

    fn assembly() -> Reassembly<u32> {
        Reassembly::new(400, Duration::from_secs(1))
    }

    #[test]
    fn pieces_in_any_order_and_number_become_the_whole() {
        let mut assembly = assembly();
        let now = Instant::ORIGIN;
        assert_eq!(assembly.handle(1, piece(2, 3), Bytes::from_static(b"c"), now), None);
        assert_eq!(assembly.handle(1, piece(0, 3), Bytes::from_static(b"a"), now), None);
        assert_eq!(assembly.handle(1, piece(0, 3), Bytes::from_static(b"a"), now), None);
        let whole = assembly.handle(1, piece(1, 3), Bytes::from_static(b"b"), now);
        assert_eq!(whole.as_deref(), Some(&b"abc"[..]));
        assert_eq!(assembly.bytes, 0);
    }

    #[test]
    fn what_is_never_finished_is_given_up_when_it_is_too_old_or_too_much() {
        let mut assembly = assembly();
        for key in 0..1000 {
            let now = Instant::from_millis(key.into());
            assembly.handle(key, piece(0, 2), Bytes::from_static(&[0; 30]), now);
            assert!(assembly.bytes <= 400);
        }
        assembly.expire(Instant::from_millis(3000));
        assert_eq!((assembly.given_up, assembly.bytes), (1000, 0));
    }
}
