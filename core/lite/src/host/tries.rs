//! How many unanswered tries declare a device lost, and how many the measured loss demands.

use super::event::HostEvent;
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
    /// This many. The host reports when the measured loss demands more.
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
    tries: u8,
    adapts: bool,
    asked: u32,
    failed: u32,
}

/// The estimate rests on so many tries.
const ESTIMATE_AFTER: u32 = 1_000;

impl LossEstimate {
    pub(super) fn new(tries: Tries) -> Self {
        let (tries, adapts) = match tries {
            Tries::Auto => (Tries::LEAST, true),
            Tries::Fixed(tries) => (tries.max(1), false),
        };
        LossEstimate { tries, adapts, asked: 0, failed: 0 }
    }

    /// How many tries in a row declare the device lost.
    pub(super) fn tries(&self) -> u8 {
        self.tries
    }

    /// Counts a try; returns a warning if the fixed number is too low.
    pub(super) fn count(&mut self, failed: bool, interval: Duration) -> Option<HostEvent> {
        self.asked += 1;
        self.failed += u32::from(failed);
        if self.asked < ESTIMATE_AFTER {
            return None;
        }
        let needed = Tries::needed(self.failed, self.asked, interval);
        let failed_per_mille = (self.failed * 1_000 / self.asked) as u16;
        (self.asked, self.failed) = (0, 0);
        if self.adapts {
            self.tries = needed;
        }
        let warning = HostEvent::TooFewTries { needed, failed_per_mille };
        (needed > self.tries).then_some(warning)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const INTERVAL: Duration = Duration::from_millis(10);

    fn after(tries: Tries, failed: u32) -> (LossEstimate, Option<HostEvent>) {
        let mut estimate = LossEstimate::new(tries);
        let warnings = (0..1_000).map(|asked| estimate.count(asked < failed, INTERVAL));
        let warning = warnings.last().flatten();
        (estimate, warning)
    }

    #[test]
    fn the_tries_follow_the_measured_loss() {
        let (mut estimate, warning) = after(Tries::Auto, 360);
        assert_eq!((estimate.tries(), warning), (16, None));
        for _ in 0..1_000 {
            assert_eq!(estimate.count(false, INTERVAL), None);
        }
        assert_eq!(estimate.tries(), Tries::LEAST, "the line is good again");
    }

    #[test]
    fn a_fixed_number_that_is_too_low_is_reported() {
        let (estimate, warning) = after(Tries::Fixed(3), 360);
        let expected = HostEvent::TooFewTries { needed: 16, failed_per_mille: 360 };
        assert_eq!((estimate.tries(), warning), (3, Some(expected)));
        assert_eq!(after(Tries::Fixed(16), 360).1, None);
    }

    #[test]
    fn a_line_that_carries_nothing_asks_for_all_tries_there_are() {
        assert_eq!(after(Tries::Auto, 1_000).0.tries(), u8::MAX);
    }
}
