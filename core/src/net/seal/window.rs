//! Which counters of a lane were seen: the sliding window of RFC 6479.

/// How far behind the highest counter a frame may be.
///
/// The ring holds one word more: with a window of all 1,024 bits, the word of the oldest counters
/// is also that of the newest, and replays of the oldest are accepted.
pub const WINDOW: u64 = (WORDS as u64 - 1) * WORD;
const WORDS: usize = 16;
const WORD: u64 = 64;

/// The counters that were seen, as far as they are not too old.
#[derive(Clone, Debug, Default)]
pub struct ReplayWindow {
    highest: u64,
    seen: [u64; WORDS],
}

impl ReplayWindow {
    /// Whether this counter was not seen, and is not too old to know.
    pub fn is_new(&self, counter: u64) -> bool {
        let (word, bit) = place(counter);
        match self.highest.checked_sub(counter) {
            None => true,
            Some(age) => age < WINDOW && self.seen[word] & bit == 0,
        }
    }

    /// Marks a counter as seen. Only a frame that was opened may be marked: a forged one must not
    /// use up the counter of a genuine one.
    pub fn mark(&mut self, counter: u64) {
        if counter > self.highest {
            let last = self.highest / WORD;
            let newer = (counter / WORD - last).min(WORDS as u64);
            for word in last + 1..=last + newer {
                self.seen[(word % WORDS as u64) as usize] = 0;
            }
            self.highest = counter;
        }
        let (word, bit) = place(counter);
        self.seen[word] |= bit;
    }

    /// The counter nearest to the highest that was seen, of those that end in these bits; `None` if
    /// no counter below `limit` does.
    pub fn nearest(&self, low: u64, bits: u32, limit: u64) -> Option<u64> {
        let span = 1u64 << bits;
        let same = self.highest & !(span - 1) | low;
        let nearest = if same > self.highest && same - self.highest > span / 2 {
            same.checked_sub(span).unwrap_or(same)
        } else if self.highest - same.min(self.highest) > span / 2 {
            same + span
        } else {
            same
        };
        (nearest < limit).then_some(nearest)
    }
}

/// The word of the ring in which a counter's bit stands, and that bit.
fn place(counter: u64) -> (usize, u64) {
    ((counter / WORD % WORDS as u64) as usize, 1 << (counter % WORD))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::random::Random;
    use std::collections::BTreeSet;

    /// Counters from 0 in an order in which each is fewer than so many places late.
    fn reordered(count: u64, late: u64, random: &mut Random) -> Vec<u64> {
        let mut counters: Vec<_> = (0..count).map(|n| (n + random.below(late), n)).collect();
        counters.sort();
        counters.into_iter().map(|(_, n)| n).collect()
    }

    /// How many of the counters the window accepts.
    fn accepted(window: &mut ReplayWindow, counters: impl IntoIterator<Item = u64>) -> usize {
        let mut accept = |counter: &u64| {
            let new = window.is_new(*counter);
            if new {
                window.mark(*counter);
            }
            new
        };
        counters.into_iter().filter(|counter| accept(counter)).count()
    }

    #[test]
    fn counters_in_any_order_that_networks_make_are_accepted_once_and_a_million_repeats_never() {
        let mut random = Random::new(1);
        let counters = reordered(100_000, 900, &mut random);
        let mut window = ReplayWindow::default();

        assert_eq!(accepted(&mut window, counters.iter().copied()), 100_000);

        let repeats = (0..1_000_000).map(|_| random.below(100_000));
        assert_eq!(accepted(&mut window, repeats), 0);
    }

    #[test]
    fn a_window_accepts_each_counter_once_whatever_the_jumps_are() {
        for seed in 0..200 {
            let (mut random, mut window) = (Random::new(seed), ReplayWindow::default());
            let mut seen = BTreeSet::new();
            let mut highest = 0;
            for _ in 0..2_000 {
                let around = [1, 64, 959, 960, 961, 1023, 1024, 1025, 5000][seed as usize % 9];
                let counter = (highest + random.below(around)).saturating_sub(random.below(around));
                let expected = !seen.contains(&counter) && counter + WINDOW > highest;
                assert_eq!(window.is_new(counter), expected, "{seed}: {counter} at {highest}");
                if expected {
                    window.mark(counter);
                    seen.insert(counter);
                    highest = highest.max(counter);
                }
            }
        }
    }

    #[test]
    fn the_oldest_counter_of_the_window_is_accepted_and_the_one_before_it_not() {
        let mut window = ReplayWindow::default();
        window.mark(10_000);

        assert!(window.is_new(10_000 - WINDOW + 1));
        assert!(!window.is_new(10_000 - WINDOW));
        assert!(!window.is_new(10_000));
    }

    #[test]
    fn the_full_counter_is_the_nearest_with_the_given_bits() {
        let check = |highest: u64, low: u64, bits: u32, expected: Option<u64>| {
            let mut window = ReplayWindow::default();
            window.mark(highest);
            assert_eq!(window.nearest(low, bits, 1 << 62), expected, "{highest} {low}");
        };

        check(0, 5, 32, Some(5));
        check(0, 0xffff_ffff, 32, Some(0xffff_ffff));
        check(0x1_0000_0005, 0xffff_fff0, 32, Some(0xffff_fff0));
        check(0xffff_fff0, 5, 32, Some(0x1_0000_0005));
        check(70_000, 0, 16, Some(65_536));
        check(65_000, 10, 16, Some(65_546));
        check(65_546, 65_000, 16, Some(65_000));
        check((1 << 62) - 1, 5, 32, None);
    }
}
