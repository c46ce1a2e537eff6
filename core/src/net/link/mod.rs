//! One use of one transport towards one neighbour: is it alive, and how good is it?
//!
//! ```text
//!              N hellos, received both ways
//! Connecting ───────────────────────────► Up ⇄ Suspect     a hello is late / there again; or the
//!                                               ▲  │       link has failed lately / 2N, 4N … came
//!                   N hellos, received both ways│  │ still none, no carrier, or the neighbour has
//!                                               │  ▼ said Down in a hello
//!                                               Down
//! ```
//!
//! Each end states in its hellos whether it is ready to use the link, and uses it only while the
//! other end is ready: each end accepts what the other sends.
//!
//! A hello that continues the neighbour's series is accepted at once. A hello that contradicts it,
//! such as one of another incarnation, is accepted where the neighbour's key has proved it, or,
//! without keys, when it is said twice and the neighbour is silent (see `acquaintance`). A frame
//! that was altered, or sent by an earlier incarnation, therefore takes no link down.
//!
//! A link does not queue, retransmit or order anything: sessions do, end to end.

mod acquaintance;
mod arrival;
mod flap_damping;
mod hello_slowdown;
mod path_mtu;
mod quality;
mod reassembly;
mod timers;
mod types;

pub mod link_set;

pub use self::quality::Quality;
pub use self::types::{
    HELLO_INTERVAL, HELLO_INTERVAL_RANGE, LinkConfig, LinkOutput, LinkState, Neighbour,
    PEER_TIMEOUT, PeerRefusal,
};

use self::acquaintance::Contradiction;
use self::path_mtu::PathMtu;
use self::quality::{QualityEstimator, QualityLimits};
use self::reassembly::RoutingReassembly;

use super::wire::frame::{Echo, Frame, Hello, NameHolder};
use super::wire::hello_state::HelloState;
use super::wire::{Refusals, WireError};
use crate::timer::Timers;
use crate::{GatherBuffer, Incarnation, Instant, Machine};
use arrival::{ArrivalEstimator, HelloArrival};
use bytes::Bytes;
use std::collections::VecDeque;
use std::time::Duration;

/// The machine of one link.
#[derive(Debug)]
pub struct Link {
    config: LinkConfig,
    /// As configured, or as long as the medium and its other links need.
    hello_interval: Duration,
    state: LinkState,
    neighbour: Option<NeighbourRecord>,
    /// The incarnation in which the neighbour is, as its key has proved; `None` where frames are
    /// not sealed.
    authenticated: Option<Incarnation>,
    /// The last hello that contradicts that.
    contradiction: Option<Contradiction>,
    next_hello: Instant,
    /// How late this node was run when a timer fired last.
    late: Duration,
    /// By when a neighbour should have proved to be there; `None` once its absence was reported.
    expected_by: Option<Instant>,
    /// The latest hellos sent, for the round trip: number and time.
    sent: VecDeque<(u32, Instant)>,
    /// How often it went down lately, and when last.
    flaps: u32,
    down_at: Instant,
    /// How often it was suspect lately, when last, and how many hellos were received since.
    suspicions: u32,
    suspected_at: Instant,
    calm: u32,
    /// It is suspect although hellos are received again.
    proving: bool,
    /// It has failed since it was trusted last. It carries only what has no other path until it has
    /// proved itself as often as it has failed lately.
    damped: bool,
    /// The medium's largest frame; 0 while it is not known.
    mtu: usize,
    /// What passes of that, where the path may drop large frames.
    path: Option<PathMtu>,
    parts: RoutingReassembly,
    gauge: QualityEstimator,
    /// The last refusal, and the last that was reported: a single one may be an accident.
    doubted: Option<PeerRefusal>,
    refused: Option<PeerRefusal>,
    refusals: Refusals,
    frames_dropped: u64,
    outputs: VecDeque<LinkOutput>,
}

/// What is known of the neighbour.
#[derive(Debug)]
struct NeighbourRecord {
    neighbour: Neighbour,
    arrivals: ArrivalEstimator,
    /// When its last hello was received.
    received_at: Instant,
    /// When anything else was: hellos may wait behind it on a full path.
    heard_at: Instant,
    /// Hellos since the last silence, while it receives ours, less two for each that was missing.
    hellos_received: u32,
    /// The state of the link at its end.
    stance: HelloState,
    /// The loss in its direction, as it reports.
    loss_there: u16,
    /// The latest of our hellos that it has echoed, and when that echo was received.
    echoed: Option<(u32, Instant)>,
    /// When the latest one that it has ever echoed was sent.
    answered: Instant,
    /// Silence before this does not count: this node was not run.
    excused_until: Instant,
    /// How often that was extended since its last hello.
    excuses: u32,
    /// How long this node was not run before. What it reads then may have been sent as long ago.
    stalled: Duration,
}

impl Link {
    /// What a medium adds to a frame: a UDP header, or a serial line's framing.
    const FRAMING: u64 = 8;
    /// A timer that is so late means that received frames may be unread. Timers alone are up to 1
    /// ms late.
    const LATE: Duration = Duration::from_millis(2);
    /// Four times in a row are no accident.
    const EXCUSES_MAX: u32 = 4;
    /// Remembered hellos: enough for round trips of so many intervals.
    const SENT_MAX: usize = 64;
    /// A neighbour is missing only when this many more hello intervals have passed than were set.
    const ABSENT_HELLOS: u32 = 5;
    /// A link that stayed up for so long has proved itself; earlier flaps are forgotten.
    const FLAP_MEMORY: Duration = Duration::from_secs(10);
    /// 16 times the usual proof at most, so that a repaired link comes back within seconds.
    const FLAPS_MAX: u32 = 4;

    /// A link that sends its first hello at once.
    pub fn new(config: LinkConfig, now: Instant) -> Self {
        Link {
            expected_by: Some(now + config.peer_timeout),
            hello_interval: config.hello_interval.max(*HELLO_INTERVAL_RANGE.start()),
            config,
            state: LinkState::Connecting,
            neighbour: None,
            authenticated: None,
            contradiction: None,
            next_hello: now,
            late: Duration::ZERO,
            sent: VecDeque::with_capacity(Self::SENT_MAX),
            flaps: 0,
            down_at: Instant::ORIGIN,
            suspicions: 0,
            suspected_at: Instant::ORIGIN,
            calm: 0,
            proving: false,
            damped: false,
            mtu: 0,
            path: None,
            parts: RoutingReassembly::default(),
            gauge: QualityEstimator::default(),
            doubted: None,
            refused: None,
            refusals: Refusals::default(),
            frames_dropped: 0,
            outputs: VecDeque::new(),
        }
    }

    /// The present state.
    pub fn state(&self) -> LinkState {
        self.state
    }

    /// The node that is, or was last, at the other end.
    pub fn neighbour(&self) -> Option<&Neighbour> {
        self.neighbour.as_ref().map(|record| &record.neighbour)
    }

    /// The node that is at the other end instead of the neighbour, once that was reported.
    pub fn refusal(&self) -> Option<&PeerRefusal> {
        self.refused.as_ref()
    }

    /// How good it is.
    pub fn quality(&self) -> Quality {
        self.gauge.quality()
    }

    /// The largest frame that it carries at present, in bytes; 0 while the medium is not known.
    pub fn frame_limit(&self) -> usize {
        self.path.as_ref().map_or(self.mtu, PathMtu::limit)
    }

    /// The largest frame that passes, and the medium's largest one, in bytes, once probes have
    /// shown that the path drops the latter.
    pub fn shortfall(&self) -> Option<(usize, usize)> {
        self.path.as_ref().and_then(PathMtu::shortfall)
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// How many frames of the router were dropped because the link was not up.
    pub fn frames_dropped(&self) -> u64 {
        self.frames_dropped
    }

    /// Sends a message of the router. Dropped and counted when the link is not up.
    pub fn handle_routing(&mut self, bytes: Bytes) {
        for frame in reassembly::frames_of(bytes, self.frame_limit()) {
            self.carry(frame);
        }
    }

    /// Sends a packet. Dropped and counted when the link is not up.
    pub fn handle_packet(&mut self, packet: impl Into<GatherBuffer>) {
        self.carry(Frame::Data(packet.into()));
    }

    /// Tells the neighbour that another node has its name.
    pub fn handle_taken(&mut self, holder: NameHolder) {
        if let Some(refused) = self.neighbour().map(|neighbour| neighbour.incarnation) {
            self.carry(Frame::Taken { refused, by: holder });
        }
    }

    /// Whether the neighbour has answered a hello that was sent after this.
    pub(super) fn has_answered(&self, since: Instant) -> bool {
        self.neighbour.as_ref().is_some_and(|record| record.answered > since)
    }

    /// How long the echo of a hello takes on a link that is up: twice the detection time.
    pub(super) fn answer_within(&self) -> Duration {
        percent(self.hello_interval, 2 * (100 + self.down_after_percent()))
    }

    fn carry(&mut self, frame: Frame) {
        if self.carries() {
            self.outputs.push_back(LinkOutput::Transmit(frame.parcel()));
        } else {
            self.frames_dropped += 1;
        }
    }

    /// Whether a received frame is accepted. A neighbour may send packets before its hello that it
    /// uses the link has been received. Only hellos bring a link up: other frames have no number,
    /// and may have been recorded.
    fn takes(&self, frame: &Frame) -> bool {
        match frame {
            Frame::Hello(_) => true,
            Frame::Data(_) => self.carries() || self.has_proved(),
            // Routers know no link that is not up; the neighbour's router retransmits.
            Frame::Routing(_) | Frame::RoutingPart(_) => self.carries(),
            // Where the neighbour has proved itself, it says so instead of taking this node's
            // hellos. A sender that has received no hello of this node does not know its
            // incarnation.
            Frame::Taken { refused, .. } => {
                *refused == self.config.incarnation
                    && (self.carries() || self.authenticated.is_some())
            }
            Frame::Probe(_) | Frame::ProbeAnswer(_) => self.neighbour.is_some(),
        }
    }

    fn carries(&self) -> bool {
        matches!(self.state, LinkState::Up | LinkState::Suspect)
    }

    /// The transport has received a frame.
    pub fn handle_frame(&mut self, frame: Bytes, now: Instant) {
        match Frame::decode(frame) {
            Ok(frame) if !self.takes(&frame) => self.refusals.unexpected += 1,
            Ok(Frame::Hello(hello)) => self.handle_hello(hello, now),
            Ok(frame) => self.handle_payload(frame, now),
            Err(error) => self.refusals.count(&error),
        }
    }

    /// The neighbour has sent something for our router.
    fn handle_payload(&mut self, frame: Frame, now: Instant) {
        if let Some(record) = &mut self.neighbour {
            record.heard_at = now;
        }
        match frame {
            Frame::Hello(_) => {}
            Frame::Routing(bytes) => self.outputs.push_back(LinkOutput::Routing(bytes)),
            Frame::RoutingPart(part) => match self.parts.handle(&part) {
                Ok(whole) => self.outputs.extend(whole.map(LinkOutput::Routing)),
                Err(error) => self.refusals.count(&error),
            },
            Frame::Data(packet) => self.outputs.push_back(LinkOutput::Packet(packet.into_bytes())),
            Frame::Taken { by, .. } => self.outputs.push_back(LinkOutput::Taken(by)),
            Frame::Probe(size) => {
                self.outputs.push_back(LinkOutput::Transmit(Frame::ProbeAnswer(size).parcel()));
            }
            Frame::ProbeAnswer(size) => {
                self.with_path(|path| path.handle_answer(size, now));
            }
        }
    }

    /// The medium's largest frame has so many bytes; a path that may drop it has `path`.
    fn handle_mtu(&mut self, mtu: usize, path: Option<PathMtu>) {
        (self.mtu, self.path) = (mtu, path);
    }

    fn with_path<T>(&mut self, input: impl FnOnce(&mut PathMtu) -> T) -> Option<T> {
        let path = self.path.as_mut()?;
        let before = (path.limit(), path.shortfall());
        let result = input(path);
        if before != (path.limit(), path.shortfall()) {
            self.outputs.push_back(LinkOutput::FrameLimit);
        }
        Some(result)
    }

    /// Probes the path while the neighbour receives this node's hellos.
    fn probe_path(&mut self, now: Instant) {
        let record = self.neighbour.as_ref().filter(|record| record.echoed.is_some());
        let Some(heard) = record.map(|record| record.answered) else { return };
        // A probe and its answer: both directions may lose one.
        let tries = 3 + hellos_beyond_three(2 * self.quality().loss_permille);
        if let Some(size) = self.with_path(|path| path.poll_probe(heard, tries, now)).flatten() {
            self.outputs.push_back(LinkOutput::Transmit(Frame::Probe(size).parcel()));
        }
    }

    /// The transport knows that the medium, or the connection, is gone: no need to wait for
    /// silence.
    pub fn handle_loss(&mut self, now: Instant) {
        if self.carries() {
            self.go_down("the transport lost the neighbour", now);
        }
    }

    /// The neighbour has proved by its key that it is there, in this incarnation. A link that an
    /// earlier one used goes down at once. Hellos of any other incarnation are refused from here
    /// on.
    pub fn handle_authenticated(&mut self, incarnation: Incarnation, now: Instant) {
        self.authenticated = Some(incarnation);
        let other = self.neighbour().is_some_and(|known| known.incarnation != incarnation);
        if other && self.carries() {
            self.go_down("the neighbour has restarted", now);
        }
    }

    /// The interface has lost its carrier: the cable is pulled, or the other end is switched off.
    /// Later hellos prove the contrary. The reason is for display.
    pub fn handle_no_carrier(&mut self, reason: &'static str, now: Instant) {
        if self.carries() {
            self.go_down(reason, now);
        } else if let Some(record) = &mut self.neighbour {
            record.forget_proof();
        }
    }

    /// The shortest hello interval where the medium carries so many bytes in a second, and a seal
    /// adds so many to each frame: hellos take a twentieth of that at most.
    fn interval_at(&self, bytes_per_second: u64, overhead: u64) -> Duration {
        let hello = self.hello(Instant::ORIGIN, 0);
        let length = Frame::Hello(hello).encode().len() as u64 + overhead + Self::FRAMING;
        let nanos = (length * 20).saturating_mul(1_000_000_000) / bytes_per_second.max(1);
        Duration::from_nanos(nanos)
    }

    /// Hellos are sent at least so far apart, and as often as configured where that is less often.
    fn set_interval(&mut self, at_least: Duration) {
        let interval = self.config.hello_interval.max(at_least);
        let interval = interval.clamp(*HELLO_INTERVAL_RANGE.start(), *HELLO_INTERVAL_RANGE.end());
        if std::mem::replace(&mut self.hello_interval, interval) != interval {
            // Hellos are numbered by their interval: echoes of the old numbers say nothing any
            // more.
            self.sent.clear();
            self.contradiction = None;
            if let Some(record) = &mut self.neighbour {
                record.echoed = None;
            }
        }
    }

    /// How often hellos are sent.
    pub fn hello_interval(&self) -> Duration {
        self.hello_interval
    }

    /// When the neighbour's last hello was received, if it is known.
    pub fn last_hello(&self) -> Option<Instant> {
        self.neighbour.as_ref().map(|record| record.received_at)
    }

    /// Silence counts only from a while after `now`. The number of excuses in a row is bounded, so
    /// that a node which stalls again and again still detects a dead link.
    fn excuse(&mut self, a_while: Duration, now: Instant) {
        if let Some(record) = &mut self.neighbour
            && record.excuses < Self::EXCUSES_MAX
        {
            record.excuses += 1;
            record.excused_until = record.excused_until.max(now + a_while);
        }
    }

    fn handle_hello(&mut self, hello: Hello, now: Instant) {
        let interval = Duration::from_micros(hello.interval_us.into());
        if !HELLO_INTERVAL_RANGE.contains(&interval) {
            self.refusals.count(&WireError::Malformed { what: "a hello's interval" });
            return;
        }
        if let Err(refusal) = self.check_name(&hello) {
            self.refuse(refusal);
            return;
        }
        if self.authenticated.is_some_and(|proved| proved != hello.incarnation) {
            self.refusals.unexpected += 1;
            return;
        }
        (self.doubted, self.refused) = (None, None);
        let HelloArrival::New { missed } = self.meet(&hello, interval, now) else { return };
        self.calm = after(self.calm, missed);
        self.listen(&hello, missed, now);
        self.judge_quality(now);
        if self.carries() && hello.stance == HelloState::Down {
            self.go_down("the neighbour has given it up", now);
        }
        self.rise(now);
    }

    fn listen(&mut self, hello: &Hello, missed: u32, now: Instant) {
        let Some(record) = &mut self.neighbour else { return };
        record.received_at = now;
        record.excuses = 0;
        record.stance = hello.stance;
        record.loss_there = hello.loss_permille;
        if let Some(echo) = hello.echo.filter(|echo| echo.incarnation == self.config.incarnation) {
            let newest = record
                .echoed
                .is_none_or(|(sequence, _)| echo.sequence.wrapping_sub(sequence).cast_signed() > 0);
            let sent = self.sent.iter().find(|(sequence, _)| *sequence == echo.sequence);
            if let (true, Some((_, sent))) = (newest, sent) {
                record.echoed = Some((echo.sequence, now));
                record.answered = *sent;
                let held = Duration::from_micros(echo.held_us.into());
                // The echo has waited here for as long as this node was not run.
                let waited = held + self.late;
                self.gauge.handle_round_trip((now - *sent).saturating_sub(waited));
            }
        }
        record.hellos_received = match record.echoed {
            // A link that loses a third of what it carries never proves itself.
            Some(_) => after(record.hellos_received, missed),
            None => 0,
        };
    }

    fn judge_quality(&mut self, now: Instant) {
        let Some(record) = &self.neighbour else { return };
        let Some(loss) = record.arrivals.loss_permille() else { return };
        let limits = QualityLimits {
            loss_permille: self.config.degraded_loss_permille,
            // On a slow medium a round trip takes two frames and two hellos, when it is full.
            round_trip: self.config.degraded_round_trip.max(self.hello_interval),
        };
        if self.gauge.judge(loss.max(record.loss_there), limits, now) {
            self.outputs.push_back(LinkOutput::Quality(self.gauge.quality()));
        }
    }

    /// When silence, or deafness of the neighbour, will have lasted so long past the expected
    /// hello. What comes meanwhile shows that the neighbour lives; that it receives us, only its
    /// hellos show.
    fn silent_at(&self, after_percent: u32) -> Option<Instant> {
        let record = self.neighbour.as_ref()?;
        let interval = record.arrivals.interval();
        let alive_at = record.arrivals.expected().max(record.heard_at);
        let silent = alive_at + percent(interval, after_percent);
        let deaf = record.echoed.map_or(record.received_at, |(_, at)| at)
            // An echo needs both directions: twice the patience, in the slower one's intervals.
            + percent(interval.max(self.hello_interval), 2 * (100 + after_percent));
        Some(silent.min(deaf).max(record.excused_until))
    }

    fn down_after_percent(&self) -> u32 {
        self.config.down_after_percent + 100 * hellos_beyond_three(self.quality().loss_permille)
    }

    fn go_down(&mut self, reason: &'static str, now: Instant) {
        if now - self.down_at > Self::FLAP_MEMORY {
            self.flaps = 0;
        }
        self.flaps = (self.flaps + 1).min(Self::FLAPS_MAX);
        self.down_at = now;
        self.damped = true;
        if let Some(record) = &mut self.neighbour {
            record.forget_proof();
        }
        self.change(LinkState::Down, reason);
    }

    fn change(&mut self, state: LinkState, reason: &'static str) {
        if let (LinkState::Down | LinkState::Connecting, LinkState::Up, Some(record)) =
            (self.state, state, &mut self.neighbour)
        {
            record.arrivals.forget_loss();
        }
        self.state = state;
        self.proving &= state == LinkState::Suspect;
        let neighbour = self.neighbour().cloned();
        self.outputs.push_back(LinkOutput::Changed { state, neighbour, reason });
    }

    fn say_hello(&mut self, now: Instant) {
        // Hellos are numbered and sent by an absolute schedule, so that a late one does not shift
        // the later ones. Numbers are counted from the clock's origin, so that they also rise when
        // this machine is rebuilt in a running process.
        let nanos = self.hello_interval.as_nanos() as u64;
        let number = now.as_nanos() / nanos;
        self.next_hello = Instant::from_nanos((number + 1).saturating_mul(nanos));
        let hello = self.hello(now, number as u32);
        if self.sent.len() == Self::SENT_MAX {
            self.sent.pop_front();
        }
        self.sent.push_back((hello.sequence, now));
        self.outputs.push_back(LinkOutput::Transmit(Frame::Hello(hello).parcel()));
        self.probe_path(now);
    }

    /// How many hellos between the last one and this one were not sent.
    fn skipped(&self, sequence: u32) -> u8 {
        let last = self.sent.back().map_or(sequence, |(last, _)| *last);
        let skipped = sequence.wrapping_sub(last).saturating_sub(1);
        skipped.min(Hello::SKIPPED_MAX.into()) as u8
    }

    fn hello(&self, now: Instant, sequence: u32) -> Hello {
        let echo = self.neighbour.as_ref().map(|record| Echo {
            incarnation: record.neighbour.incarnation,
            sequence: record.arrivals.highest(),
            held_us: u32::try_from((now - record.received_at).as_micros()).unwrap_or(u32::MAX),
        });
        let lost = self.neighbour.as_ref().and_then(|record| record.arrivals.loss_permille());
        Hello {
            node: self.config.node.clone(),
            incarnation: self.config.incarnation,
            sequence,
            interval_us: u32::try_from(self.hello_interval.as_micros()).unwrap_or(u32::MAX),
            skipped: self.skipped(sequence),
            stance: self.stance(),
            loss_permille: lost.unwrap_or(0),
            echo,
        }
    }

    fn report_absence(&mut self) {
        self.expected_by = None;
        // The refused node at the other end was reported, which says more.
        if self.refused.is_none() {
            let hello_received = self.neighbour.is_some();
            self.outputs.push_back(LinkOutput::Missing { hello_received });
        }
    }

    fn suspect(&mut self, now: Instant) {
        self.proving = false;
        let lately = now - self.suspected_at <= Self::FLAP_MEMORY;
        let before = if lately { self.suspicions } else { 0 };
        self.suspicions = (before + 1).min(Self::FLAPS_MAX + 1);
        (self.suspected_at, self.calm) = (now, 0);
        self.change(LinkState::Suspect, "a hello is late");
    }
}

impl NeighbourRecord {
    fn forget_proof(&mut self) {
        self.hellos_received = 0;
        self.echoed = None;
    }
}

impl Machine for Link {
    type Output = LinkOutput;

    fn poll_output(&mut self) -> Option<LinkOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.next_due()
    }

    fn handle_timeout(&mut self, now: Instant) {
        let due = self.poll_timeout().unwrap_or(now);
        // A timer that fires so late means that this node was not run; the neighbour's hellos are
        // still unread. After a long stall every silence up to now is void.
        let late = now - due;
        self.late = late;
        if late > self.hello_interval {
            let interval = self.neighbour.as_ref().map(|record| record.arrivals.interval());
            self.excuse(percent(interval.unwrap_or_default(), self.down_after_percent()), now);
            if let Some(record) = &mut self.neighbour {
                record.stalled = late;
            }
        } else if late > Self::LATE {
            self.excuse(late, now);
        }
        self.fire_due(now);
    }
}

/// One more good hello, and two less for each that was missing.
fn after(good: u32, missed: u32) -> u32 {
    good.saturating_sub(missed.saturating_mul(2)).saturating_add(1)
}

fn percent(span: Duration, percent: u32) -> Duration {
    span * percent / 100
}

/// How many more than three hellos must be lost in a row until that is less likely than 1 in
/// 100,000.
fn hellos_beyond_three(loss_permille: u16) -> u32 {
    match loss_permille {
        0..=20 => 0,
        21..=50 => 1,
        51..=100 => 2,
        101..=200 => 4,
        201..=300 => 6,
        // Beyond, the link is of little use, and it is not worth finding its end any later.
        _ => 9,
    }
}

#[cfg(test)]
mod tests;
