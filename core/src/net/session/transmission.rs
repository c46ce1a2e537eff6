//! What a session sends when, and what acknowledgements tell it.

use super::best_effort::DatagramProgress;
use super::congestion::{CongestionControl, CongestionSignal, DelaySample};
use super::outbound::{Chunk, SentPart};
use super::reassembly::pieces_of;
use super::round_trip::RttEstimator;
use super::{Session, SessionOutput, State};
use crate::net::is_narrow;
use crate::net::session::size_class::SizeClass;
use crate::net::wire::packet::{PacketPriority, UndeliveredReason, WAY_MAX};
use crate::net::wire::segment::{
    Ack, Data, DatagramAck, DelayTicks, PIECE_HEADER, Segment, Stream, data_header,
};
use crate::{DeliveryError, Instant};
use std::time::Duration;

/// Which stream goes first when several wait.
const BY_URGENCY: [Stream; 3] = [Stream::Control, Stream::Redundant, Stream::Data];
/// The same when control has gone first often enough.
const DATA_FIRST: [Stream; 3] = [Stream::Redundant, Stream::Data, Stream::Control];

impl Session {
    /// Something of ours came back: it is repeated once the routers have had time to find another
    /// way, and never faster than silence would be taken for loss.
    pub fn handle_undelivered(&mut self, reason: UndeliveredReason, now: Instant) {
        self.now = now;
        self.counters.returned += 1;
        self.counters.last_return = Some(reason);
        self.returned = Some(reason);
        let soon = now + self.config.retransmit_min;
        self.retransmit_at = self.retransmit_at.map(|due| due.map(|at| at.min(soon)));
    }

    /// Why the peer cannot be reached, as far as it was reported.
    pub(super) fn unreachable(&self) -> DeliveryError {
        let node = self.config.peer.to_string();
        match self.returned {
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
        self.path.is_some_and(is_narrow)
    }

    /// Parts on their way of this stream.
    fn flying(&self, stream: Stream) -> usize {
        self.streams[stream as usize].outbound.flying()
    }

    /// What is on its way along one path.
    fn load(&self) -> usize {
        let load = |stream| {
            let outbound = &self.streams[stream as usize].outbound;
            CongestionControl::load(outbound.flying(), outbound.flying_bytes())
        };
        let (datagrams, bytes) = self.datagrams_out.flying();
        load(Stream::Control) + load(Stream::Data) + CongestionControl::load(datagrams, bytes)
    }

    /// How long an answer is waited for. Where this stream has measured none, others may have.
    pub(super) fn retransmit_timeout(&self, stream: Stream) -> Duration {
        let own = &self.rtt[stream as usize];
        let measured = self.rtt.iter().filter(|rtt| rtt.smoothed().is_some());
        match own.smoothed() {
            Some(_) => own.timeout(),
            None => {
                measured.map(RttEstimator::timeout).max().unwrap_or_default().max(own.timeout())
            }
        }
    }

    /// When data may go on, if something of it waits for nothing but that.
    pub(super) fn paced_until(&self) -> Option<Instant> {
        let data = &self.streams[Stream::Data as usize].outbound;
        let waits = data.has_more() || self.datagrams_out.has_more();
        let is_open = matches!(self.state, State::Open { .. } | State::Closing { .. });
        let is_held = !is_open || self.path.is_none() || self.congestion.is_full(self.load());
        let at = self.congestion.send_at();
        (waits && !is_held && at > self.now).then_some(at)
    }

    /// The path bears more data at present.
    pub(super) fn may_send_data(&self) -> bool {
        !self.congestion.is_full(self.load()) && self.congestion.send_at() <= self.now
    }

    /// Sends the next part that may be sent: control first, but for every ninth part if data waits,
    /// and what was lost before what is new.
    pub(super) fn transmit_part(&mut self) -> bool {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return false };
        let Some(mtu) = self.path else { return false };
        let congested = self.congestion.is_full(self.load());
        let is_paced = self.congestion.send_at() > self.now;
        // Room for an acknowledgement of a few ranges, or of none in a small frame; a longer one
        // travels alone.
        let ack_capacity = 32.min(mtu / 8);
        let always = self.congestion.least_parts();
        let part_max = self.config.chunk_max.min(self.congestion.part_max());
        let due = self.control_run >= Self::CONTROL_RUN;
        for stream in if due { DATA_FIRST } else { BY_URGENCY } {
            let state = &mut self.streams[stream as usize];
            // The way of each copy is written before it.
            let way = if stream == Stream::Redundant { WAY_MAX } else { 0 };
            let header = data_header(state.outbound.next()) + way;
            // Copies that do not fit onto their ways go one way.
            let least = if stream == Stream::Redundant { 48 } else { 16 };
            let capacity =
                mtu.saturating_sub(header + ack_capacity).clamp(least, part_max.max(least));
            let held = match stream {
                // Some of it may always be on its way, whatever data is before it.
                Stream::Control => congested && state.outbound.flying() >= always,
                // Nor does control keep it from having one there.
                Stream::Data => (congested || is_paced) && !(due && state.outbound.flying() == 0),
                // It keeps its time whatever one of the ways is like; the peer's window bounds it.
                Stream::Redundant => false,
            };
            if held {
                continue;
            }
            if stream == Stream::Data && self.is_datagrams_turn && self.transmit_datagram(peer.tag)
            {
                return true;
            }
            let state = &mut self.streams[stream as usize];
            if let Some((sequence, part)) = state.outbound.transmit(capacity, self.now) {
                match stream {
                    Stream::Control => self.control_run += 1,
                    Stream::Data => (self.control_run, self.is_datagrams_turn) = (0, true),
                    Stream::Redundant => {}
                }
                let state = &mut self.streams[stream as usize];
                let owed = state.inbound.owed().is_some();
                let ack = owed.then(|| state.inbound.acknowledge());
                // What was cut for a larger path says of each piece which it is.
                let place = if part.payload.len() > capacity { PIECE_HEADER } else { 0 };
                let (ack, alone) = match ack {
                    Some(ack) if ack.length() + place > ack_capacity => (None, Some(ack)),
                    ack => (ack, None),
                };
                if let Some(ack) = alone {
                    self.transmit_ack(peer.tag, stream, ack);
                }
                self.transmit_as(peer.tag, stream, sequence, part, ack, capacity);
                return true;
            }
            if stream == Stream::Data && self.transmit_datagram(peer.tag) {
                return true;
            }
        }
        false
    }

    /// Sends the next datagram, as large as a part of data may be.
    pub(super) fn transmit_datagram(&mut self, tag: u32) -> bool {
        let Some(mtu) = self.path else { return false };
        // The queues before a slow line are those of its transport, which keeps them short; an
        // acknowledgement takes as long there as what it tells of.
        let is_numbered = !self.is_narrow();
        let capacity = mtu.min(self.config.chunk_max.min(self.congestion.part_max()));
        let way = (capacity, is_numbered);
        let Some(datagram) = self.datagrams_out.transmit(tag, way, self.now) else { return false };
        (self.control_run, self.is_datagrams_turn) = (0, false);
        if is_numbered {
            let due = self.now + self.retransmit_timeout(Stream::Data);
            self.datagrams_lost_at.get_or_insert(due);
            let load = CongestionControl::load(1, datagram.payload.len());
            let round_trip = self.rtt[Stream::Data as usize].smoothed();
            self.congestion.handle_sent(load, round_trip, self.now);
        }
        self.transmit(PacketPriority::Data, Segment::Datagram(datagram));
        true
    }

    fn transmit_ack(&mut self, tag: u32, stream: Stream, ack: Ack) {
        let mut acks = [None, None, None];
        acks[stream as usize] = Some(ack);
        let [control, data, redundant] = acks;
        let segment = Segment::Acknowledge { tag, control, data, redundant, datagrams: None };
        match stream {
            Stream::Redundant => self.transmit_everywhere(PacketPriority::Control, segment),
            Stream::Control | Stream::Data => self.transmit(PacketPriority::Control, segment),
        }
    }

    pub(super) fn transmit_as(
        &mut self,
        tag: u32,
        stream: Stream,
        sequence: u64,
        part: Chunk,
        mut ack: Option<Ack>,
        capacity: usize,
    ) {
        let again = part.latest.again;
        self.counters.sent += 1;
        self.counters.retransmitted += u64::from(again);
        let due = self.now + self.retransmit_timeout(stream);
        self.retransmit_at[stream as usize].get_or_insert(due);
        let Chunk { first, last, payload, .. } = part;
        if stream == Stream::Data {
            let load = CongestionControl::load(1, payload.len());
            let round_trip = self.rtt[stream as usize].smoothed();
            self.congestion.handle_sent(load, round_trip, self.now);
        }
        for (piece, payload) in pieces_of(&payload, capacity) {
            let ack = ack.take();
            let data = Data { tag, stream, sequence, first, last, again, piece, ack, payload };
            let segment = Segment::Data(data);
            match stream {
                Stream::Control => self.transmit(PacketPriority::Control, segment),
                Stream::Data => self.transmit(PacketPriority::Data, segment),
                // A stop, or a beat: it waits for nothing that is said one way.
                Stream::Redundant if first && last => {
                    self.transmit_everywhere(PacketPriority::Control, segment);
                }
                Stream::Redundant => self.transmit_everywhere(PacketPriority::Data, segment),
            }
        }
    }

    /// Acknowledges what travels one way now, and with it shows that the session is known.
    pub(super) fn acknowledge(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let [control, data, _] = &mut self.streams;
        let control = Some(control.inbound.acknowledge());
        let data = Some(data.inbound.acknowledge());
        let datagrams = self.datagrams_in.acknowledge();
        let tag = peer.tag;
        let segment = Segment::Acknowledge { tag, control, data, redundant: None, datagrams };
        self.transmit(PacketPriority::Control, segment);
    }

    /// Acknowledges what has waited for it.
    pub(super) fn acknowledge_owed(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let redundant = &mut self.streams[Stream::Redundant as usize].inbound;
        if redundant.owed().is_some() {
            let ack = redundant.acknowledge();
            self.transmit_ack(peer.tag, Stream::Redundant, ack);
        }
        if self.ack_owed().is_some() {
            self.acknowledge();
        }
    }

    pub(super) fn ack_owed(&self) -> Option<Instant> {
        let streams = self.streams.iter().filter_map(|stream| stream.inbound.owed());
        streams.chain(self.datagrams_in.owed()).min()
    }

    pub(super) fn handle_ack(&mut self, stream: Stream, ack: &Ack) {
        // As full as it gets, unless parts are as large as the window.
        let was_full = self.congestion.is_full(self.load() + self.congestion.part_max());
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
                self.rtt[stream as usize].measure(round_trip);
            }
            // Copies take every path.
            if stream != Stream::Redundant {
                let is_data = stream == Stream::Data;
                let delay = ack.arrived - DelayTicks::of(sent);
                if !again {
                    let sample = DelaySample { delay, round_trip, is_data };
                    self.congestion.handle_delay(sample, self.now);
                }
                let arrived = (progress.parts, progress.bytes);
                let is_measured = !again;
                let signal = CongestionSignal { arrived, was_full, has_lost, is_measured, sent };
                self.congestion.handle_arrived(signal, self.now);
            }
            let due = self.now + self.retransmit_timeout(stream);
            self.retransmit_at[stream as usize] = (self.flying(stream) > 0).then_some(due);
        }
        self.report_ready(stream);
        self.record_receipt();
    }

    pub(super) fn handle_datagram_ack(&mut self, ack: DatagramAck) {
        let was_full = self.congestion.is_full(self.load() + self.congestion.part_max());
        let progress = match self.datagrams_out.handle_ack(ack) {
            Ok(Some(progress)) => progress,
            Ok(None) => return,
            Err(error) => return self.refusals.count(&error),
        };
        let DatagramProgress { arrived, latest: SentPart { sent, .. }, has_lost } = progress;
        let round_trip = self.now - sent;
        self.rtt[Stream::Data as usize].measure(round_trip);
        let delay = ack.arrived - DelayTicks::of(sent);
        let sample = DelaySample { delay, round_trip, is_data: true };
        self.congestion.handle_delay(sample, self.now);
        let signal = CongestionSignal { arrived, was_full, has_lost, is_measured: true, sent };
        self.congestion.handle_arrived(signal, self.now);
        let due = self.now + self.retransmit_timeout(Stream::Data);
        self.datagrams_lost_at = (self.datagrams_out.flying().0 > 0).then_some(due);
    }

    /// Takes all datagrams on their way for lost.
    pub(super) fn detect_lost_datagrams(&mut self) {
        self.datagrams_lost_at = None;
        self.datagrams_out.lose_all();
        // Data on its way tells by itself what the path is like.
        if self.flying(Stream::Data) == 0 {
            self.rtt[Stream::Data as usize].back_off();
            self.congestion.handle_timeout(self.now);
        }
    }

    pub(super) fn report_ready(&mut self, stream: Stream) {
        let state = &self.streams[stream as usize];
        let (messages, most) = (state.outbound.messages(), self.config.buffer_messages);
        let ready = SizeClass::ALL.map(|load| {
            let (holds, should) = (state.outbound.bytes(load), self.buffer_bytes(load));
            match load {
                // Half empty, so that a waiting sender can send more than one message.
                SizeClass::Small => messages <= most / 2 && holds <= should / 2,
                // One is worth the word, and the next is to be here before the last has gone. What
                // is small may stand here for ever: it has room of its own, and its senders keep
                // their half.
                SizeClass::Bulk => messages <= most && holds <= should,
            }
        });
        let state = &mut self.streams[stream as usize];
        for load in SizeClass::ALL {
            if ready[load as usize] && std::mem::take(&mut state.full[load as usize]) {
                self.outputs.push_back(SessionOutput::Ready { stream, load });
            }
        }
    }

    /// The bytes of this load that should wait in a stream at most.
    pub(super) fn buffer_bytes(&self, load: SizeClass) -> usize {
        match load {
            SizeClass::Small => self.config.buffer_bytes,
            // What is small waits behind no more of it.
            SizeClass::Bulk => self.config.buffer_bytes / 2,
        }
    }

    /// Takes all that is in flight of this stream for lost.
    pub(super) fn detect_loss(&mut self, stream: Stream) {
        self.retransmit_at[stream as usize] = None;
        if self.flying(stream) == 0 {
            return;
        }
        self.rtt[stream as usize].back_off();
        // Data on its way tells by itself what the path is like.
        if stream == Stream::Data || stream == Stream::Control && self.flying(Stream::Data) == 0 {
            self.congestion.handle_timeout(self.now);
        }
        self.streams[stream as usize].outbound.lose_all();
        self.retransmit_at[stream as usize] = Some(self.now + self.retransmit_timeout(stream));
    }
}
