//! Who speaks, and whether to believe it.
//!
//! ```text
//!    neighbour                             we
//!        │ hello 7 of a life unknown to us ──► │  a claimant, and no more
//!        │ ◄──────── hello 40, echo of that 7  │
//!        │ hello 8, echo of our 40 ──────────► │  it lives now, and hears us: it is the neighbour
//! ```
//!
//! A hello that goes on from the neighbour's last one is taken at once. One that does not (another
//! life, another interval, a number that was passed or is far ahead) makes a *claimant*. It becomes
//! the neighbour with a further hello that goes on from its first, and that echoes what we said
//! only after that, if the neighbour has been silent since, and should not have been. A hello with
//! a changed bit has no sequel, one that was made up without hearing us no echo, and one of a life
//! that is over echoes what we said while that life was there.
//!
//! What was recorded and comes again cannot echo what we said later. So a hello that echoes more of
//! us outdoes one that echoes less: whoever repeats the past keeps nobody from becoming the
//! neighbour, and does not stay it, also where we began anew and heard the past first.
//!
//! Which life is the present one is thus decided by who answers, and not by whose number is
//! greater: a node whose clock was set back while it was off is no worse off than another. Of two
//! that both answer, the first has the link.

use super::quality::QualityEstimator;
use super::{Link, Neighbour, NeighbourRecord, PeerRefusal};
use crate::net::link::arrival::{ArrivalEstimator, HelloArrival};
use crate::net::wire::frame::Hello;
use crate::net::wire::node_id::NodeId;
use crate::{Incarnation, Instant};
use std::time::Duration;

/// A hello's number may be ahead by so many more intervals than have passed since the last one
/// came, which may have waited on its way. Those that it has passed are missed, and two may be.
const AHEAD_MAX: u64 = 2;

/// Of numbers that were passed, so many are remembered.
const BEHIND_MAX: i32 = 64;

/// The sender of hellos that contradict what is known of the neighbour.
#[derive(Debug)]
pub(super) struct Claimant {
    neighbour: Neighbour,
    interval: Duration,
    /// Its last hello's number, and when it came.
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
            // Our own hello may come back from a medium that echoes: no node, no refusal.
            let echoed = hello.incarnation == self.config.incarnation;
            return Err((!echoed).then(|| PeerRefusal::NameTaken { node: ours.clone() }));
        }
        if NodeId::of(ours) == NodeId::of(theirs) {
            let (node, other) = (ours.clone(), theirs.clone());
            return Err(Some(PeerRefusal::NumberTaken { node, other }));
        }
        let present = self.carries().then_some(self.neighbour.as_ref()).flatten();
        let expected = self.config.expected.as_ref().or(present.map(|heard| &heard.neighbour.node));
        match expected {
            Some(expected) if expected != theirs => Err(Some(PeerRefusal::WrongNeighbour {
                expected: expected.clone(),
                found: theirs.clone(),
            })),
            _ => Ok(()),
        }
    }

    /// Counts every refusal. Tells each the second time in a row, and only when it is another than
    /// the last that was told.
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

    /// Is it the neighbour who speaks, and when is the next hello due? What says nothing is
    /// counted.
    pub(super) fn meet(&mut self, hello: &Hello, interval: Duration, now: Instant) -> HelloArrival {
        let Some(heard) = &mut self.neighbour else {
            self.begin_with(hello, interval, now);
            return HelloArrival::New { missed: 0 };
        };
        let interval_before = heard.arrivals.interval();
        let same = heard.neighbour.is(hello);
        let highest = heard.arrivals.highest();
        if same
            && interval == interval_before
            && !is_far_behind(highest, hello.sequence)
            && !is_far_ahead(highest, hello.sequence, now - heard.last, interval)
        {
            let arrival = heard.arrivals.handle(hello.sequence, now);
            match arrival {
                HelloArrival::New { .. } if heard.echoed.is_some() => self.claimant = None,
                // It does not receive us, or is of the past: another node may.
                HelloArrival::New { .. } => {}
                HelloArrival::Old => self.refusals.stale += 1,
            }
            return arrival;
        }
        // It would be given up before it had said a second hello.
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

    /// Whether this hello shows that the claimant, whose it is, hears us now, while the neighbour
    /// is silent or does not. If there was none, or one that says less, its is the claim from now
    /// on.
    fn has_confirmed(&mut self, hello: &Hello, interval: Duration, now: Instant) -> bool {
        let answered = self.echo_in(hello);
        let silent = self.neighbour.as_ref().is_none_or(|heard| {
            // Of one life, it is the same end that says both.
            heard.neighbour.is(hello) || heard.arrivals.expected() <= now || heard.echoed.is_none()
        });
        let challenge = (self.next_hello.as_nanos() / self.interval().as_nanos() as u64) as u32;
        match &mut self.claimant {
            Some(claimant) if claimant.goes_on_with(hello, interval, now) => {
                (claimant.sequence, claimant.last) = (hello.sequence, now);
                claimant.answered = answered.or(claimant.answered);
                silent && answered.is_some_and(|echo| is_from(claimant.challenge, echo))
            }
            // Late, duplicated, or of the past: it replaces no known neighbour.
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

    /// What our next hello echoes, if it is the claimant's turn: while the neighbour speaks as
    /// well, every other time, and where that hears us, only if the claimant does, too.
    pub(super) fn claimants_turn(&self) -> Option<(Incarnation, u32, Instant)> {
        let (number, said) = self.sent.back().copied().unwrap_or((0, Instant::ORIGIN));
        let claimant = self.claimant.as_ref().filter(|claimant| claimant.last >= said)?;
        let rival = self.neighbour.as_ref().filter(|heard| heard.last >= said);
        let its_turn = rival.is_none_or(|rival| {
            number % 2 == 0 && (claimant.answered.is_some() || rival.echoed.is_none())
        });
        its_turn.then_some((claimant.neighbour.incarnation, claimant.sequence, claimant.last))
    }

    /// A new neighbour, or a new life of the old one, begins from nothing.
    fn begin_with(&mut self, hello: &Hello, interval: Duration, now: Instant) {
        let arrivals = ArrivalEstimator::new(interval, hello.sequence, now);
        if let Some(heard) = &mut self.neighbour
            && heard.neighbour.is(hello)
        {
            heard.arrivals = arrivals;
            return;
        }
        if self.carries() {
            self.go_down("the neighbour has restarted", now);
        }
        // That the link went down was the old life's end, and says nothing of the medium.
        self.flaps = 0;
        let heard = NeighbourRecord {
            neighbour: Neighbour::of(hello),
            arrivals,
            last: now,
            hellos_received: 0,
            stance: hello.stance,
            loss_there: 0,
            turn: 1,
            echoed: None,
            excused_until: Instant::ORIGIN,
            excuses: 0,
        };
        self.neighbour = Some(heard);
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
