//! Whether a thread gets a processor when it is ready to run.

use super::load::SATURATED;
use super::{ArbiterId, ComponentRecord, HangDetector, Silence};
use crate::Instant;
use crate::sorted::SortedMap;
use std::collections::VecDeque;
use std::time::Duration;

/// What counts: longer than any single delay, and as long as two windows of rounds.
const SPAN: Duration = Duration::from_secs(2);
/// A thread that has waited for a processor for less than this share of the time was not kept from
/// its rounds; once it was, for less than half of it.
const LEAST: f32 = 0.2;
/// The same where no rounds are missed, and it is not known what the thread would have run.
const LEAST_UNKNOWN: f32 = 0.5;
/// Rounds that count as run at least, so that the work of a thread that ran none is bounded.
const RUN_LEAST: f32 = 0.05;

/// What a thread has had of the processors since it began.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProcessorTime {
    /// How long it ran.
    pub used: Duration,
    /// How long it was ready to run and did not.
    pub waited: Duration,
}

/// What a thread had of the processors of late.
#[derive(Debug, Default)]
pub(super) struct ProcessorShare {
    /// In order; the first is as old as [`SPAN`], or there is none so old.
    seen: VecDeque<(Instant, ProcessorTime)>,
    /// The share of their rounds that components on it have missed.
    missed: f32,
    is_scarce: bool,
}

impl ProcessorShare {
    /// One more look.
    pub(super) fn note(&mut self, at: Instant, time: ProcessorTime) {
        self.seen.push_back((at, time));
        while self.seen.get(1).is_some_and(|(second, _)| at - *second >= SPAN) {
            self.seen.pop_front();
        }
    }

    /// Judges the latest looks, in which such a share of rounds was missed. `is_kept`: a component
    /// is known to keep the thread.
    pub(super) fn judge(&mut self, missed: f32, is_kept: bool) {
        self.missed = missed;
        self.is_scarce = self.was_scarce(SPAN, is_kept);
    }

    /// The thread lacks a processor: it waits for one for a good part of the time, and would have
    /// been in time with one of its own.
    pub(super) fn is_scarce(&self) -> bool {
        self.is_scarce
    }

    /// The same for so long a time only.
    ///
    /// What the thread ran for the rounds that were run, it would have run in proportion for those
    /// that were missed. If all that leaves a processor nothing to spare, there is too much to do
    /// on the thread, whatever else the computer runs. What was found last stands until the
    /// contrary is clear.
    pub(super) fn was_scarce(&self, span: Duration, is_kept: bool) -> bool {
        let (used, waited) = self.shares(span);
        let least = if self.missed > 0.0 { LEAST } else { LEAST_UNKNOWN };
        let (least, full) = match (self.is_scarce, is_kept) {
            (true, _) => (least / 2.0, 1.0),
            (false, true) => (least, SATURATED - 0.2),
            (false, false) => (least, SATURATED),
        };
        waited >= least && used < full * (1.0 - self.missed).max(RUN_LEAST)
    }

    /// The share of the time in which the thread ran, and in which it waited for a processor.
    pub(super) fn shares(&self, span: Duration) -> (f32, f32) {
        let Some((now, latest)) = self.seen.back() else { return (0.0, 0.0) };
        let is_old = |seen: &&(Instant, ProcessorTime)| *now - seen.0 >= span;
        let before = self.seen.iter().rev().find(is_old).or(self.seen.front());
        let Some((since, before)) = before.filter(|(since, _)| since < now) else {
            return (0.0, 0.0);
        };
        let of = |part: Duration| (part.as_secs_f32() / (*now - *since).as_secs_f32()).min(1.0);
        let used = latest.used.saturating_sub(before.used);
        (of(used), of(latest.waited.saturating_sub(before.waited)))
    }
}

impl HangDetector {
    /// What an arbiter's thread has had of the processors, where the system reports it: before
    /// [`handle_activities`](Self::handle_activities).
    pub fn handle_processor_time(&mut self, id: ArbiterId, time: ProcessorTime) {
        if let (Some(at), Some(arbiter)) = (self.looked_at, self.arbiters.get_mut(&id)) {
            arbiter.processor.note(at, time);
        }
    }

    /// Whether the arbiters lack a processor, by what the latest windows of their components
    /// missed.
    pub(super) fn judge_processors(&mut self) {
        let mut missed: SortedMap<ArbiterId, f32> = SortedMap::new();
        // One that is silent does nothing, whatever the thread gets.
        let works = |component: &&ComponentRecord| component.silence != Silence::Reported;
        for component in self.awake().map(|(_, component)| component).filter(works) {
            let share = missed.entry(component.judged.arbiter).or_default();
            *share = share.max(component.lateness.missed_share());
        }
        for (id, arbiter) in &mut self.arbiters {
            let missed = missed.get(id).copied().unwrap_or_default();
            arbiter.processor.judge(missed, arbiter.overloaded.is_some());
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// So many looks of 100 ms, in each of which the thread ran and waited for so long, while such
    /// a share of rounds was missed. Says whether it lacks a processor.
    fn pass(share: &mut ProcessorShare, looks: u64, used: u64, waited: u64, missed: f32) -> bool {
        for _ in 0..looks {
            let (at, time) = share.seen.back().copied().unwrap_or_default();
            let time = ProcessorTime {
                used: time.used + Duration::from_millis(used),
                waited: time.waited + Duration::from_millis(waited),
            };
            share.note(at + Duration::from_millis(100), time);
            share.judge(missed, false);
        }
        share.is_scarce()
    }

    #[test]
    fn a_thread_that_would_be_in_time_with_a_processor_of_its_own_lacks_one() {
        for (used, waited, missed, scarce) in [
            (1, 30, 0.3, true),
            (15, 85, 0.0, true),
            (5, 40, 0.0, false),
            (15, 85, 0.9, false),
            (1, 99, 1.0, true),
            (95, 5, 0.0, false),
            (70, 30, 0.3, false),
            (1, 10, 0.5, false),
        ] {
            let mut share = ProcessorShare::default();
            let is_scarce = pass(&mut share, 40, used, waited, missed);
            assert_eq!(is_scarce, scarce, "{used} {waited} {missed}");
        }
    }

    #[test]
    fn what_was_found_stands_until_the_contrary_is_clear() {
        let mut share = ProcessorShare::default();
        assert!(pass(&mut share, 40, 60, 40, 0.2));
        assert!(pass(&mut share, 40, 75, 25, 0.2));
        assert!(!pass(&mut share, 40, 90, 10, 0.2));
        assert!(!pass(&mut share, 40, 75, 25, 0.2));

        assert!(pass(&mut share, 40, 50, 50, 0.2));
        share.is_scarce = false;
        assert!(share.was_scarce(SPAN, false));
        assert!(!share.was_scarce(SPAN, true), "a component keeps the thread");
    }

    #[test]
    fn a_shorter_time_is_judged_by_its_latest_part() {
        let mut share = ProcessorShare::default();
        assert!(!pass(&mut share, 40, 1, 0, 0.0));
        assert!(!pass(&mut share, 2, 10, 90, 0.0));

        assert!(share.was_scarce(Duration::from_millis(200), false));
        assert!((share.shares(Duration::from_millis(200)).1 - 0.9).abs() < 0.01);
    }
}
