//! One use of one transport towards one neighbour: is it alive, and how good is it?
//!
//! ```text
//!              N hellos, heard both ways
//! Connecting ───────────────────────────► Up ⇄ Suspect     a hello is late / is here again
//!                                          ▲      │ still none
//!                 2N, 4N … hellos          │      ▼
//!                └─────────────────────────┴──── Down      it must prove itself again
//! ```
//!
//! A link does not queue, repeat or order anything: that is the session's business, end to end.

use super::arrival::{Arrival, Arrivals};
use super::frame::{Echo, Frame, Hello};
use super::node_id::NodeId;
use super::wire::{Refusals, WireError};
use crate::{Incarnation, Instant, Machine, NodeName};
use bytes::Bytes;
use std::collections::VecDeque;
use std::fmt;
use std::time::Duration;

/// How a link behaves.
#[derive(Clone, Debug)]
pub struct LinkConfig {
    /// Our own name.
    pub node: NodeName,
    /// Our own life.
    pub incarnation: Incarnation,
    /// Who must be at the other end; `None` takes whoever speaks first.
    pub expected: Option<NodeName>,
    /// How often we say hello. Shorter finds a dead link sooner and costs more.
    pub hello_interval: Duration,
    /// So many percent of an interval after its time, a missing hello makes the link suspect: traffic
    /// avoids it where it can. Lower fails over sooner, and more often for nothing.
    pub suspect_after_percent: u32,
    /// So many percent of an interval after its time, a missing hello takes the link down. On a link
    /// that loses hellos anyway, more must be missing, so that loss alone takes it down once in some
    /// 100,000 hellos.
    pub down_after_percent: u32,
    /// So many hellos in a row bring a new link up; a link that was down needs twice as many for
    /// each time that it went down lately.
    pub proof: u32,
    /// A link that loses more than this of a thousand hellos is degraded.
    pub degraded_loss_permille: u16,
    /// A link whose round trip takes longer than this is degraded.
    pub degraded_round_trip: Duration,
}

impl LinkConfig {
    /// The usual behaviour for this node.
    pub fn new(node: NodeName, incarnation: Incarnation) -> Self {
        LinkConfig {
            node,
            incarnation,
            expected: None,
            // A process that shares its cores stands still for some 100 ms when they are overloaded;
            // with 50 ms, such a link is suspect, and not yet down.
            hello_interval: Duration::from_millis(50),
            // Expected at 1, suspect at 2, down at 3.5 intervals after the last hello: two lost in a
            // row divert traffic, three take the link down (ITU-T G.8013: 3.5 intervals).
            suspect_after_percent: 100,
            down_after_percent: 250,
            proof: 3,
            degraded_loss_permille: 100,
            degraded_round_trip: Duration::from_millis(250),
        }
    }
}

/// What is known of a link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum LinkState {
    /// Nobody has proved yet to be at the other end.
    Connecting,
    /// The neighbour is heard and hears.
    Up,
    /// A hello is late. Traffic goes elsewhere where it can; nothing is torn down.
    Suspect,
    /// The neighbour is not heard, or does not hear; it must prove itself again.
    Down,
}

impl fmt::Display for LinkState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            LinkState::Connecting => "connecting",
            LinkState::Up => "up",
            LinkState::Suspect => "suspect",
            LinkState::Down => "down",
        })
    }
}

/// Who is at the other end of a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Neighbour {
    /// Its name.
    pub node: NodeName,
    /// Which of its lives.
    pub incarnation: Incarnation,
}

/// How good a link is, as measured.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Quality {
    /// The smoothed round trip; `None` before the first.
    pub round_trip: Option<Duration>,
    /// Its smoothed deviation.
    pub jitter: Duration,
    /// How many of a thousand of the neighbour's hellos were lost, over the last 64.
    pub loss_permille: u16,
    /// One of them is beyond its limit.
    pub degraded: bool,
}

/// Why a link does not take the one who speaks on it.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum LinkRefusal {
    /// Two nodes have one name. Give one of them another.
    #[error("another node is also called {node}")]
    NameTaken {
        /// The name.
        node: NodeName,
    },
    /// Two names give one number. Give one of the nodes another name.
    #[error("the names {node} and {other} give the same node number {}", NodeId::of(.node))]
    NumberTaken {
        /// Our name.
        node: NodeName,
        /// The other's.
        other: NodeName,
    },
    /// The cable is plugged in elsewhere, or the configured address is another node's.
    #[error("{found} is at the other end, {expected} is expected")]
    WrongNeighbour {
        /// Who should be there.
        expected: NodeName,
        /// Who is.
        found: NodeName,
    },
}

/// What a link wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum LinkOutput {
    /// Give this frame to the transport.
    Transmit(Bytes),
    /// The link is now in another state.
    Changed {
        /// Which.
        state: LinkState,
        /// Who is, or was, at the other end.
        neighbour: Option<Neighbour>,
        /// Why, for people.
        reason: &'static str,
    },
    /// The link became degraded, or good again.
    Quality(Quality),
    /// Whoever is at the other end is not taken.
    Refused(LinkRefusal),
    /// For the router: what the neighbour's router says.
    Routing(Bytes),
    /// For the router: a packet.
    Packet(Bytes),
}

/// The machine of one link.
#[derive(Debug)]
pub struct Link {
    config: LinkConfig,
    state: LinkState,
    neighbour: Option<Heard>,
    next_hello: Instant,
    /// When the last hellos went out, for the round trip: number and time.
    sent: VecDeque<(u32, Instant)>,
    /// How often it went down lately, and when last.
    flaps: u32,
    last_down: Instant,
    quality: Quality,
    refused: Option<LinkRefusal>,
    refusals: Refusals,
    outputs: VecDeque<LinkOutput>,
}

/// What we know of whoever speaks.
#[derive(Debug)]
struct Heard {
    neighbour: Neighbour,
    arrivals: Arrivals,
    last: Instant,
    /// Hellos since the last silence, while it hears us.
    proved: u32,
    /// When its echo last told something new, and which of our hellos that was.
    echoed: Option<(u32, Instant)>,
    /// Silence before this does not count: we ourselves stood still.
    excused_until: Instant,
}

impl Link {
    /// The shortest interval that a neighbour may announce: shorter ones are an attack or an error.
    const INTERVAL_MIN: Duration = Duration::from_millis(1);
    /// The longest: a link must be known to be dead within a minute.
    const INTERVAL_MAX: Duration = Duration::from_secs(15);
    /// Remembered hellos: enough for round trips of so many intervals.
    const SENT_MAX: usize = 64;
    /// A link that stayed up for so long has proved itself; earlier flaps are forgotten.
    const FLAP_MEMORY: Duration = Duration::from_secs(10);
    /// 16 times the usual proof at most, so that a repaired link comes back within seconds.
    const FLAPS_MAX: u32 = 4;

    /// A link that says its first hello at once.
    pub fn new(config: LinkConfig, now: Instant) -> Self {
        Link {
            config,
            state: LinkState::Connecting,
            neighbour: None,
            next_hello: now,
            sent: VecDeque::with_capacity(Self::SENT_MAX),
            flaps: 0,
            last_down: Instant::ORIGIN,
            quality: Quality::default(),
            refused: None,
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
        }
    }

    /// The present state.
    pub fn state(&self) -> LinkState {
        self.state
    }

    /// Who is, or was last, at the other end.
    pub fn neighbour(&self) -> Option<&Neighbour> {
        self.neighbour.as_ref().map(|heard| &heard.neighbour)
    }

    /// How good it is.
    pub fn quality(&self) -> Quality {
        self.quality
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// Sends something of the router's. Dropped and counted when the link is not up.
    pub fn handle_routing(&mut self, bytes: Bytes) {
        self.carry(Frame::Routing(bytes));
    }

    /// Sends a packet. Dropped and counted when the link is not up.
    pub fn handle_packet(&mut self, packet: Bytes) {
        self.carry(Frame::Data(packet));
    }

    fn carry(&mut self, frame: Frame) {
        if self.carries() {
            self.outputs.push_back(LinkOutput::Transmit(frame.encode()));
        } else {
            self.refusals.unexpected += 1;
        }
    }

    fn carries(&self) -> bool {
        matches!(self.state, LinkState::Up | LinkState::Suspect)
    }

    /// A frame came from the transport.
    pub fn handle_frame(&mut self, frame: Bytes, now: Instant) {
        match Frame::decode(frame) {
            Ok(Frame::Hello(hello)) => self.handle_hello(hello, now),
            Ok(Frame::Routing(_) | Frame::Data(_)) if !self.carries() => {
                self.refusals.unexpected += 1;
            }
            Ok(Frame::Routing(bytes)) => self.outputs.push_back(LinkOutput::Routing(bytes)),
            Ok(Frame::Data(packet)) => self.outputs.push_back(LinkOutput::Packet(packet)),
            Err(error) => self.refusals.count(&error),
        }
    }

    /// The transport knows that the medium, or the connection, is gone: no need to wait for silence.
    pub fn handle_loss(&mut self, now: Instant) {
        if self.carries() {
            self.go_down("the transport lost the neighbour", now);
        }
    }

    /// We ourselves were not scheduled until `now`: every silence up to now is void.
    pub fn handle_stall(&mut self, now: Instant) {
        let patience = self.down_after_percent();
        if let Some(heard) = &mut self.neighbour {
            heard.excused_until = now + percent(heard.arrivals.interval(), patience);
        }
    }

    fn handle_hello(&mut self, hello: Hello, now: Instant) {
        let interval = Duration::from_micros(hello.interval_us.into());
        if interval < Self::INTERVAL_MIN || interval > Self::INTERVAL_MAX {
            self.refusals.count(&WireError::Malformed { what: "a hello's interval" });
            return;
        }
        if let Err(refusal) = self.check_name(&hello) {
            self.refuse(refusal);
            return;
        }
        self.refused = None;
        let known = self.neighbour.as_ref().map(|heard| &heard.neighbour);
        let ended = known
            .is_some_and(|known| known.node == hello.node && hello.incarnation < known.incarnation);
        if ended || self.meet(&hello, interval, now) == Arrival::Old {
            self.refusals.stale += 1;
            return;
        }
        self.listen(&hello, now);
        self.judge_quality();
        self.rise(now);
    }

    fn check_name(&mut self, hello: &Hello) -> Result<(), Option<LinkRefusal>> {
        let (ours, theirs) = (&self.config.node, &hello.node);
        if ours == theirs {
            // Our own hello may come back from a medium that echoes: no node, no refusal.
            let echoed = hello.incarnation == self.config.incarnation;
            return Err((!echoed).then(|| LinkRefusal::NameTaken { node: ours.clone() }));
        }
        if NodeId::of(ours) == NodeId::of(theirs) {
            let (node, other) = (ours.clone(), theirs.clone());
            return Err(Some(LinkRefusal::NumberTaken { node, other }));
        }
        let present = self.carries().then_some(self.neighbour.as_ref()).flatten();
        let expected = self.config.expected.as_ref().or(present.map(|heard| &heard.neighbour.node));
        match expected {
            Some(expected) if expected != theirs => Err(Some(LinkRefusal::WrongNeighbour {
                expected: expected.clone(),
                found: theirs.clone(),
            })),
            _ => Ok(()),
        }
    }

    /// Counts every refusal, and tells each only when it is another than the last.
    fn refuse(&mut self, refusal: Option<LinkRefusal>) {
        self.refusals.unexpected += 1;
        if refusal.is_some() && refusal != self.refused {
            self.refused.clone_from(&refusal);
            self.outputs.extend(refusal.map(LinkOutput::Refused));
        }
    }

    /// Who is there, and when is the next hello due? A new neighbour, or a new life of the old one,
    /// begins from nothing. An old or doubled hello says nothing.
    fn meet(&mut self, hello: &Hello, interval: Duration, now: Instant) -> Arrival {
        let neighbour = Neighbour { node: hello.node.clone(), incarnation: hello.incarnation };
        let arrivals = Arrivals::new(interval, hello.sequence, now);
        match &mut self.neighbour {
            Some(heard) if heard.neighbour == neighbour => {
                if heard.arrivals.interval() == interval {
                    return heard.arrivals.handle(hello.sequence, now);
                }
                heard.arrivals = arrivals;
            }
            _ => {
                if self.carries() {
                    self.go_down("the neighbour has restarted", now);
                }
                let excused_until = Instant::ORIGIN;
                let heard = Heard {
                    neighbour,
                    arrivals,
                    last: now,
                    proved: 0,
                    echoed: None,
                    excused_until,
                };
                self.neighbour = Some(heard);
                self.quality = Quality::default();
            }
        }
        Arrival::New
    }

    fn listen(&mut self, hello: &Hello, now: Instant) {
        let Some(heard) = &mut self.neighbour else { return };
        heard.last = now;
        if let Some(echo) = hello.echo.filter(|echo| echo.incarnation == self.config.incarnation) {
            let newest = heard
                .echoed
                .is_none_or(|(sequence, _)| echo.sequence.wrapping_sub(sequence).cast_signed() > 0);
            let sent = self.sent.iter().find(|(sequence, _)| *sequence == echo.sequence);
            if let (true, Some((_, sent))) = (newest, sent) {
                heard.echoed = Some((echo.sequence, now));
                let held = Duration::from_micros(echo.held_us.into());
                measure(&mut self.quality, (now - *sent).saturating_sub(held));
            }
        }
        heard.proved = if heard.echoed.is_some() { heard.proved.saturating_add(1) } else { 0 };
    }

    fn judge_quality(&mut self) {
        let Some(loss) = self.neighbour.as_ref().and_then(|heard| heard.arrivals.loss_permille())
        else {
            return;
        };
        self.quality.loss_permille = loss;
        let LinkConfig { degraded_loss_permille, degraded_round_trip, .. } = self.config;
        let round_trip = self.quality.round_trip.unwrap_or_default();
        // Half the limit clears it, so that a link at its limit does not report all day.
        let degraded = if self.quality.degraded {
            loss > degraded_loss_permille / 2 || round_trip > degraded_round_trip / 2
        } else {
            loss > degraded_loss_permille || round_trip > degraded_round_trip
        };
        if degraded != self.quality.degraded {
            self.quality.degraded = degraded;
            self.outputs.push_back(LinkOutput::Quality(self.quality));
        }
    }

    /// A hello was heard: does it lift the state?
    fn rise(&mut self, now: Instant) {
        let Some(heard) = &self.neighbour else { return };
        match self.state {
            LinkState::Up => {}
            LinkState::Suspect => {
                if self.due(self.config.suspect_after_percent).is_none_or(|due| due > now) {
                    self.change(LinkState::Up, "the neighbour is heard again");
                }
            }
            LinkState::Connecting | LinkState::Down => {
                if now - self.last_down > Self::FLAP_MEMORY {
                    self.flaps = 0;
                }
                if heard.proved >= self.config.proof << self.flaps {
                    self.change(LinkState::Up, "the neighbour is heard and hears");
                }
            }
        }
    }

    /// When silence, or deafness of the neighbour, will have lasted so long past the expected hello.
    fn due(&self, after_percent: u32) -> Option<Instant> {
        let heard = self.neighbour.as_ref()?;
        let interval = heard.arrivals.interval();
        let silent = heard.arrivals.expected() + percent(interval, after_percent);
        let deaf = heard.echoed.map_or(heard.last, |(_, at)| at)
            // An echo needs both directions: twice the patience, in the slower one's intervals.
            + percent(interval.max(self.config.hello_interval), 2 * (100 + after_percent));
        Some(silent.min(deaf).max(heard.excused_until))
    }

    fn down_after_percent(&self) -> u32 {
        self.config.down_after_percent + 100 * hellos_beyond_three(self.quality.loss_permille)
    }

    fn go_down(&mut self, reason: &'static str, now: Instant) {
        if now - self.last_down > Self::FLAP_MEMORY {
            self.flaps = 0;
        }
        self.flaps = (self.flaps + 1).min(Self::FLAPS_MAX);
        self.last_down = now;
        if let Some(heard) = &mut self.neighbour {
            heard.proved = 0;
            heard.echoed = None;
        }
        self.change(LinkState::Down, reason);
    }

    fn change(&mut self, state: LinkState, reason: &'static str) {
        self.state = state;
        let neighbour = self.neighbour().cloned();
        self.outputs.push_back(LinkOutput::Changed { state, neighbour, reason });
    }

    fn say_hello(&mut self, now: Instant) {
        // Numbered and sent by the absolute schedule, never "an interval after the last one": a late
        // hello must not shift the later ones. Counted from the clock's origin, the number also
        // goes on rising when this machine is built anew in a running process.
        let interval = self.config.hello_interval.max(Self::INTERVAL_MIN);
        let nanos = interval.as_nanos() as u64;
        let number = now.as_nanos() / nanos;
        self.next_hello = Instant::from_nanos((number + 1).saturating_mul(nanos));
        let echo = self.neighbour.as_ref().map(|heard| Echo {
            incarnation: heard.neighbour.incarnation,
            sequence: heard.arrivals.highest(),
            held_us: u32::try_from((now - heard.last).as_micros()).unwrap_or(u32::MAX),
        });
        let hello = Hello {
            node: self.config.node.clone(),
            incarnation: self.config.incarnation,
            sequence: number as u32,
            interval_us: u32::try_from(interval.as_micros()).unwrap_or(u32::MAX),
            echo,
        };
        if self.sent.len() == Self::SENT_MAX {
            self.sent.pop_front();
        }
        self.sent.push_back((hello.sequence, now));
        self.outputs.push_back(LinkOutput::Transmit(Frame::Hello(hello).encode()));
    }

    fn judge_silence(&mut self, now: Instant) {
        let past = |due: Option<Instant>| due.is_some_and(|due| due <= now);
        let down = past(self.due(self.down_after_percent()));
        match self.state {
            LinkState::Up | LinkState::Suspect if down => {
                self.go_down("the neighbour is not heard, or does not hear", now);
            }
            LinkState::Up if past(self.due(self.config.suspect_after_percent)) => {
                self.change(LinkState::Suspect, "a hello is late");
            }
            LinkState::Connecting | LinkState::Down if down => {
                if let Some(heard) = &mut self.neighbour {
                    heard.proved = 0;
                    heard.echoed = None;
                }
            }
            _ => {}
        }
    }
}

impl Machine for Link {
    type Output = LinkOutput;

    fn poll_output(&mut self) -> Option<LinkOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let silence = match self.state {
            LinkState::Up => self.due(self.config.suspect_after_percent),
            LinkState::Suspect => self.due(self.down_after_percent()),
            // Looked at with the next hello: nobody depends on a link that is not up.
            LinkState::Connecting | LinkState::Down => None,
        };
        silence.into_iter().chain([self.next_hello]).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        let due = self.poll_timeout().unwrap_or(now);
        // Woken so late, we are the one who stood still; the neighbour's hellos wait unread.
        if now - due > self.config.hello_interval {
            self.handle_stall(now);
        }
        if self.next_hello <= now {
            self.say_hello(now);
        }
        self.judge_silence(now);
    }
}

fn percent(span: Duration, percent: u32) -> Duration {
    span * percent / 100
}

/// How many more than three hellos must be lost in a row until that is less likely than 1 in 100,000.
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

/// RFC 6298's smoothing: an eighth of each new round trip, a quarter of each deviation.
fn measure(quality: &mut Quality, sample: Duration) {
    match quality.round_trip {
        None => {
            quality.round_trip = Some(sample);
            quality.jitter = sample / 2;
        }
        Some(smoothed) => {
            let deviation = smoothed.abs_diff(sample);
            quality.jitter = (quality.jitter * 3 + deviation) / 4;
            quality.round_trip = Some((smoothed * 7 + sample) / 8);
        }
    }
}

#[cfg(test)]
mod tests;
