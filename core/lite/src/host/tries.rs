//! How many unanswered tries declare a device lost, and how many the measured loss demands.

use core::time::Duration;

/// When a device that does not answer is lost.
///
/// A try fails with `q = 1 - (1 - p)^2` on a line that loses each frame with `p`. At `p` = 20 %
/// three tries in a row fail in 4.7 % of cases.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Tries {
    /// As many as keep false alarms below one a day at the measured loss, at least 3.
    #[default]
    Auto,
    /// This many.
    Fixed(u8),
}

impl Tries {
    /// The fewest tries, also of a line without loss.
    pub const LEAST: u8 = 3;

    /// The tries that keep false alarms below one a day, if of `asked` tries `missed` failed.
    ///
    /// ```
    /// use blastema_lite::Tries;
    /// use core::time::Duration;
    /// // 36 % fail: 14 tries at 10 pings per second, 16 at 100.
    /// assert_eq!(Tries::needed(360, 1000, Duration::from_millis(100)), 14);
    /// assert_eq!(Tries::needed(360, 1000, Duration::from_millis(10)), 16);
    /// assert_eq!(Tries::needed(0, 1000, Duration::from_millis(10)), 3);
    /// ```
    pub fn needed(missed: u32, asked: u32, interval: Duration) -> u8 {
        const DAY_S: f32 = 86_400.0;
        let target = interval.as_secs_f32() / DAY_S;
        let fails = missed as f32 / asked.max(1) as f32;
        let mut all_fail = fails;
        let mut tries = 1;
        while all_fail > target && tries < u8::MAX {
            all_fail *= fails;
            tries += 1;
        }
        tries.max(Tries::LEAST)
    }
}

/// Counts tries, and those that failed.
#[derive(Clone, Copy, Debug)]
pub(super) struct LossEstimate {
    tries: Tries,
    needed: u8,
    asked: u32,
    failed: u32,
}

/// The estimate rests on so many tries.
const ESTIMATE_AFTER: u32 = 1_000;

impl LossEstimate {
    pub(super) fn new(tries: Tries) -> Self {
        LossEstimate { tries, needed: Tries::LEAST, asked: 0, failed: 0 }
    }

    /// How many tries in a row declare the device lost.
    pub(super) fn tries(&self) -> u8 {
        match self.tries {
            Tries::Auto => self.needed,
            Tries::Fixed(tries) => tries.max(1),
        }
    }

    /// Counts a try.
    pub(super) fn count(&mut self, failed: bool, interval: Duration) {
        self.asked += 1;
        self.failed += u32::from(failed);
        if self.asked >= ESTIMATE_AFTER {
            self.needed = Tries::needed(self.failed, self.asked, interval);
            (self.asked, self.failed) = (0, 0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTERVAL: Duration = Duration::from_millis(10);

    fn after(tries: Tries, failed: u32) -> LossEstimate {
        let mut estimate = LossEstimate::new(tries);
        (0..1_000).for_each(|asked| estimate.count(asked < failed, INTERVAL));
        estimate
    }

    #[test]
    fn the_tries_follow_the_measured_loss() {
        let mut estimate = after(Tries::Auto, 360);
        assert_eq!(estimate.tries(), 16);
        (0..1_000).for_each(|_| estimate.count(false, INTERVAL));
        assert_eq!(estimate.tries(), Tries::LEAST, "the line is good again");
    }

    #[test]
    fn a_fixed_number_stays_whatever_is_measured() {
        assert_eq!(after(Tries::Fixed(3), 360).tries(), 3);
    }

    #[test]
    fn a_line_that_carries_nothing_asks_for_all_tries_there_are() {
        assert_eq!(after(Tries::Auto, 1_000).tries(), u8::MAX);
    }
}
