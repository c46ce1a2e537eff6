//! What was found wrong, and is a fault until it is over.
//!
//! An alarm is raised, seen again while its cause lasts, and over when it was not seen for a
//! minute, or is cleared.

use crate::Instant;
use crate::sorted::SortedMap;
use std::time::Duration;

/// Whatever goes on is heard of again within ten seconds: six times as long, and longer than an
/// announcement lives that is not repeated.
pub const QUIET: Duration = Duration::from_secs(60);

/// What stands, by what it is; as much as there are things to be wrong.
#[derive(Clone, Debug)]
pub struct ActiveAlarms<K> {
    /// When each was last seen.
    last: SortedMap<K, Instant>,
}

impl<K> Default for ActiveAlarms<K> {
    fn default() -> Self {
        ActiveAlarms { last: SortedMap::new() }
    }
}

impl<K: Ord + Clone> ActiveAlarms<K> {
    /// It is found now, and is over when it was not seen for a minute.
    pub fn raise(&mut self, what: K, now: Instant) {
        self.last.insert(what, now);
    }

    /// It was heard of again, if it stands.
    pub fn go_on(&mut self, what: &K, now: Instant) {
        if let Some(last) = self.last.get_mut(what) {
            *last = now;
        }
    }

    /// It has ended; answers whether it stood.
    pub fn clear(&mut self, what: &K) -> bool {
        self.last.remove(what).is_some()
    }

    /// What is over by now, once.
    pub fn take_over(&mut self, now: Instant) -> Vec<K> {
        let quiet = self.last.iter().filter(|(_, last)| **last + QUIET <= now);
        let over: Vec<K> = quiet.map(|(what, _)| what.clone()).collect();
        self.last.retain(|_, last| *last + QUIET > now);
        over
    }

    /// When the first of them may be over.
    pub fn due(&self) -> Option<Instant> {
        self.last.values().min().map(|last| *last + QUIET)
    }

    /// All that stands.
    pub fn iter(&self) -> impl Iterator<Item = &K> {
        self.last.keys()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Instant {
        Instant::from_millis(seconds * 1000)
    }

    #[test]
    fn what_goes_on_stands_and_is_over_a_minute_after_it_was_last_heard_of() {
        let mut latch = ActiveAlarms::default();
        latch.raise('a', at(0));
        latch.raise('b', at(2000));
        latch.go_on(&'a', at(50));
        latch.go_on(&'c', at(50));

        assert_eq!(latch.due(), Some(at(110)));
        assert_eq!(latch.take_over(at(109)), []);
        assert_eq!(latch.take_over(at(110)), ['a']);
        assert_eq!(latch.take_over(at(1000)), []);
        assert!(latch.iter().eq(&['b']));
        assert_eq!((latch.clear(&'b'), latch.clear(&'b')), (true, false));
    }
}
