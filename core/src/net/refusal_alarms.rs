//! Tells persistent refusals from passing ones.
//!
//! Something is always refused: a packet that was late, a peer that was just restarted. What goes
//! on for seconds is a broken peer or a hostile one, and a user should look.

use super::wire::Refusals;
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
}

#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    refusals: Refusals,
    /// How many looks in a row found many.
    looks: u32,
}

impl<K> Default for RefusalAlarms<K> {
    fn default() -> Self {
        RefusalAlarms { seen: SortedMap::new() }
    }
}

impl<K: Ord> RefusalAlarms<K> {
    /// What was refused of `who` up to now. Answers when it goes on for too long what was refused
    /// since the last look; and again each time that it has gone on for as long.
    pub fn handle_look(&mut self, who: K, refusals: Refusals) -> Option<Refusals> {
        let seen = self.seen.entry(who).or_default();
        let since = refusals.since(&std::mem::replace(&mut seen.refusals, refusals));
        let many = since.total() >= MANY;
        seen.looks = if many { seen.looks.saturating_add(1) } else { 0 };
        (seen.looks > 0 && seen.looks.is_multiple_of(LOOKS)).then_some(since)
    }

    /// Forgets what was refused of `who`.
    pub fn forget(&mut self, who: &K) {
        self.seen.remove(who);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_goes_on_is_told_and_what_passes_never() {
        let mut alarms = RefusalAlarms::default();
        let mut total = Refusals::default();
        let mut look = |malformed: u64| {
            total.malformed += malformed;
            let reported = alarms.handle_look("peer", total);
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
        let mut alarms = RefusalAlarms::default();
        for n in 1..=3 {
            let many = Refusals { stale: n * 100, ..Refusals::default() };
            let few = Refusals { stale: n, ..Refusals::default() };
            assert_eq!(alarms.handle_look(1, many).is_some(), n == 3);
            assert_eq!(alarms.handle_look(2, few), None);
        }
        alarms.forget(&1);
        assert_eq!(alarms.seen.len(), 1);
    }
}
