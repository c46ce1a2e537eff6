//! The sending half of an ordered stream.

use super::queue::{OutboundMessage, SendQueue};
use crate::net::session::ordering_key::OrderingKey;
use crate::net::wire::segment::Ack;
use crate::net::wire::{WireError, Write, varint_length};
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant};
use bytes::{Bytes, BytesMut};
use std::collections::VecDeque;

/// Messages that wait or are on their way, until the peer has acknowledged them.
#[derive(Debug)]
pub(crate) struct Outbound {
    /// Those that have been cut altogether, in that order.
    cut: VecDeque<Held>,
    /// The one of which more is to be cut.
    partial: Option<Partial>,
    /// Those of which nothing has been cut.
    waiting: SendQueue,
    /// The part before the next one overtook it.
    overtook: bool,
    /// Of those that may overtake, those that arrived before this have been looked at.
    looked: u64,
    bytes: usize,
    /// Parts on their way, by sequence number.
    flight: SortedMap<u64, Chunk>,
    /// The bytes of those that are not known to be lost.
    flying_bytes: usize,
    lost: usize,
    next: u64,
    /// How many transmissions there were.
    orders: u64,
    /// The peer takes parts below this.
    limit: u64,
    /// The widest window that is believed.
    window: u32,
}

/// A message on its way.
#[derive(Debug)]
struct Held {
    message: OutboundMessage,
    /// The part that it ends in.
    last: u64,
}

/// A message that does not fit into one part.
#[derive(Debug)]
struct Partial {
    strand: OrderingKey,
    message: OutboundMessage,
    /// How many bytes of it have been cut.
    cut: usize,
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
    /// Their bytes.
    pub(crate) bytes: usize,
    /// The latest transmission among them.
    pub(crate) latest: Option<SentPart>,
}

/// The length that stands before a message.
fn length_of(message: usize) -> BytesMut {
    let mut bytes = BytesMut::with_capacity(64);
    bytes.varint(message as u64);
    bytes
}

/// Whether a message, with its length, goes into a part beside so many bytes.
fn fits(message: &GatherBuffer, beside: usize, capacity: usize) -> bool {
    beside + varint_length(message.len() as u64) + message.len() <= capacity
}

impl Outbound {
    /// For one part so many strands are passed over of which the first message does not fit in; the
    /// next search goes on behind them. It bounds the work for a part where a thousand strands
    /// wait.
    const LOOK: usize = 32;

    pub(crate) fn new(window: u32) -> Self {
        Outbound {
            cut: VecDeque::new(),
            partial: None,
            waiting: SendQueue::default(),
            overtook: false,
            looked: 0,
            bytes: 0,
            flight: SortedMap::new(),
            flying_bytes: 0,
            lost: 0,
            next: 0,
            orders: 0,
            limit: window.into(),
            window,
        }
    }

    /// The bytes of all messages.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes
    }

    pub(crate) fn messages(&self) -> usize {
        self.cut.len() + usize::from(self.partial.is_some()) + self.waiting.len()
    }

    /// The number of the next part that is cut.
    pub(crate) fn next(&self) -> u64 {
        self.next
    }

    /// Everything was acknowledged.
    pub(crate) fn is_empty(&self) -> bool {
        self.cut.is_empty() && !self.is_waiting()
    }

    /// There is something to send that the peer takes.
    pub(crate) fn has_more(&self) -> bool {
        self.lost > 0 || self.next < self.limit && self.is_waiting()
    }

    /// There is something to cut.
    fn is_waiting(&self) -> bool {
        self.partial.is_some() || !self.waiting.is_empty()
    }

    /// Their bytes.
    pub(crate) fn flying_bytes(&self) -> usize {
        self.flying_bytes
    }

    /// Parts that are on their way and not believed lost.
    pub(crate) fn flying(&self) -> usize {
        self.flight.len() - self.lost
    }

    pub(crate) fn push(&mut self, strand: OrderingKey, message: OutboundMessage) {
        self.bytes += message.bytes.len();
        self.waiting.push(strand, message);
    }

    /// Takes out the messages that were sent altogether, each with the part that it ends in.
    pub(crate) fn take_sent(&mut self) -> impl Iterator<Item = (u64, Bytes)> + use<> {
        let cut = std::mem::take(&mut self.cut).into_iter();
        cut.map(|held| (held.last, held.message.bytes.into_bytes()))
    }

    /// All messages that are not acknowledged, in order, and whether some of it was sent; nothing
    /// is left.
    pub(crate) fn take_all(&mut self) -> impl Iterator<Item = (Bytes, bool)> + use<> {
        let Outbound { cut, partial, waiting, .. } = std::mem::replace(self, Outbound::new(0));
        let partial = partial.into_iter().map(|partial| partial.message);
        let sent = cut.into_iter().map(|held| held.message).chain(partial);
        let sent = sent.map(|message| (message.bytes.into_bytes(), true));
        sent.chain(waiting.into_messages().map(|message| (message.bytes.into_bytes(), false)))
    }

    /// The next part to send: what was lost first, then new ones, as large as `capacity` allows.
    pub(crate) fn transmit(&mut self, capacity: usize, now: Instant) -> Option<(u64, Chunk)> {
        let latest = SentPart { order: self.orders, sent: now, again: self.lost > 0 };
        if self.lost > 0
            && let Some((sequence, part)) = self.flight.iter_mut().find(|(_, part)| part.lost)
        {
            self.lost -= 1;
            self.orders += 1;
            *part = Chunk { latest, lost: false, ..part.clone() };
            self.flying_bytes += part.payload.len();
            return Some((*sequence, part.clone()));
        }
        if self.next >= self.limit || !self.is_waiting() {
            return None;
        }
        let sequence = self.next;
        let (first, last, payload) = match self.cut_overtaking(capacity, sequence) {
            Some(payload) => (true, true, payload),
            None => self.cut_part(capacity, sequence),
        };
        let part = Chunk { first, last, payload, latest, lost: false };
        self.next += 1;
        self.orders += 1;
        self.flying_bytes += part.payload.len();
        self.flight.insert(sequence, part.clone());
        Some((sequence, part))
    }

    /// After each part of what is large, one of whole messages that need not wait for the rest of
    /// it: nothing of its strand. The large one goes on after them.
    fn cut_overtaking(&mut self, capacity: usize, sequence: u64) -> Option<GatherBuffer> {
        let large = self.partial.as_ref()?.strand;
        if std::mem::take(&mut self.overtook) {
            return None;
        }
        let mut payload = BytesMut::new();
        let (mut passed, mut first_left) = (0, None);
        while passed < Self::LOOK {
            let Some((number, strand, message)) = self.waiting.first(self.looked..) else {
                self.looked = 0;
                break;
            };
            self.looked = number + 1;
            if strand == large {
                continue;
            }
            if !fits(&message.bytes, payload.len(), capacity) {
                passed += 1;
                if fits(&message.bytes, 0, capacity) {
                    first_left.get_or_insert(number);
                }
                continue;
            }
            self.cut_whole(number, sequence, &mut payload);
        }
        self.looked = first_left.unwrap_or(self.looked);
        self.overtook = !payload.is_empty();
        self.overtook.then(|| payload.freeze().into())
    }

    /// Cuts a message that waits, as a whole.
    fn cut_whole(&mut self, number: u64, sequence: u64, payload: &mut BytesMut) {
        let (_, message) = self.waiting.take(number).expect("it was just looked at");
        let bytes = &message.bytes;
        payload.varint(bytes.len() as u64);
        bytes.put(0..bytes.len(), payload);
        self.cut.push_back(Held { message, last: sequence });
    }

    /// As many whole messages as fit, or as much of a large one.
    fn cut_part(&mut self, capacity: usize, sequence: u64) -> (bool, bool, GatherBuffer) {
        if let Some(mut partial) = self.partial.take() {
            let bytes = &partial.message.bytes;
            let end = bytes.len().min(partial.cut + capacity);
            let payload = bytes.slice(partial.cut..end);
            let last = end == bytes.len();
            if last {
                self.cut.push_back(Held { message: partial.message, last: sequence });
            } else {
                partial.cut = end;
                self.partial = Some(partial);
            }
            return (false, last, payload);
        }
        let (number, _, first) = self.waiting.first(0..).expect("something waits");
        let length = first.bytes.len();
        let needed = varint_length(length as u64) + length;
        if needed <= capacity / 2 {
            let mut payload = BytesMut::with_capacity(needed);
            while let Some((number, _, message)) = self.waiting.first(0..)
                && fits(&message.bytes, payload.len(), capacity)
            {
                self.cut_whole(number, sequence, &mut payload);
            }
            return (true, true, payload.freeze().into());
        }
        // Few others would go with it, and it would be copied.
        let (strand, message) = self.waiting.take(number).expect("it was just looked at");
        let last = needed <= capacity;
        let cut = if last { length } else { capacity - varint_length(length as u64) };
        let payload = message.bytes.slice(0..cut).behind(length_of(length));
        if last {
            self.cut.push_back(Held { message, last: sequence });
        } else {
            self.partial = Some(Partial { strand, message, cut });
        }
        (true, last, payload)
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
            self.arrived(first, last, &mut progress);
        }
        while self.cut.front().is_some_and(|held| held.last < ack.next) {
            let held = self.cut.pop_front().expect("there is a front");
            self.bytes -= held.message.bytes.len();
        }
        Ok(progress)
    }

    fn arrived(&mut self, first: u64, last: u64, progress: &mut AckResult) {
        while let Some((&sequence, _)) = self.flight.range(first..=last).next() {
            let part = self.flight.remove(&sequence).expect("it was found");
            match part.lost {
                true => self.lost -= 1,
                false => self.flying_bytes -= part.payload.len(),
            }
            progress.parts += 1;
            progress.bytes += part.payload.len();
            if progress.latest.is_none_or(|latest| part.latest.order > latest.order) {
                progress.latest = Some(part.latest);
            }
        }
    }

    /// Parts that were sent well before one that has arrived are lost. True if there are new ones.
    pub(crate) fn find_lost(&mut self, arrived: u64) -> bool {
        // Fewer than three later arrivals are taken for reordering (RFC 5681, RFC 9002).
        const REORDERING: u64 = 3;
        self.lose(|part| part.latest.order + REORDERING <= arrived)
    }

    /// Nothing on its way is believed to arrive any more.
    pub(crate) fn lose_all(&mut self) -> bool {
        self.lose(|_| true)
    }

    fn lose(&mut self, is_lost: impl Fn(&Chunk) -> bool) -> bool {
        let before = self.lost;
        for part in self.flight.values_mut() {
            if !part.lost && is_lost(part) {
                part.lost = true;
                self.lost += 1;
                self.flying_bytes -= part.payload.len();
            }
        }
        self.lost > before
    }
}
