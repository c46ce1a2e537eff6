//! The parts of a stream that are on their way.

use super::chunker::CutChunk;
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant};

/// Parts that are not acknowledged.
#[derive(Debug, Default)]
pub(super) struct ChunksInFlight {
    /// By sequence number.
    chunks: SortedMap<u64, Chunk>,
    /// The bytes of those that are not known to be lost.
    pub(super) bytes: usize,
    pub(super) lost: usize,
    /// How many transmissions there were.
    orders: u64,
}

/// A part on its way.
#[derive(Clone, Debug)]
pub(crate) struct Chunk {
    pub(crate) first: bool,
    pub(crate) last: bool,
    pub(crate) payload: GatherBuffer,
    pub(crate) latest: SentPart,
    lost: bool,
}

/// When a part was sent last.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct SentPart {
    /// Its place among all transmissions of the stream.
    pub(crate) order: u64,
    pub(crate) sent: Instant,
    /// The part was sent before that, too.
    pub(crate) again: bool,
}

/// What an acknowledgement brought.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct AckResult {
    /// How many parts it acknowledged for the first time.
    pub(crate) parts: usize,
    pub(crate) bytes: usize,
    /// The latest transmission among them.
    pub(crate) latest: Option<SentPart>,
}

impl ChunksInFlight {
    /// Those that are not believed lost.
    pub(super) fn count(&self) -> usize {
        self.chunks.len() - self.lost
    }

    /// Sends a new part.
    pub(super) fn insert(&mut self, sequence: u64, piece: CutChunk, now: Instant) -> Chunk {
        let CutChunk { first, last, payload } = piece;
        let latest = SentPart { order: self.orders, sent: now, again: false };
        self.orders += 1;
        self.bytes += payload.len();
        let part = Chunk { first, last, payload, latest, lost: false };
        self.chunks.insert(sequence, part.clone());
        part
    }

    /// Sends the first lost part again.
    pub(super) fn retransmit(&mut self, now: Instant) -> Option<(u64, Chunk)> {
        if self.lost == 0 {
            return None;
        }
        let (sequence, part) = self.chunks.iter_mut().find(|(_, part)| part.lost)?;
        self.lost -= 1;
        part.latest = SentPart { order: self.orders, sent: now, again: true };
        part.lost = false;
        self.orders += 1;
        self.bytes += part.payload.len();
        Some((*sequence, part.clone()))
    }

    pub(super) fn arrived(&mut self, first: u64, last: u64, progress: &mut AckResult) {
        while let Some((&sequence, _)) = self.chunks.range(first..=last).next() {
            let part = self.chunks.remove(&sequence).expect("it was found");
            match part.lost {
                true => self.lost -= 1,
                false => self.bytes -= part.payload.len(),
            }
            progress.parts += 1;
            progress.bytes += part.payload.len();
            if progress.latest.is_none_or(|latest| part.latest.order > latest.order) {
                progress.latest = Some(part.latest);
            }
        }
    }

    /// Takes these for lost. True if there are new ones.
    pub(super) fn lose(&mut self, is_lost: impl Fn(&Chunk) -> bool) -> bool {
        let before = self.lost;
        for part in self.chunks.values_mut() {
            if !part.lost && is_lost(part) {
                part.lost = true;
                self.lost += 1;
                self.bytes -= part.payload.len();
            }
        }
        self.lost > before
    }
}
