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

use super::{Link, Neighbour, NeighbourRecord, PeerRefusal};
use crate::net::link::arrival::{ArrivalEstimator, HelloArrival};
use crate::net::wire::frame::Hello;
use crate::net::wire::node_id::NodeId;
use crate::{Incarnation, Instant};
use std::time::Duration;

/// A hello's number may be ahead by so many more intervals than have passed since the last one was
/// received, which may have been delayed, or have waited while this node was not run. The numbers
/// in between count as missed.
const AHEAD_MAX: i64 = 2;

/// A hello that so many later ones have overtaken is none that was merely late.
const BEHIND_MAX: i64 = 64;

/// Which doubts there are about the node at the other end.
#[derive(Debug, Default)]
pub(super) struct Acquaintance {
    /// The incarnation in which the neighbour is, as its key has proved; `None` where frames are
    /// not sealed.
    pub(super) authenticated: Option<Incarnation>,
    /// The last hello that contradicts what is known of the neighbour.
    pub(super) contradiction: Option<Contradiction>,
    /// The last refusal: a single one may be an accident.
    doubted: Option<PeerRefusal>,
    /// The last that was reported.
    pub(super) refused: Option<PeerRefusal>,
}

impl Acquaintance {
    /// Returns a refusal that occurs twice in a row, unless it was the last reported.
    fn refuse(&mut self, refusal: PeerRefusal) -> Option<PeerRefusal> {
        if self.refused.as_ref() == Some(&refusal) {
            return None;
        }
        let refusal = Some(refusal);
        if refusal == self.doubted {
            self.refused.clone_from(&refusal);
            return refusal;
        }
        self.doubted = refusal;
        None
    }

    pub(super) fn forget_refusals(&mut self) {
        (self.doubted, self.refused) = (None, None);
    }

    /// Whether an earlier hello was the last contradiction, and said the same.
    fn is_repeated(&mut self, hello: &Hello, interval: Duration) -> bool {
        let (neighbour, sequence) = (Neighbour::of(hello), hello.sequence);
        let before = self.contradiction.replace(Contradiction { neighbour, interval, sequence });
        before.is_some_and(|before| {
            let later = sequence.wrapping_sub(before.sequence).cast_signed() > 0;
            later && before.neighbour.is(hello) && before.interval == interval
        })
    }
}

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

    /// Counts every refusal. Reports one that occurs twice in a row.
    pub(super) fn refuse(&mut self, refusal: Option<PeerRefusal>) {
        self.refusals.unexpected += 1;
        let reported = refusal.and_then(|refusal| self.acquaintance.refuse(refusal));
        self.outputs.extend(reported.map(super::LinkOutput::Refused));
    }

    /// Whether this is a new hello of the neighbour. Any other is counted as refused.
    pub(super) fn meet(&mut self, hello: &Hello, interval: Duration, now: Instant) -> HelloArrival {
        let Some(record) = &mut self.neighbour else {
            self.begin_with(hello, interval, now);
            return HelloArrival::New { missed: 0 };
        };
        let same = record.neighbour.is(hello) && interval == record.arrivals.interval();
        let stall = &record.stall;
        let stalled = if now < stall.until { stall.stalled } else { Duration::ZERO };
        let (highest, passed) = (record.arrivals.highest(), now - record.received_at + stalled);
        if same && !is_far_off(highest, hello.sequence, passed, interval) {
            let arrival = record.arrivals.handle(hello.sequence, hello.skipped, now);
            match arrival {
                HelloArrival::New { .. } => self.acquaintance.contradiction = None,
                HelloArrival::Old => self.refusals.stale += 1,
            }
            return arrival;
        }
        // By the shorter interval it would be down before its second hello.
        let slower = record.neighbour.is(hello) && interval > record.arrivals.interval();
        if self.acquaintance.authenticated.is_none()
            && !slower
            && !self.is_confirmed(hello, interval, now)
        {
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
        let again = self.acquaintance.is_repeated(hello, interval);
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
        self.acquaintance.contradiction = None;
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
        self.damping.forget();
        self.neighbour = Some(NeighbourRecord::new(hello, arrivals, now));
    }
}

impl Neighbour {
    pub(super) fn of(hello: &Hello) -> Self {
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
