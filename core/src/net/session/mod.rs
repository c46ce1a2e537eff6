//! End to end between two nodes: every message exactly once and in order, whatever path it takes.
//!
//! ```text
//!      one node                                       the other
//!         │ open: tag 7, nothing heard ─────────────────► │
//!         │ ◄────────────── open: tag 9, I know your 7    │
//!   open  │ data, for tag 9 ─────────────────────────────►│ open
//!         │ ◄────────────── acknowledge, for tag 7        │
//! ```
//!
//! * Both may open at once; the handshake is the same from both ends.
//! * A peer's session is known by its incarnation and a number that rises within it. A greater pair
//!   ends the old session; a smaller one is refused. Tags keep apart what belongs to which.
//! * Within a session each message of the ordered streams is delivered exactly once and in order.
//!   When a session ends, every message that was not acknowledged is handed back with the reason: it
//!   was delivered at most once, perhaps not at all.
//! * A change of path, told by the router, repeats at once what is not acknowledged.
//!
//! What it does not do: wait for the application. What has arrived in order is output at once; whoever
//! takes it must decide what to do when its receiver is busy.

mod assembly;
mod inbound;
mod outbound;
mod round_trip;

use self::assembly::Assembly;
use self::inbound::{Arrived, Inbound};
use self::outbound::{Outbound, Part};
use self::round_trip::RoundTrip;
use super::node_id::NodeId;
use super::packet::Class;
use super::segment::{Ack, DATA_HEADER, Data, Datagram, Open, PIECES_MAX, Piece, Segment, Stream};
use super::wire::{Refusals, WireError};
use crate::{Incarnation, Instant, Machine, NodeName, Why};
use bytes::Bytes;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// The version of what sessions say to each other.
pub const VERSION: u8 = 1;

/// How a session behaves.
#[derive(Clone, Debug)]
pub struct SessionConfig {
    /// Our own name.
    pub node: NodeName,
    /// Our own life.
    pub incarnation: Incarnation,
    /// The peer's name.
    pub peer: NodeName,
    /// Sessions of this machine are numbered above this. A machine that is built anew within one life
    /// of its node must be given a greater number than the one before ever used.
    pub number: u32,
    /// How long the peer may owe an answer, or be without a path, before the session ends. Longer
    /// rides out longer outages; shorter gives messages back sooner.
    pub patience: Duration,
    /// The most bytes of one message. Bounds what a peer can make us collect.
    pub message_max: usize,
    /// The bytes that should wait or be unacknowledged in one stream at most. Beyond, senders are
    /// told to stop; at twice as many, messages are refused.
    pub buffer_bytes: usize,
    /// The number of messages, likewise.
    pub buffer_messages: usize,
    /// How many parts of a stream may be on their way, and may arrive ahead of their turn.
    pub window: u32,
    /// The largest part in bytes, however large the path's frames are: a full window of parts should
    /// fit into the buffers of the sockets on the way.
    pub part_max: usize,
    /// How long an acknowledgement may wait for something to travel with.
    pub ack_delay: Duration,
    /// The shortest time after which silence is taken for loss.
    pub retransmit_min: Duration,
    /// The longest.
    pub retransmit_max: Duration,
    /// The most best-effort channels of the peer that are remembered.
    pub channels_max: usize,
}

impl SessionConfig {
    /// The usual behaviour between these two.
    pub fn new(node: NodeName, incarnation: Incarnation, peer: NodeName) -> Self {
        SessionConfig {
            node,
            incarnation,
            peer,
            number: 0,
            patience: Duration::from_secs(2),
            message_max: 1 << 20,
            // Four of the largest messages, or a second of 1 kB at 4 kHz.
            buffer_bytes: 4 << 20,
            buffer_messages: 4096,
            window: 256,
            part_max: 8 * 1024,
            ack_delay: Duration::from_millis(2),
            // Ten times the delay of acknowledgements.
            retransmit_min: Duration::from_millis(20),
            retransmit_max: Duration::from_millis(500),
            channels_max: 1024,
        }
    }
}

/// What a session wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum SessionOutput {
    /// Give this segment to the router for the peer.
    Transmit {
        /// How urgent it is.
        class: Class,
        /// The segment.
        segment: Bytes,
    },
    /// A session has begun.
    Opened {
        /// With this life of the peer.
        incarnation: Incarnation,
    },
    /// A message has arrived, once and in its order.
    Message {
        /// On which stream.
        stream: Stream,
        /// The message.
        message: Bytes,
    },
    /// A best-effort message has arrived, newer than all before it on its channel.
    Newest {
        /// On which channel.
        channel: u32,
        /// The message.
        message: Bytes,
    },
    /// A message was not acknowledged before its session ended.
    Returned {
        /// The stream that it was for.
        stream: Stream,
        /// The message.
        message: Bytes,
        /// Why.
        why: Why,
    },
    /// The session is over. What was unacknowledged has been returned before this.
    Ended {
        /// Which life of the peer it was with.
        incarnation: Incarnation,
        /// Why.
        why: Why,
    },
    /// A stream holds all that it should: stop sending, or messages will soon be refused.
    Full {
        /// Which.
        stream: Stream,
    },
    /// A stream that was full takes messages again.
    Room {
        /// Which.
        stream: Stream,
    },
    /// The peer speaks another version; the two cannot talk until one is updated.
    Incompatible {
        /// The peer's version.
        theirs: u8,
    },
}

/// A refused message, and why.
pub type Refused = (Why, Bytes);

/// What a session did so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SessionCounters {
    /// Parts sent, repetitions included.
    pub sent: u64,
    /// Parts sent again.
    pub repeated: u64,
    /// Parts and best-effort messages that had arrived before.
    pub doubled: u64,
    /// Best-effort messages that came after a newer one of their channel.
    pub overtaken: u64,
    /// Messages that were never finished.
    pub unfinished: u64,
}

/// The machine of one peer node's sessions, one after the other.
#[derive(Debug)]
pub struct Session {
    config: SessionConfig,
    state: State,
    /// What we are in the present session.
    number: u32,
    tag: u32,
    /// The newest session of the peer's that we know of.
    newest: (Incarnation, u32),
    /// The largest segment that the path carries; `None` while there is no path.
    path: Option<usize>,
    streams: [StreamState; 2],
    trip: RoundTrip,
    /// How many parts may be on their way at once.
    congestion: usize,
    /// Losses of transmissions before this have been answered by a smaller window.
    reduced_until: u64,
    order: u64,
    retransmit_at: Option<Instant>,
    /// Since when the peer owes us a sign of life.
    owed_since: Option<Instant>,
    pieces: Assembly<(Stream, u64)>,
    best_effort: BestEffort,
    now: Instant,
    counters: SessionCounters,
    refusals: Refusals,
    outputs: VecDeque<SessionOutput>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// There is no session, and no path to open one.
    Idle,
    /// We say who we are until the peer shows that it knows.
    Opening { peer: Option<Peer>, again_at: Instant, pause: Duration },
    /// Both know each other.
    Open { peer: Peer },
    /// Everything is to be acknowledged, then the peer is told that this is the end.
    Closing { peer: Peer, again_at: Option<Instant>, tries: u32 },
    /// We ended in order and open no more.
    Closed,
}

/// The other end of the present session.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Peer {
    incarnation: Incarnation,
    number: u32,
    tag: u32,
}

#[derive(Debug)]
struct StreamState {
    outbound: Outbound,
    inbound: Inbound,
    /// Its senders have been told to stop.
    is_full: bool,
}

#[derive(Debug)]
struct BestEffort {
    /// The last number used, by channel.
    sent: BTreeMap<u32, u64>,
    /// The newest that was delivered, by channel.
    delivered: BTreeMap<u32, u64>,
    pieces: Assembly<(u32, u64)>,
}

const STREAMS: [Stream; 2] = [Stream::Control, Stream::Data];

impl Session {
    /// Parts on their way at first; no more than any UDP socket's default buffer takes at once.
    const CONGESTION_INITIAL: usize = 32;
    /// Parts that may always be on their way: fewer would wait for a timer at every loss.
    const CONGESTION_MIN: usize = 8;
    /// How long an unfinished message is kept.
    const ASSEMBLY_PATIENCE: Duration = Duration::from_secs(5);
    /// How often an unanswered close is sent.
    const CLOSE_TRIES: u32 = 5;

    /// A machine without a session; it opens one when there is a path.
    pub fn new(config: SessionConfig, now: Instant) -> Self {
        let streams = [(); 2].map(|()| StreamState::new(&config));
        let trip = RoundTrip::new(config.retransmit_min, config.retransmit_max);
        // Pieces of two of the largest messages.
        let assembly = config.message_max.saturating_mul(2);
        Session {
            state: State::Idle,
            number: config.number,
            tag: 0,
            newest: (Incarnation(0), 0),
            path: None,
            streams,
            trip,
            congestion: Self::CONGESTION_INITIAL,
            reduced_until: 0,
            order: 0,
            retransmit_at: None,
            owed_since: None,
            pieces: Assembly::new(assembly, Self::ASSEMBLY_PATIENCE),
            best_effort: BestEffort {
                sent: BTreeMap::new(),
                delivered: BTreeMap::new(),
                pieces: Assembly::new(assembly, Self::ASSEMBLY_PATIENCE),
            },
            now,
            counters: SessionCounters::default(),
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
            config,
        }
    }

    /// The peer's life that the present session is with.
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
        self.trip.smoothed()
    }

    /// What it did so far.
    pub fn counters(&self) -> SessionCounters {
        let unfinished = self.pieces.given_up + self.best_effort.pieces.given_up;
        SessionCounters { unfinished, ..self.counters }
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// The number of the last session; a machine built anew must begin above it.
    pub fn number(&self) -> u32 {
        self.number
    }

    /// Sends a message, exactly once and in the order of its stream.
    ///
    /// # Errors
    /// [`Why::Full`]: [`SessionOutput::Full`] was not heeded; [`SessionOutput::Room`] tells when the
    /// stream takes more. [`Why::TooLarge`], [`Why::Unreachable`], [`Why::Stopped`] after
    /// [`handle_close`](Session::handle_close). The message comes back.
    pub fn handle_send(
        &mut self,
        stream: Stream,
        message: Bytes,
        now: Instant,
    ) -> Result<(), Refused> {
        self.now = now;
        self.check(&message)?;
        let SessionConfig { buffer_bytes, buffer_messages, .. } = self.config;
        let state = &mut self.streams[stream as usize];
        let outbound = &mut state.outbound;
        let (messages, bytes) = (outbound.messages() + 1, outbound.bytes() + message.len());
        let full = |times| messages > times * buffer_messages || bytes > times * buffer_bytes;
        if full(1) && !state.is_full {
            state.is_full = true;
            self.outputs.push_back(SessionOutput::Full { stream });
        }
        if full(2) {
            return Err((Why::Full, message));
        }
        outbound.push(message);
        self.owed_since.get_or_insert(now);
        Ok(())
    }

    /// Sends a message once, if at all: of one channel, the newest that arrives counts.
    ///
    /// # Errors
    /// [`Why::Restarting`] while there is no session yet, otherwise as
    /// [`handle_send`](Session::handle_send). The message comes back.
    pub fn handle_send_newest(
        &mut self,
        channel: u32,
        message: Bytes,
        now: Instant,
    ) -> Result<(), Refused> {
        self.now = now;
        self.check(&message)?;
        let (State::Open { peer }, Some(room)) = (self.state, self.path) else {
            return Err((Why::Restarting, message));
        };
        let sequence = self.best_effort.sent.entry(channel).or_insert(0);
        *sequence += 1;
        let sequence = *sequence;
        // The tag, the numbers, and the flags, at their longest.
        let room = room.saturating_sub(28).max(1);
        for (piece, payload) in pieces_of(&message, room) {
            let tag = peer.tag;
            let datagram = Datagram { tag, channel, sequence, piece, payload };
            self.transmit(Class::Data, Segment::Datagram(datagram));
        }
        Ok(())
    }

    fn check(&self, message: &Bytes) -> Result<(), Refused> {
        let refuse = |why| Err((why, message.clone()));
        match self.state {
            State::Closing { .. } | State::Closed => refuse(Why::Stopped),
            State::Idle => refuse(self.unreachable()),
            _ if message.len() > self.config.message_max => {
                refuse(Why::TooLarge { limit: self.config.message_max })
            }
            _ => Ok(()),
        }
    }

    fn unreachable(&self) -> Why {
        Why::Unreachable { node: self.config.peer.to_string() }
    }

    /// The router has found a path, or another one: opens a session, or repeats at once what is not
    /// acknowledged. `mtu` is the largest segment that the path carries.
    pub fn handle_path(&mut self, mtu: usize, now: Instant) {
        self.now = now;
        self.path = Some(mtu);
        self.trip.progress();
        match self.state {
            State::Idle => self.open(None),
            State::Opening { peer, pause, .. } => {
                self.state = State::Opening { peer, again_at: now, pause };
            }
            State::Open { .. } | State::Closing { .. } => {
                let waits = self.streams.iter().any(|stream| !stream.outbound.is_empty());
                self.owed_since = waits.then_some(now);
                let mut lost = false;
                for stream in &mut self.streams {
                    lost |= stream.outbound.lose_all();
                }
                if lost {
                    self.retransmit_at = Some(now + self.trip.timeout());
                }
            }
            State::Closed => {}
        }
    }

    /// The router knows no path any more. The session waits for one as long as it has patience.
    pub fn handle_no_path(&mut self, now: Instant) {
        self.now = now;
        self.path = None;
        self.retransmit_at = None;
        self.owed_since.get_or_insert(now);
    }

    /// The router has heard of this life of the peer: sessions with earlier ones are over.
    pub fn handle_incarnation(&mut self, incarnation: Incarnation, now: Instant) {
        self.now = now;
        if self.newest < (incarnation, 0) {
            self.newest = (incarnation, 0);
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
                self.give_back(&Why::Stopped);
                self.state = State::Closed;
            }
            State::Closing { .. } | State::Closed => {}
        }
    }

    /// This end has lost its memory of the session: both ends begin a new one.
    pub fn handle_begin_anew(&mut self, now: Instant) {
        self.now = now;
        if matches!(self.state, State::Open { .. }) {
            // The peer's own tag is what it knows this session by.
            self.transmit(Class::Control, Segment::Reset { tag: self.tag });
            self.end(self.unreachable());
        }
    }

    /// Takes out what was not acknowledged, when this machine is about to be replaced.
    pub fn surrender(&mut self) -> Vec<(Stream, Bytes)> {
        STREAMS
            .into_iter()
            .flat_map(|stream| {
                let messages = self.streams[stream as usize].outbound.take_all();
                messages.map(move |message| (stream, message))
            })
            .collect()
    }

    /// A segment from the peer's node arrived.
    pub fn handle_segment(&mut self, segment: Bytes, now: Instant) {
        self.now = now;
        match Segment::decode(segment) {
            Ok(Segment::Open(open)) => self.handle_open(open),
            Ok(Segment::Reset { tag }) => self.handle_reset(tag),
            Ok(Segment::Data(data)) if self.meant_for_us(data.tag) => self.handle_data(data),
            Ok(Segment::Datagram(datagram)) if self.meant_for_us(datagram.tag) => {
                self.handle_datagram(datagram);
            }
            Ok(Segment::Acknowledge { tag, control, data }) if self.meant_for_us(tag) => {
                for (stream, ack) in STREAMS.into_iter().zip([control, data]) {
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
                self.transmit(Class::Control, Segment::Reset { tag });
            }
            Ok(
                Segment::Data(Data { tag, .. })
                | Segment::Datagram(Datagram { tag, .. })
                | Segment::Acknowledge { tag, .. },
            ) => {
                self.refusals.stale += 1;
                self.transmit(Class::Control, Segment::Reset { tag });
            }
            Err(error) => self.refusals.count(&error),
        }
    }

    /// Is it for the present session? Then the peer knows our tag, and the session is open.
    fn meant_for_us(&mut self, tag: u32) -> bool {
        if tag != self.tag {
            return false;
        }
        match self.state {
            State::Opening { peer: Some(peer), .. } => {
                self.begin(peer);
                true
            }
            State::Open { .. } | State::Closing { .. } => {
                self.heard();
                true
            }
            _ => false,
        }
    }

    fn heard(&mut self) {
        let waits = self.streams.iter().any(|stream| !stream.outbound.is_empty());
        self.owed_since = (waits || self.path.is_none()).then_some(self.now);
    }

    fn open(&mut self, peer: Option<Peer>) {
        self.number = self.number.saturating_add(1);
        self.tag = self.new_tag();
        let pause = self.config.retransmit_min;
        self.state = State::Opening { peer, again_at: self.now, pause };
        self.say_open();
    }

    /// A tag that no other session of ours with this peer has, as far as 32 bits can tell.
    fn new_tag(&self) -> u32 {
        let names = u64::from(NodeId::of(&self.config.node).0) << 32
            | u64::from(NodeId::of(&self.config.peer).0);
        let mixed = [names, self.config.incarnation.0, self.number.into()]
            .into_iter()
            .fold(0, |state: u64, word| mix(state ^ word));
        // 0 stands for "not known" in the handshake.
        (mixed as u32).max(1)
    }

    fn say_open(&mut self) {
        let State::Opening { peer, pause, .. } = self.state else { return };
        // Grows by half each time, up to the longest retransmission.
        let next = (pause * 3 / 2).min(self.config.retransmit_max);
        self.state = State::Opening { peer, again_at: self.now + pause, pause: next };
        self.tell_open(peer.map_or(0, |peer| peer.tag));
    }

    fn tell_open(&mut self, echo: u32) {
        let (tag, number) = (self.tag, self.number);
        let incarnation = self.config.incarnation;
        let open = Open { version: VERSION, tag, echo, incarnation, number };
        self.transmit(Class::Control, Segment::Open(open));
    }

    fn handle_open(&mut self, open: Open) {
        if open.version != VERSION {
            let theirs = open.version;
            if self.refusals.version == 0 {
                self.outputs.push_back(SessionOutput::Incompatible { theirs });
            }
            self.refusals.count(&WireError::Version { theirs, ours: VERSION });
            return;
        }
        let key = (open.incarnation, open.number);
        if key < self.newest {
            self.refusals.stale += 1;
            return;
        }
        let theirs = Peer { incarnation: open.incarnation, number: open.number, tag: open.tag };
        if key > self.newest {
            self.newest = key;
            self.end_with_old_peer(open.incarnation);
        }
        match self.state {
            State::Idle if self.path.is_some() => self.open(Some(theirs)),
            State::Idle | State::Closed => {}
            State::Opening { again_at, pause, .. } => {
                if open.echo == self.tag {
                    self.begin(theirs);
                    self.acknowledge();
                } else {
                    self.state = State::Opening { peer: Some(theirs), again_at, pause };
                    self.say_open();
                }
            }
            State::Open { peer } | State::Closing { peer, .. } if peer != theirs => {
                // One session of the peer's has one tag.
                self.refusals.unexpected += 1;
            }
            State::Open { .. } | State::Closing { .. } => {
                if open.echo == self.tag {
                    self.heard();
                    self.acknowledge();
                } else {
                    self.tell_open(theirs.tag);
                }
            }
        }
    }

    /// The peer has a newer session, or a newer life: what we had with the old one is over.
    fn end_with_old_peer(&mut self, incarnation: Incarnation) {
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } => {
                let why = if peer.incarnation < incarnation {
                    Why::PeerDied { incarnation: peer.incarnation }
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

    fn begin(&mut self, peer: Peer) {
        self.state = State::Open { peer };
        self.heard();
        self.outputs.push_back(SessionOutput::Opened { incarnation: peer.incarnation });
    }

    /// Ends the present session; opens the next one if there is a path.
    fn end(&mut self, why: Why) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let closing = matches!(self.state, State::Closing { .. });
        self.give_back(&why);
        let incarnation = peer.incarnation;
        self.outputs.push_back(SessionOutput::Ended { incarnation, why });
        if closing {
            self.state = State::Closed;
        } else if self.path.is_some() {
            self.open(None);
        } else {
            self.state = State::Idle;
        }
    }

    /// Returns every unacknowledged message and begins from nothing.
    fn give_back(&mut self, why: &Why) {
        for stream in STREAMS {
            let state = &mut self.streams[stream as usize];
            for message in state.outbound.take_all() {
                let why = why.clone();
                self.outputs.push_back(SessionOutput::Returned { stream, message, why });
            }
            if state.is_full {
                self.outputs.push_back(SessionOutput::Room { stream });
            }
            *state = StreamState::new(&self.config);
        }
        let assembly = self.config.message_max.saturating_mul(2);
        let given_up = self.pieces.given_up;
        self.pieces = Assembly::new(assembly, Self::ASSEMBLY_PATIENCE);
        self.pieces.given_up = given_up;
        self.best_effort.sent.clear();
        self.best_effort.delivered.clear();
        self.congestion = Self::CONGESTION_INITIAL;
        self.reduced_until = self.order;
        self.retransmit_at = None;
        self.owed_since = None;
        self.trip.progress();
    }

    fn handle_reset(&mut self, tag: u32) {
        match self.state {
            State::Open { peer } | State::Closing { peer, .. } if peer.tag == tag => {
                self.end(self.unreachable());
            }
            _ => self.refusals.stale += 1,
        }
    }

    fn handle_data(&mut self, data: Data) {
        let Data { stream, sequence, first, last, piece, ack, payload, .. } = data;
        if let Some(ack) = ack {
            self.handle_ack(stream, &ack);
        }
        let whole = match piece {
            Some(piece) if self.streams[stream as usize].inbound.expects(sequence) => {
                self.pieces.handle((stream, sequence), piece, payload, self.now)
            }
            _ => Some(payload),
        };
        if let Some(payload) = whole {
            let mut messages = Vec::new();
            let inbound = &mut self.streams[stream as usize].inbound;
            let times = (self.now, self.config.ack_delay);
            let arrived = inbound.handle(sequence, (first, last, payload), times, &mut messages);
            let outputs = messages.into_iter();
            self.outputs.extend(outputs.map(|message| SessionOutput::Message { stream, message }));
            match arrived {
                Ok(Arrived::New) => {}
                Ok(Arrived::Again) => self.counters.doubled += 1,
                Ok(Arrived::Beyond) => self.refusals.unexpected += 1,
                Err(error) => {
                    // The peer is broken; whatever it says next cannot be trusted to be in order.
                    self.refusals.count(&error);
                    let State::Open { peer } = self.state else { return };
                    let reset = Segment::Reset { tag: self.tag };
                    self.transmit(Class::Control, reset);
                    self.newest = self.newest.max((peer.incarnation, peer.number + 1));
                    self.end(Why::Undecodable { reason: error.to_string() });
                    return;
                }
            }
        }
        self.close_when_done();
    }

    fn handle_ack(&mut self, stream: Stream, ack: &Ack) {
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

    fn make_room(&mut self, stream: Stream) {
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

    fn handle_datagram(&mut self, datagram: Datagram) {
        let Datagram { channel, sequence, piece, payload, .. } = datagram;
        let full = self.best_effort.delivered.len() >= self.config.channels_max;
        match self.best_effort.delivered.get(&channel) {
            Some(newest) if sequence == *newest => self.counters.doubled += 1,
            Some(newest) if sequence < *newest => self.counters.overtaken += 1,
            None if full => self.refusals.too_large += 1,
            _ => {
                let message = match piece {
                    None => Some(payload),
                    Some(piece) => {
                        let key = (channel, sequence);
                        self.best_effort.pieces.handle(key, piece, payload, self.now)
                    }
                };
                if let Some(message) = message {
                    self.best_effort.delivered.insert(channel, sequence);
                    self.outputs.push_back(SessionOutput::Newest { channel, message });
                }
            }
        }
    }

    fn close_when_done(&mut self) {
        if let State::Closing { peer, again_at: None, tries: 0 } = self.state
            && self.streams.iter().all(|stream| stream.outbound.is_empty())
        {
            let again_at = Some(self.now + self.trip.timeout());
            self.state = State::Closing { peer, again_at, tries: 1 };
            self.transmit(Class::Control, Segment::Close { tag: peer.tag });
        }
    }

    fn handle_peers_close(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        self.transmit(Class::Control, Segment::Closed { tag: peer.tag });
        // The peer's next session, if there is one, has a greater number.
        self.newest = self.newest.max((peer.incarnation, peer.number.saturating_add(1)));
        self.end(Why::Stopped);
        if let State::Opening { .. } = self.state {
            // It will not answer until it lives again: the router, or its own open, will tell.
            self.state = State::Idle;
        }
    }

    fn handle_closed(&mut self) {
        if let State::Closing { tries: 1.., .. } = self.state {
            self.end(Why::Stopped);
        }
    }

    fn transmit(&mut self, class: Class, segment: Segment) {
        let segment = segment.encode();
        self.outputs.push_back(SessionOutput::Transmit { class, segment });
    }

    /// Acknowledges both streams now.
    fn acknowledge(&mut self) {
        let (State::Open { peer } | State::Closing { peer, .. }) = self.state else { return };
        let [control, data] = &mut self.streams;
        let control = Some(control.inbound.acknowledge());
        let data = Some(data.inbound.acknowledge());
        self.transmit(Class::Control, Segment::Acknowledge { tag: peer.tag, control, data });
    }

    /// Sends the next part that may be sent: control first, and what was lost before what is new.
    fn transmit_part(&mut self) -> bool {
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

    fn transmit_as(
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

    fn ack_owed(&self) -> Option<Instant> {
        self.streams.iter().filter_map(|stream| stream.inbound.owed()).min()
    }

    fn give_up_at(&self) -> Option<Instant> {
        self.owed_since.map(|since| since + self.config.patience)
    }

    /// The peer has owed us a sign of life for too long.
    fn give_up(&mut self) {
        self.owed_since = None;
        match self.state {
            State::Open { .. } | State::Closing { .. } => self.end(self.unreachable()),
            State::Opening { .. } => {
                self.give_back(&self.unreachable());
                if self.path.is_none() {
                    self.state = State::Idle;
                }
            }
            State::Idle | State::Closed => {}
        }
    }

    fn repeat_close(&mut self, peer: Peer, tries: u32) {
        if tries > Self::CLOSE_TRIES {
            return self.end(Why::Stopped);
        }
        self.trip.back_off();
        let again_at = Some(self.now + self.trip.timeout());
        self.state = State::Closing { peer, again_at, tries: tries + 1 };
        self.transmit(Class::Control, Segment::Close { tag: peer.tag });
    }

    fn handle_silence(&mut self) {
        self.trip.back_off();
        self.congestion = Self::CONGESTION_MIN;
        self.reduced_until = self.order;
        for stream in &mut self.streams {
            stream.outbound.lose_all();
        }
        self.retransmit_at = Some(self.now + self.trip.timeout());
    }
}

impl StreamState {
    fn new(config: &SessionConfig) -> Self {
        StreamState {
            outbound: Outbound::new(config.window),
            inbound: Inbound::new(config.window, config.message_max),
            is_full: false,
        }
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
                self.acknowledge();
                continue;
            }
            return None;
        }
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let again_at = match self.state {
            State::Opening { again_at, .. } => self.path.map(|_| again_at),
            State::Closing { again_at, .. } => again_at,
            _ => None,
        };
        [again_at, self.retransmit_at, self.ack_owed(), self.give_up_at()]
            .into_iter()
            .flatten()
            .min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.now = now;
        let due = |at: Option<Instant>| at.is_some_and(|at| at <= now);
        if due(self.give_up_at()) {
            self.give_up();
        }
        if due(self.retransmit_at) {
            self.retransmit_at = None;
            if self.streams.iter().any(|stream| stream.outbound.flying() > 0) {
                self.handle_silence();
            }
        }
        match self.state {
            State::Opening { again_at, .. } if again_at <= now && self.path.is_some() => {
                self.say_open();
            }
            State::Closing { peer, again_at, tries } if due(again_at) => {
                self.repeat_close(peer, tries);
            }
            _ => {}
        }
    }
}

/// One whole, or pieces of at most `room` bytes.
fn pieces_of(payload: &Bytes, room: usize) -> Vec<(Option<Piece>, Bytes)> {
    if payload.len() <= room {
        return vec![(None, payload.clone())];
    }
    let count = payload.len().div_ceil(room).min(PIECES_MAX.into()) as u16;
    let size = payload.len().div_ceil(count.into());
    (0..count)
        .map(|index| {
            let start = (usize::from(index) * size).min(payload.len());
            let end = (start + size).min(payload.len());
            (Some(Piece { index, count }), payload.slice(start..end))
        })
        .collect()
}

/// The finaliser of SplitMix64: every bit of the input changes half of the output's.
fn mix(mut word: u64) -> u64 {
    word = word.wrapping_add(0x9e37_79b9_7f4a_7c15);
    word = (word ^ (word >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    word = (word ^ (word >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    word ^ (word >> 31)
}

#[cfg(test)]
mod tests;
