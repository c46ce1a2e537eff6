//! The receiving half of best-effort channels.

use crate::Instant;
use crate::net::session::reassembly::Reassembly;
use crate::net::wire::segment::{Datagram, DatagramAck, DelayTicks};
use crate::sorted::SortedMap;
use bytes::Bytes;
use std::time::Duration;

/// What has arrived of the channels of one session.
#[derive(Debug)]
pub(crate) struct BestEffortInbound {
    /// The newest that was delivered, and the how manieth delivery that was, by channel.
    delivered: SortedMap<u32, (u64, u64)>,
    deliveries: u64,
    channels_max: usize,
    pieces: Reassembly<(u32, u64)>,
    /// What is told of numbered datagrams.
    arrived: DatagramAck,
    /// When that is owed at the latest.
    owed: Option<Instant>,
    /// Datagrams since it was told.
    unsent: u32,
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
}

impl BestEffortInbound {
    /// So many datagrams are acknowledged at once: a few of those that a slow path bears.
    const UNTOLD_MAX: u32 = 4;

    pub(crate) fn new(channels_max: usize, pieces: Reassembly<(u32, u64)>) -> Self {
        BestEffortInbound {
            delivered: SortedMap::new(),
            deliveries: 0,
            channels_max,
            pieces,
            arrived: DatagramAck::default(),
            owed: None,
            unsent: 0,
        }
    }

    /// A datagram has arrived that its sender has numbered.
    fn note(&mut self, number: u64, now: Instant, delay: Duration) {
        let DatagramAck { next, received, .. } = self.arrived;
        let next = next.max(number.saturating_add(1));
        self.arrived = DatagramAck { next, received: received + 1, arrived: DelayTicks::of(now) };
        self.unsent += 1;
        let due = if self.unsent < Self::UNTOLD_MAX { now + delay } else { now };
        self.owed = Some(self.owed.map_or(due, |owed| owed.min(due)));
    }

    /// When an acknowledgement is owed at the latest.
    pub(crate) fn owed(&self) -> Option<Instant> {
        self.owed
    }

    /// What has arrived, if that is owed; nothing is any more.
    pub(crate) fn acknowledge(&mut self) -> Option<DatagramAck> {
        self.unsent = 0;
        self.owed.take().map(|_| self.arrived)
    }

    /// A datagram has arrived, of which the sender is told within `delay`.
    pub(crate) fn handle(
        &mut self,
        datagram: Datagram,
        now: Instant,
        delay: Duration,
    ) -> DatagramStatus {
        let Datagram { channel, sequence, number, piece, payload, .. } = datagram;
        if let Some(number) = number {
            self.note(number, now, delay);
        }
        let payload = payload.into_bytes();
        match self.delivered.get(&channel) {
            Some((newest, _)) if sequence == *newest => return DatagramStatus::Again,
            Some((newest, _)) if sequence < *newest => return DatagramStatus::Overtaken,
            _ => {}
        }
        let message = match piece {
            None => Some(payload),
            Some(piece) => self.pieces.handle((channel, sequence), piece, payload, now),
        };
        match message {
            Some(message) => {
                self.deliveries += 1;
                self.delivered.insert(channel, (sequence, self.deliveries));
                self.forget_oldest();
                DatagramStatus::Newest(message)
            }
            None => DatagramStatus::InPart,
        }
    }

    /// Of more channels than are remembered, the one that was used last before all others is
    /// forgotten: subscriptions and bindings that have ended use theirs no more.
    fn forget_oldest(&mut self) {
        if self.delivered.len() <= self.channels_max {
            return;
        }
        let oldest = self.delivered.iter().min_by_key(|(_, (_, delivery))| *delivery);
        if let Some(channel) = oldest.map(|(channel, _)| *channel) {
            self.delivered.remove(&channel);
        }
    }

    /// Messages that were never finished.
    pub(crate) fn unfinished(&self) -> u64 {
        self.pieces.given_up
    }
}
