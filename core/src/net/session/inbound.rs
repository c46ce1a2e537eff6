//! The receiving half of an ordered stream.

use crate::Instant;
use crate::net::wire::segment::{Ack, DelayTicks, RANGES_MAX};
use crate::net::wire::{Reader, WireError};
use crate::sorted::SortedMap;
use bytes::{Bytes, BytesMut};
use std::collections::VecDeque;
use std::time::Duration;

/// Fresh memory for a message of this size, in bytes, costs more than all else that is done with
/// it.
const SPARE_FROM: usize = 128 * 1024;
/// One is put together while the one before is read.
const SPARES: usize = 2;

/// The bytes that may have arrived ahead of their turn: four times what a sender has on its way.
const AHEAD_MAX: usize = 4 << 20;
/// A part from this size on is large, in bytes.
const LARGE: usize = 16 * 1024;

/// Puts parts in order and messages together, each once.
#[derive(Debug)]
pub(crate) struct Inbound {
    next: u64,
    /// Arrived ahead of their turn; all within the window.
    ahead: SortedMap<u64, Part>,
    ahead_bytes: usize,
    partial: Option<Partial>,
    /// Where large messages were put together before: taken again once no receiver holds those any
    /// more. Two of the largest message for each stream at most, once such have come.
    spare: VecDeque<BytesMut>,
    window: u32,
    message_max: usize,
    /// When an acknowledgement is owed at the latest.
    owed: Option<Instant>,
    /// When the last part arrived.
    arrived: DelayTicks,
    /// Parts since the last acknowledgement.
    unacknowledged: u32,
}

#[derive(Debug)]
pub(crate) struct Part {
    pub(crate) first: bool,
    pub(crate) last: bool,
    pub(crate) payload: Bytes,
}

#[derive(Debug)]
struct Partial {
    length: usize,
    bytes: BytesMut,
}

/// What became of a part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ChunkStatus {
    /// It is the first of its number.
    New,
    /// It had arrived before.
    Again,
    /// It is beyond the window: a peer that keeps to the rules does not send it.
    Beyond,
}

impl Inbound {
    pub(crate) fn new(window: u32, message_max: usize) -> Self {
        Inbound {
            next: 0,
            ahead: SortedMap::new(),
            ahead_bytes: 0,
            partial: None,
            spare: VecDeque::new(),
            window,
            message_max,
            owed: None,
            arrived: DelayTicks::default(),
            unacknowledged: 0,
        }
    }

    /// The first part that has not arrived. All messages that end before it have been delivered.
    pub(crate) fn next(&self) -> u64 {
        self.next
    }

    fn limit(&self) -> u64 {
        self.next.saturating_add(self.window.into())
    }

    /// Whether this part has arrived.
    pub(crate) fn has(&self, sequence: u64) -> bool {
        sequence < self.next || self.ahead.contains_key(&sequence)
    }

    /// Whether this part is within the window, and has not arrived.
    pub(crate) fn expects(&self, sequence: u64) -> bool {
        sequence < self.limit() && !self.has(sequence)
    }

    /// A part has arrived; `deliver` gets every message that it completes.
    pub(crate) fn handle(
        &mut self,
        sequence: u64,
        part: Part,
        now: Instant,
        delay: Duration,
        deliver: &mut Vec<Bytes>,
    ) -> Result<ChunkStatus, WireError> {
        if !self.expects(sequence) {
            // The peer does not know what we have: tell it now.
            self.owed = Some(now);
            let beyond = sequence >= self.limit();
            return Ok(if beyond { ChunkStatus::Beyond } else { ChunkStatus::Again });
        }
        if sequence != self.next && self.ahead_bytes + part.payload.len() > AHEAD_MAX {
            return Ok(ChunkStatus::Beyond);
        }
        self.arrived = DelayTicks::of(now);
        let in_order = sequence == self.next && self.ahead.is_empty();
        // Every second part at once (RFC 9000, 13.2.2). Of large ones, where an acknowledgement
        // costs a quarter of what a part does, every fourth: half of what may be on its way at the
        // least.
        let many = if part.payload.len() >= LARGE { 4 } else { 2 };
        self.ahead_bytes += part.payload.len();
        self.ahead.insert(sequence, part);
        while let Some(part) = self.ahead.remove(&self.next) {
            self.next += 1;
            self.ahead_bytes -= part.payload.len();
            self.put_together(part, deliver)?;
        }
        self.unacknowledged += 1;
        // A gap at once, so that it is soon filled.
        let due = if in_order && self.unacknowledged < many { now + delay } else { now };
        self.owed = Some(self.owed.map_or(due, |owed| owed.min(due)));
        Ok(ChunkStatus::New)
    }

    fn put_together(&mut self, part: Part, deliver: &mut Vec<Bytes>) -> Result<(), WireError> {
        let mut reader = Reader::new(part.payload);
        if part.first {
            // Whole ones may come between the parts of a large one.
            if part.last {
                while !reader.is_empty() {
                    deliver.push(reader.sized(self.message_max, "a message")?);
                }
                return Ok(());
            }
            if self.partial.is_some() {
                return Err(WireError::Malformed { what: "a message that begins within another" });
            }
            let length = reader.varint()?;
            let length = usize::try_from(length).unwrap_or(usize::MAX);
            if length > self.message_max {
                return Err(WireError::TooLarge { what: "a message" });
            }
            // Room is taken as bytes arrive, four times as much at most, and not as they are
            // promised.
            let large = length >= SPARE_FROM;
            let spare = self.spare.iter_mut().position(|spare| large && spare.try_reclaim(length));
            let bytes = spare.and_then(|at| self.spare.remove(at)).unwrap_or_default();
            self.partial = Some(Partial { length, bytes });
        }
        let partial = self
            .partial
            .as_mut()
            .ok_or(WireError::Malformed { what: "a message without a start" })?;
        let rest = reader.rest();
        if partial.bytes.capacity() - partial.bytes.len() < rest.len() {
            let capacity = (4 * (partial.bytes.len() + rest.len())).min(partial.length);
            partial.bytes.reserve(capacity.saturating_sub(partial.bytes.len()));
        }
        partial.bytes.extend_from_slice(&rest);
        if partial.bytes.len() > partial.length {
            return Err(WireError::TooLarge { what: "a message" });
        }
        if part.last {
            let Partial { length, mut bytes } = self.partial.take().expect("it was just extended");
            if bytes.len() < length {
                return Err(WireError::Truncated);
            }
            deliver.push(bytes.split().freeze());
            if length >= SPARE_FROM {
                self.spare.truncate(SPARES - 1);
                self.spare.push_front(bytes);
            }
        }
        Ok(())
    }

    /// When an acknowledgement is owed at the latest.
    pub(crate) fn owed(&self) -> Option<Instant> {
        self.owed
    }

    /// What has arrived; nothing is owed any more.
    pub(crate) fn acknowledge(&mut self) -> Ack {
        self.owed = None;
        self.unacknowledged = 0;
        let mut ranges: Vec<(u64, u64)> = Vec::new();
        for &sequence in self.ahead.keys() {
            if let Some((_, last)) = ranges.last_mut()
                && *last + 1 == sequence
            {
                *last = sequence;
            } else if ranges.len() < RANGES_MAX {
                ranges.push((sequence, sequence));
            } else {
                break;
            }
        }
        Ack { next: self.next, window: self.window, arrived: self.arrived, ranges }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::wire::Write;

    /// A message of this length, in two parts.
    fn arrive(inbound: &mut Inbound, length: usize) -> Bytes {
        let mut bytes = BytesMut::new();
        bytes.varint(length as u64);
        bytes.resize(bytes.len() + length, 7);
        let mut second = bytes.freeze();
        let first = second.split_to(length / 2);
        let mut deliver = Vec::new();
        for (first, payload) in [(true, first), (false, second)] {
            let part = Part { first, last: !first, payload };
            let (now, delay) = (Instant::ORIGIN, Duration::ZERO);
            inbound.handle(inbound.next, part, now, delay, &mut deliver).unwrap();
        }
        deliver.pop().unwrap()
    }

    #[test]
    fn what_arrives_ahead_of_a_gap_is_bounded_in_bytes_and_the_gap_can_be_filled() {
        let mut inbound = Inbound::new(256, 1 << 20);
        let mut deliver = Vec::new();
        let mut arrive = |inbound: &mut Inbound, sequence| {
            let mut part = BytesMut::new();
            part.varint(60_000);
            part.resize(part.len() + 60_000, 7);
            let part = Part { first: true, last: true, payload: part.freeze() };
            let (now, delay) = (Instant::ORIGIN, Duration::ZERO);
            inbound.handle(sequence, part, now, delay, &mut deliver).unwrap()
        };
        let taken = (1..256).filter(|n| arrive(&mut inbound, *n) == ChunkStatus::New).count();
        assert_eq!(taken, AHEAD_MAX / 60_003);

        assert_eq!(arrive(&mut inbound, 0), ChunkStatus::New);
        assert_eq!((inbound.next, inbound.ahead_bytes), (taken as u64 + 1, 0));
        assert_eq!(deliver.len(), taken + 1);
    }

    #[test]
    fn the_memory_of_a_large_message_is_taken_again_when_nobody_holds_it_any_more() {
        let mut inbound = Inbound::new(64, 1 << 20);
        let first = arrive(&mut inbound, 1 << 20);
        let place = first.as_ptr();
        let second = arrive(&mut inbound, 1 << 20);
        assert_ne!(second.as_ptr(), place, "the first is still held");

        drop(first);
        let small = arrive(&mut inbound, 1000);
        assert_ne!(small.as_ptr(), place, "little holds no large memory");
        let third = arrive(&mut inbound, 1 << 19);
        assert_eq!((third.as_ptr(), third.len()), (place, 1 << 19));
        assert!(second.iter().chain(&third).all(|byte| *byte == 7));
    }
}
