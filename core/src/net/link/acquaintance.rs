//! Which node sends on a link, and in which incarnation.
//!
//! Where frames are sealed, the neighbour's key has proved both, and no frame comes twice.
//! Elsewhere a hello that continues the neighbour's series is accepted at once. Any other (another
//! incarnation, another interval, a number far ahead) is accepted when the sender's next hello says
//! the same, and the neighbour is silent although a hello was due, or has never been shown to
//! receive ours. So a hello with a changed bit, one of an earlier incarnation that was late, and a
//! second node of one name take no link down. A forger does: only keys refuse it.
//!
//! The present incarnation is the one that sends, not the one with the greater number: a node whose
//! clock was set back while it was off is found as fast as any other. Of two that both send, the
//! first keeps the link.

use super::quality::QualityEstimator;
use super::{Link, Neighbour, NeighbourRecord, PeerRefusal};
use crate::Instant;
use crate::net::link::arrival::{ArrivalEstimator, HelloArrival};
use crate::net::wire::frame::Hello;
use crate::net::wire::node_id::NodeId;
use std::time::Duration;

/// A hello's number may be ahead by so many more intervals than have passed since the last one was
/// received, which may have been delayed, or have waited while this node was not run. The numbers
/// in between count as missed.
const AHEAD_MAX: i64 = 2;

/// A hello that so many later ones have overtaken is none that was merely late.
const BEHIND_MAX: i64 = 64;

/// The last hello that contradicts what is known of the neighbour.
#[derive(Debug)]
pub(super) struct Contradiction {
    neighbour: Neighbour,
    interval: Duration,
    sequence: u32,
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
        let same = record.neighbour.is(hello) && interval == record.arrivals.interval();
        let stalled = if now < record.excused_until { record.stalled } else { Duration::ZERO };
        let (highest, passed) = (record.arrivals.highest(), now - record.received_at + stalled);
        if same && !is_far_off(highest, hello.sequence, passed, interval) {
            let arrival = record.arrivals.handle(hello.sequence, hello.skipped, now);
            match arrival {
                HelloArrival::New { .. } => self.contradiction = None,
                HelloArrival::Old => self.refusals.stale += 1,
            }
            return arrival;
        }
        // By the shorter interval it would be down before its second hello.
        let slower = record.neighbour.is(hello) && interval > record.arrivals.interval();
        if self.authenticated.is_none() && !slower && !self.is_confirmed(hello, interval, now) {
            match self.is_known(hello) {
                true => self.refusals.stale += 1,
                false => self.refusals.unexpected += 1,
            }
            return HelloArrival::Old;
        }
        self.begin_with(hello, interval, now);
        HelloArrival::New { missed: 0 }
    }

    /// Whether it is of the neighbour's present incarnation, or of an earlier one.
    fn is_known(&self, hello: &Hello) -> bool {
        self.neighbour()
            .is_some_and(|known| known.node == hello.node && hello.incarnation <= known.incarnation)
    }

    /// Whether the last contradiction said the same, and it is possible: another incarnation while
    /// the neighbour is silent or was never shown to receive our hellos.
    fn is_confirmed(&mut self, hello: &Hello, interval: Duration, now: Instant) -> bool {
        let said =
            Contradiction { neighbour: Neighbour::of(hello), interval, sequence: hello.sequence };
        let before = self.contradiction.replace(said);
        let again = before.is_some_and(|before| {
            let later = hello.sequence.wrapping_sub(before.sequence).cast_signed() > 0;
            later && before.neighbour.is(hello) && before.interval == interval
        });
        let possible = self.neighbour.as_ref().is_none_or(|record| {
            match record.neighbour.is(hello) {
                // What the present incarnation has said before says nothing against it.
                true => !self.carries() || interval != record.arrivals.interval(),
                false => record.arrivals.expected() <= now || record.echoed.is_none(),
            }
        });
        again && possible
    }

    /// Starts with a new neighbour, or with a new incarnation of the present one.
    fn begin_with(&mut self, hello: &Hello, interval: Duration, now: Instant) {
        self.contradiction = None;
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
            heard_at: now,
            hellos_received: 0,
            stance: hello.stance,
            loss_there: 0,
            echoed: None,
            answered: Instant::ORIGIN,
            excused_until: Instant::ORIGIN,
            excuses: 0,
            stalled: Duration::ZERO,
        };
        self.neighbour = Some(record);
        self.gauge = QualityEstimator::default();
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

/// Whether no node that sends a hello per interval can have come to this number, or it was passed
/// so long ago that no network has held it back.
fn is_far_off(last: u32, number: u32, passed: Duration, interval: Duration) -> bool {
    // Serial-number arithmetic (RFC 1982): the nearer way round decides.
    let step = i64::from(number.wrapping_sub(last).cast_signed());
    let passed = (passed.as_nanos() / interval.as_nanos().max(1)) as i64;
    step > passed.saturating_add(AHEAD_MAX) || step <= -BEHIND_MAX
}
