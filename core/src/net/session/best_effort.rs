//! Messages that are sent once, if at all: of one channel, the newest that arrives counts.

use super::reassembly::{Reassembly, pieces_of};
use crate::net::wire::segment::{Datagram, PIECES_MAX};
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant};
use bytes::Bytes;

/// The bytes that a datagram puts before its payload, at most.
const DATAGRAM_HEADER: usize = 28;

/// What a datagram of this size carries at least.
fn payload_capacity(capacity: usize) -> usize {
    capacity.saturating_sub(DATAGRAM_HEADER).max(1)
}

/// Both directions of all channels of one session.
#[derive(Debug)]
pub(crate) struct BestEffort {
    /// The last number used, by channel.
    sent: SortedMap<u32, u64>,
    /// The newest that was delivered, by channel.
    delivered: SortedMap<u32, u64>,
    channels_max: usize,
    pieces: Reassembly<(u32, u64)>,
}

/// What became of a datagram.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum DatagramStatus {
    /// It completes the newest message of its channel.
    Newest(Bytes),
    /// More pieces are to come.
    InPart,
    /// The message was delivered before.
    Again,
    /// A newer one was.
    Overtaken,
    /// The peer has too many channels.
    TooMany,
}

impl BestEffort {
    pub(crate) fn new(channels_max: usize, pieces: Reassembly<(u32, u64)>) -> Self {
        BestEffort { sent: SortedMap::new(), delivered: SortedMap::new(), channels_max, pieces }
    }

    /// The most bytes of a message whose datagrams are no larger than `capacity` with their
    /// headers.
    pub(crate) fn most(capacity: usize) -> usize {
        payload_capacity(capacity) * usize::from(PIECES_MAX)
    }

    /// The datagrams of one message, none larger than `capacity` with its header.
    pub(crate) fn cut(
        &mut self,
        tag: u32,
        channel: u32,
        message: &GatherBuffer,
        capacity: usize,
    ) -> impl Iterator<Item = Datagram> + use<> {
        let sequence = self.sent.entry(channel).or_insert(0);
        *sequence += 1;
        let sequence = *sequence;
        let pieces = pieces_of(message, payload_capacity(capacity)).into_iter();
        pieces.map(move |(piece, payload)| Datagram { tag, channel, sequence, piece, payload })
    }

    pub(crate) fn handle(&mut self, datagram: Datagram, now: Instant) -> DatagramStatus {
        let Datagram { channel, sequence, piece, payload, .. } = datagram;
        let payload = payload.into_bytes();
        let full = self.delivered.len() >= self.channels_max;
        match self.delivered.get(&channel) {
            Some(newest) if sequence == *newest => return DatagramStatus::Again,
            Some(newest) if sequence < *newest => return DatagramStatus::Overtaken,
            None if full => return DatagramStatus::TooMany,
            _ => {}
        }
        let message = match piece {
            None => Some(payload),
            Some(piece) => self.pieces.handle((channel, sequence), piece, payload, now),
        };
        match message {
            Some(message) => {
                self.delivered.insert(channel, sequence);
                DatagramStatus::Newest(message)
            }
            None => DatagramStatus::InPart,
        }
    }

    /// Messages that were never finished.
    pub(crate) fn unfinished(&self) -> u64 {
        self.pieces.given_up
    }
}
