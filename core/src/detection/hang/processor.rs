//! Whether a thread gets a processor when it is ready to run.

use super::load::SATURATED;
use super::{ArbiterId, ComponentRecord, HangDetector, Silence};
use crate::Instant;
use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

/// What counts: longer than any single delay, and as long as two windows of rounds.
const SPAN: Duration = Duration::from_secs(2);
/// A thread that has waited for a processor for less than this share of the time was not kept from
/// its rounds; once it was, for less than half of it.
const LEAST: f32 = 0.2;
/// The same where no rounds are missed, and it is not known what the thread would have run.
const LEAST_UNKNOWN: f32 = 0.5;
/// A thread that runs for this share of the time has a processor: what is late on it asks for too
/// much.
const MOST: f32 = 2.0 / 3.0;

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
    /// A component on it has missed rounds.
    misses: bool,
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

    /// Judges the latest looks. `misses`: a component on it has missed rounds.
    pub(super) fn judge(&mut self, misses: bool) {
        self.misses = misses;
        self.is_scarce = self.was_scarce(SPAN);
    }

    /// The thread lacks a processor: it waits for one for a good part of the time, and runs for so
    /// little that what is late on it says nothing about its components.
    pub(super) fn is_scarce(&self) -> bool {
        self.is_scarce
    }

    /// The same for so long a time only. What was found last stands until the contrary is clear.
    pub(super) fn was_scarce(&self, span: Duration) -> bool {
        let (used, waited) = self.shares(span);
        let least = if self.misses { LEAST } else { LEAST_UNKNOWN };
        match self.is_scarce {
            true => waited >= least / 2.0 && used < SATURATED,
            false => waited >= least && used < MOST,
        }
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

    /// Whether the arbiters lack a processor.
    pub(super) fn judge_processors(&mut self) {
        // One that is silent does nothing, whatever the thread gets.
        let misses = |component: &&ComponentRecord| {
            component.silence != Silence::Reported && component.lateness.misses()
        };
        let late = self.awake().map(|(_, component)| component).filter(misses);
        let late: BTreeSet<ArbiterId> = late.map(|component| component.judged.arbiter).collect();
        for (id, arbiter) in &mut self.arbiters {
            arbiter.processor.judge(late.contains(id));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// So many looks of 100 ms, in each of which the thread ran and waited for so long, while rounds
    /// were missed or not. Says whether it lacks a processor.
    fn pass(share: &mut ProcessorShare, looks: u64, used: u64, waited: u64, misses: bool) -> bool {
        for _ in 0..looks {
            let (at, time) = share.seen.back().copied().unwrap_or_default();
            let time = ProcessorTime {
                used: time.used + Duration::from_millis(used),
                waited: time.waited + Duration::from_millis(waited),
            };
            share.note(at + Duration::from_millis(100), time);
            share.judge(misses);
        }
        share.is_scarce()
    }

    #[test]
    fn a_thread_that_waits_and_runs_for_less_than_two_thirds_of_the_time_lacks_a_processor() {
        for (used, waited, misses, scarce) in [
            (1, 30, true, true),
            (15, 85, false, true),
            (5, 40, false, false),
            (15, 85, true, true),
            (1, 99, true, true),
            (60, 40, true, true),
            (45, 22, true, true),
            (95, 5, false, false),
            (70, 30, true, false),
            (1, 10, true, false),
        ] {
            let mut share = ProcessorShare::default();
            let is_scarce = pass(&mut share, 40, used, waited, misses);
            assert_eq!(is_scarce, scarce, "{used} {waited} {misses}");
        }
    }

    #[test]
    fn what_was_found_stands_until_the_contrary_is_clear() {
        let mut share = ProcessorShare::default();
        assert!(pass(&mut share, 40, 60, 40, true));
        assert!(pass(&mut share, 40, 75, 25, true));
        assert!(!pass(&mut share, 40, 90, 10, true));
        assert!(!pass(&mut share, 40, 75, 25, true));
    }

    #[test]
    fn a_shorter_time_is_judged_by_its_latest_part() {
        let mut share = ProcessorShare::default();
        assert!(!pass(&mut share, 40, 1, 0, false));
        assert!(!pass(&mut share, 2, 10, 90, false));

        assert!(share.was_scarce(Duration::from_millis(200)));
        assert!((share.shares(Duration::from_millis(200)).1 - 0.9).abs() < 0.01);
    }
}
