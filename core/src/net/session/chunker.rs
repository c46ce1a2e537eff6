//! Cuts messages into parts.

use super::queue::{OutboundMessage, SendQueue};
use crate::GatherBuffer;
use crate::net::session::ordering_key::OrderingKey;
use crate::net::wire::{Write, varint_length};
use bytes::{Bytes, BytesMut};
use std::collections::VecDeque;

/// Messages until they are acknowledged, and how much of them has been cut into parts.
#[derive(Debug, Default)]
pub(super) struct Chunker {
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
    /// Of all messages.
    pub(super) bytes: usize,
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
    key: OrderingKey,
    message: OutboundMessage,
    /// How many bytes of it have been cut.
    cut: usize,
}

/// What a part carries, and whether a message begins and ends in it.
pub(super) struct CutChunk {
    pub(super) first: bool,
    pub(super) last: bool,
    pub(super) payload: GatherBuffer,
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

impl Chunker {
    /// For one part so many keys are passed over of which the first message does not fit in; the
    /// next search goes on behind them. It bounds the work for a part where a thousand keys
    /// wait.
    const LOOK: usize = 32;

    pub(super) fn len(&self) -> usize {
        self.cut.len() + usize::from(self.partial.is_some()) + self.waiting.len()
    }

    /// There is something to cut.
    pub(super) fn is_waiting(&self) -> bool {
        self.partial.is_some() || !self.waiting.is_empty()
    }

    pub(super) fn push(&mut self, key: OrderingKey, message: OutboundMessage) {
        self.bytes += message.bytes.len();
        self.waiting.push(key, message);
    }

    /// Takes out the messages that were cut altogether, each with the part that it ends in.
    pub(super) fn take_sent(&mut self) -> impl Iterator<Item = (u64, Bytes)> + use<> {
        let cut = std::mem::take(&mut self.cut).into_iter();
        cut.map(|held| (held.last, held.message.bytes.into_bytes()))
    }

    /// All messages in order, and whether some of it was cut.
    pub(super) fn into_messages(self) -> impl Iterator<Item = (Bytes, bool)> {
        let partial = self.partial.into_iter().map(|partial| partial.message);
        let sent = self.cut.into_iter().map(|held| held.message).chain(partial);
        let sent = sent.map(|message| (message.bytes.into_bytes(), true));
        sent.chain(self.waiting.into_messages().map(|message| (message.bytes.into_bytes(), false)))
    }

    /// Drops the messages that end in a part before this one.
    pub(super) fn drop_below(&mut self, next: u64) {
        while self.cut.front().is_some_and(|held| held.last < next) {
            let held = self.cut.pop_front().expect("there is a front");
            self.bytes -= held.message.bytes.len();
        }
    }

    /// The next part, which has this number, while something waits.
    pub(super) fn cut(&mut self, capacity: usize, sequence: u64) -> CutChunk {
        match self.cut_overtaking(capacity, sequence) {
            Some(payload) => CutChunk { first: true, last: true, payload },
            None => self.cut_part(capacity, sequence),
        }
    }

    /// After each part of what is large, one of whole messages that need not wait for the rest of
    /// it: nothing of its key. The large one goes on after them.
    fn cut_overtaking(&mut self, capacity: usize, sequence: u64) -> Option<GatherBuffer> {
        let large = self.partial.as_ref()?.key;
        if std::mem::take(&mut self.overtook) {
            return None;
        }
        let mut payload = BytesMut::new();
        let (mut passed, mut first_left) = (0, None);
        while passed < Self::LOOK {
            let Some((number, key, message)) = self.waiting.first(self.looked..) else {
                self.looked = 0;
                break;
            };
            self.looked = number + 1;
            if key == large {
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
    fn cut_part(&mut self, capacity: usize, sequence: u64) -> CutChunk {
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
            return CutChunk { first: false, last, payload };
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
            return CutChunk { first: true, last: true, payload: payload.freeze().into() };
        }
        // Few others would go with it, and it would be copied.
        let (key, message) = self.waiting.take(number).expect("it was just looked at");
        let last = needed <= capacity;
        let cut = if last { length } else { capacity - varint_length(length as u64) };
        let payload = message.bytes.slice(0..cut).behind(length_of(length));
        if last {
            self.cut.push_back(Held { message, last: sequence });
        } else {
            self.partial = Some(Partial { key, message, cut });
        }
        CutChunk { first: true, last, payload }
    }
}
