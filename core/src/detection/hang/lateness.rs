//! Whether a component that works is late, from counts over time.

use super::{ComponentSample, HangLimits, QueueReading, SlotId};
use crate::Instant;
use crate::detection::OverloadFigures;
use std::collections::BTreeSet;
use std::time::Duration;

/// Rounds that a window holds at least: of fewer, one that is missed is already a large share.
const ROUNDS_LEAST: u64 = 10;
/// Messages of one window whose sender did not wait any more: fewer are callers that changed their
/// mind.
const EXPIRED_LEAST: u64 = 3;
/// Over how long, at least, rounds and expired requests are counted. Two such windows in a row must
/// be bad. Shorter reports single delays; longer finds an overload later.
pub(super) const WINDOW: Duration = Duration::from_secs(1);
/// How long messages must have been late before that is an overload. Shorter reports single bursts.
const DWELL: Duration = Duration::from_millis(500);
/// Windows in a row that must be bad.
const WINDOWS: u32 = 2;

/// What has been counted of one incarnation.
#[derive(Debug, Default)]
pub(super) struct Lateness {
    /// `None` before anything is counted, and after time in which nothing could be.
    window: Option<Window>,
    /// Bad windows in a row, and what the last of them held.
    bad: u32,
    counts: Counts,
    delayed_since: Option<Instant>,
}

/// What a window held.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Counts {
    pub(super) missed: u64,
    pub(super) expired: u64,
    /// What kept the component from its thread meanwhile.
    pub(super) root: Option<OverloadRoot>,
}

/// What had been counted when a window began.
#[derive(Clone, Copy, Debug)]
struct Window {
    since: Instant,
    /// How long the scanner had not been scheduled, all in all.
    blind: Duration,
    /// As in [`ComponentSample`], and so are those that follow.
    ticks: u32,
    missed_ticks: u64,
    expired: u64,
}

impl Window {
    fn new(since: Instant, blind: Duration, reading: &ComponentSample) -> Self {
        let ComponentSample { ticks, missed_ticks, expired, .. } = *reading;
        Window { since, blind, ticks, missed_ticks, expired }
    }
}

impl Lateness {
    /// Nothing is late, and what has been counted is known.
    pub(super) fn new(now: Instant, blind: Duration, reading: &ComponentSample) -> Self {
        Lateness { window: Some(Window::new(now, blind, reading)), ..Lateness::default() }
    }

    /// The latest window has missed rounds, or ticks of timers.
    pub(super) fn misses(&self) -> bool {
        self.counts.missed > 0
    }

    /// Nothing is late, and the window has taken note of all that was counted.
    pub(super) fn is_settled(&self, reading: &ComponentSample) -> bool {
        let has_noted = |window: &Window| {
            (window.missed_ticks, window.expired) == (reading.missed_ticks, reading.expired)
        };
        self.bad == 0 && self.delayed_since.is_none() && self.window.as_ref().is_some_and(has_noted)
    }

    /// Time in which nothing could be counted is over.
    pub(super) fn void(&mut self) {
        (self.window, self.delayed_since, self.bad) = (None, None, 0);
    }

    /// Compares counts. Answers what the latest window held if that and the one before it were bad.
    pub(super) fn handle_counts(
        &mut self,
        limits: &HangLimits,
        reading: &ComponentSample,
        root: Option<OverloadRoot>,
        now: Instant,
        blind: Duration,
    ) -> Option<Counts> {
        let next = Window::new(now, blind, reading);
        let window = *self.window.get_or_insert(next);
        let missed = next.missed_ticks.saturating_sub(window.missed_ticks);
        let due = missed + u64::from(next.ticks.wrapping_sub(window.ticks));
        let is_full = due >= ROUNDS_LEAST || reading.interval.is_zero();
        if now - window.since >= WINDOW && is_full {
            // Half of the limit where it was exceeded: a load near the limit is one overload.
            let limit = match u64::from(limits.max_missed_percent) {
                limit if limit < 100 && self.bad >= WINDOWS => limit / 2,
                limit => limit,
            };
            let rounds = due >= ROUNDS_LEAST && missed * 100 > due * limit;
            let expired = reading.expired.saturating_sub(window.expired);
            let messages = expired >= EXPIRED_LEAST && reading.allowance.is_zero();
            // What is missed or expires while the scanner is not scheduled is no fault of the
            // component.
            let seen = blind.saturating_sub(window.blind) < now - window.since;
            self.bad = if (rounds || messages) && seen { self.bad + 1 } else { 0 };
            // A component that was late because of another is so until a window is good: the end of
            // a load is no fault of the components behind it.
            let root = root.or(self.counts.root.filter(|_| self.bad > 1));
            self.counts = Counts { missed, expired, root };
            self.window = Some(next);
        }
        (self.bad >= WINDOWS).then_some(self.counts)
    }

    /// How long messages may wait: half of the limit where some have waited for longer.
    pub(super) fn max_delay(&self, limits: &HangLimits) -> Duration {
        if self.delayed_since.is_some() { limits.max_delay / 2 } else { limits.max_delay }
    }

    /// The queue holds messages back, or does not. Says whether it has for long enough.
    pub(super) fn handle_delay(&mut self, delayed: bool, now: Instant) -> bool {
        if !delayed {
            self.delayed_since = None;
            return false;
        }
        let since = *self.delayed_since.get_or_insert(now);
        now - since >= DWELL
    }
}

/// What makes components late.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum OverloadRoot {
    /// Their threads get no processor.
    Computer,
    /// A component keeps their thread.
    Component(SlotId),
}

/// An overload: the components that are late, and when one was late last.
#[derive(Debug)]
pub(super) struct Episode {
    pub(super) latest: Instant,
    pub(super) victims: BTreeSet<SlotId>,
    /// The worst of all its figures.
    pub(super) worst: OverloadFigures,
    /// The worst of them when it was reported last, if it was.
    reported: Option<OverloadFigures>,
}

impl Episode {
    pub(super) fn new(now: Instant) -> Self {
        let worst = OverloadFigures::default();
        Episode { latest: now, victims: BTreeSet::new(), worst, reported: None }
    }

    /// These are late too, or still. Returns whether the overload is to be reported: it is new, has
    /// more victims, or one of its figures has doubled.
    pub(super) fn note(
        &mut self,
        victims: impl Iterator<Item = SlotId>,
        figures: OverloadFigures,
        now: Instant,
    ) -> bool {
        let known = self.victims.len();
        self.latest = now;
        self.victims.extend(victims);
        self.worst = self.worst.worst(figures);
        let is_news = self.victims.len() != known || self.has_doubled();
        if is_news {
            self.reported = Some(self.worst);
        }
        is_news
    }

    /// One of its figures is twice as bad as reported. Smaller changes are reported with the next,
    /// and so is silence, which is a fault of its own: an overload that lasts is reported a few
    /// times, and not at every look.
    fn has_doubled(&self) -> bool {
        let OverloadFigures { queued, oldest, missed_rounds, expired, .. } = self.worst;
        let Some(reported) = &self.reported else { return true };
        (oldest > reported.oldest && oldest >= 2 * reported.oldest)
            || (queued > reported.queued && queued >= 2 * reported.queued)
            || (missed_rounds > reported.missed_rounds
                && missed_rounds >= 2 * reported.missed_rounds)
            || (expired > reported.expired && expired >= 2 * reported.expired)
    }
}

/// One component that is late.
#[derive(Debug)]
pub(super) struct Late {
    pub(super) slot: SlotId,
    /// What keeps it waiting, or itself.
    pub(super) root: OverloadRoot,
    pub(super) queue: QueueReading,
    pub(super) missed: u64,
    pub(super) expired: u64,
    pub(super) silent_for: Duration,
}
