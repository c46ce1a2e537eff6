//! The sending half of an ordered stream.

use super::chunker::Chunker;
use super::flight::{AckResult, Chunk, ChunksInFlight};
use super::queue::OutboundMessage;
use crate::Instant;
use crate::net::session::ordering_key::OrderingKey;
use crate::net::wire::WireError;
use crate::net::wire::segment::Ack;
use bytes::Bytes;

/// Messages that wait or are on their way, until the peer has acknowledged them.
#[derive(Debug)]
pub(crate) struct Outbound {
    messages: Chunker,
    flight: ChunksInFlight,
    next: u64,
    /// The peer takes parts below this.
    limit: u64,
    /// The widest window that is believed.
    window: u32,
}

impl Outbound {
    pub(crate) fn new(window: u32) -> Self {
        let (messages, flight) = (Chunker::default(), ChunksInFlight::default());
        Outbound { messages, flight, next: 0, limit: window.into(), window }
    }

    /// The bytes of all messages.
    pub(crate) fn bytes(&self) -> usize {
        self.messages.bytes
    }

    pub(crate) fn messages(&self) -> usize {
        self.messages.len()
    }

    /// The number of the next part that is cut.
    pub(crate) fn next(&self) -> u64 {
        self.next
    }

    /// Everything was acknowledged.
    pub(crate) fn is_empty(&self) -> bool {
        self.messages.len() == 0
    }

    /// There is something to send that the peer takes.
    pub(crate) fn has_more(&self) -> bool {
        self.flight.lost > 0 || self.can_cut()
    }

    fn can_cut(&self) -> bool {
        self.next < self.limit && self.messages.is_waiting()
    }

    /// The bytes of the parts that are on their way and not believed lost.
    pub(crate) fn flying_bytes(&self) -> usize {
        self.flight.bytes
    }

    /// Parts that are on their way and not believed lost.
    pub(crate) fn flying(&self) -> usize {
        self.flight.count()
    }

    pub(crate) fn push(&mut self, key: OrderingKey, message: OutboundMessage) {
        self.messages.push(key, message);
    }

    /// Takes out the messages that were sent altogether, each with the part that it ends in.
    pub(crate) fn take_sent(&mut self) -> impl Iterator<Item = (u64, Bytes)> + use<> {
        self.messages.take_sent()
    }

    /// All messages that are not acknowledged, in order, and whether some of it was sent; nothing
    /// is left.
    pub(crate) fn take_all(&mut self) -> impl Iterator<Item = (Bytes, bool)> + use<> {
        std::mem::replace(self, Outbound::new(0)).messages.into_messages()
    }

    /// The next part to send: what was lost first, then new ones, as large as `capacity` allows.
    pub(crate) fn transmit(&mut self, capacity: usize, now: Instant) -> Option<(u64, Chunk)> {
        if let Some(again) = self.flight.retransmit(now) {
            return Some(again);
        }
        if !self.can_cut() {
            return None;
        }
        let sequence = self.next;
        self.next += 1;
        let part = self.messages.cut(capacity, sequence);
        Some((sequence, self.flight.insert(sequence, part, now)))
    }

    /// The peer has told what arrived.
    pub(crate) fn handle_ack(&mut self, ack: &Ack) -> Result<AckResult, WireError> {
        let beyond = ack.ranges.last().map_or(ack.next, |(_, last)| last.saturating_add(1));
        if beyond.max(ack.next) > self.next {
            return Err(WireError::Malformed { what: "an acknowledgement of what was never sent" });
        }
        // Windows only open: an acknowledgement that overtook another one must not close it. None
        // is wider than ours, whatever the peer promises.
        let window = ack.window.min(self.window);
        self.limit = self.limit.max(ack.next.saturating_add(window.into()));
        let mut progress = AckResult::default();
        let below = ack.next.checked_sub(1).map(|last| (0, last));
        for (first, last) in below.into_iter().chain(ack.ranges.iter().copied()) {
            self.flight.arrived(first, last, &mut progress);
        }
        self.messages.drop_below(ack.next);
        Ok(progress)
    }

    /// Parts that were sent well before one that has arrived are lost. True if there are new ones.
    pub(crate) fn find_lost(&mut self, arrived: u64) -> bool {
        // Fewer than three later arrivals are taken for reordering (RFC 5681, RFC 9002).
        const REORDERING: u64 = 3;
        self.flight.lose(|part| part.latest.order + REORDERING <= arrived)
    }

    /// Nothing on its way is believed to arrive any more.
    pub(crate) fn lose_all(&mut self) -> bool {
        self.flight.lose(|_| true)
    }
}
