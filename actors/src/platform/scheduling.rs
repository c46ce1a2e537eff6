//! How the system schedules a component's own thread, and whether it may swap the process out.

use crate::settings::{CPU, PRIORITY, SettingError};
use rustix::mm::{MlockAllFlags, mlockall};
use rustix::process::{Resource, getrlimit};
use rustix::thread::{CapabilitySet, CpuSet, capabilities, sched_setaffinity};
use std::{io, thread};
use thread_priority::{
    Error, RealtimeThreadSchedulePolicy, ScheduleParams, ThreadPriority, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// How the system is to schedule a thread. By default, as any other.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct ThreadScheduling {
    /// The priority of `SCHED_FIFO` (sched(7)).
    pub(crate) priority: Option<u8>,
    /// The number of the only processor to run on.
    pub(crate) cpu: Option<usize>,
}

impl ThreadScheduling {
    pub(crate) fn is_default(self) -> bool {
        self == ThreadScheduling::default()
    }

    /// Finds what would never be so, on any computer.
    pub(crate) fn check(self, own_thread: bool) -> [Option<SettingError>; 2] {
        const CURE: &str = "give the component a thread of its own (`on_own_thread`, in a robot \
                            file `thread=\"own\"`)";
        let shared = |value: String| format!("{value} on a shared thread");
        let priority = self.priority.map(|priority| match own_thread {
            true => PRIORITY.check(priority),
            false => Err(PRIORITY.refuse(shared(priority.to_string()), CURE)),
        });
        let cpu = self.cpu.map(|cpu| match own_thread {
            true => CPU.check(cpu),
            false => Err(CPU.refuse(shared(cpu.to_string()), CURE)),
        });
        [priority.and_then(Result::err), cpu.and_then(Result::err)]
    }

    /// Tries it on a thread that ends at once.
    ///
    /// # Errors
    /// The system forbids it.
    pub(crate) fn try_out(self) -> Result<(), SettingError> {
        thread::scope(|scope| scope.spawn(|| self.apply()).join()).unwrap_or(Ok(()))
    }

    /// Has this thread scheduled so.
    ///
    /// # Errors
    /// The system forbids it.
    pub(crate) fn apply(self) -> Result<(), SettingError> {
        let refused = |value: String, error: io::Error| format!("{value}, which failed: {error}");
        if let Some(cpu) = self.cpu {
            let mut only = CpuSet::new();
            only.set(cpu);
            sched_setaffinity(None, &only).map_err(|error| {
                let cure = "write the number of a processor that this process may use: \
                            `taskset -cp $$` lists them";
                CPU.refuse(refused(cpu.to_string(), error.into()), cure)
            })?;
        }
        let Some(priority) = self.priority else { return Ok(()) };
        let wanted = ThreadPriority::from_posix(ScheduleParams { sched_priority: priority.into() });
        let fifo = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        set_thread_priority_and_policy(thread_native_id(), wanted, fifo).map_err(|error| {
            let error = match error {
                Error::OS(code) => io::Error::from_raw_os_error(code),
                other => io::Error::other(format!("{other:?}")),
            };
            let cure = "allow it by `rtprio` in /etc/security/limits.conf, `LimitRTPRIO=` of a \
                        systemd service, or the capability CAP_SYS_NICE";
            PRIORITY.refuse(refused(priority.to_string(), error), cure)
        })
    }
}

/// Keeps all memory of this process, now and later, from being swapped out (mlockall(2)).
///
/// # Errors
/// The system forbids it, or would refuse memory later on.
pub(crate) fn lock_memory() -> Result<(), SettingError> {
    let refused = |why: String| SettingError {
        setting: "locked_memory",
        value: format!("on, which failed: {why}"),
        cure: "allow it by `memlock unlimited` in /etc/security/limits.conf, \
               `LimitMEMLOCK=infinity` of a systemd service, or the capability CAP_IPC_LOCK",
    };
    let privileged =
        || capabilities(None).is_ok_and(|sets| sets.effective.contains(CapabilitySet::IPC_LOCK));
    match getrlimit(Resource::Memlock).current {
        // An allocation beyond the limit would end the process.
        Some(limit) if !privileged() => Err(refused(format!("the limit is {limit} bytes"))),
        _ => mlockall(MlockAllFlags::CURRENT | MlockAllFlags::FUTURE)
            .map_err(|error| refused(error.to_string())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rustix::thread::set_capabilities;

    #[test]
    fn a_priority_and_a_processor_need_a_thread_of_the_components_own_and_a_number_in_range() {
        let of = |priority, cpu| ThreadScheduling { priority, cpu };
        let refused = |scheduling: ThreadScheduling, own_thread| {
            let found = scheduling.check(own_thread).into_iter().flatten();
            found.map(|error| error.setting).collect::<Vec<_>>()
        };
        assert_eq!(refused(of(None, None), false), [""; 0]);
        assert_eq!(refused(of(Some(80), Some(1)), true), [""; 0]);
        assert_eq!(refused(of(Some(80), Some(1)), false), ["priority", "cpu"]);
        for priority in [0, 100] {
            assert_eq!(refused(of(Some(priority), Some(1024)), true), ["priority", "cpu"]);
        }
    }

    #[test]
    fn a_processor_that_is_not_there_is_refused() {
        let none = ThreadScheduling { cpu: Some(1023), priority: None };
        let refused = none.try_out().expect_err("no computer of tests has so many");
        assert!(refused.to_string().contains("cpu 1023, which failed"), "{refused}");
    }

    /// On a thread without this capability.
    fn without<T: Send>(capability: CapabilitySet, call: impl FnOnce() -> T + Send) -> T {
        let body = || {
            let mut sets = capabilities(None).expect("the system has capabilities");
            sets.effective.remove(capability);
            set_capabilities(None, sets).expect("it may have less than it has");
            call()
        };
        thread::scope(|scope| scope.spawn(body).join().expect("it does not panic"))
    }

    #[test]
    fn what_the_system_forbids_is_refused_with_what_allows_it() {
        if getrlimit(Resource::Rtprio).current.is_some_and(|limit| limit < 99) {
            let highest = ThreadScheduling { priority: Some(99), cpu: None };
            let refused = without(CapabilitySet::SYS_NICE, || highest.try_out());
            let refused = refused.expect_err("99 is above the limit").to_string();
            let words = ["priority 99, which failed", "rtprio", "LimitRTPRIO=", "CAP_SYS_NICE"];
            assert!(words.iter().all(|word| refused.contains(word)), "{refused}");
        }
        if getrlimit(Resource::Memlock).current.is_some() {
            let refused = without(CapabilitySet::IPC_LOCK, lock_memory);
            let refused = refused.expect_err("there is a limit").to_string();
            let words = ["locked_memory", "memlock", "LimitMEMLOCK=", "CAP_IPC_LOCK"];
            assert!(words.iter().all(|word| refused.contains(word)), "{refused}");
        }
    }
}
