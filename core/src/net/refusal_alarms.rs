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
    /// Those of the last look.
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

impl<K: Ord + Clone> RefusalAlarms<K> {
    /// What was refused of each up to now. Returns those of whom it goes on for too long, with what
    /// was refused since the last look; and again each time that it has gone on for as long. Who is
    /// not looked at is forgotten.
    pub fn handle_look(
        &mut self,
        all: impl IntoIterator<Item = (K, Refusals)>,
    ) -> Vec<(K, Refusals)> {
        let (mut before, mut alarms) = (std::mem::take(&mut self.seen), Vec::new());
        for (who, refusals) in all {
            let last = before.remove(&who).unwrap_or_default();
            let since = refusals.since(&last.refusals);
            let looks = if since.total() >= MANY { last.looks.saturating_add(1) } else { 0 };
            if looks > 0 && looks.is_multiple_of(LOOKS) {
                alarms.push((who.clone(), since));
            }
            self.seen.insert(who, Seen { refusals, looks });
        }
        alarms
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
            let reported = alarms.handle_look([("peer", total)]);
            reported.first().map(|(_, since)| since.malformed)
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
            let reported = alarms.handle_look([(1, many), (2, few)]);
            assert_eq!(reported.iter().map(|(who, _)| *who).eq([1]), n == 3);
        }
        alarms.handle_look([(2, Refusals::default())]);
        assert_eq!(alarms.seen.len(), 1);
    }
}
