//! The limits of one component's incarnation, and which of them make sense.

use crate::messaging::sender::DEFAULT_DEADLINE;
use blastema_core::detection::hang::{HangLimits, MaxSilence};
use blastema_core::detection::{Liveness, Pull, Push};
use std::ops::{Deref, RangeInclusive};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

/// The limits of one component's incarnation.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct ComponentLimits {
    pub(crate) interval: Option<Duration>,
    pub(crate) watch: Liveness,
    pub(crate) max_block: Duration,
    pub(crate) max_wait: Duration,
    pub(crate) max_delay: Duration,
    pub(crate) max_missed_percent: u8,
    pub(crate) ready_within: Duration,
    pub(crate) shutdown_within: Duration,
    pub(crate) own_thread: bool,
}

impl Default for ComponentLimits {
    fn default() -> Self {
        ComponentLimits {
            interval: None,
            watch: Liveness::Guard,
            // Fifty beats: far beyond what a loaded machine adds, and short for a robot's
            // standstill.
            max_block: Duration::from_millis(500),
            // Ten times the default deadline of a request that the handler may be waiting for.
            max_wait: Duration::from_secs(10),
            // A message that is older is too late for who asked with the default deadline.
            max_delay: DEFAULT_DEADLINE,
            // A controller that loses one round in four is not the one that was tuned. Less is lost
            // to a busy machine without real-time priorities.
            max_missed_percent: 25,
            // A device that has to warm up, a map that has to be loaded.
            ready_within: Duration::from_secs(10),
            // Outputs are brought to rest within a second or two.
            shutdown_within: Duration::from_secs(5),
            own_thread: false,
        }
    }
}

/// The limits of a component, as all who go by them share them.
#[derive(Clone)]
pub(crate) struct SharedLimits(Arc<(ComponentLimits, Arc<HangLimits>)>);

impl SharedLimits {
    /// By what the watch judges the component.
    pub(crate) fn judged(&self) -> Arc<HangLimits> {
        self.0.1.clone()
    }
}

impl Deref for SharedLimits {
    type Target = ComponentLimits;

    fn deref(&self) -> &ComponentLimits {
        &self.0.0
    }
}

impl From<ComponentLimits> for SharedLimits {
    fn from(limits: ComponentLimits) -> Self {
        static DEFAULT: LazyLock<SharedLimits> =
            LazyLock::new(|| SharedLimits::of(ComponentLimits::default()));
        // Most components have these.
        if limits == DEFAULT.0.0 { DEFAULT.clone() } else { SharedLimits::of(limits) }
    }
}

impl SharedLimits {
    fn of(limits: ComponentLimits) -> Self {
        let judged = Arc::new(limits.judged());
        SharedLimits(Arc::new((limits, judged)))
    }
}

/// The sampler looks once in a beat: with less, a component at work at two looks would be hanging.
const BLOCK_MIN: Duration = Duration::from_millis(10);
/// The clocks of threads and media are no finer than this.
const LEAST: Duration = Duration::from_millis(1);
/// Signs of life that come more seldom are of no use: then silence is not watched at all.
const SIGNS: RangeInclusive<Duration> = LEAST..=Duration::from_secs(24 * 60 * 60);
/// Signs of life that may be missing. A thousand is an hour of one in four seconds.
const TOLERANCE: RangeInclusive<u32> = 1..=1000;
/// No round need be missed: one may be under way whenever it is counted.
const PERCENT: RangeInclusive<u8> = 1..=100;

/// A limit that makes no sense.
#[derive(Debug)]
pub(crate) struct LimitError {
    pub(crate) setting: &'static str,
    pub(crate) value: String,
    /// What to write instead.
    pub(crate) cure: &'static str,
}

impl LimitError {
    fn new(setting: &'static str, value: String, cure: &'static str) -> Self {
        LimitError { setting, value, cure }
    }
}

impl ComponentLimits {
    fn judged(&self) -> HangLimits {
        let max_silence = match self.watch {
            // Half an interval of lateness is not another lost sign.
            Liveness::Push(push) => Some(MaxSilence {
                first: push.start_up,
                between: push
                    .interval
                    .saturating_mul(push.tolerance)
                    .saturating_add(push.interval / 2),
            }),
            _ => None,
        };
        // It is looked at every interval, and may be found dead that much later.
        let max_unanswered = match self.watch {
            Liveness::Pull(Pull { interval, within, tolerance, .. }) => {
                Some(within.saturating_mul(tolerance).saturating_add(interval))
            }
            _ => None,
        };
        HangLimits {
            max_block: self.max_block,
            max_wait: self.max_wait,
            max_silence,
            max_unanswered,
            max_delay: self.max_delay,
            max_missed_percent: self.max_missed_percent,
        }
    }

    /// Finds what would never, or always, be so. [`Duration::MAX`] is for ever, where that makes
    /// sense.
    pub(crate) fn check(&self) -> Result<(), LimitError> {
        let spans = [
            (
                "max_block",
                self.max_block,
                BLOCK_MIN,
                "10 ms at least: the watch looks no more often",
            ),
            (
                "max_wait",
                self.max_wait,
                LEAST,
                "no handler awaits anything so short: 1 ms at least",
            ),
            ("max_delay", self.max_delay, LEAST, "a message in the queue takes 1 ms at least"),
            ("ready_within", self.ready_within, LEAST, "nothing starts so fast: 1 ms at least"),
        ];
        for (setting, value, least, cure) in spans {
            if value < least {
                return Err(LimitError::new(setting, format!("{value:?}"), cure));
            }
        }
        if !PERCENT.contains(&self.max_missed_percent) {
            let value = format!("{} %", self.max_missed_percent);
            let cure = "write 1 to 99 %, or 100 for any number";
            return Err(LimitError::new("max_missed_rounds", value, cure));
        }
        match self.watch {
            Liveness::Push(push) => check_push(push),
            Liveness::Pull(pull) => check_pull(pull),
            _ => Ok(()),
        }
    }
}

fn check_push(push: Push) -> Result<(), LimitError> {
    let Push { interval, tolerance, start_up } = push;
    check_signs(interval, tolerance)?;
    if start_up < LEAST {
        let cure = "no incarnation gives a sign at once: 1 ms at least";
        return Err(LimitError::new("the watch's start_up", format!("{start_up:?}"), cure));
    }
    Ok(())
}

fn check_pull(pull: Pull) -> Result<(), LimitError> {
    let Pull { interval, within, tolerance } = pull;
    check_signs(interval, tolerance)?;
    if within < LEAST {
        let (value, cure) = (format!("{within:?}"), "an answer takes 1 ms at least");
        return Err(LimitError::new("the watch's within", value, cure));
    }
    Ok(())
}

fn check_signs(interval: Duration, tolerance: u32) -> Result<(), LimitError> {
    if !SIGNS.contains(&interval) {
        let cure = "write 1 ms to 24 h, or Liveness::Guard";
        return Err(LimitError::new("the watch's interval", format!("{interval:?}"), cure));
    }
    if !TOLERANCE.contains(&tolerance) {
        let cure = "write 1 to 1000 signs of life";
        return Err(LimitError::new("the watch's tolerance", tolerance.to_string(), cure));
    }
    Ok(())
}
