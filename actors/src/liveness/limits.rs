//! The limits of one component's incarnation, and which of them make sense together.

use crate::platform::scheduling::ThreadScheduling;
use crate::settings::{
    MAX_BLOCK, MAX_DELAY, MAX_MISSED_ROUNDS, MAX_WAIT, READY_WITHIN, SHUTDOWN_WITHIN, SettingError,
    WATCH_INTERVAL, WATCH_START_UP, WATCH_TOLERANCE, WATCH_WITHIN,
};
use blastema_core::detection::hang::{HangLimits, MaxSilence};
use blastema_core::detection::{Liveness, Pull, Push};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

/// The limits of one component's incarnation.
#[derive(Clone)]
pub(crate) struct ComponentLimits {
    pub(crate) interval: Option<Duration>,
    watch: Liveness,
    /// By what the hang detector judges it.
    pub(crate) hang: Arc<HangLimits>,
    pub(crate) ready_within: Duration,
    pub(crate) shutdown_within: Duration,
    pub(crate) own_thread: bool,
    pub(crate) scheduling: ThreadScheduling,
}

impl Default for ComponentLimits {
    fn default() -> Self {
        let hang = HangLimits {
            max_block: MAX_BLOCK.default,
            max_wait: MAX_WAIT.default,
            max_silence: None,
            max_unanswered: None,
            max_delay: MAX_DELAY.default,
            max_missed_percent: MAX_MISSED_ROUNDS.default,
        };
        ComponentLimits {
            interval: None,
            watch: Liveness::Guard,
            hang: Arc::new(hang),
            ready_within: READY_WITHIN.default,
            shutdown_within: SHUTDOWN_WITHIN.default,
            own_thread: false,
            scheduling: ThreadScheduling::default(),
        }
    }
}

impl ComponentLimits {
    /// The default ones, which most components share.
    pub(crate) fn shared() -> Arc<Self> {
        static DEFAULT: LazyLock<Arc<ComponentLimits>> = LazyLock::new(Arc::default);
        DEFAULT.clone()
    }

    /// By what the hang detector is to judge the component.
    pub(crate) fn hang(&mut self) -> &mut HangLimits {
        Arc::make_mut(&mut self.hang)
    }

    /// How its signs of life come.
    pub(crate) fn set_watch(&mut self, watch: Liveness) {
        self.watch = watch;
        self.hang().max_silence = match watch {
            // Half an interval of lateness is not another lost sign.
            Liveness::Push(Push { interval, tolerance, start_up }) => Some(MaxSilence {
                first: start_up,
                between: interval.saturating_mul(tolerance).saturating_add(interval / 2),
            }),
            _ => None,
        };
        self.hang().max_unanswered = match watch {
            // It is looked at every interval, and may be found dead that much later.
            Liveness::Pull(Pull { interval, within, tolerance, .. }) => {
                Some(within.saturating_mul(tolerance).saturating_add(interval))
            }
            _ => None,
        };
    }

    /// Finds what would never, or always, be so. [`Duration::MAX`] is for ever, where that makes
    /// sense.
    pub(crate) fn check(&self) -> Vec<SettingError> {
        let HangLimits { max_block, max_wait, max_delay, max_missed_percent, .. } = *self.hang;
        let mut checks = vec![
            MAX_BLOCK.check(max_block),
            MAX_WAIT.check(max_wait),
            MAX_DELAY.check(max_delay),
            MAX_MISSED_ROUNDS.check(max_missed_percent),
            READY_WITHIN.check(self.ready_within),
            SHUTDOWN_WITHIN.check(self.shutdown_within),
        ];
        match self.watch {
            Liveness::Push(Push { interval, tolerance, start_up }) => checks.extend([
                WATCH_INTERVAL.check(interval),
                WATCH_TOLERANCE.check(tolerance),
                WATCH_START_UP.check(start_up),
                self.check_rounds(interval, tolerance),
            ]),
            Liveness::Pull(Pull { interval, within, tolerance, .. }) => checks.extend([
                WATCH_INTERVAL.check(interval),
                WATCH_TOLERANCE.check(tolerance),
                WATCH_WITHIN.check(within),
            ]),
            _ => {}
        }
        let scheduling = self.scheduling.check(self.own_thread).into_iter().flatten();
        checks.into_iter().filter_map(Result::err).chain(scheduling).collect()
    }

    /// The rounds of a component come within the silence that its watch permits.
    fn check_rounds(&self, interval: Duration, tolerance: u32) -> Result<(), SettingError> {
        match self.interval {
            Some(round) if round > interval.saturating_mul(tolerance) => {
                let missing = format!("{interval:?} with {tolerance} missing");
                let value = format!("{missing}, but its rounds come every {round:?}");
                let cure = "write the time of a round at least, or a higher rate";
                Err(WATCH_INTERVAL.refuse(value, cure))
            }
            _ => Ok(()),
        }
    }
}
