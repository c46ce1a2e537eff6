//! The sending half of an ordered stream.

use super::config::HEADER_MAX;
use crate::net::load::Load;
use crate::net::segment::Ack;
use crate::net::strand::Strand;
use crate::net::wire::{WireError, Write, varint_length};
use crate::{Instant, Parcel};
use bytes::{Bytes, BytesMut};
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// Messages that wait or are on their way, until the peer has acknowledged them.
#[derive(Debug)]
pub(crate) struct Outbound {
    /// In order: those on their way, then those that wait.
    messages: VecDeque<Held>,
    /// How many of them have been cut into parts altogether.
    cut: usize,
    /// How many bytes of the next one have been cut.
    cut_bytes: usize,
    /// The part before the next one overtook it.
    overtook: bool,
    /// Of what is small, and of bulk.
    bytes: [usize; 2],
    /// Parts on their way, by sequence number.
    flight: BTreeMap<u64, Part>,
    /// The bytes of those that are not known to be lost.
    flying_bytes: usize,
    lost: usize,
    next: u64,
    /// The peer takes parts below this.
    limit: u64,
    /// The widest window that is believed.
    window: u32,
}

#[derive(Debug)]
struct Held {
    strand: Strand,
    message: Parcel,
    /// The part that it ends in.
    last: Option<u64>,
}

/// A part on its way.
#[derive(Clone, Debug)]
pub(crate) struct Part {
    pub(crate) first: bool,
    pub(crate) last: bool,
    pub(crate) payload: Parcel,
    sent: Instant,
    /// Its place among all transmissions of the session.
    order: u64,
    again: bool,
    lost: bool,
}

impl Part {
    /// It has been sent before.
    pub(crate) fn is_repeated(&self) -> bool {
        self.again
    }
}

/// What an acknowledgement brought.
#[derive(Debug, Default, PartialEq, Eq)]
pub(crate) struct Progress {
    /// How many parts it acknowledged for the first time.
    pub(crate) parts: usize,
    /// A round trip, from a part that was sent only once (Karn's rule).
    pub(crate) round_trip: Option<Duration>,
    /// The latest transmission among them.
    pub(crate) order: Option<u64>,
}

/// What is small to whoever sent it is so with what an exchange has put before it.
pub(crate) fn load_of(message: &Parcel) -> Load {
    Load::of(message.len().saturating_sub(HEADER_MAX))
}

/// The length that stands before a message.
fn length_of(message: usize) -> BytesMut {
    let mut bytes = BytesMut::with_capacity(64);
    bytes.varint(message as u64);
    bytes
}

impl Outbound {
    /// So many messages behind a large one are looked at: those that may overtake it do so, a part at a time.
    const LOOK: usize = 32;

    pub(crate) fn new(window: u32) -> Self {
        Outbound {
            messages: VecDeque::new(),
            cut: 0,
            cut_bytes: 0,
            overtook: false,
            bytes: [0; 2],
            flight: BTreeMap::new(),
            flying_bytes: 0,
            lost: 0,
            next: 0,
            limit: window.into(),
            window,
        }
    }

    /// The bytes of all messages of this load.
    pub(crate) fn bytes(&self, load: Load) -> usize {
        self.bytes[load as usize]
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
        self.messages.is_empty()
    }

    /// Their bytes.
    pub(crate) fn flying_bytes(&self) -> usize {
        self.flying_bytes
    }

    /// Parts that are on their way and not believed lost.
    pub(crate) fn flying(&self) -> usize {
        self.flight.len() - self.lost
    }

    pub(crate) fn push(&mut self, strand: Strand, message: Parcel) {
        self.bytes[load_of(&message) as usize] += message.len();
        self.messages.push_back(Held { strand, message, last: None });
    }

    /// All messages that are not acknowledged, in order, and whether some of it was sent; nothing is
    /// left.
    pub(crate) fn take_all(&mut self) -> impl Iterator<Item = (Bytes, bool)> + use<> {
        let sent = self.cut + usize::from(self.cut_bytes > 0);
        let messages = std::mem::take(&mut self.messages);
        *self = Outbound::new(0);
        messages.into_iter().enumerate().map(move |(n, held)| (held.message.into_bytes(), n < sent))
    }

    /// The next part to send: what was lost first, then new ones, as large as `room` allows.
    pub(crate) fn transmit(
        &mut self,
        room: usize,
        order: u64,
        now: Instant,
    ) -> Option<(u64, Part)> {
        if self.lost > 0
            && let Some((sequence, part)) = self.flight.iter_mut().find(|(_, part)| part.lost)
        {
            self.lost -= 1;
            *part = Part { sent: now, order, again: true, lost: false, ..part.clone() };
            self.flying_bytes += part.payload.len();
            return Some((*sequence, part.clone()));
        }
        if self.next >= self.limit || self.cut == self.messages.len() {
            return None;
        }
        let sequence = self.next;
        let (first, last, payload) = match self.cut_overtaking(room, sequence) {
            Some(payload) => (true, true, payload),
            None => self.cut_part(room, sequence),
        };
        let part = Part { first, last, payload, sent: now, order, again: false, lost: false };
        self.next += 1;
        self.flying_bytes += part.payload.len();
        self.flight.insert(sequence, part.clone());
        Some((sequence, part))
    }

    /// After each part of what is large, one of whole messages that need not wait for the rest of it: nothing
    /// of their strands does. The large one goes on after them.
    fn cut_overtaking(&mut self, room: usize, sequence: u64) -> Option<Parcel> {
        if self.cut_bytes == 0 || std::mem::take(&mut self.overtook) {
            return None;
        }
        let mut payload = BytesMut::new();
        let mut before = vec![self.messages[self.cut].strand];
        for at in self.cut + 1..self.messages.len().min(self.cut + 1 + Self::LOOK) {
            let Held { strand, ref message, .. } = self.messages[at];
            let length = message.len();
            if before.contains(&strand) {
                continue;
            }
            if payload.len() + varint_length(length as u64) + length > room {
                before.push(strand);
                continue;
            }
            payload.varint(length as u64);
            message.put(0..length, &mut payload);
            let mut held = self.messages.remove(at).expect("it was just read");
            held.last = Some(sequence);
            self.messages.insert(self.cut, held);
            self.cut += 1;
        }
        self.overtook = !payload.is_empty();
        self.overtook.then(|| payload.freeze().into())
    }

    /// As many whole messages as fit, or as much of a large one.
    fn cut_part(&mut self, room: usize, sequence: u64) -> (bool, bool, Parcel) {
        let front = &mut self.messages[self.cut];
        let length = front.message.len();
        let prefix = varint_length(length as u64);
        if self.cut_bytes > 0 {
            let end = length.min(self.cut_bytes + room);
            let payload = front.message.slice(self.cut_bytes..end);
            self.cut_bytes = end;
            if end == length {
                front.last = Some(sequence);
                self.cut += 1;
                self.cut_bytes = 0;
            }
            return (false, end == length, payload);
        }
        if prefix + length > room {
            let end = room - prefix;
            self.cut_bytes = end;
            return (true, false, front.message.slice(0..end).behind(length_of(length)));
        }
        if prefix + length > room / 2 {
            // Few others would go with it, and it would be copied.
            front.last = Some(sequence);
            self.cut += 1;
            return (true, true, front.message.behind(length_of(length)));
        }
        let mut payload = BytesMut::with_capacity(prefix + length);
        while let Some(held) = self.messages.get_mut(self.cut) {
            let length = held.message.len();
            if payload.len() + varint_length(length as u64) + length > room {
                break;
            }
            payload.varint(length as u64);
            held.message.put(0..length, &mut payload);
            held.last = Some(sequence);
            self.cut += 1;
        }
        (true, true, payload.freeze().into())
    }

    /// The peer has told what arrived.
    pub(crate) fn handle_ack(&mut self, ack: &Ack, now: Instant) -> Result<Progress, WireError> {
        let beyond = ack.ranges.last().map_or(ack.next, |(_, last)| last.saturating_add(1));
        if beyond.max(ack.next) > self.next {
            return Err(WireError::Malformed { what: "an acknowledgement of what was never sent" });
        }
        // Windows only open: an acknowledgement that overtook another one must not close it. None is
        // wider than ours, whatever the peer promises.
        let window = ack.window.min(self.window);
        self.limit = self.limit.max(ack.next.saturating_add(window.into()));
        let mut progress = Progress::default();
        let below = ack.next.checked_sub(1).map(|last| (0, last));
        for (first, last) in below.into_iter().chain(ack.ranges.iter().copied()) {
            self.arrived(first, last, now, &mut progress);
        }
        while self.messages.front().is_some_and(|held| held.last.is_some_and(|n| n < ack.next)) {
            let held = self.messages.pop_front().expect("there is a front");
            self.bytes[load_of(&held.message) as usize] -= held.message.len();
            self.cut -= 1;
        }
        Ok(progress)
    }

    fn arrived(&mut self, first: u64, last: u64, now: Instant, progress: &mut Progress) {
        while let Some((&sequence, _)) = self.flight.range(first..=last).next() {
            let part = self.flight.remove(&sequence).expect("it was found");
            match part.lost {
                true => self.lost -= 1,
                false => self.flying_bytes -= part.payload.len(),
            }
            progress.parts += 1;
            if progress.order.is_none_or(|order| part.order > order) {
                progress.order = Some(part.order);
                progress.round_trip = (!part.again).then(|| now - part.sent);
            }
        }
    }

    /// Parts that were sent well before one that has arrived are lost. True if there are new ones.
    pub(crate) fn find_lost(&mut self, arrived: u64) -> bool {
        // Fewer than three later arrivals are taken for reordering (RFC 5681, RFC 9002).
        const REORDERING: u64 = 3;
        self.lose(|part| part.order + REORDERING <= arrived)
    }

    /// Nothing on its way is believed to arrive any more.
    pub(crate) fn lose_all(&mut self) -> bool {
        self.lose(|_| true)
    }

    fn lose(&mut self, is_lost: impl Fn(&Part) -> bool) -> bool {
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
