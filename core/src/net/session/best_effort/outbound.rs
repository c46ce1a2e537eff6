//! The sending half of best-effort channels: what waits gives way to what is newer.

use crate::net::session::flight::SentPart;
use crate::net::session::reassembly::pieces_of;
use crate::net::wire::WireError;
use crate::net::wire::segment::{Datagram, DatagramAck, PIECES_MAX};
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Instant};
use std::collections::VecDeque;

/// The bytes that a datagram puts before its payload, at most.
const DATAGRAM_HEADER: usize = 28;
/// The same with its number.
const NUMBERED_HEADER: usize = DATAGRAM_HEADER + 6;

/// What a datagram of this size carries at least.
fn payload_capacity(capacity: usize, is_numbered: bool) -> usize {
    let header = if is_numbered { NUMBERED_HEADER } else { DATAGRAM_HEADER };
    capacity.saturating_sub(header).max(1)
}

/// What waits and what is on its way of the channels of one session.
#[derive(Debug, Default)]
pub(crate) struct BestEffortOutbound {
    /// The number of the last message. Those of one channel rise.
    sequence: u64,
    /// The newest message of each channel that has one, and the order of the channels.
    waiting: SortedMap<u32, GatherBuffer>,
    turns: VecDeque<u32>,
    bytes: usize,
    /// The rest of the message that is being sent.
    rest: VecDeque<Datagram>,
    /// How many numbered datagrams there were.
    numbered: u64,
    /// Those of which the peer has not told yet.
    flying: VecDeque<Flying>,
    flying_bytes: usize,
    /// How many were lost, as far as that was noticed; not known at first, and after some were
    /// given up, of which the peer may tell yet.
    lost: Option<u64>,
    /// Messages that gave way to newer ones, or whose path went.
    pub(crate) replaced: u64,
}

#[derive(Clone, Copy, Debug)]
struct Flying {
    number: u64,
    sent: Instant,
    bytes: usize,
}

/// What an acknowledgement brought.
#[derive(Debug)]
pub(crate) struct DatagramProgress {
    /// How many datagrams it speaks of for the first time, and their bytes.
    pub(crate) arrived: (usize, usize),
    /// The latest of them.
    pub(crate) latest: SentPart,
    /// More were lost than are taken for reordered.
    pub(crate) has_lost: bool,
}

impl BestEffortOutbound {
    /// The most bytes of a message whose datagrams are no larger than `capacity` with their
    /// headers.
    pub(crate) fn most(capacity: usize, is_numbered: bool) -> usize {
        payload_capacity(capacity, is_numbered) * usize::from(PIECES_MAX)
    }

    /// The bytes of all messages that wait.
    pub(crate) fn bytes(&self) -> usize {
        self.bytes
    }

    /// There is something to send.
    pub(crate) fn has_more(&self) -> bool {
        !self.rest.is_empty() || !self.turns.is_empty()
    }

    /// Datagrams on their way, and their bytes.
    pub(crate) fn flying(&self) -> (usize, usize) {
        (self.flying.len(), self.flying_bytes)
    }

    /// A message waits for its turn, in the place of an older one of its channel.
    pub(crate) fn push(&mut self, channel: u32, message: GatherBuffer) {
        self.bytes += message.len();
        match self.waiting.insert(channel, message) {
            Some(older) => {
                self.bytes -= older.len();
                self.replaced += 1;
            }
            None => self.turns.push_back(channel),
        }
    }

    /// The next datagram, no larger than `capacity` with its header. Numbered ones are
    /// acknowledged.
    pub(crate) fn transmit(
        &mut self,
        tag: u32,
        capacity: usize,
        is_numbered: bool,
        now: Instant,
    ) -> Option<Datagram> {
        while self.rest.is_empty() {
            self.cut_next(tag, capacity, is_numbered)?;
        }
        let datagram = self.rest.pop_front()?;
        if !is_numbered {
            return Some(datagram);
        }
        let number = self.numbered;
        self.numbered += 1;
        let bytes = datagram.payload.len();
        self.flying.push_back(Flying { number, sent: now, bytes });
        self.flying_bytes += bytes;
        Some(Datagram { number: Some(number), ..datagram })
    }

    /// Cuts the message of the next channel, unless it has become too large for the path.
    fn cut_next(&mut self, tag: u32, capacity: usize, is_numbered: bool) -> Option<()> {
        let channel = self.turns.pop_front()?;
        let message = self.waiting.remove(&channel).expect("a channel with a turn has a message");
        self.bytes -= message.len();
        if message.len() > Self::most(capacity, is_numbered) {
            self.replaced += 1;
            return Some(());
        }
        self.sequence += 1;
        let sequence = self.sequence;
        let pieces = pieces_of(&message, payload_capacity(capacity, is_numbered)).into_iter();
        let datagrams = pieces.map(|(piece, payload)| Datagram {
            tag,
            channel,
            sequence,
            number: None,
            piece,
            payload,
        });
        self.rest.extend(datagrams);
        Some(())
    }

    /// The peer has told what arrived. Nothing if it has told that before.
    pub(crate) fn handle_ack(
        &mut self,
        ack: DatagramAck,
    ) -> Result<Option<DatagramProgress>, WireError> {
        /// So many are taken for reordered (RFC 9002).
        const REORDERING: u64 = 3;
        if ack.next > self.numbered {
            return Err(WireError::Malformed { what: "an acknowledgement of what was never sent" });
        }
        let (mut arrived, mut latest) = ((0, 0), None);
        while let Some(datagram) = self.flying.front().copied()
            && datagram.number < ack.next
        {
            self.flying.pop_front();
            arrived = (arrived.0 + 1, arrived.1 + datagram.bytes);
            latest = Some(SentPart { order: datagram.number, sent: datagram.sent, again: false });
        }
        self.flying_bytes -= arrived.1;
        let lost = ack.next.saturating_sub(ack.received);
        let has_lost = self.lost.is_some_and(|noticed| lost >= noticed + REORDERING);
        // Some that were taken for lost may be there by now.
        self.lost = Some(match self.lost {
            Some(noticed) if !has_lost => noticed.min(lost),
            _ => lost,
        });
        Ok(latest.map(|latest| DatagramProgress { arrived, latest, has_lost }))
    }

    /// Of what is on its way nothing is known any more.
    pub(crate) fn lose_all(&mut self) {
        self.lost = self.lost.filter(|_| self.flying.is_empty());
        self.flying.clear();
        self.flying_bytes = 0;
    }

    /// The path has gone: what waits is old when there is another.
    pub(crate) fn handle_no_path(&mut self) {
        self.handle_path();
        self.replaced += self.waiting.len() as u64;
        self.waiting.clear();
        self.turns.clear();
        self.bytes = 0;
    }

    /// The path is another: what was cut for the one before is left out.
    pub(crate) fn handle_path(&mut self) {
        self.lose_all();
        if !self.rest.is_empty() {
            self.rest.clear();
            self.replaced += 1;
        }
    }
}
