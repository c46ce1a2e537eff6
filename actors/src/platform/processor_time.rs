//! How much of the processor a thread was given.

use blastema_core::detection::hang::ProcessorTime;
use std::fs;
use std::time::Duration;

/// A thread of this process.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct ThreadNumber(u32);

impl ThreadNumber {
    /// This thread.
    pub(crate) fn here() -> Self {
        ThreadNumber(rustix::thread::gettid().as_raw_nonzero().get().cast_unsigned())
    }

    /// The processor time that the thread has used so far, if it runs or is ready to run; `None`
    /// where it waits for something, has ended, or the system does not tell.
    ///
    /// The state is the third field of proc_pid_stat(5).
    pub(crate) fn used_while_ready(self) -> Option<Duration> {
        // The thread's name before it, in parentheses, may hold any character.
        let is_ready = self.read("stat")?.rsplit_once(") ")?.1.starts_with('R');
        Some(self.processor_time().filter(|_| is_ready)?.used)
    }

    /// What the thread has had of the processors so far; `None` where it has ended, or the system
    /// does not tell.
    ///
    /// The first two fields of `schedstat` (sched-stats.rst). The kernel brings the first up to
    /// date with each tick, and the second whenever the thread gets a processor.
    pub(crate) fn processor_time(self) -> Option<ProcessorTime> {
        let text = self.read("schedstat")?;
        let mut nanos = text.split(' ').map(|field| field.parse().map(Duration::from_nanos));
        let time = ProcessorTime { used: nanos.next()?.ok()?, waited: nanos.next()?.ok()? };
        // A kernel that does not count shows zeros.
        Some(time).filter(|time| !time.used.is_zero())
    }

    fn read(self, file: &str) -> Option<String> {
        fs::read_to_string(format!("/proc/self/task/{}/{file}", self.0)).ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;
    use std::thread;

    /// On real threads.
    mod real {
        use super::*;

        #[test]
        fn a_thread_that_works_is_ready_and_uses_time_and_one_that_waits_is_not() {
            let _turn = blastema_doubles::turn();
            let here = ThreadNumber::here();
            // A thread that has just begun has not been counted yet.
            let used = || std::iter::repeat_with(|| here.used_while_ready()).find_map(|used| used);
            let before = used().unwrap();
            while used().unwrap() < before + Duration::from_millis(10) {}

            let (sender, receiver) = mpsc::channel();
            let (end, ended) = mpsc::channel::<()>();
            let waiter = thread::spawn(move || {
                sender.send(ThreadNumber::here()).unwrap();
                let _ = ended.recv();
            });
            let waiting = receiver.recv().unwrap();
            while waiting.used_while_ready().is_some() {
                thread::yield_now();
            }

            drop(end);
            waiter.join().unwrap();
            assert_eq!(waiting.used_while_ready(), None);
        }
    }
}
