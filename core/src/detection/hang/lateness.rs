//! Whether a component that works is late, from counts over time.

use super::{ComponentSample, HangLimits, OverloadFigures, QueueReading, SlotId};
use crate::Instant;
use std::collections::BTreeSet;
use std::time::Duration;

/// Rounds that a window holds at least: of fewer, one that is missed is already a large share.
const ROUNDS_LEAST: u64 = 10;
/// Messages of one window whose sender did not wait any more: fewer are callers that changed their
/// mind.
const EXPIRED_LEAST: u64 = 3;
/// Windows in a row that must be bad.
const WINDOWS: u32 = 2;

/// What has been counted of one incarnation.
#[derive(Debug)]
pub(super) struct Lateness {
    rounds: Option<Rounds>,
    window: Window,
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
    /// Who kept the component from its thread meanwhile.
    pub(super) root: Option<SlotId>,
}

/// The rounds of a component since it has had this interval.
#[derive(Clone, Copy, Debug)]
struct Rounds {
    interval: Duration,
    since: Instant,
    /// How many it had finished then.
    before: u64,
    /// How many it has missed since.
    missed: u64,
    /// How many it had missed before, in this incarnation.
    earlier: u64,
}

#[derive(Clone, Copy, Debug)]
struct Window {
    since: Instant,
    /// How long the scanner had not been scheduled when it began, all in all.
    blind: Duration,
    due: u64,
    missed: u64,
    expired: u64,
}

impl Rounds {
    fn due(&self, now: Instant) -> u64 {
        let interval = self.interval.as_nanos().max(1);
        u64::try_from((now - self.since).as_nanos() / interval).unwrap_or(u64::MAX)
    }

    fn total(&self) -> u64 {
        self.earlier + self.missed
    }
}

impl Lateness {
    /// Nothing is late, and so many messages have been noted as expired.
    pub(super) fn new(now: Instant, expired: u64) -> Self {
        let blind = Duration::ZERO;
        let window = Window { since: now, blind, due: 0, missed: 0, expired };
        Lateness { rounds: None, window, bad: 0, counts: Counts::default(), delayed_since: None }
    }

    /// Rounds that this incarnation has missed.
    pub(super) fn missed_rounds(&self) -> u64 {
        self.rounds.map_or(0, |rounds| rounds.total())
    }

    /// Nothing is late, and the window has taken note of all that was counted.
    pub(super) fn is_settled(&self, reading: &ComponentSample) -> bool {
        self.bad == 0
            && self.delayed_since.is_none()
            && self.missed_rounds() == 0
            && self.window.expired == reading.expired
    }

    /// Time in which nothing could be counted is over.
    pub(super) fn void(&mut self, now: Instant) {
        if let Some(rounds) = &mut self.rounds {
            (rounds.earlier, rounds.missed, rounds.interval) = (rounds.total(), 0, Duration::ZERO);
        }
        self.window.since = now;
        self.delayed_since = None;
        self.bad = 0;
    }

    /// Counts rounds. Answers what the latest window held if that and the one before it were bad.
    pub(super) fn handle_counts(
        &mut self,
        limits: &HangLimits,
        reading: &ComponentSample,
        (window, root): (Duration, Option<SlotId>),
        (now, blind): (Instant, Duration),
    ) -> Option<Counts> {
        let due = self.count_rounds(reading, now);
        let missed = self.missed_rounds();
        let Window { since, due: due_before, missed: missed_before, expired, .. } = self.window;
        let next = Window { since: now, blind, due, missed, expired: reading.expired };
        let due_here = due.saturating_sub(due_before);
        let is_full = due_here >= ROUNDS_LEAST || reading.interval.is_zero();
        if due < due_before {
            // It is counted from the beginning.
            self.window = next;
        } else if now - since >= window && is_full {
            let missed_here = missed.saturating_sub(missed_before);
            let limit = u64::from(limits.max_missed_percent);
            let rounds = missed_here * 100 > due_here * limit;
            let expired_here = reading.expired.saturating_sub(expired);
            // What expires while the scanner is not scheduled is no fault of the component.
            let seen = blind.saturating_sub(self.window.blind) < now - since;
            let messages = expired_here >= EXPIRED_LEAST && reading.allowance.is_zero() && seen;
            self.bad = if rounds || messages { self.bad + 1 } else { 0 };
            // A component that was late because of another is so until a window is good: the end of
            // a load is no fault of those who were behind it.
            let root = root.or(self.counts.root.filter(|_| self.bad > 1));
            self.counts = Counts { missed: missed_here, expired: expired_here, root };
            self.window = next;
        }
        (self.bad >= WINDOWS).then_some(self.counts)
    }

    /// How many rounds were due since the interval was set.
    fn count_rounds(&mut self, reading: &ComponentSample, now: Instant) -> u64 {
        let runs = reading.speaks && !reading.interval.is_zero();
        let same = self.rounds.is_some_and(|rounds| rounds.interval == reading.interval);
        if !runs || !same {
            let earlier = self.missed_rounds();
            let interval = if runs { reading.interval } else { Duration::ZERO };
            let before = reading.rounds;
            self.rounds = Some(Rounds { interval, since: now, before, missed: 0, earlier });
            return 0;
        }
        let Some(rounds) = &mut self.rounds else { return 0 };
        let due = rounds.due(now);
        // Rounds that were run while the scanner was not are no credit for later ones.
        rounds.before = rounds.before.max(reading.rounds.saturating_sub(due));
        // One may be under way.
        let done = reading.rounds.saturating_sub(rounds.before) + 1;
        rounds.missed = rounds.missed.max(due.saturating_sub(done));
        due
    }

    /// The queue holds messages back, or does not. Says whether it has for long enough.
    pub(super) fn handle_delay(&mut self, delayed: bool, dwell: Duration, now: Instant) -> bool {
        if !delayed {
            self.delayed_since = None;
            return false;
        }
        let since = *self.delayed_since.get_or_insert(now);
        now - since >= dwell
    }
}

/// An overload: who is late, and when one was so last.
#[derive(Debug)]
pub(super) struct Episode {
    pub(super) latest: Instant,
    pub(super) victims: BTreeSet<SlotId>,
    /// The worst of all its figures.
    pub(super) worst: OverloadFigures,
    /// The worst of them when it was told last.
    pub(super) told: OverloadFigures,
}

impl Episode {
    pub(super) fn new(now: Instant) -> Self {
        let (worst, told) = Default::default();
        Episode { latest: now, victims: BTreeSet::new(), worst, told }
    }

    /// One of its figures is twice as bad as it was told. Smaller changes are told with the next,
    /// and so is silence, which is a fault of its own: an overload that lasts is reported a few
    /// times, and not at every look.
    pub(super) fn has_doubled(&self) -> bool {
        let OverloadFigures { queued, oldest, missed_rounds, expired, .. } = self.worst;
        let told = &self.told;
        (oldest > told.oldest && oldest >= 2 * told.oldest)
            || (queued > told.queued && queued >= 2 * told.queued)
            || (missed_rounds > told.missed_rounds && missed_rounds >= 2 * told.missed_rounds)
            || (expired > told.expired && expired >= 2 * told.expired)
    }
}

/// One component that is late.
#[derive(Debug)]
pub(super) struct Late {
    pub(super) slot: SlotId,
    /// Who keeps it waiting, or itself.
    pub(super) root: SlotId,
    pub(super) queue: QueueReading,
    pub(super) missed: u64,
    pub(super) expired: u64,
    pub(super) silent_for: Duration,
}
