//! How a session begins and ends.

use super::round_trip::RttEstimator;
use super::{RemoteEnd, Session, SessionOutput, State, Unsettled, VERSION, tag};
use crate::net::wire::WireError;
use crate::net::wire::packet::PacketPriority;
use crate::net::wire::segment::{OpenSegment, Segment, SessionReceipt};
use crate::{DeliveryError, Incarnation, TrafficClass};

impl Session {
    pub(super) fn open(&mut self, peer: Option<RemoteEnd>) {
        self.identity.number = self.identity.number.saturating_add(1);
        self.identity.tag = tag::tag(&self.config, self.identity.number);
        let pause = RttEstimator::SHORTEST * if self.is_narrow() { 10 } else { 1 };
        self.state = State::Opening { peer, again_at: self.now, pause };
        self.transmit_open();
    }

    pub(super) fn transmit_open(&mut self) {
        let State::Opening { peer, pause, .. } = self.state else { return };
        // Grows by half each time, up to the longest retransmission.
        let next = (pause * 3 / 2).min(RttEstimator::LONGEST);
        self.state = State::Opening { peer, again_at: self.now + pause, pause: next };
        self.tell_open(peer.map_or(0, |peer| peer.tag));
    }

    pub(super) fn tell_open(&mut self, echo: u32) {
        let (tag, number) = (self.identity.tag, self.identity.number);
        let incarnation = self.config.incarnation;
        let before = self.identity.before;
        let open = OpenSegment { version: VERSION, tag, echo, incarnation, number, before };
        self.transmit(PacketPriority::Control, Segment::Open(open));
    }

    pub(super) fn handle_open(&mut self, open: OpenSegment) {
        if open.version != VERSION {
            let theirs = open.version;
            if self.refusals.version == 0 {
                self.outputs.push_back(SessionOutput::Incompatible { theirs });
            }
            self.refusals.count(&WireError::Version { theirs, ours: VERSION });
            return;
        }
        // The router speaks for incarnations, whatever their numbers: one that it does not know is
        // over, or forged, or will be told in a moment.
        if let Some(known) = self.identity.known.filter(|known| *known != open.incarnation) {
            match open.incarnation < known {
                true => self.refusals.stale += 1,
                false => self.refusals.unexpected += 1,
            }
            return;
        }
        let key = (open.incarnation, open.number);
        if key < self.identity.newest {
            self.refusals.stale += 1;
            return;
        }
        let theirs =
            RemoteEnd { incarnation: open.incarnation, number: open.number, tag: open.tag };
        let older = |unsettled: &Unsettled| unsettled.peer.number < open.number;
        if self.identity.unsettled.as_ref().is_some_and(older) {
            // The peer has ended that session, and receives no more of it.
            self.settle(open.incarnation, open.before);
        }
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } => {
                if open.incarnation > peer.incarnation {
                    self.end_with_old_peer(open.incarnation);
                } else if open.number > peer.number {
                    // Perhaps it is forged: the other end of the present session
                    // knows its tag, or says that it does not any more.
                    self.refusals.unexpected += 1;
                    self.acknowledge();
                    return;
                }
            }
            // A new tag: the old peer may have been told the present one.
            State::Opening { peer: Some(peer), .. } if (peer.incarnation, peer.number) < key => {
                self.open(None);
            }
            _ => {}
        }
        match self.state {
            State::Idle if self.path.mtu.is_some() => self.open(Some(theirs)),
            State::Idle | State::Closed => {}
            State::Opening { again_at, pause, .. } => {
                if open.echo == self.identity.tag {
                    self.begin(theirs);
                    self.acknowledge();
                } else {
                    self.state = State::Opening { peer: Some(theirs), again_at, pause };
                    self.transmit_open();
                }
            }
            // The sender knows our tag, so the one that was noted for it had a changed bit.
            State::Open { peer } if peer != theirs && open.echo == self.identity.tag => {
                self.state = State::Open { peer: theirs };
                self.record_receipt();
                self.acknowledge();
            }
            State::Open { peer } | State::Closing { peer, .. } if peer != theirs => {
                // One session of the peer's has one tag.
                self.refusals.unexpected += 1;
            }
            State::Open { .. } | State::Closing { .. } => {
                if open.echo == self.identity.tag {
                    self.record_receipt();
                    self.acknowledge();
                } else {
                    self.tell_open(theirs.tag);
                }
            }
        }
    }

    /// Takes out what is in flight to a peer that is silent.
    pub(super) fn take_unsettled(&mut self, peer: RemoteEnd) -> Unsettled {
        let sent = TrafficClass::ALL.into_iter().flat_map(|stream| {
            let sent = self.streams[stream as usize].outbound.take_sent();
            sent.map(move |(last, message)| (stream, last, message))
        });
        Unsettled { tag: self.identity.tag, peer, messages: sent.collect() }
    }

    /// Returns what was in flight in the last session and has not arrived, as far as the peer's
    /// `receipt` tells. The peer is in this incarnation now.
    pub(super) fn settle(&mut self, incarnation: Incarnation, receipt: Option<SessionReceipt>) {
        let Some(Unsettled { tag, peer, messages }) = self.identity.unsettled.take() else {
            return;
        };
        let receipt = receipt.filter(|receipt| receipt.tag == tag);
        let why = match incarnation == peer.incarnation {
            true => self.unreachable(),
            false => DeliveryError::PeerDied { incarnation: peer.incarnation },
        };
        for (stream, last, message) in messages {
            if receipt.is_none_or(|receipt| last >= receipt.next[stream as usize]) {
                let (why, sent) = (why.clone(), receipt.is_none());
                self.outputs.push_back(SessionOutput::Returned { stream, message, why, sent });
            }
        }
    }

    /// The peer has a newer session, or a newer incarnation: what we had with the old one is over.
    pub(super) fn end_with_old_peer(&mut self, incarnation: Incarnation) {
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } => {
                let why = if peer.incarnation != incarnation {
                    DeliveryError::PeerDied { incarnation: peer.incarnation }
                } else {
                    self.unreachable()
                };
                self.end(why);
            }
            // A new tag: the old peer may have been told the present one.
            State::Opening { peer: Some(_), .. } => self.open(None),
            _ => {}
        }
    }

    pub(super) fn begin(&mut self, peer: RemoteEnd) {
        self.settle(peer.incarnation, None);
        self.state = State::Open { peer };
        self.identity.newest = self.identity.newest.max((peer.incarnation, peer.number));
        self.record_receipt();
        let (incarnation, number) = (peer.incarnation, self.identity.number);
        self.outputs.push_back(SessionOutput::Opened { incarnation, number });
    }

    pub(super) fn handle_reset(&mut self, tag: u32) {
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } if peer.tag == tag => {
                self.end(self.unreachable());
            }
            _ => self.refusals.stale += 1,
        }
    }

    pub(super) fn close_when_done(&mut self) {
        if let State::Closing { peer, again_at: None, tries: 0 } = self.state
            && self.streams.iter().all(|stream| stream.outbound.is_empty())
        {
            let again_at = Some(self.now + self.retransmit_timeout(TrafficClass::Control));
            self.state = State::Closing { peer, again_at, tries: 1 };
            self.transmit(PacketPriority::Control, Segment::Close { tag: peer.tag });
        }
    }

    pub(super) fn repeat_close(&mut self) {
        let State::Closing { peer, tries, .. } = self.state else { return };
        if tries > Self::CLOSE_TRIES {
            return self.end(DeliveryError::Stopped);
        }
        self.streams[TrafficClass::Control as usize].rtt.back_off();
        let again_at = Some(self.now + self.retransmit_timeout(TrafficClass::Control));
        self.state = State::Closing { peer, again_at, tries: tries + 1 };
        self.transmit(PacketPriority::Control, Segment::Close { tag: peer.tag });
    }

    pub(super) fn handle_peers_close(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        self.transmit(PacketPriority::Control, Segment::Closed { tag: peer.tag });
        // The peer's next session, if there is one, has a greater number.
        self.identity.newest =
            self.identity.newest.max((peer.incarnation, peer.number.saturating_add(1)));
        self.end(DeliveryError::Stopped);
        if let State::Opening { .. } = self.state {
            // It will not answer until it lives again: the router, or its own open, will tell.
            self.state = State::Idle;
        }
    }

    pub(super) fn handle_closed(&mut self) {
        if let State::Closing { tries: 1.., .. } = self.state {
            self.end(DeliveryError::Stopped);
        }
    }
}
