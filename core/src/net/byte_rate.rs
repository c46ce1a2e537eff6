//! How many bytes go each way in a second, for display.

use crate::Instant;
use crate::sorted::SortedMap;

/// How many bytes went each way, in a second.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ByteRate {
    /// The bytes sent per second.
    pub sent: u64,
    /// The bytes received per second.
    pub received: u64,
}

/// Measures the rates of links, or of sessions, from counters that only rise: each is the mean
/// between two looks.
#[derive(Clone, Debug)]
pub struct ByteRates<K> {
    all: SortedMap<K, ByteMeter>,
}

#[derive(Clone, Copy, Debug)]
struct ByteMeter {
    looked: Instant,
    /// The counters then: bytes sent, and received.
    counted: (u64, u64),
    rate: ByteRate,
}

impl<K> Default for ByteRates<K> {
    fn default() -> Self {
        ByteRates { all: SortedMap::new() }
    }
}

impl<K: Ord + Copy> ByteRates<K> {
    /// Looks at the counters of all that there are: bytes sent, and received. What is not among
    /// them is forgotten. Counters that have begun again say nothing until the next look.
    pub fn handle_look(&mut self, all: impl IntoIterator<Item = (K, u64, u64)>, now: Instant) {
        let look = |(key, sent, received)| {
            let counted = (sent, received);
            let first = ByteMeter { looked: now, counted, rate: ByteRate::default() };
            let known = self.all.get(&key);
            (key, known.map_or(first, |known| known.look(counted, now)))
        };
        self.all = all.into_iter().map(look).collect();
    }

    /// The rate between the last two looks.
    pub fn rate(&self, of: K) -> ByteRate {
        self.all.get(&of).map(|meter| meter.rate).unwrap_or_default()
    }
}

impl ByteMeter {
    fn look(self, counted: (u64, u64), now: Instant) -> Self {
        let millis = (now - self.looked).as_millis() as u64;
        if millis == 0 {
            return self;
        }
        let rate = |now: u64, before: u64| now.saturating_sub(before).saturating_mul(1000) / millis;
        let sent = rate(counted.0, self.counted.0);
        let received = rate(counted.1, self.counted.1);
        ByteMeter { looked: now, counted, rate: ByteRate { sent, received } }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rate_is_the_mean_since_the_last_look_whenever_that_was() {
        let mut rates = ByteRates::default();
        let mut look = |sent, received, now| {
            rates.handle_look([('a', sent, received), ('b', 7, 7)], Instant::from_millis(now));
            (rates.rate('a').sent, rates.rate('a').received)
        };
        assert_eq!(look(1_000, 0, 1_000), (0, 0), "since when is not known");
        assert_eq!(look(5_000, 8_000, 3_000), (2_000, 4_000));
        assert_eq!(look(5_001, 8_000, 3_000), (2_000, 4_000), "no time has passed");
        assert_eq!(look(10, 8_000, 4_000), (0, 0), "the counters have begun again");
        assert_eq!(look(110, 8_050, 4_100), (1_000, 500));
        assert_eq!((rates.rate('b'), rates.rate('c')), (ByteRate::default(), ByteRate::default()));
        rates.handle_look([], Instant::from_millis(5_000));
        assert_eq!(rates.rate('a'), ByteRate::default(), "it is gone");
    }
}
