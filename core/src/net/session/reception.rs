//! What a session does with what arrives.

use super::best_effort::DatagramStatus;
use super::config::ACK_DELAY;
use super::inbound::ChunkStatus;
use super::{Session, SessionOutput, State};
use crate::net::wire::packet::PacketPriority;
use crate::net::wire::segment::{Data, Datagram, Segment};
use crate::{DeliveryError, TrafficClass};
use std::time::Duration;

impl Session {
    pub(super) fn handle_data(&mut self, data: Data) {
        let Data { stream, sequence, first, last, again, piece, ack, payload, .. } = data;
        self.counters.bytes_received += payload.len() as u64;
        if let Some(ack) = ack {
            self.handle_ack(stream, &ack);
        }
        let copied = stream == TrafficClass::Redundant && !again && piece.is_none();
        if copied && self.streams[stream as usize].inbound.has(sequence) {
            self.counters.replicas += 1;
            return self.close_when_done();
        }
        let payload = payload.into_bytes();
        let whole = match piece {
            Some(piece) if self.streams[stream as usize].inbound.expects(sequence) => {
                self.pieces.handle((stream, sequence), piece, payload, self.now)
            }
            _ => Some(payload),
        };
        if let Some(payload) = whole {
            let mut messages = Vec::new();
            let times = (self.now, self.ack_delay());
            let inbound = &mut self.streams[stream as usize].inbound;
            let arrived = inbound.handle(sequence, (first, last, payload), times, &mut messages);
            let outputs = messages.into_iter();
            self.outputs.extend(outputs.map(|message| SessionOutput::Message { stream, message }));
            match arrived {
                Ok(ChunkStatus::New) => {}
                Ok(ChunkStatus::Again) => self.counters.duplicates += 1,
                Ok(ChunkStatus::Beyond) => self.refusals.unexpected += 1,
                Err(error) => {
                    // The peer is broken; whatever it says next cannot be trusted to be in order.
                    self.refusals.count(&error);
                    let State::Open { peer } = self.state else { return };
                    let reset = Segment::Reset { tag: self.identity.tag };
                    self.transmit(PacketPriority::Control, reset);
                    self.identity.newest =
                        self.identity.newest.max((peer.incarnation, peer.number.saturating_add(1)));
                    // Ours were good: they come back because of what it sent.
                    let reason = format!(
                        "it breaks the protocol of sessions ({error}): update one of the two"
                    );
                    let node = self.config.peer.to_string();
                    self.end(DeliveryError::Undelivered { node, reason });
                    return;
                }
            }
        }
        self.close_when_done();
    }

    /// On a narrow path an acknowledgement waits longer for something to travel with, for alone it
    /// takes a third of what a part does.
    fn ack_delay(&self) -> Duration {
        const NARROW_MAX: Duration = Duration::from_millis(50);
        let trip = self.round_trip().filter(|_| self.is_narrow());
        let quarter = trip.map_or(Duration::ZERO, |trip| trip / 4);
        ACK_DELAY.max(quarter.min(NARROW_MAX))
    }

    pub(super) fn handle_datagram(&mut self, datagram: Datagram) {
        let channel = datagram.channel;
        self.counters.bytes_received += datagram.payload.len() as u64;
        match self.datagrams.inbound.handle(datagram, self.now, self.ack_delay()) {
            DatagramStatus::Newest(message) => {
                self.outputs.push_back(SessionOutput::Newest { channel, message });
            }
            DatagramStatus::InPart => {}
            DatagramStatus::Again => self.counters.duplicates += 1,
            DatagramStatus::Overtaken => self.counters.superseded += 1,
        }
    }
}
