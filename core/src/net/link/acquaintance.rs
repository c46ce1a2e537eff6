//! Which node sends on a link, and in which incarnation.
//!
//! ```text
//!    neighbour                             we
//!        │ hello 7, unknown incarnation ─────► │  a claimant, and no more
//!        │ ◄──────── hello 40, echo of that 7  │
//!        │ hello 8, echo of our 40 ──────────► │  it runs now, and receives: it is the neighbour
//! ```
//!
//! A hello that continues the neighbour's series is accepted at once. Any other (another
//! incarnation, another interval, a number that was passed or is far ahead) makes its sender a
//! *claimant*. The claimant becomes the neighbour with a further hello that continues its series
//! and echoes a hello that we sent after its first, if the neighbour has been silent since although
//! a hello was due. A hello with a changed bit is not continued, a forged one has no echo, and one
//! of an earlier incarnation echoes hellos that we sent while that incarnation ran.
//!
//! Recorded hellos cannot echo hellos that we sent later. A hello with a later echo therefore
//! replaces a claimant with an earlier one: replayed hellos neither keep a node from becoming the
//! neighbour nor keep the link, also if this node has restarted and received the replay first.
//!
//! The present incarnation is the one that answers, not the one with the greater number: a node
//! whose clock was set back while it was off is found as fast as any other. Of two that both
//! answer, the first keeps the link.

use super::quality::QualityEstimator;
use super::{Link, Neighbour, NeighbourRecord, PeerRefusal};
use crate::net::link::arrival::{ArrivalEstimator, HelloArrival};
use crate::net::wire::frame::Hello;
use crate::net::wire::node_id::NodeId;
use crate::{Incarnation, Instant};
use std::time::Duration;

/// A hello's number may be ahead by so many more intervals than have passed since the last one was
/// received, which may have been delayed. The numbers in between count as missed.
const AHEAD_MAX: u64 = 2;

/// Of numbers that were passed, so many are remembered.
const BEHIND_MAX: i32 = 64;

/// The sender of hellos that contradict what is known of the neighbour.
#[derive(Debug)]
pub(super) struct Claimant {
    neighbour: Neighbour,
    interval: Duration,
    /// Its last hello's number, and when it was received.
    sequence: u32,
    last: Instant,
    /// Our first hello that is later than its first.
    challenge: u32,
    /// The latest of our hellos that it has echoed.
    answered: Option<u32>,
}

impl Link {
    pub(super) fn check_name(&mut self, hello: &Hello) -> Result<(), Option<PeerRefusal>> {
        let (ours, theirs) = (&self.config.node, &hello.node);
        if ours == theirs {
            // A medium that echoes returns our own hello: that is no other node.
            let echoed = hello.incarnation == self.config.incarnation;
            return Err((!echoed).then(|| PeerRefusal::NameTaken { node: ours.clone() }));
        }
        if NodeId::of(ours) == NodeId::of(theirs) {
            let (node, other) = (ours.clone(), theirs.clone());
            return Err(Some(PeerRefusal::NumberTaken { node, other }));
        }
        let present = self.carries().then_some(self.neighbour.as_ref()).flatten();
        let expected =
            self.config.expected.as_ref().or(present.map(|record| &record.neighbour.node));
        match expected {
            Some(expected) if expected != theirs => Err(Some(PeerRefusal::WrongNeighbour {
                expected: expected.clone(),
                found: theirs.clone(),
            })),
            _ => Ok(()),
        }
    }

    /// Counts every refusal. Reports one that occurs twice in a row, unless it was the last
    /// reported.
    pub(super) fn refuse(&mut self, refusal: Option<PeerRefusal>) {
        self.refusals.unexpected += 1;
        if refusal.is_none() || refusal == self.refused {
            return;
        }
        if refusal == self.doubted {
            self.refused.clone_from(&refusal);
            self.outputs.extend(refusal.map(super::LinkOutput::Refused));
        } else {
            self.doubted = refusal;
        }
    }

    /// Whether this is a new hello of the neighbour. Any other is counted as refused.
    pub(super) fn meet(&mut self, hello: &Hello, interval: Duration, now: Instant) -> HelloArrival {
        let Some(record) = &mut self.neighbour else {
            self.begin_with(hello, interval, now);
            return HelloArrival::New { missed: 0 };
        };
        let interval_before = record.arrivals.interval();
        let same = record.neighbour.is(hello);
        if self.authenticated.is_some() {
            // Its key has proved its incarnation, and its seal that the hello is no repeat.
            if same && interval == interval_before {
                let arrival = record.arrivals.handle(hello.sequence, now);
                if arrival == HelloArrival::Old {
                    self.refusals.stale += 1;
                }
                return arrival;
            }
            self.begin_with(hello, interval, now);
            return HelloArrival::New { missed: 0 };
        }
        let highest = record.arrivals.highest();
        if same
            && interval == interval_before
            && !is_far_behind(highest, hello.sequence)
            && !is_far_ahead(highest, hello.sequence, now - record.received_at, interval)
        {
            let arrival = record.arrivals.handle(hello.sequence, now);
            match arrival {
                HelloArrival::New { .. } if record.echoed.is_some() => self.claimant = None,
                // It does not receive our hellos, or is replayed: the claimant stays.
                HelloArrival::New { .. } => {}
                HelloArrival::Old => self.refusals.stale += 1,
            }
            return arrival;
        }
        // By the shorter interval it would be down before its second hello.
        let slower = same && interval > interval_before && self.echo_in(hello).is_some();
        if !slower && !self.has_confirmed(hello, interval, now) {
            match same || self.is_older(hello) {
                true => self.refusals.stale += 1,
                false => self.refusals.unexpected += 1,
            }
            return HelloArrival::Old;
        }
        self.claimant = None;
        self.begin_with(hello, interval, now);
        HelloArrival::New { missed: 0 }
    }

    fn is_older(&self, hello: &Hello) -> bool {
        self.neighbour()
            .is_some_and(|known| known.node == hello.node && hello.incarnation < known.incarnation)
    }

    /// Which of our latest hellos it names.
    fn echo_in(&self, hello: &Hello) -> Option<u32> {
        let echo = hello.echo.filter(|echo| echo.incarnation == self.config.incarnation)?;
        let mut sent = self.sent.iter().map(|(sequence, _)| *sequence);
        sent.find(|sequence| *sequence == echo.sequence)
    }

    /// Whether this hello proves that the claimant, its sender, receives our hellos now, while the
    /// neighbour is silent or does not. Without a claimant, or with one that it outdoes, its sender
    /// becomes the claimant.
    fn has_confirmed(&mut self, hello: &Hello, interval: Duration, now: Instant) -> bool {
        let answered = self.echo_in(hello);
        let silent = self.neighbour.as_ref().is_none_or(|record| {
            // Both are of one incarnation, so of the same node.
            record.neighbour.is(hello)
                || record.arrivals.expected() <= now
                || record.echoed.is_none()
        });
        let challenge = (self.next_hello.as_nanos() / self.interval().as_nanos() as u64) as u32;
        match &mut self.claimant {
            Some(claimant) if claimant.goes_on_with(hello, interval, now) => {
                (claimant.sequence, claimant.last) = (hello.sequence, now);
                claimant.answered = answered.or(claimant.answered);
                silent && answered.is_some_and(|echo| is_from(claimant.challenge, echo))
            }
            // Late, duplicated, or replayed: it replaces no claimant.
            Some(claimant) if !claimant.is_outdone_by(hello, interval, answered) => false,
            _ => {
                self.claimant = Some(Claimant {
                    neighbour: Neighbour::of(hello),
                    interval,
                    sequence: hello.sequence,
                    last: now,
                    challenge,
                    answered,
                });
                false
            }
        }
    }

    /// The claimant's hello that our next hello echoes, if it is the claimant's turn. While the
    /// neighbour sends as well, that is every second hello; and if the neighbour receives ours,
    /// only if the claimant does, too.
    pub(super) fn claimants_turn(&self) -> Option<(Incarnation, u32, Instant)> {
        let (number, sent_at) = self.sent.back().copied().unwrap_or((0, Instant::ORIGIN));
        let claimant = self.claimant.as_ref().filter(|claimant| claimant.last >= sent_at)?;
        let rival = self.neighbour.as_ref().filter(|record| record.received_at >= sent_at);
        let its_turn = rival.is_none_or(|rival| {
            number % 2 == 0 && (claimant.answered.is_some() || rival.echoed.is_none())
        });
        its_turn.then_some((claimant.neighbour.incarnation, claimant.sequence, claimant.last))
    }

    /// Starts with a new neighbour, or with a new incarnation of the present one.
    fn begin_with(&mut self, hello: &Hello, interval: Duration, now: Instant) {
        let arrivals = ArrivalEstimator::new(interval, hello.sequence, now);
        if let Some(record) = &mut self.neighbour
            && record.neighbour.is(hello)
        {
            record.arrivals = arrivals;
            return;
        }
        if self.carries() {
            self.go_down("the neighbour has restarted", now);
        }
        // The link went down because that incarnation ended, which is no flap of the medium.
        self.flaps = 0;
        let record = NeighbourRecord {
            neighbour: Neighbour::of(hello),
            arrivals,
            received_at: now,
            hellos_received: 0,
            stance: hello.stance,
            loss_there: 0,
            turn: 1,
            echoed: None,
            excused_until: Instant::ORIGIN,
            excuses: 0,
        };
        self.neighbour = Some(record);
        self.gauge = QualityEstimator::default();
    }
}

impl Claimant {
    fn goes_on_with(&self, hello: &Hello, interval: Duration, now: Instant) -> bool {
        self.neighbour.is(hello)
            && self.interval == interval
            && hello.sequence.wrapping_sub(self.sequence).cast_signed() > 0
            && !is_far_ahead(self.sequence, hello.sequence, now - self.last, interval)
    }

    /// Whether a hello that does not go on from its last takes its place.
    fn is_outdone_by(&self, hello: &Hello, interval: Duration, answered: Option<u32>) -> bool {
        match (self.answered, answered) {
            (Some(before), Some(answered)) => is_from(before.wrapping_add(1), answered),
            (Some(_), None) => false,
            (None, Some(_)) => true,
            (None, None) => !self.neighbour.is(hello) || self.interval != interval,
        }
    }
}

impl Neighbour {
    fn of(hello: &Hello) -> Self {
        Neighbour { node: hello.node.clone(), incarnation: hello.incarnation }
    }

    fn is(&self, hello: &Hello) -> bool {
        self.incarnation == hello.incarnation && self.node == hello.node
    }
}

/// Whether a number is the first or a later one.
fn is_from(first: u32, number: u32) -> bool {
    number.wrapping_sub(first).cast_signed() >= 0
}

/// Whether a number is too old for a hello that was merely overtaken.
fn is_far_behind(last: u32, number: u32) -> bool {
    last.wrapping_sub(number).cast_signed() >= BEHIND_MAX
}

/// Whether no node that sends a hello per interval can have come to this number.
fn is_far_ahead(last: u32, number: u32, passed: Duration, interval: Duration) -> bool {
    // Serial-number arithmetic (RFC 1982): the nearer way round decides.
    let step = number.wrapping_sub(last).cast_signed();
    let passed = (passed.as_nanos() / interval.as_nanos().max(1)) as u64;
    u64::try_from(step).is_ok_and(|step| step > passed.saturating_add(AHEAD_MAX))
}
