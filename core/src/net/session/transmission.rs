//! What a session sends when, and what acknowledgements tell it.

use super::best_effort::DatagramProgress;
use super::config::CHUNK_MAX;
use super::congestion::{self, CongestionControl, CongestionSignal, DelayLane, DelaySample};
use super::flight::{Chunk, SentPart};
use super::reassembly::pieces_of;
use super::round_trip::RttEstimator;
use super::{Session, State};
use crate::net::is_narrow;
use crate::net::wire::packet::{PacketPriority, UndeliveredReason};
use crate::net::wire::segment::{
    Ack, Data, DatagramAck, DelayTicks, PIECE_HEADER, Segment, data_header,
};
use crate::{DeliveryError, Instant, TrafficClass};
use std::time::Duration;

impl Session {
    /// Something of ours came back: it is repeated once the routers have had time to find another
    /// way, and never faster than silence would be taken for loss.
    pub fn handle_undelivered(&mut self, reason: UndeliveredReason, now: Instant) {
        self.now = now;
        self.counters.returned += 1;
        self.counters.last_return = Some(reason);
        self.path.returned = Some(reason);
        let soon = now + RttEstimator::SHORTEST;
        for stream in &mut self.streams {
            stream.retransmit_at = stream.retransmit_at.map(|at| at.min(soon));
        }
    }

    /// Why the peer cannot be reached, as far as it was reported.
    pub(super) fn unreachable(&self) -> DeliveryError {
        let node = self.config.peer.to_string();
        match self.path.returned {
            None | Some(UndeliveredReason::NoRoute) => DeliveryError::Unreachable { node },
            Some(reason) => DeliveryError::Undelivered {
                node,
                reason: format!("{reason}; {}", reason.advice()),
            },
        }
    }

    /// The path leads over a medium that is taken for slow until it is measured: a serial line, or
    /// CAN.
    pub(super) fn is_narrow(&self) -> bool {
        self.path.mtu.is_some_and(is_narrow)
    }

    /// Parts on their way of this stream.
    fn flying(&self, stream: TrafficClass) -> usize {
        self.streams[stream as usize].outbound.flying()
    }

    /// What is on its way along one path.
    fn load(&self) -> usize {
        let load = |stream| {
            let outbound = &self.streams[stream as usize].outbound;
            CongestionControl::load(outbound.flying(), outbound.flying_bytes())
        };
        let (datagrams, bytes) = self.datagrams.outbound.flying();
        // Copies take every path.
        let streams =
            TrafficClass::ALL.into_iter().filter(|class| *class != TrafficClass::Redundant);
        streams.map(load).sum::<usize>() + CongestionControl::load(datagrams, bytes)
    }

    /// How long an answer is waited for. Where this stream has measured none, others may have.
    pub(super) fn retransmit_timeout(&self, stream: TrafficClass) -> Duration {
        let own = &self.streams[stream as usize].rtt;
        let measured = self.streams.iter().map(|stream| &stream.rtt);
        let measured = measured.filter(|rtt| rtt.smoothed().is_some());
        match own.smoothed() {
            Some(_) => own.timeout(),
            None => {
                measured.map(RttEstimator::timeout).max().unwrap_or_default().max(own.timeout())
            }
        }
    }

    /// There is something to send of a class that shares the path.
    fn waits(&self, class: TrafficClass) -> bool {
        let has_datagrams = class == TrafficClass::Event && self.datagrams.outbound.has_more();
        has_datagrams || self.streams[class as usize].outbound.has_more()
    }

    /// Some of what shares the path is on its way.
    fn is_shared(&self) -> bool {
        TrafficClass::WEIGHTED.into_iter().any(|(class, _)| self.flying(class) > 0)
    }

    /// When what shares the path may go on, if some of it waits for nothing but that.
    pub(super) fn paced_until(&self) -> Option<Instant> {
        let waits = TrafficClass::WEIGHTED.into_iter().any(|(class, _)| self.waits(class));
        let is_open = matches!(self.state, State::Open { .. } | State::Closing { .. });
        let is_held =
            !is_open || self.path.mtu.is_none() || self.path.congestion.is_full(self.load());
        let at = self.path.congestion.send_at();
        (waits && !is_held && at > self.now).then_some(at)
    }

    /// The path bears more than control at present.
    pub(super) fn may_send_data(&self) -> bool {
        !self.path.congestion.is_full(self.load()) && self.path.congestion.send_at() <= self.now
    }

    /// Sends the next part that may be sent: control first, but for every ninth part if others
    /// wait, and what was lost before what is new.
    pub(super) fn transmit_part(&mut self) -> bool {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return false };
        let Some(mtu) = self.path.mtu else { return false };
        let congested = self.path.congestion.is_full(self.load());
        let is_paced = self.path.congestion.send_at() > self.now;
        let due = self.turns.control_run >= Self::CONTROL_RUN;
        // Some of it may always be on its way, whatever else is before it.
        let least = self.path.congestion.least_parts();
        let may_control = !congested || self.flying(TrafficClass::Control) < least;
        // Nor does control keep the others from having one there.
        let may_share = !(congested || is_paced) || due && !self.is_shared();
        let control = may_control.then_some(TrafficClass::Control);
        let shared = may_share.then(|| self.turns.next(|class| self.waits(class))).flatten();
        // It keeps its time whatever one of the paths is like; two windows bound it.
        let flying = self.streams[TrafficClass::Redundant as usize].outbound.flying_bytes();
        let redundant = (flying < congestion::MOST).then_some(TrafficClass::Redundant);
        let order = if due { [redundant, shared, control] } else { [control, redundant, shared] };
        order.into_iter().flatten().any(|class| self.transmit_of(class, peer.tag, mtu))
            // A datagram that the path does not carry any more is dropped: others have their turn.
            || shared.is_some_and(|class| !self.waits(class)) && self.transmit_part()
    }

    /// Sends the next part of this class.
    fn transmit_of(&mut self, class: TrafficClass, tag: u32, mtu: usize) -> bool {
        let waited = TrafficClass::WEIGHTED.map(|(class, _)| (class, self.waits(class)));
        let is_sent = if class == TrafficClass::Event && self.datagrams.has_turn {
            self.transmit_datagram(tag) || self.transmit_stream(class, tag, mtu)
        } else {
            self.transmit_stream(class, tag, mtu)
                || class == TrafficClass::Event && self.transmit_datagram(tag)
        };
        if is_sent && class == TrafficClass::Control {
            self.turns.control_run += 1;
        } else if is_sent && class.is_weighted() {
            self.turns.control_run = 0;
            self.turns.took(class, |class| waited.contains(&(class, true)));
        }
        is_sent
    }

    /// Sends the next part of the stream of this class.
    fn transmit_stream(&mut self, stream: TrafficClass, tag: u32, mtu: usize) -> bool {
        // Room for an acknowledgement of a few ranges, or of none in a small frame; a longer one
        // travels alone.
        let ack_capacity = 32.min(mtu / 8);
        let part_max = CHUNK_MAX.min(self.path.congestion.part_max());
        let state = &mut self.streams[stream as usize];
        let header = data_header(state.outbound.next());
        let capacity = mtu.saturating_sub(header + ack_capacity).clamp(16, part_max.max(16));
        let Some((sequence, part)) = state.outbound.transmit(capacity, self.now) else {
            return false;
        };
        let owed = state.inbound.owed().is_some();
        let ack = owed.then(|| state.inbound.acknowledge());
        // What was cut for a larger path says of each piece which it is.
        let place = if part.payload.len() > capacity { PIECE_HEADER } else { 0 };
        let (ack, alone) = match ack {
            Some(ack) if ack.length() + place > ack_capacity => (None, Some(ack)),
            ack => (ack, None),
        };
        if let Some(ack) = alone {
            self.transmit_ack(tag, stream, ack);
        }
        if stream == TrafficClass::Event {
            self.datagrams.has_turn = true;
        }
        self.transmit_as(tag, stream, sequence, part, ack, capacity);
        true
    }

    /// Sends the next datagram, as large as a part of data may be.
    pub(super) fn transmit_datagram(&mut self, tag: u32) -> bool {
        let Some(mtu) = self.path.mtu else { return false };
        // The queues before a slow line are those of its transport, which keeps them short; an
        // acknowledgement takes as long there as what it tells of.
        let is_numbered = !self.is_narrow();
        let capacity = mtu.min(CHUNK_MAX.min(self.path.congestion.part_max()));
        let outbound = &mut self.datagrams.outbound;
        let Some(datagram) = outbound.transmit(tag, capacity, is_numbered, self.now) else {
            return false;
        };
        self.datagrams.has_turn = false;
        self.counters.bytes_sent += datagram.payload.len() as u64;
        if is_numbered {
            let due = self.now + self.retransmit_timeout(TrafficClass::Event);
            self.datagrams.lost_at.get_or_insert(due);
            let load = CongestionControl::load(1, datagram.payload.len());
            let round_trip = self.streams[TrafficClass::Event as usize].rtt.smoothed();
            self.path.congestion.handle_sent(load, round_trip, self.now);
        }
        self.transmit(PacketPriority::Data, Segment::Datagram(datagram));
        true
    }

    fn transmit_ack(&mut self, tag: u32, stream: TrafficClass, ack: Ack) {
        let streams = TrafficClass::ALL.map(|other| (other == stream).then(|| ack.clone()));
        let segment = Segment::Acknowledge { tag, streams, datagrams: None };
        self.transmit_for(stream, PacketPriority::Control, segment);
    }

    pub(super) fn transmit_as(
        &mut self,
        tag: u32,
        stream: TrafficClass,
        sequence: u64,
        part: Chunk,
        mut ack: Option<Ack>,
        capacity: usize,
    ) {
        let again = part.latest.again;
        self.counters.sent += 1;
        self.counters.bytes_sent += part.payload.len() as u64;
        self.counters.retransmitted += u64::from(again);
        let due = self.now + self.retransmit_timeout(stream);
        self.streams[stream as usize].retransmit_at.get_or_insert(due);
        let Chunk { first, last, payload, .. } = part;
        if stream.is_weighted() {
            let load = CongestionControl::load(1, payload.len());
            let round_trip = self.streams[stream as usize].rtt.smoothed();
            self.path.congestion.handle_sent(load, round_trip, self.now);
        }
        for (piece, payload) in pieces_of(&payload, capacity) {
            let ack = ack.take();
            let data = Data { tag, stream, sequence, first, last, again, piece, ack, payload };
            let segment = Segment::Data(data);
            let class = match stream {
                TrafficClass::Control => PacketPriority::Control,
                // A stop, or a beat: it waits for nothing that is said one way.
                TrafficClass::Redundant if first && last => PacketPriority::Control,
                _ => PacketPriority::Data,
            };
            self.transmit_for(stream, class, segment);
        }
    }

    /// Acknowledges what travels one way now, and with it shows that the session is known: control
    /// in any case, and what something has arrived of since the last time.
    pub(super) fn acknowledge(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let streams = TrafficClass::ALL.map(|stream| {
            let inbound = &mut self.streams[stream as usize].inbound;
            let is_told = match stream {
                TrafficClass::Control => true,
                TrafficClass::Redundant => false,
                _ => inbound.owed().is_some(),
            };
            is_told.then(|| inbound.acknowledge())
        });
        let datagrams = self.datagrams.inbound.acknowledge();
        let segment = Segment::Acknowledge { tag: peer.tag, streams, datagrams };
        self.transmit(PacketPriority::Control, segment);
    }

    /// Acknowledges what has waited for it.
    pub(super) fn acknowledge_owed(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let redundant = &mut self.streams[TrafficClass::Redundant as usize].inbound;
        if redundant.owed().is_some() {
            let ack = redundant.acknowledge();
            self.transmit_ack(peer.tag, TrafficClass::Redundant, ack);
        }
        if self.ack_owed().is_some() {
            self.acknowledge();
        }
    }

    /// When an acknowledgement is owed at the latest, while there is a session to send it in.
    pub(super) fn ack_owed(&self) -> Option<Instant> {
        let (State::Open { .. } | State::Closing { .. }) = self.state else { return None };
        let streams = self.streams.iter().filter_map(|stream| stream.inbound.owed());
        streams.chain(self.datagrams.inbound.owed()).min()
    }

    pub(super) fn handle_ack(&mut self, stream: TrafficClass, ack: &Ack) {
        // As full as it gets, unless parts are as large as the window.
        let was_full = self.path.congestion.is_full(self.load() + self.path.congestion.part_max());
        let outbound = &mut self.streams[stream as usize].outbound;
        let progress = match outbound.handle_ack(ack) {
            Ok(progress) => progress,
            Err(error) => return self.refusals.count(&error),
        };
        if let Some(SentPart { order, sent, again }) = progress.latest {
            let has_lost = outbound.find_lost(order);
            let round_trip = self.now - sent;
            // What was sent again may be the answer to the first sending (Karn's algorithm).
            if !again {
                self.streams[stream as usize].rtt.measure(round_trip);
            }
            // Copies take every path.
            if stream != TrafficClass::Redundant {
                let lane = if stream.is_weighted() { DelayLane::Usual } else { DelayLane::Urgent };
                let delay = ack.arrived - DelayTicks::of(sent);
                if !again {
                    let sample = DelaySample { delay, round_trip, lane };
                    self.path.congestion.handle_delay(sample, self.now);
                }
                let arrived = (progress.parts, progress.bytes);
                let is_measured = !again;
                let signal = CongestionSignal { arrived, was_full, has_lost, is_measured, sent };
                self.path.congestion.handle_arrived(signal, self.now);
            }
            let due = self.now + self.retransmit_timeout(stream);
            self.streams[stream as usize].retransmit_at = (self.flying(stream) > 0).then_some(due);
        }
        self.record_receipt();
    }

    pub(super) fn handle_datagram_ack(&mut self, ack: DatagramAck) {
        let was_full = self.path.congestion.is_full(self.load() + self.path.congestion.part_max());
        let progress = match self.datagrams.outbound.handle_ack(ack) {
            Ok(Some(progress)) => progress,
            Ok(None) => return,
            Err(error) => return self.refusals.count(&error),
        };
        let DatagramProgress { arrived, latest: SentPart { sent, .. }, has_lost } = progress;
        let round_trip = self.now - sent;
        self.streams[TrafficClass::Event as usize].rtt.measure(round_trip);
        let delay = ack.arrived - DelayTicks::of(sent);
        let sample = DelaySample { delay, round_trip, lane: DelayLane::Usual };
        self.path.congestion.handle_delay(sample, self.now);
        let signal = CongestionSignal { arrived, was_full, has_lost, is_measured: true, sent };
        self.path.congestion.handle_arrived(signal, self.now);
        let due = self.now + self.retransmit_timeout(TrafficClass::Event);
        self.datagrams.lost_at = (self.datagrams.outbound.flying().0 > 0).then_some(due);
    }

    /// Takes all datagrams on their way for lost.
    pub(super) fn detect_lost_datagrams(&mut self) {
        self.datagrams.lost_at = None;
        self.datagrams.outbound.lose_all();
        // What shares the path with them tells by itself what the path is like.
        if !self.is_shared() {
            self.streams[TrafficClass::Event as usize].rtt.back_off();
            self.path.congestion.handle_timeout(self.now);
        }
    }

    /// Takes all that is in flight of this stream for lost.
    pub(super) fn detect_loss(&mut self, stream: TrafficClass) {
        self.streams[stream as usize].retransmit_at = None;
        if self.flying(stream) == 0 {
            return;
        }
        self.streams[stream as usize].rtt.back_off();
        // What shares the path with control tells by itself what the path is like.
        if stream.is_weighted() || stream == TrafficClass::Control && !self.is_shared() {
            self.path.congestion.handle_timeout(self.now);
        }
        self.streams[stream as usize].outbound.lose_all();
        self.streams[stream as usize].retransmit_at =
            Some(self.now + self.retransmit_timeout(stream));
    }
}
