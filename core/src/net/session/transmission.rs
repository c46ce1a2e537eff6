//! What a session sends when, and what acknowledgements tell it.

use super::assembly::pieces_of;
use super::outbound::Part;
use super::{STREAMS, Session, SessionConfig, SessionOutput, State};
use crate::Instant;
use crate::net::packet::{Class, Undelivered};
use crate::net::segment::{Ack, DATA_HEADER, Data, Segment, Stream};

impl Session {
    /// Something of ours came back: it is repeated once the routers have had time to find another way,
    /// and never faster than silence would be taken for loss.
    pub fn handle_undelivered(&mut self, reason: Undelivered, now: Instant) {
        self.now = now;
        self.counters.returned += 1;
        self.counters.last_return = Some(reason);
        let soon = now + self.config.retransmit_min;
        self.retransmit_at = self.retransmit_at.map(|at| at.min(soon));
    }

    /// Sends the next part that may be sent: control first, and what was lost before what is new.
    pub(super) fn transmit_part(&mut self) -> bool {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return false };
        let Some(mtu) = self.path else { return false };
        let flying: usize = self.streams.iter().map(|stream| stream.outbound.flying()).sum();
        if flying >= self.congestion {
            return false;
        }
        // Room for an acknowledgement of a few ranges; one with more travels alone.
        let room = mtu.saturating_sub(DATA_HEADER + 32).clamp(64, self.config.part_max);
        for stream in STREAMS {
            let state = &mut self.streams[stream as usize];
            if let Some((sequence, part)) = state.outbound.transmit(room, self.order, self.now) {
                let owed = state.inbound.owed().is_some();
                let ack = owed.then(|| state.inbound.acknowledge());
                let (ack, alone) = match ack {
                    Some(ack) if ack.ranges.len() > 2 => (None, Some(ack)),
                    ack => (ack, None),
                };
                if let Some(ack) = alone {
                    let (control, data) = match stream {
                        Stream::Control => (Some(ack), None),
                        Stream::Data => (None, Some(ack)),
                    };
                    let tag = peer.tag;
                    self.transmit(Class::Control, Segment::Acknowledge { tag, control, data });
                }
                self.transmit_as(peer.tag, stream, sequence, part, ack, room);
                return true;
            }
        }
        false
    }

    pub(super) fn transmit_as(
        &mut self,
        tag: u32,
        stream: Stream,
        sequence: u64,
        part: Part,
        mut ack: Option<Ack>,
        room: usize,
    ) {
        self.counters.sent += 1;
        self.counters.repeated += u64::from(part.is_repeated());
        self.order += 1;
        self.retransmit_at.get_or_insert(self.now + self.trip.timeout());
        let class = match stream {
            Stream::Control => Class::Control,
            Stream::Data => Class::Data,
        };
        let Part { first, last, payload, .. } = part;
        for (piece, payload) in pieces_of(&payload, room) {
            let ack = ack.take();
            let data = Data { tag, stream, sequence, first, last, piece, ack, payload };
            self.transmit(class, Segment::Data(data));
        }
    }

    /// Acknowledges both streams now.
    pub(super) fn acknowledge(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let [control, data] = &mut self.streams;
        let control = Some(control.inbound.acknowledge());
        let data = Some(data.inbound.acknowledge());
        self.transmit(Class::Control, Segment::Acknowledge { tag: peer.tag, control, data });
    }

    pub(super) fn ack_owed(&self) -> Option<Instant> {
        self.streams.iter().filter_map(|stream| stream.inbound.owed()).min()
    }

    pub(super) fn handle_ack(&mut self, stream: Stream, ack: &Ack) {
        let outbound = &mut self.streams[stream as usize].outbound;
        let progress = match outbound.handle_ack(ack, self.now) {
            Ok(progress) => progress,
            Err(error) => return self.refusals.count(&error),
        };
        if let Some(sample) = progress.round_trip {
            self.trip.measure(sample);
        }
        if let Some(order) = progress.order {
            self.trip.progress();
            self.congestion = (self.congestion + progress.parts).min(self.config.window as usize);
            let mut lost = false;
            for stream in &mut self.streams {
                lost |= stream.outbound.find_lost(order);
            }
            // Once per round trip, as in RFC 9002: one burst of losses is one sign.
            if lost && order >= self.reduced_until {
                self.reduced_until = self.order;
                self.congestion = (self.congestion / 2).max(Self::CONGESTION_MIN);
            }
            let flying = self.streams.iter().any(|stream| stream.outbound.flying() > 0);
            self.retransmit_at = flying.then(|| self.now + self.trip.timeout());
        }
        self.make_room(stream);
        self.heard();
    }

    pub(super) fn make_room(&mut self, stream: Stream) {
        let SessionConfig { buffer_bytes, buffer_messages, .. } = self.config;
        let state = &mut self.streams[stream as usize];
        let outbound = &state.outbound;
        // Half empty, so that whoever waits can send more than one message.
        let half =
            outbound.bytes() <= buffer_bytes / 2 && outbound.messages() <= buffer_messages / 2;
        if state.is_full && half {
            state.is_full = false;
            self.outputs.push_back(SessionOutput::Room { stream });
        }
    }

    pub(super) fn handle_silence(&mut self) {
        self.trip.back_off();
        self.congestion = Self::CONGESTION_MIN;
        self.reduced_until = self.order;
        for stream in &mut self.streams {
            stream.outbound.lose_all();
        }
        self.retransmit_at = Some(self.now + self.trip.timeout());
    }
}
