//! The settings of a node and of its components: the name, the default and the range of each, and
//! what to write instead of a value outside of the range.
//!
//! The manual's page on limits shows the same to users. A setting of a session, a link or the
//! supervision has its default in the core, beside the machine that goes by it.

pub(crate) mod network;

use std::fmt::Debug;
use std::ops::RangeInclusive;
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);
const MINUTE: Duration = Duration::from_secs(60);
const HOUR: Duration = Duration::from_secs(60 * 60);

/// One setting. Those without a default of their own have `()` in its place.
pub(crate) struct Setting<T: 'static, D = T> {
    /// As error texts call it.
    name: &'static str,
    pub(crate) default: D,
    range: RangeInclusive<T>,
    /// What to write instead of a value outside of the range.
    pub(crate) cure: &'static str,
}

/// A value that makes no sense.
#[derive(Debug, thiserror::Error)]
#[error("{setting} {value} makes no sense: {cure}")]
pub(crate) struct SettingError {
    pub(crate) setting: &'static str,
    pub(crate) value: String,
    /// What to write instead.
    pub(crate) cure: &'static str,
}

impl<T: PartialOrd + Debug, D> Setting<T, D> {
    /// Refuses a value outside of the range.
    pub(crate) fn check(&self, value: T) -> Result<(), SettingError> {
        match self.range.contains(&value) {
            true => Ok(()),
            false => Err(self.refuse(format!("{value:?}"), self.cure)),
        }
    }

    /// Refuses a value for another reason than its range.
    pub(crate) fn refuse(&self, value: String, cure: &'static str) -> SettingError {
        SettingError { setting: self.name, value, cure }
    }
}

/// How long [`Sender::ask`](crate::Sender::ask) waits for a reply: longer than any healthy handler
/// takes.
pub const DEFAULT_DEADLINE: Duration = SECOND;
/// How long a fault stands that a component has declared, and neither declares again nor clears.
pub(crate) const FAULT_HOLD: Duration = Duration::from_secs(10 * 60);

/// Shared arbiters: more than computers have cores. Each is a thread with its stack.
pub(crate) const WORK_THREADS: Setting<usize, ()> = Setting {
    name: "work_threads",
    default: (),
    range: 1..=1024,
    cure: "write 1 to 1024, or leave it out for one per core",
};

/// Twenty heartbeats: a handler that was merely slow has come back by then. The neighbours of a
/// handler that hangs stand still for as long.
pub(crate) const GRACE: Setting<Duration> = Setting {
    name: "grace",
    default: Duration::from_millis(200),
    range: Duration::ZERO..=HOUR,
    cure: "the neighbours of what hangs stand still for so long: an hour at most",
};

/// A call of the application's code from the fault chain. A call that takes no longer than a
/// heartbeat blocks no component, and safe outputs wait at most a minute.
pub(crate) const CALLBACK_LIMIT: Setting<Duration> = Setting {
    name: "callback_limit",
    default: Duration::from_millis(500),
    range: Duration::from_millis(10)..=MINUTE,
    cure: "write 10 ms to a minute, or leave it out for 500 ms",
};

/// Restarts that a supervisor may count: each of them is remembered for one period, and reported to
/// the fault chain. A storm of more would fill the chain's queues before it is ended.
pub(crate) const INTENSITY: Setting<u32, ()> =
    Setting { name: "intensity", default: (), range: 0..=1000, cure: "write 1000 at most" };

/// So many restarts in a shorter period are more than the fault chain can record, so that a storm
/// of them would go on for ever.
pub(crate) fn intensity_period(times: u32) -> Setting<Duration, ()> {
    Setting {
        name: "period",
        default: (),
        range: MS * times..=Duration::MAX,
        cure: "no restarts would ever be too many: write 1 ms at least for each of them",
    }
}

/// Messages that a queue holds: a second or two of a robot's rates. A million are seconds of the
/// fastest sender there is; more would be a leak with a name.
pub(crate) const QUEUE: Setting<usize> = Setting {
    name: "queue",
    default: 64,
    range: 1..=1 << 20,
    cure: "a queue holds one message at least, and a million at most",
};

/// Rounds a second, in virtual time and where the system has no exact timers. Faster, an arbiter
/// serves nothing else.
pub(crate) const RATE_HZ: Setting<f64, ()> = Setting {
    name: "rate_hz",
    default: (),
    range: f64::MIN_POSITIVE..=100_000.0,
    cure: "write a rate above 0 and up to 100000",
};

/// The same on a thread that components share. Its timers count whole milliseconds: of a period of
/// two, a round starts late by half at most.
pub(crate) const SHARED_RATE_HZ: Setting<f64, ()> = Setting {
    range: f64::MIN_POSITIVE..=500.0,
    cure: "a shared thread keeps rates above 0 and up to 500 Hz: give the component a thread of its \
           own (`on_own_thread`, in a robot file `thread=\"own\"`), which keeps up to 10000 Hz",
    ..RATE_HZ
};

/// The same on a thread of the component's own. Each round costs a few system calls: faster, they
/// take most of the thread.
pub(crate) const OWN_RATE_HZ: Setting<f64, ()> = Setting {
    range: f64::MIN_POSITIVE..=10_000.0,
    cure: "a thread of its own keeps rates above 0 and up to 10000 Hz",
    ..RATE_HZ
};

/// The priorities of `SCHED_FIFO` (sched(7)).
pub(crate) const PRIORITY: Setting<u8, ()> = Setting {
    name: "priority",
    default: (),
    range: 1..=99,
    cure: "write 1 to 99, of which 99 is served first",
};

/// As many processors as the kernel's sets of them have by default.
pub(crate) const CPU: Setting<usize, ()> =
    Setting { name: "cpu", default: (), range: 0..=1023, cure: "write 0 to 1023" };

/// Fifty heartbeats: far beyond what a loaded machine adds, and short for a robot's standstill.
/// The sampler looks once in a heartbeat: with less than one, a component at work at two looks
/// would be hanging.
pub(crate) const MAX_BLOCK: Setting<Duration> = Setting {
    name: "max_block",
    default: Duration::from_millis(500),
    range: Duration::from_millis(10)..=Duration::MAX,
    cure: "10 ms at least: the watch looks no more often",
};

/// Ten times the default deadline of a request that the handler may be waiting for.
pub(crate) const MAX_WAIT: Setting<Duration> = Setting {
    name: "max_wait",
    default: Duration::from_secs(10),
    range: MS..=Duration::MAX,
    cure: "no handler awaits anything so short: 1 ms at least",
};

/// A message that is older is too late for a caller with the default deadline.
pub(crate) const MAX_DELAY: Setting<Duration> = Setting {
    name: "max_delay",
    default: DEFAULT_DEADLINE,
    range: MS..=Duration::MAX,
    cure: "a message in the queue takes 1 ms at least",
};

/// Percent. A controller that loses one round in four is not the one that was tuned. Less is lost
/// to a busy machine without real-time priorities. One may be under way whenever they are counted.
pub(crate) const MAX_MISSED_ROUNDS: Setting<u8> = Setting {
    name: "max_missed_rounds",
    default: 25,
    range: 1..=100,
    cure: "write 1 to 99 %, or 100 for any number",
};

/// A device that has to warm up, a map that has to be loaded.
pub(crate) const READY_WITHIN: Setting<Duration> = Setting {
    name: "ready_within",
    default: Duration::from_secs(10),
    range: MS..=Duration::MAX,
    cure: "nothing starts so fast: 1 ms at least",
};

/// Outputs are brought to rest within a second or two. Zero gives no time at all.
pub(crate) const SHUTDOWN_WITHIN: Setting<Duration> = Setting {
    name: "shutdown_within",
    default: Duration::from_secs(5),
    range: Duration::ZERO..=Duration::MAX,
    cure: "write any span",
};

/// How far apart two signs of life of a program may be. It sends them twice as often, and its
/// launcher looks when one is due.
#[cfg(feature = "process")]
pub(crate) const WATCHDOG: Setting<Duration, ()> = Setting {
    name: "watchdog",
    default: (),
    range: Duration::from_millis(10)..=HOUR,
    cure: "write 10 ms to an hour",
};

/// Less than a mebibyte is less than a program that does nothing has.
#[cfg(feature = "process")]
pub(crate) const MEMORY_LIMIT: Setting<u64, ()> = Setting {
    name: "memory_limit",
    default: (),
    range: 1 << 20..=u64::MAX,
    cure: "no program has less: allow 1 MiB (1048576 bytes) at least",
};

/// How long a channel of a condition may be silent. More than an hour is no connection.
pub(crate) const CONDITION_TIMEOUT: Setting<Duration, ()> = Setting {
    name: "the timeout",
    default: (),
    range: Duration::from_millis(10)..=HOUR,
    cure: "write 10 ms to an hour",
};

/// When the last rung of a policy for lost communication begins, counted from the loss.
pub(crate) const LAST_RUNG_AFTER: Setting<Duration, ()> = Setting {
    name: "the time of its last rung",
    default: (),
    range: Duration::ZERO..=HOUR,
    cure: "write an hour at most",
};

/// Over which time the events of a topic are counted: conditions are looked at each 50 ms.
pub(crate) const CONDITION_WINDOW: Setting<Duration, ()> = Setting {
    name: "the window",
    default: (),
    range: Duration::from_millis(100)..=HOUR,
    cure: "write 100 ms to an hour",
};

/// How often heartbeats are sent: no more often than an arbiter's own, and once an hour at least.
pub(crate) const HEARTBEAT_INTERVAL: Setting<Duration, ()> = Setting {
    name: "the interval of heartbeats",
    default: (),
    range: Duration::from_millis(10)..=HOUR,
    cure: "write 10 ms to an hour",
};

/// Signs of life that come more seldom than once a day are of no use.
pub(crate) const WATCH_INTERVAL: Setting<Duration, ()> = Setting {
    name: "liveness.interval",
    default: (),
    range: MS..=Duration::from_secs(24 * 60 * 60),
    cure: "write 1 ms to 24 h, or the model guard without any",
};

/// Signs of life that may be missing. A thousand is an hour of one in four seconds.
pub(crate) const WATCH_TOLERANCE: Setting<u32, ()> = Setting {
    name: "liveness.tolerance",
    default: (),
    range: 1..=1000,
    cure: "write 1 to 1000 signs of life",
};

/// Until the first sign of life.
pub(crate) const WATCH_START_UP: Setting<Duration, ()> = Setting {
    name: "liveness.start_up",
    default: (),
    range: MS..=Duration::MAX,
    cure: "no life gives a sign at once: 1 ms at least",
};

/// Until an answer.
pub(crate) const WATCH_WITHIN: Setting<Duration, ()> = Setting {
    name: "liveness.within",
    default: (),
    range: MS..=Duration::MAX,
    cure: "an answer takes 1 ms at least",
};

/// Three renewals may be late or lost, and nothing moves on for longer than a person takes to be
/// startled. A shorter lease than the range allows would end whenever a computer is busy for a
/// moment; a longer one would let a robot move without a commander for longer than it takes to walk
/// up to it.
pub(crate) const LEASE: Setting<Duration> = Setting {
    name: "actuator.lease",
    default: Duration::from_millis(200),
    range: Duration::from_millis(20)..=MINUTE,
    cure: "write 20 ms to 60 s",
};

/// Three commands of a base that is commanded 30 times a second, or more. A beat is how often the
/// node looks. What is to go on for longer without a further command is a goal.
pub(crate) const COMMAND_TIMEOUT: Setting<Duration, ()> = Setting {
    name: "actuator.command_timeout",
    default: (),
    range: Duration::from_millis(10)..=MINUTE,
    cure: "write 10 ms to 60 s, or hold for commands that run for long",
};
