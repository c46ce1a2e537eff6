//! Tells persistent refusals from passing ones.
//!
//! Something is always refused: a packet that was late, a peer that was just restarted. What goes
//! on for seconds is a broken peer or a hostile one, and a user should look: until it was quiet
//! for a while.

use super::active_alarms::ActiveAlarms;
use super::wire::Refusals;
use crate::Instant;
use crate::sorted::SortedMap;

/// Refusals from one look to the next that are no passing matter.
pub const MANY: u64 = 50;
/// So many looks in a row.
const LOOKS: u32 = 3;

/// What was refused of whom, as seen at regular looks.
#[derive(Clone, Debug)]
pub struct RefusalAlarms<K> {
    /// As many as are looked at.
    seen: SortedMap<K, Seen>,
    /// Of whom it was reported.
    alarms: ActiveAlarms<K>,
    /// An alarm was reported, and not yet that all alarms are over.
    stands: bool,
}

#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    refusals: Refusals,
    /// How many looks in a row found many.
    looks: u32,
}

impl<K> Default for RefusalAlarms<K> {
    fn default() -> Self {
        RefusalAlarms { seen: SortedMap::new(), alarms: ActiveAlarms::default(), stands: false }
    }
}

impl<K: Ord + Clone> RefusalAlarms<K> {
    /// What was refused of `who` up to now. Answers when it goes on for too long what was refused
    /// since the last look; and again each time that it has gone on for as long.
    pub fn handle_look(&mut self, who: K, refusals: Refusals, now: Instant) -> Option<Refusals> {
        let seen = self.seen.entry(who.clone()).or_default();
        let since = refusals.since(&std::mem::replace(&mut seen.refusals, refusals));
        let many = since.total() >= MANY;
        seen.looks = if many { seen.looks.saturating_add(1) } else { 0 };
        let reported = seen.looks > 0 && seen.looks.is_multiple_of(LOOKS);
        if reported {
            self.stands = true;
            self.alarms.raise(who, now);
        } else if many {
            self.alarms.go_on(&who, now);
        }
        reported.then_some(since)
    }

    /// Forgets `who`.
    pub fn forget(&mut self, who: &K) {
        self.seen.remove(who);
        self.alarms.clear(who);
    }

    /// Whether all that was reported is over by now, which it is when no look found many for
    /// [a minute](super::active_alarms::QUIET); once.
    pub fn take_over(&mut self, now: Instant) -> bool {
        self.alarms.take_over(now);
        let over = self.alarms.iter().next().is_none();
        over && std::mem::take(&mut self.stands)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_goes_on_is_told_and_what_passes_never() {
        let mut complaints = RefusalAlarms::default();
        let mut total = Refusals::default();
        let mut look = |malformed: u64| {
            total.malformed += malformed;
            let reported = complaints.handle_look("peer", total, Instant::ORIGIN);
            reported.map(|since| since.malformed)
        };

        let reported: Vec<_> =
            [1000, 49, 50, 50, 0, 60, 70, 80, 90, 0, 50, 51, 52, 53, 54, 55].map(&mut look).into();

        let mut wanted = vec![None; 16];
        wanted[7] = Some(80);
        (wanted[12], wanted[15]) = (Some(52), Some(55));
        assert_eq!(reported, wanted);
    }

    #[test]
    fn each_is_judged_by_its_own() {
        let mut complaints = RefusalAlarms::default();
        for n in 1..=3 {
            let many = Refusals { stale: n * 100, ..Refusals::default() };
            let few = Refusals { stale: n, ..Refusals::default() };
            assert_eq!(complaints.handle_look(1, many, Instant::ORIGIN).is_some(), n == 3);
            assert_eq!(complaints.handle_look(2, few, Instant::ORIGIN), None);
        }
        complaints.forget(&1);
        assert_eq!(complaints.seen.len(), 1);
        assert!(complaints.take_over(Instant::ORIGIN), "no other peer is complained of");
    }

    #[test]
    fn what_was_told_is_over_a_minute_after_the_last_of_them_and_told_again_when_it_repeats() {
        let mut complaints = RefusalAlarms::default();
        let mut refused = [0; 2];
        let mut second = |at: u64, many: [bool; 2]| {
            let now = Instant::from_millis(at * 1000);
            let reported = [0, 1].map(|who| {
                refused[who] += if many[who] { 100 } else { 1 };
                let refusals = Refusals { stale: refused[who], ..Refusals::default() };
                complaints.handle_look(who, refusals, now).is_some()
            });
            (reported, complaints.take_over(now))
        };
        let mut reported = Vec::new();
        for at in 0..300 {
            // One goes on until 40, the other from 10 until 20, and once more from 200 until 205.
            let many = [(0..40).contains(&at) || (200..205).contains(&at), (10..20).contains(&at)];
            let (of, over) = second(at, many);
            reported.extend(over.then_some((at, "over")));
            reported.extend((of[0] && !(3..=100).contains(&at)).then_some((at, "told")));
        }
        assert_eq!(reported, [(2, "told"), (99, "over"), (202, "told"), (264, "over")]);
    }
}
