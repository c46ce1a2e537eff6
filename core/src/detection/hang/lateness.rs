//! Whether a component that works is late, from counts over time.

use super::{ComponentSample, HangLimits, OverloadFigures, QueueReading, SlotId};
use crate::Instant;
use crate::sorted::SortedSet;
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
    /// Ticks of its timers that it has missed.
    missed_ticks: u64,
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
    /// What kept the component from its thread meanwhile.
    pub(super) root: Option<OverloadRoot>,
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
    /// As in [`ComponentSample`], and so are those that follow.
    ticks: u32,
    missed_ticks: u32,
    expired: u64,
}

impl Window {
    fn new(
        (since, blind): (Instant, Duration),
        (due, missed): (u64, u64),
        reading: &ComponentSample,
    ) -> Self {
        let ComponentSample { ticks, missed_ticks, expired, .. } = *reading;
        Window { since, blind, due, missed, ticks, missed_ticks, expired }
    }
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
    /// Nothing is late, and what has been counted is known.
    pub(super) fn new(now: Instant, reading: &ComponentSample) -> Self {
        Lateness {
            rounds: None,
            missed_ticks: 0,
            window: Window::new((now, Duration::ZERO), (0, 0), reading),
            bad: 0,
            counts: Counts::default(),
            delayed_since: None,
        }
    }

    /// Rounds, and ticks of timers, that this incarnation has missed.
    pub(super) fn missed_rounds(&self) -> u64 {
        self.rounds.map_or(0, |rounds| rounds.total()) + self.missed_ticks
    }

    /// The latest window has missed rounds, or ticks of timers.
    pub(super) fn misses(&self) -> bool {
        self.counts.missed > 0
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
        (window, root): (Duration, Option<OverloadRoot>),
        (now, blind): (Instant, Duration),
    ) -> Option<Counts> {
        let due = self.count_rounds(reading, now);
        let missed = self.rounds.map_or(0, |rounds| rounds.total());
        let Window { since, due: due_before, missed: missed_before, expired, .. } = self.window;
        let next = Window::new((now, blind), (due, missed), reading);
        let due_here = due.saturating_sub(due_before);
        let is_full = due_here >= ROUNDS_LEAST || reading.interval.is_zero();
        if due < due_before {
            // It is counted from the beginning.
            self.window = next;
        } else if now - since >= window && is_full {
            let missed_here = missed.saturating_sub(missed_before);
            let missed_ticks = u64::from(next.missed_ticks.wrapping_sub(self.window.missed_ticks));
            let ticks = missed_ticks + u64::from(next.ticks.wrapping_sub(self.window.ticks));
            self.missed_ticks += missed_ticks;
            // Half of the limit where it was exceeded: a load near the limit is one overload.
            let limit = match u64::from(limits.max_missed_percent) {
                limit if limit < 100 && self.bad >= WINDOWS => limit / 2,
                limit => limit,
            };
            let is_bad = |missed: u64, due: u64| missed * 100 > due * limit;
            let rounds = is_bad(missed_here, due_here)
                || (ticks >= ROUNDS_LEAST && is_bad(missed_ticks, ticks));
            let expired_here = reading.expired.saturating_sub(expired);
            // What expires while the scanner is not scheduled is no fault of the component.
            let seen = blind.saturating_sub(self.window.blind) < now - since;
            let messages = expired_here >= EXPIRED_LEAST && reading.allowance.is_zero() && seen;
            self.bad = if rounds || messages { self.bad + 1 } else { 0 };
            // A component that was late because of another is so until a window is good: the end of
            // a load is no fault of the components behind it.
            let root = root.or(self.counts.root.filter(|_| self.bad > 1));
            let missed = missed_here + missed_ticks;
            self.counts = Counts { missed, expired: expired_here, root };
            self.window = next;
        }
        (self.bad >= WINDOWS).then_some(self.counts)
    }

    /// How many rounds were due since the interval was set.
    fn count_rounds(&mut self, reading: &ComponentSample, now: Instant) -> u64 {
        let runs = reading.speaks && !reading.interval.is_zero();
        let same = self.rounds.is_some_and(|rounds| rounds.interval == reading.interval);
        if !runs || !same {
            let earlier = self.rounds.map_or(0, |rounds| rounds.total());
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

    /// How long messages may wait: half of the limit where some have waited for longer.
    pub(super) fn max_delay(&self, limits: &HangLimits) -> Duration {
        if self.delayed_since.is_some() { limits.max_delay / 2 } else { limits.max_delay }
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
    pub(super) victims: SortedSet<SlotId>,
    /// The worst of all its figures.
    pub(super) worst: OverloadFigures,
    /// The worst of them when it was reported last, if it was.
    reported: Option<OverloadFigures>,
}

impl Episode {
    pub(super) fn new(now: Instant) -> Self {
        let worst = OverloadFigures::default();
        Episode { latest: now, victims: SortedSet::new(), worst, reported: None }
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
