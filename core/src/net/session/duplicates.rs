//! Copies of one thing that come over several ways: the first is taken, the others are dropped.
//!
//! The vector recovery of IEEE 802.1CB (7.4.3.4), which is the duplicate discard of IEC 62439-3
//! (PRP) with a window instead of a time. A way that has failed is not noticed by what is
//! delivered, which is the purpose; so it is counted here, as the standard's latent error detection
//! does.

use std::collections::VecDeque;

/// How many numbers are remembered: longer than the slowest way is late, at a message each
/// millisecond.
const HISTORY: usize = 512;

/// The history of one stream.
#[derive(Debug, Default)]
pub(crate) struct DuplicateDiscard {
    /// How many copies have come of the numbers before `next`, oldest first.
    seen: VecDeque<u8>,
    /// One above the greatest number that has come.
    next: u64,
    /// The most copies that a number of late had: as many ways carry, or did.
    ways: u8,
    /// Numbers until the greatest count is taken again.
    renew_in: usize,
    most: u8,
    pub(crate) dropped: u64,
    /// Numbers that left the history without a copy.
    pub(crate) missed: u64,
    /// Numbers that left it with fewer copies than ways.
    pub(crate) alone: u64,
}

/// What a copy is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CopyStatus {
    First,
    Replica,
    /// Older than the history: whether it came before is not known here.
    Rogue,
}

impl DuplicateDiscard {
    pub(crate) fn handle(&mut self, number: u64) -> CopyStatus {
        if number >= self.next {
            // More than the window ahead is not believed; the stream refuses it as well.
            let ahead = usize::try_from(number - self.next).unwrap_or(usize::MAX);
            if ahead >= HISTORY {
                return CopyStatus::Rogue;
            }
            for _ in 0..ahead {
                self.advance(0);
            }
            self.advance(1);
            return CopyStatus::First;
        }
        let back = usize::try_from(self.next - number).unwrap_or(usize::MAX);
        let Some(place) = self.seen.len().checked_sub(back) else { return CopyStatus::Rogue };
        let count = &mut self.seen[place];
        *count = count.saturating_add(1);
        if *count == 1 {
            return CopyStatus::First;
        }
        self.dropped += 1;
        CopyStatus::Replica
    }

    /// One number more is remembered, and the oldest is judged.
    fn advance(&mut self, copies: u8) {
        self.next += 1;
        self.seen.push_back(copies);
        if self.seen.len() > HISTORY
            && let Some(copies) = self.seen.pop_front()
        {
            self.judge(copies);
        }
    }

    fn judge(&mut self, copies: u8) {
        self.missed += u64::from(copies == 0);
        self.alone += u64::from(0 < copies && copies < self.ways);
        self.most = self.most.max(copies);
        self.ways = self.ways.max(copies);
        match self.renew_in.checked_sub(1) {
            Some(less) => self.renew_in = less,
            None => {
                self.ways = std::mem::take(&mut self.most);
                self.renew_in = HISTORY;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_first_copy_is_taken_from_whichever_way_and_every_other_dropped() {
        let mut replicas = DuplicateDiscard::default();
        let came: Vec<_> = [0, 1, 0, 3, 1, 2, 3, 2, 3].map(|n| replicas.handle(n)).to_vec();

        use CopyStatus::{First, Replica};
        let wanted = [First, First, Replica, First, Replica, First, Replica, Replica, Replica];
        assert_eq!(came, wanted);
        assert_eq!(replicas.dropped, 5);
    }

    #[test]
    fn what_is_older_than_the_history_or_far_ahead_of_it_is_not_judged() {
        let mut replicas = DuplicateDiscard::default();
        for n in 0..2 * HISTORY as u64 {
            assert_eq!(replicas.handle(n), CopyStatus::First);
        }
        assert_eq!(replicas.handle(0), CopyStatus::Rogue);
        assert_eq!(replicas.handle(u64::MAX), CopyStatus::Rogue);
        assert_eq!(replicas.handle(HISTORY as u64), CopyStatus::Replica);
        assert_eq!(replicas.seen.len(), HISTORY);
    }

    #[test]
    fn a_way_that_has_failed_is_counted_although_nothing_is_missing() {
        let mut replicas = DuplicateDiscard::default();
        for n in 0..4 * HISTORY as u64 {
            replicas.handle(n);
            // The second way fails after a while.
            if n < 1000 {
                replicas.handle(n);
            }
        }
        assert_eq!((replicas.missed, replicas.dropped), (0, 1000));
        assert!(replicas.alone > 400, "{}", replicas.alone);

        // After a history without a second copy there is one way only, and that is no news.
        let before = replicas.alone;
        for n in 4 * HISTORY as u64..8 * HISTORY as u64 {
            replicas.handle(n);
        }
        assert!(replicas.alone - before <= HISTORY as u64);
    }

    #[test]
    fn what_no_way_brought_is_counted_as_missed() {
        let mut replicas = DuplicateDiscard::default();
        for n in (0..3 * HISTORY as u64).filter(|n| n % 10 != 5) {
            replicas.handle(n);
        }
        assert_eq!(replicas.missed, 2 * HISTORY as u64 / 10);
    }
}
