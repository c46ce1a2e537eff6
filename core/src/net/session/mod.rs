//! End to end between two nodes: every message exactly once and in order, whatever path it takes.
//!
//! ```text
//!      one node                                       the other
//!         │ open: tag 7, nothing received ──────────────► │
//!         │ ◄────────────── open: tag 9, I know your 7    │
//!   open  │ data, for tag 9 ─────────────────────────────►│ open
//!         │ ◄────────────── acknowledge, for tag 7        │
//! ```
//!
//! * Both may open at once; the handshake is the same from both ends.
//! * A peer's session is identified by the peer's incarnation and a number that rises within it. A
//!   greater number ends the old session; a smaller one is refused. The router reports which
//!   incarnation is the present one. Tags tell the segments of different sessions apart.
//! * Each traffic class has an ordered stream, in which each message is delivered exactly once and
//!   in order. Control goes first; requests, events and bulk share the path by their weights. A
//!   message that fits into one chunk may be sent between the chunks of a larger one with another
//!   ordering key. When a session ends, every message that was not acknowledged is returned with
//!   the reason: it was delivered at most once.
//! * Messages that were in flight when the peer fell silent are returned later. The next handshake
//!   tells what the peer had received, and those that had arrived are not returned. Without a
//!   handshake within four times the idle timeout, they are returned as perhaps delivered.
//! * A handshake of the peer is compared with the incarnation that the router knows. A newer
//!   session of the same incarnation is accepted if the peer has forgotten the present one.
//! * When the router reports another path, everything that is not acknowledged is retransmitted at
//!   once.
//!
//! A session does not wait for the application. Messages that are complete and in order are output
//! at once; the caller decides what to do when the receiver is busy.

mod best_effort;
mod chunker;
mod config;
mod congestion;
mod flight;
mod handshake;
mod inbound;
mod outbound;
mod output;
mod queue;
mod reassembly;
mod round_trip;
mod status;
mod tag;
mod timers;
mod transmission;
mod turns;

pub mod ordering_key;

pub use self::config::{IDLE_TIMEOUT, PAYLOAD_MAX, SessionConfig};
pub use self::output::{Refused, SessionCounters, SessionOutput};
pub use self::status::{SessionState, SessionStatus};

use self::best_effort::{BestEffortInbound, BestEffortOutbound, DatagramStatus};
use self::config::{ACK_DELAY, WINDOW};
use self::congestion::CongestionControl;
use self::inbound::{ChunkStatus, Inbound, Part};
use self::outbound::Outbound;
use self::queue::OutboundMessage;
use self::reassembly::Reassembly;
use self::round_trip::RttEstimator;
use self::turns::WeightedTurns;
use super::wire::Refusals;
use super::wire::packet::{PacketPriority, UndeliveredReason};
use super::wire::segment::{Data, Datagram, Segment, SessionReceipt};
use crate::timer::Timers;
use crate::{Credit, DeliveryError, GatherBuffer, Incarnation, Instant, Machine, TrafficClass};
use bytes::Bytes;
use ordering_key::OrderingKey;
use std::collections::VecDeque;
use std::time::Duration;

/// The version of what sessions say to each other. From 2 on whole messages come between the parts
/// of a large one; from 3 on acknowledgements tell when the last part arrived; from 4 on each class
/// has a stream of its own; from 6 on an open tells what arrived in the session before; from 7 on
/// faults come as requests, and a reply that cannot be written is an error of its own; from 8 on
/// one acknowledgement speaks of all streams; from 9 on a session tells what a node says of itself,
/// and the codec writes what is no daily traffic.
pub const VERSION: u8 = 9;

/// The machine of one peer node's sessions, one after the other.
#[derive(Debug)]
pub struct Session {
    config: SessionConfig,
    state: State,
    identity: SessionIdentity,
    path: SessionPath,
    /// By class, as all arrays here.
    streams: [StreamState; TrafficClass::COUNT],
    turns: WeightedTurns,
    /// What has arrived of the streams, and is not whole.
    pieces: Reassembly<(TrafficClass, u64)>,
    datagrams: DatagramState,
    now: Instant,
    counters: SessionCounters,
    refusals: Refusals,
    outputs: VecDeque<SessionOutput>,
}

/// Which sessions there are, and were: what the handshake is about.
#[derive(Debug)]
struct SessionIdentity {
    /// Our end of the present session.
    number: u32,
    tag: u32,
    /// The newest known session of the peer.
    newest: (Incarnation, u32),
    /// The peer's incarnation that the router knows.
    known: Option<Incarnation>,
    /// What had been received in the last session that ended.
    before: Option<SessionReceipt>,
    /// What was in flight in it.
    unsettled: Option<Unsettled>,
}

/// The path to the peer.
#[derive(Debug)]
struct SessionPath {
    /// The largest segment that it carries; `None` while there is no path.
    mtu: Option<usize>,
    /// Of what travels by one path.
    congestion: CongestionControl,
    /// Since when the peer owes an answer, or has no path.
    waiting_since: Option<Instant>,
    /// Why a router last returned a segment, since the peer's last one.
    returned: Option<UndeliveredReason>,
}

/// The messages of which the newest counts.
#[derive(Debug)]
struct DatagramState {
    outbound: BestEffortOutbound,
    inbound: BestEffortInbound,
    /// Of events and datagrams, which share their turns, datagrams go next.
    has_turn: bool,
    /// When datagrams are taken for lost of which the peer has told nothing.
    lost_at: Option<Instant>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// There is no session, and no path to open one.
    Idle,
    /// The handshake is repeated until the peer confirms it.
    Opening { peer: Option<RemoteEnd>, again_at: Instant, pause: Duration },
    /// Both know each other.
    Open { peer: RemoteEnd },
    /// Everything is to be acknowledged; then a close is sent.
    Closing { peer: RemoteEnd, again_at: Option<Instant>, tries: u32 },
    /// Closed in order; no further session is opened.
    Closed,
}

/// The other end of the present session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct RemoteEnd {
    incarnation: Incarnation,
    number: u32,
    tag: u32,
}

/// Messages that were in flight when a session ended, for the peer was silent.
#[derive(Debug)]
struct Unsettled {
    /// Our tag in that session.
    tag: u32,
    peer: RemoteEnd,
    /// Each with its stream and the part that it ends in.
    messages: Vec<(TrafficClass, u64, Bytes)>,
}

#[derive(Debug)]
struct StreamState {
    outbound: Outbound,
    inbound: Inbound,
    /// Of each stream by itself, for control overtakes the others on its way.
    rtt: RttEstimator,
    retransmit_at: Option<Instant>,
}

impl Session {
    /// Parts of control that go before one of the others that waits: control goes first, and takes
    /// no more than eight parts of nine.
    const CONTROL_RUN: usize = 8;
    /// So many idle timeouts long a silent peer may still tell what it had received.
    const SETTLE_TIMES: u32 = 4;
    /// How often an unanswered close is sent.
    const CLOSE_TRIES: u32 = 5;

    /// A machine without a session; it opens one when there is a path.
    pub fn new(config: SessionConfig, now: Instant) -> Self {
        let streams = [(); TrafficClass::COUNT].map(|()| StreamState::new(&config));
        let identity = SessionIdentity {
            number: config.number,
            tag: 0,
            newest: (Incarnation(0), 0),
            known: None,
            before: None,
            unsettled: None,
        };
        let congestion = CongestionControl::new();
        Session {
            state: State::Idle,
            identity,
            path: SessionPath { mtu: None, congestion, waiting_since: None, returned: None },
            streams,
            turns: WeightedTurns::default(),
            pieces: reassembly(&config),
            datagrams: DatagramState::new(&config),
            now,
            counters: SessionCounters::default(),
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
            config,
        }
    }

    /// The number of the last session; a rebuilt machine must begin above it.
    pub fn number(&self) -> u32 {
        self.identity.number
    }

    /// Sends a message, exactly once and in the order of its key. Its credit is given back when
    /// the peer has acknowledged it, or when it comes back.
    ///
    /// # Errors
    /// [`DeliveryError::WayFull`] for a message without credit where the stream holds as much as it
    /// may; one of control ends the session. [`DeliveryError::TooLargeForSession`],
    /// [`DeliveryError::Unreachable`], [`DeliveryError::Stopped`] after
    /// [`handle_close`](Session::handle_close). The message comes back.
    pub fn handle_send_along(
        &mut self,
        stream: TrafficClass,
        key: OrderingKey,
        message: impl Into<GatherBuffer>,
        credit: Option<Credit>,
        now: Instant,
    ) -> Result<(), Refused> {
        self.now = now;
        let bytes = self.check(message.into())?;
        let outbound = &mut self.streams[stream as usize].outbound;
        let is_full = outbound.messages() >= self.config.buffer_messages
            || outbound.bytes() + bytes.len() > self.config.buffer_bytes;
        if is_full && credit.is_none() {
            if stream == TrafficClass::Control {
                // Without it the ends do not agree any more.
                self.handle_restart(now);
            }
            return Err((self.way_full(stream), bytes.into_bytes()));
        }
        outbound.push(key, OutboundMessage { bytes, credit });
        self.path.waiting_since.get_or_insert(now);
        Ok(())
    }

    /// Sends a message once, if at all: of one channel, the newest that arrives counts, and one
    /// that still waits for the path gives way to the next.
    ///
    /// # Errors
    /// [`DeliveryError::Restarting`] while there is no session yet,
    /// [`DeliveryError::TooLargeForSession`] also for what the path's segments would carry in more
    /// than [`PIECES_MAX`](crate::net::wire::segment::PIECES_MAX) pieces, otherwise as
    /// [`handle_send_along`](Session::handle_send_along). The message comes back.
    pub fn handle_send_newest(
        &mut self,
        channel: u32,
        message: impl Into<GatherBuffer>,
        now: Instant,
    ) -> Result<(), Refused> {
        self.now = now;
        let message = self.check(message.into())?;
        let (State::Open { peer }, Some(capacity)) = (self.state, self.path.mtu) else {
            return Err((DeliveryError::Restarting, message.into_bytes()));
        };
        let limit = BestEffortOutbound::most(capacity, !self.is_narrow());
        if message.len() > limit {
            return Err((DeliveryError::TooLargeForSession { limit }, message.into_bytes()));
        }
        if self.datagrams.outbound.bytes() + message.len() > self.config.buffer_bytes {
            return Err((self.way_full(TrafficClass::Event), message.into_bytes()));
        }
        self.datagrams.outbound.push(channel, message);
        // While the path bears it, nothing waits for something newer.
        while self.may_send_data() && self.transmit_datagram(peer.tag) {}
        Ok(())
    }

    fn way_full(&self, class: TrafficClass) -> DeliveryError {
        DeliveryError::WayFull { node: self.config.peer.to_string(), class }
    }

    fn check(&self, message: GatherBuffer) -> Result<GatherBuffer, Refused> {
        let refuse = |why| Err((why, message.clone().into_bytes()));
        match self.state {
            State::Closing { .. } | State::Closed => refuse(DeliveryError::Stopped),
            State::Idle => refuse(self.unreachable()),
            _ if message.len() > self.config.message_max => {
                refuse(DeliveryError::TooLargeForSession { limit: self.config.message_max })
            }
            _ => Ok(message),
        }
    }

    /// The router has found a path, or another one: opens a session, or repeats at once what is not
    /// acknowledged. `mtu` is the largest segment that the path carries.
    pub fn handle_path(&mut self, mtu: usize, now: Instant) {
        self.now = now;
        self.path.mtu = Some(mtu);
        let narrow = self.is_narrow();
        self.streams.iter_mut().for_each(|stream| stream.rtt.enter_path(narrow));
        self.path.congestion.enter_path(mtu, narrow);
        self.datagrams.outbound.handle_path();
        self.datagrams.lost_at = None;
        match self.state {
            State::Idle => self.open(None),
            State::Opening { peer, pause, .. } => {
                self.state = State::Opening { peer, again_at: now, pause };
            }
            State::Open { .. } | State::Closing { .. } => {
                let waits = self.streams.iter().any(|stream| !stream.outbound.is_empty());
                self.path.waiting_since = waits.then_some(now);
                for stream in TrafficClass::ALL {
                    if self.streams[stream as usize].outbound.lose_all() {
                        let due = now + self.retransmit_timeout(stream);
                        self.streams[stream as usize].retransmit_at = Some(due);
                    }
                }
            }
            State::Closed => {}
        }
    }

    /// The router knows no path any more. The session waits for one for `idle_timeout`.
    pub fn handle_no_path(&mut self, now: Instant) {
        self.now = now;
        self.path.mtu = None;
        self.datagrams.outbound.handle_no_path();
        self.datagrams.lost_at = None;
        self.streams.iter_mut().for_each(|stream| stream.retransmit_at = None);
        self.path.waiting_since.get_or_insert(now);
    }

    /// The router reports the peer's present incarnation. Sessions with any other are over,
    /// whichever number is greater.
    pub fn handle_incarnation(&mut self, incarnation: Incarnation, now: Instant) {
        self.now = now;
        self.identity.known = Some(incarnation);
        if self.identity.newest.0 != incarnation {
            self.identity.newest = (incarnation, 0);
            self.settle(incarnation, None);
            self.end_with_old_peer(incarnation);
        }
    }

    /// Ends the session in order: what was sent is delivered first.
    pub fn handle_close(&mut self, now: Instant) {
        self.now = now;
        match self.state {
            State::Open { peer } => {
                self.state = State::Closing { peer, again_at: None, tries: 0 };
                self.close_when_done();
            }
            State::Idle | State::Opening { .. } => {
                self.return_unacknowledged(&DeliveryError::Stopped);
                self.state = State::Closed;
            }
            State::Closing { .. } | State::Closed => {}
        }
    }

    /// This end has lost its memory of the session: both ends begin a new one.
    pub fn handle_restart(&mut self, now: Instant) {
        self.now = now;
        if matches!(self.state, State::Open { .. }) {
            // The peer's own tag is what it knows this session by.
            self.transmit(PacketPriority::Control, Segment::Reset { tag: self.identity.tag });
            self.end(self.unreachable());
        }
    }

    /// Takes out what was not acknowledged, and whether some of it was sent, when this machine is
    /// about to be replaced. What it has returned and nothing has polled comes first.
    pub fn take_unacknowledged(&mut self) -> Vec<(TrafficClass, Bytes, bool)> {
        let returned = std::mem::take(&mut self.outputs).into_iter().filter_map(|output| {
            let SessionOutput::Returned { stream, message, sent, .. } = output else { return None };
            Some((stream, message, sent))
        });
        let unsettled =
            self.identity.unsettled.take().into_iter().flat_map(|unsettled| unsettled.messages);
        let unsettled = unsettled.map(|(stream, _, message)| (stream, message, true));
        let held = TrafficClass::ALL.into_iter().flat_map(|stream| {
            let messages = self.streams[stream as usize].outbound.take_all();
            messages.map(move |(message, sent)| (stream, message, sent))
        });
        returned.chain(unsettled).chain(held).collect()
    }

    /// A segment from the peer's node arrived.
    pub fn handle_segment(&mut self, segment: Bytes, now: Instant) {
        self.now = now;
        self.path.returned = None;
        match Segment::decode(segment) {
            Ok(Segment::Open(open)) => self.handle_open(open),
            Ok(Segment::Reset { tag }) => self.handle_reset(tag),
            Ok(Segment::Data(data)) if self.meant_for_us(data.tag) => self.handle_data(data),
            Ok(Segment::Datagram(datagram)) if self.meant_for_us(datagram.tag) => {
                self.handle_datagram(datagram);
            }
            Ok(Segment::Acknowledge { tag, streams, datagrams }) if self.meant_for_us(tag) => {
                if let Some(ack) = datagrams {
                    self.handle_datagram_ack(ack);
                }
                for (stream, ack) in TrafficClass::ALL.into_iter().zip(streams) {
                    if let Some(ack) = ack {
                        self.handle_ack(stream, &ack);
                    }
                }
                self.close_when_done();
            }
            Ok(Segment::Close { tag }) if self.meant_for_us(tag) => self.handle_peers_close(),
            Ok(Segment::Closed { tag }) if self.meant_for_us(tag) => self.handle_closed(),
            Ok(Segment::Close { tag } | Segment::Closed { tag }) => {
                // Repeated after we had forgotten the session: no answer but this one ends it.
                self.refusals.stale += 1;
                self.transmit(PacketPriority::Control, Segment::Reset { tag });
            }
            Ok(
                Segment::Data(Data { tag, .. })
                | Segment::Datagram(Datagram { tag, .. })
                | Segment::Acknowledge { tag, .. },
            ) => {
                self.refusals.stale += 1;
                self.transmit(PacketPriority::Control, Segment::Reset { tag });
            }
            Err(error) => self.refusals.count(&error),
        }
    }

    /// Is it for the present session? Then the peer knows our tag, and the session is open.
    fn meant_for_us(&mut self, tag: u32) -> bool {
        if tag != self.identity.tag {
            return false;
        }
        match self.state {
            State::Opening { peer: Some(peer), .. } => {
                self.begin(peer);
                true
            }
            State::Open { .. } | State::Closing { .. } => {
                self.record_receipt();
                true
            }
            _ => false,
        }
    }

    fn record_receipt(&mut self) {
        let waits = self.streams.iter().any(|stream| !stream.outbound.is_empty());
        self.path.waiting_since = (waits || self.path.mtu.is_none()).then_some(self.now);
    }

    /// Ends the present session; opens the next one if there is a path.
    fn end(&mut self, why: DeliveryError) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let closing = matches!(self.state, State::Closing { .. });
        let next = std::array::from_fn(|stream| self.streams[stream].inbound.next());
        self.identity.before = Some(SessionReceipt { tag: peer.tag, next });
        let may_tell = !closing && matches!(why, DeliveryError::Unreachable { .. });
        let unsettled = may_tell.then(|| self.take_unsettled(peer));
        self.return_unacknowledged(&why);
        if let Some(unsettled) = unsettled.filter(|unsettled| !unsettled.messages.is_empty()) {
            self.identity.unsettled = Some(unsettled);
            self.path.waiting_since = Some(self.now);
        }
        let incarnation = peer.incarnation;
        self.outputs.push_back(SessionOutput::Ended { incarnation, why });
        if closing {
            self.state = State::Closed;
        } else if self.path.mtu.is_some() {
            self.open(None);
        } else {
            self.state = State::Idle;
        }
    }

    /// Returns every unacknowledged message and begins from nothing.
    fn return_unacknowledged(&mut self, why: &DeliveryError) {
        self.settle(self.identity.newest.0, None);
        for stream in TrafficClass::ALL {
            let state = &mut self.streams[stream as usize];
            for (message, sent) in state.outbound.take_all() {
                let why = why.clone();
                self.outputs.push_back(SessionOutput::Returned { stream, message, why, sent });
            }
            state.rtt.progress();
            *state = StreamState { rtt: state.rtt, ..StreamState::new(&self.config) };
        }
        self.counters = self.counters();
        self.pieces = reassembly(&self.config);
        self.datagrams = DatagramState::new(&self.config);
        self.path.congestion.restart(self.now);
        self.path.waiting_since = None;
    }

    fn transmit(&mut self, class: PacketPriority, segment: Segment) {
        let segment = segment.parcel();
        self.outputs.push_back(SessionOutput::Transmit { class, segment, everywhere: false });
    }

    /// Transmits what belongs to one stream; a copy of what is redundant goes over every path.
    fn transmit_for(&mut self, stream: TrafficClass, class: PacketPriority, segment: Segment) {
        let (segment, everywhere) = (segment.parcel(), stream == TrafficClass::Redundant);
        self.outputs.push_back(SessionOutput::Transmit { class, segment, everywhere });
    }

    /// The peer has owed an answer, or had no path, for too long.
    fn give_up(&mut self) {
        self.path.waiting_since = None;
        match self.state {
            State::Open { .. } | State::Closing { .. } => self.end(self.unreachable()),
            State::Opening { .. } | State::Idle => {
                self.return_unacknowledged(&self.unreachable());
                if self.path.mtu.is_none() {
                    self.state = State::Idle;
                }
            }
            State::Closed => {}
        }
    }

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
            let (now, delay) = (self.now, self.ack_delay());
            let part = Part { first, last, payload };
            let inbound = &mut self.streams[stream as usize].inbound;
            let arrived = inbound.handle(sequence, part, now, delay, &mut messages);
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

    /// The peer's incarnation that the present session is with.
    pub fn peer(&self) -> Option<Incarnation> {
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } => Some(peer.incarnation),
            _ => None,
        }
    }

    /// We ended in order; nothing is left to do.
    pub fn is_closed(&self) -> bool {
        self.state == State::Closed
    }

    /// The smoothed round trip to the peer.
    pub fn round_trip(&self) -> Option<Duration> {
        self.streams.iter().find_map(|stream| stream.rtt.smoothed())
    }

    /// What it did so far.
    pub fn counters(&self) -> SessionCounters {
        let unfinished = self.pieces.given_up + self.datagrams.inbound.unfinished();
        SessionCounters {
            incomplete: self.counters.incomplete + unfinished,
            replaced: self.counters.replaced + self.datagrams.outbound.replaced,
            ..self.counters
        }
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// How it stands now.
    pub fn status(&self) -> SessionStatus {
        let state = match self.state {
            State::Idle => SessionState::Away,
            State::Opening { .. } if self.path.mtu.is_none() => SessionState::Away,
            State::Opening { .. } => SessionState::Opening,
            State::Open { .. } => SessionState::Open,
            State::Closing { .. } => SessionState::Closing,
            State::Closed => SessionState::Closed,
        };
        let held = self.streams.iter().map(|stream| stream.outbound.messages());
        let parts = self.streams.iter().map(|stream| stream.outbound.flying());
        SessionStatus {
            state,
            incarnation: self.peer(),
            round_trip: self.round_trip(),
            unacknowledged: held.sum(),
            in_flight: parts.sum::<usize>() + self.datagrams.outbound.flying().0,
            window: self.path.congestion.window(),
            queueing: self.path.congestion.queueing(),
            counters: self.counters(),
            refusals: self.refusals(),
        }
    }
}

impl StreamState {
    fn new(config: &SessionConfig) -> Self {
        StreamState {
            outbound: Outbound::new(WINDOW),
            inbound: Inbound::new(WINDOW, config.message_max),
            rtt: RttEstimator::new(),
            retransmit_at: None,
        }
    }
}

/// Keeps pieces of two of the largest messages, for five seconds.
fn reassembly<K: Ord + Copy>(config: &SessionConfig) -> Reassembly<K> {
    Reassembly::new(config.message_max.saturating_mul(2), Duration::from_secs(5))
}

impl DatagramState {
    fn new(config: &SessionConfig) -> Self {
        let inbound = BestEffortInbound::new(config.channels_max, reassembly(config));
        let outbound = BestEffortOutbound::default();
        DatagramState { outbound, inbound, has_turn: false, lost_at: None }
    }
}

impl Machine for Session {
    type Output = SessionOutput;

    fn poll_output(&mut self) -> Option<SessionOutput> {
        loop {
            if let Some(output) = self.outputs.pop_front() {
                return Some(output);
            }
            if self.transmit_part() {
                continue;
            }
            if self.ack_owed().is_some_and(|due| due <= self.now) {
                self.acknowledge_owed();
                continue;
            }
            return None;
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.next_due()
    }

    fn handle_timeout(&mut self, now: Instant) {
        /// A timer that fires so late means that this node was not run. Segments of the peer may
        /// still be unread, so the delay is not counted as its silence.
        const STALL: Duration = Duration::from_millis(100);
        let late = self.poll_timeout().map_or(Duration::ZERO, |due| now - due);
        if late > STALL {
            self.path.waiting_since = self.path.waiting_since.map(|since| since + late);
        }
        self.now = now;
        self.fire_due(now);
    }
}

#[cfg(test)]
mod tests;
