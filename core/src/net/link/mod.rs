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
mod hello_schedule;
mod hello_slowdown;
mod neighbour_record;
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

use self::acquaintance::Acquaintance;
use self::arrival::HelloArrival;
use self::flap_damping::FlapDamping;
use self::hello_schedule::HelloSchedule;
use self::neighbour_record::NeighbourRecord;
use self::path_mtu::{FrameSize, PathMtu};
use self::reassembly::RoutingReassembly;

use super::wire::frame::{Echo, Frame, Hello, NameHolder};
use super::wire::hello_state::HelloState;
use super::wire::{Refusals, WireError};
use crate::timer::Timers;
use crate::{GatherBuffer, Incarnation, Instant, Machine};
use bytes::Bytes;
use std::collections::VecDeque;
use std::time::Duration;

/// The machine of one link.
#[derive(Debug)]
pub struct Link {
    config: LinkConfig,
    state: LinkState,
    neighbour: Option<NeighbourRecord>,
    acquaintance: Acquaintance,
    hellos: HelloSchedule,
    /// By when a neighbour should have proved to be there; `None` once its absence was reported.
    expected_by: Option<Instant>,
    damping: FlapDamping,
    frame_size: FrameSize,
    parts: RoutingReassembly,
    refusals: Refusals,
    frames_dropped: u64,
    outputs: VecDeque<LinkOutput>,
}

impl Link {
    /// What a medium adds to a frame: a UDP header, or a serial line's framing.
    const FRAMING: u64 = 8;
    /// So many percent of an interval after its time, a missing hello makes the link suspect, and
    /// takes it down: expected at 1, suspect at 2, down at 3.5 intervals after the last hello. Two
    /// lost in a row divert traffic, three take the link down (ITU-T G.8013: 3.5 intervals). On a
    /// link that loses hellos anyway, more must be missing, so that loss alone takes it down once
    /// in some 100,000 hellos.
    const SUSPECT_AFTER_PERCENT: u32 = 100;
    const DOWN_AFTER_PERCENT: u32 = 250;
    /// A timer that is so late means that received frames may be unread. Timers alone are up to 1
    /// ms late.
    const LATE: Duration = Duration::from_millis(2);
    /// A neighbour is missing only when this many more hello intervals have passed than were set.
    const ABSENT_HELLOS: u32 = 5;
    /// A link that sends its first hello at once.
    pub fn new(config: LinkConfig, now: Instant) -> Self {
        Link {
            state: LinkState::Connecting,
            neighbour: None,
            acquaintance: Acquaintance::default(),
            hellos: HelloSchedule::new(config.hello_interval, now),
            expected_by: Some(now + config.peer_timeout),
            damping: FlapDamping::default(),
            frame_size: FrameSize::default(),
            parts: RoutingReassembly::default(),
            refusals: Refusals::default(),
            frames_dropped: 0,
            config,
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
        self.acquaintance.refused.as_ref()
    }

    /// How good it is.
    pub fn quality(&self) -> Quality {
        self.neighbour.as_ref().map(|record| record.quality.quality()).unwrap_or_default()
    }

    /// The largest frame that it carries at present, in bytes; 0 while the medium is not known.
    pub fn frame_limit(&self) -> usize {
        self.frame_size.limit()
    }

    /// The largest frame that passes, and the medium's largest one, in bytes, once probes have
    /// shown that the path drops the latter.
    pub fn shortfall(&self) -> Option<(usize, usize)> {
        self.frame_size.shortfall()
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
        percent(self.hello_interval(), 2 * (100 + self.down_after_percent()))
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
                    && (self.carries() || self.acquaintance.authenticated.is_some())
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

    fn with_path<T>(&mut self, input: impl FnOnce(&mut PathMtu) -> T) -> Option<T> {
        let path = self.frame_size.path.as_mut()?;
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
        self.acquaintance.authenticated = Some(incarnation);
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
        if self.hellos.set_interval(interval) {
            self.acquaintance.contradiction = None;
            if let Some(record) = &mut self.neighbour {
                record.echoed = None;
            }
        }
    }

    /// How often hellos are sent.
    pub fn hello_interval(&self) -> Duration {
        self.hellos.interval
    }

    /// When the neighbour's last hello was received, if it is known.
    pub fn last_hello(&self) -> Option<Instant> {
        self.neighbour.as_ref().map(|record| record.received_at)
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
        if self.acquaintance.authenticated.is_some_and(|proved| proved != hello.incarnation) {
            self.refusals.unexpected += 1;
            return;
        }
        self.acquaintance.forget_refusals();
        let HelloArrival::New { missed } = self.meet(&hello, interval, now) else { return };
        self.damping.handle_hello(missed);
        self.listen(&hello, missed, now);
        self.judge_quality(now);
        if self.carries() && hello.state == HelloState::Down {
            self.go_down("the neighbour has given it up", now);
        }
        self.rise(now);
    }

    fn listen(&mut self, hello: &Hello, missed: u32, now: Instant) {
        let Some(record) = &mut self.neighbour else { return };
        record.received_at = now;
        record.stall.count = 0;
        record.state_there = hello.state;
        record.loss_there = hello.loss_permille;
        if let Some(echo) = hello.echo.filter(|echo| echo.incarnation == self.config.incarnation) {
            let newest = record
                .echoed
                .is_none_or(|(sequence, _)| echo.sequence.wrapping_sub(sequence).cast_signed() > 0);
            if let Some(sent) = self.hellos.sent_at(echo.sequence).filter(|_| newest) {
                record.echoed = Some((echo.sequence, now));
                record.answered = sent;
                let held = Duration::from_micros(echo.held_us.into());
                // The echo has waited here for as long as this node was not run.
                let waited = held + self.hellos.late;
                record.quality.handle_round_trip((now - sent).saturating_sub(waited));
            }
        }
        record.hellos_received = match record.echoed {
            // A link that loses a third of what it carries never proves itself.
            Some(_) => after(record.hellos_received, missed),
            None => 0,
        };
    }

    fn judge_quality(&mut self, now: Instant) {
        let Some(record) = &mut self.neighbour else { return };
        let Some(loss) = record.arrivals.loss_permille() else { return };
        if record.quality.judge(loss.max(record.loss_there), self.hellos.interval, now) {
            self.outputs.push_back(LinkOutput::Quality(record.quality.quality()));
        }
    }

    /// When the neighbour will have been silent, or deaf, for so long past the expected hello.
    fn silent_at(&self, after_percent: u32) -> Option<Instant> {
        let record = self.neighbour.as_ref()?;
        Some(record.silent_at(after_percent, self.hellos.interval))
    }

    fn down_after_percent(&self) -> u32 {
        Self::DOWN_AFTER_PERCENT + 100 * hellos_beyond_three(self.quality().loss_permille)
    }

    fn go_down(&mut self, reason: &'static str, now: Instant) {
        self.damping.handle_failure(2 * self.config.up_after_hellos, now);
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
        self.damping.proving &= state == LinkState::Suspect;
        let neighbour = self.neighbour().cloned();
        self.outputs.push_back(LinkOutput::Changed { state, neighbour, reason });
    }

    fn say_hello(&mut self, now: Instant) {
        let sequence = self.hellos.advance(now);
        let hello = self.hello(now, sequence);
        self.hellos.handle_sent(sequence, now);
        self.outputs.push_back(LinkOutput::Transmit(Frame::Hello(hello).parcel()));
        self.probe_path(now);
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
            interval_us: u32::try_from(self.hellos.interval.as_micros()).unwrap_or(u32::MAX),
            skipped: self.hellos.skipped(sequence),
            state: self.hello_state(),
            loss_permille: lost.unwrap_or(0),
            echo,
        }
    }

    fn report_absence(&mut self) {
        self.expected_by = None;
        // The refused node at the other end was reported, which says more.
        if self.acquaintance.refused.is_none() {
            let hello_received = self.neighbour.is_some();
            self.outputs.push_back(LinkOutput::Missing { hello_received });
        }
    }

    fn suspect(&mut self, now: Instant) {
        self.damping.handle_failure(1, now);
        self.change(LinkState::Suspect, "a hello is late");
    }

    /// Whether the hellos of a suspect link are received again, and it carries only what has no
    /// other path because of how often it has failed.
    pub fn is_proving(&self) -> bool {
        self.damping.proving
    }

    /// Raises the state after a hello, if it has proved enough.
    fn rise(&mut self, now: Instant) {
        let Some(record) = &self.neighbour else { return };
        let (received, usual) = (record.hellos_received, self.config.up_after_hellos);
        match self.state {
            LinkState::Up => {}
            LinkState::Suspect => {
                let late = self.silent_at(Self::SUSPECT_AFTER_PERCENT);
                if late.is_some_and(|due| due <= now) {
                    return;
                }
                if self.damping.is_over(now) {
                    self.change(LinkState::Up, "the neighbour is heard again");
                } else if !std::mem::replace(&mut self.damping.proving, true) {
                    self.change(LinkState::Suspect, "heard again, and not yet trusted");
                }
            }
            LinkState::Connecting | LinkState::Down => {
                if received < usual || record.state_there != HelloState::Ready {
                    return;
                }
                if self.damping.is_over(now) {
                    self.change(LinkState::Up, "the neighbour is heard and hears");
                } else {
                    self.damping.proving = true;
                    self.change(LinkState::Suspect, "heard again, and not yet trusted");
                }
            }
        }
    }

    /// Whether enough hellos were received in both directions.
    fn has_proved(&self) -> bool {
        let enough =
            |record: &NeighbourRecord| record.hellos_received >= self.config.up_after_hellos;
        self.neighbour.as_ref().is_some_and(enough)
    }

    fn hello_state(&self) -> HelloState {
        match self.state {
            LinkState::Up | LinkState::Suspect => HelloState::Ready,
            LinkState::Connecting | LinkState::Down if self.has_proved() => HelloState::Ready,
            LinkState::Connecting => HelloState::Unproved,
            LinkState::Down => HelloState::Down,
        }
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
        self.hellos.late = late;
        let down_after = self.down_after_percent();
        if let Some(record) = &mut self.neighbour {
            if late > self.hellos.interval {
                let interval = record.arrivals.interval();
                record.stall.extend(percent(interval, down_after), now);
                record.stall.stalled = late;
            } else if late > Self::LATE {
                record.stall.extend(late, now);
            }
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
