//! What a link knows of its neighbour.

use super::arrival::ArrivalEstimator;
use super::quality::QualityEstimator;
use super::{Neighbour, percent};
use crate::Instant;
use crate::net::wire::frame::Hello;
use crate::net::wire::hello_state::HelloState;
use std::time::Duration;

/// The neighbour, and how well frames pass between it and this node.
#[derive(Debug)]
pub(super) struct NeighbourRecord {
    pub(super) neighbour: Neighbour,
    pub(super) arrivals: ArrivalEstimator,
    /// When its last hello was received.
    pub(super) received_at: Instant,
    /// When anything else was: hellos may wait behind it on a full path.
    pub(super) heard_at: Instant,
    /// Hellos since the last silence, while it receives ours, less two for each that was missing.
    pub(super) hellos_received: u32,
    /// The state of the link at its end.
    pub(super) state_there: HelloState,
    /// The loss in its direction, as it reports.
    pub(super) loss_there: u16,
    /// The latest of our hellos that it has echoed, and when that echo was received.
    pub(super) echoed: Option<(u32, Instant)>,
    /// When the latest one that it has ever echoed was sent.
    pub(super) answered: Instant,
    pub(super) stall: StallExcuse,
    pub(super) quality: QualityEstimator,
}

/// Which silence of the neighbour does not count, because this node was not run.
#[derive(Debug, Default)]
pub(super) struct StallExcuse {
    /// Silence before this does not count.
    pub(super) until: Instant,
    /// How often that was extended since the neighbour's last hello.
    pub(super) count: u32,
    /// How long this node was not run before. What it reads then may have been sent as long ago.
    pub(super) stalled: Duration,
}

impl StallExcuse {
    /// Four times in a row are no accident.
    const COUNT_MAX: u32 = 4;

    /// Silence counts only from a while after `now`. The number of excuses in a row is bounded, so
    /// that a node which stalls again and again still detects a dead link.
    pub(super) fn extend(&mut self, a_while: Duration, now: Instant) {
        if self.count < Self::COUNT_MAX {
            self.count += 1;
            self.until = self.until.max(now + a_while);
        }
    }
}

impl NeighbourRecord {
    pub(super) fn new(hello: &Hello, arrivals: ArrivalEstimator, now: Instant) -> Self {
        NeighbourRecord {
            neighbour: Neighbour::of(hello),
            arrivals,
            received_at: now,
            heard_at: now,
            hellos_received: 0,
            state_there: hello.state,
            loss_there: 0,
            echoed: None,
            answered: Instant::ORIGIN,
            stall: StallExcuse::default(),
            quality: QualityEstimator::default(),
        }
    }

    pub(super) fn forget_proof(&mut self) {
        self.hellos_received = 0;
        self.echoed = None;
    }

    /// When silence, or deafness of the neighbour, will have lasted so long past the expected
    /// hello. What comes meanwhile shows that the neighbour lives; that it receives us, only its
    /// hellos show.
    pub(super) fn silent_at(&self, after_percent: u32, own_interval: Duration) -> Instant {
        let interval = self.arrivals.interval();
        let alive_at = self.arrivals.expected().max(self.heard_at);
        let silent = alive_at + percent(interval, after_percent);
        let deaf = self.echoed.map_or(self.received_at, |(_, at)| at)
            // An echo needs both directions: twice the time, in the slower one's intervals.
            + percent(interval.max(own_interval), 2 * (100 + after_percent));
        silent.min(deaf).max(self.stall.until)
    }
}
