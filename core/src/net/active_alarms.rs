//! What was found wrong, and is a fault until it is over.
//!
//! Of some things one hears when they go on, and of nothing when they have ended: they are over
//! when they were quiet for long enough. Others last until something puts an end to them.

use crate::Instant;
use std::collections::BTreeMap;
use std::time::Duration;

/// Whatever goes on is heard of again within ten seconds: six times as long, and longer than an
/// announcement lives that is not repeated.
pub const QUIET: Duration = Duration::from_secs(60);

/// What stands, by what it is; as much as there are things to be wrong.
#[derive(Clone, Debug)]
pub struct ActiveAlarms<K> {
    /// When it was last heard of; `None` for what lasts until it is ended.
    last: BTreeMap<K, Option<Instant>>,
}

impl<K> Default for ActiveAlarms<K> {
    fn default() -> Self {
        ActiveAlarms { last: BTreeMap::new() }
    }
}

impl<K: Ord + Clone> ActiveAlarms<K> {
    /// It is found now, and is over when nothing is heard of it any more.
    pub fn raise(&mut self, what: K, now: Instant) {
        self.last.insert(what, Some(now));
    }

    /// It is found, and lasts until it is [ended](ActiveAlarms::clear).
    pub fn raise_until_cleared(&mut self, what: K) {
        self.last.insert(what, None);
    }

    /// It was heard of again, if it stands.
    pub fn go_on(&mut self, what: &K, now: Instant) {
        if let Some(Some(last)) = self.last.get_mut(what) {
            *last = now;
        }
    }

    /// It has ended; answers whether it stood.
    pub fn clear(&mut self, what: &K) -> bool {
        self.last.remove(what).is_some()
    }

    /// What is over by now, once.
    pub fn take_over(&mut self, now: Instant) -> Vec<K> {
        let quiet = |last: &Option<Instant>| last.is_some_and(|at| at + QUIET <= now);
        let over = self.last.iter().filter(|(_, last)| quiet(last));
        let over: Vec<K> = over.map(|(what, _)| what.clone()).collect();
        self.last.retain(|_, last| !quiet(last));
        over
    }

    /// When the first of them may be over.
    pub fn due(&self) -> Option<Instant> {
        self.last.values().flatten().min().map(|last| *last + QUIET)
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
        latch.raise_until_cleared('b');
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
