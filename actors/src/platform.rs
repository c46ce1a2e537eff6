//! Access to the operating system: the only file that reads a clock, starts threads and knows
//! processes.
#![expect(clippy::disallowed_methods, reason = "the clock is read here")]

pub(crate) mod alarm;
pub(crate) mod errors;
pub(crate) mod file_lock;
pub(crate) mod key_files;
#[cfg(feature = "process")]
pub(crate) mod launcher;
#[cfg(feature = "process")]
mod output_lines;
pub(crate) mod panics;
mod printer;
#[cfg(feature = "process")]
pub(crate) mod processes;
pub(crate) mod processor_time;
pub(crate) mod replace_file;
pub(crate) mod scheduling;
pub(crate) mod signals;
pub(crate) mod systemd;
#[cfg_attr(not(feature = "journal"), allow(unreachable_pub, reason = "the journal's times"))]
pub(crate) mod wall_time;
pub(crate) mod watchdog_device;

#[cfg(feature = "process")]
pub use output_lines::read_lines;
pub(crate) use printer::{finish_printing, tell_person};
pub use printer::{print, print_error_line, print_line};
#[cfg(feature = "process")]
pub use processes::finish_output;
pub use signals::{Termination, Terminations};

use blastema_core::{Incarnation, Instant};
use scheduling::ThreadScheduling;
use std::hash::{BuildHasher, RandomState};
use std::sync::{Mutex, MutexGuard, OnceLock, PoisonError};
use std::time::{Duration, SystemTime};
use std::{hint, io, process, thread};

/// A watchdog of the process: it fires when it has not been stroked for a while.
pub(crate) trait ProcessWatchdog: Send {
    /// What it is called in the log.
    fn name(&self) -> String;

    /// How often it wants to be stroked.
    fn interval(&self) -> Duration;

    /// Says that the process lives.
    ///
    /// # Errors
    /// The system refuses it.
    fn stroke(&mut self) -> io::Result<()>;

    /// The process ends in order: it is not to fire.
    fn close(&mut self) {}
}

/// Locks what a panic leaves as good as it was: no update of it is left half done.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// The point at which both clocks were read together.
struct Origin {
    runtime: tokio::time::Instant,
    monotonic_nanos: u64,
    wall_micros: u64,
}

fn origin() -> &'static Origin {
    static ORIGIN: OnceLock<Origin> = OnceLock::new();
    ORIGIN.get_or_init(|| {
        let monotonic = || nanos_of(rustix::time::ClockId::Monotonic);
        // The thread may lose its processor between two readings: the closest of a few count, since
        // timers of the kernel go by one clock and those of the runtime by the other.
        let readings = (0..8).map(|_| {
            let before = monotonic();
            // Not the runtime's own reading: a test that has paused and advanced its clock may be
            // the first to ask, and others of the process must not depend on how far it had come.
            let runtime = std::time::Instant::now().into();
            (monotonic() - before, before, runtime)
        });
        let closest = readings.min_by_key(|(apart, ..)| *apart);
        let (_, monotonic_nanos, runtime) = closest.expect("there are eight readings");
        Origin {
            runtime,
            monotonic_nanos,
            wall_micros: SystemTime::now()
                .duration_since(SystemTime::UNIX_EPOCH)
                .map_or(0, |since| u64::try_from(since.as_micros()).unwrap_or(u64::MAX)),
        }
    })
}

/// Returns the time of this thread's clock.
///
/// It is the system's monotonic clock, so that instants of two processes of one machine compare,
/// and it stands still and leaps as tokio's clock does where a test has paused that.
pub fn now() -> Instant {
    let origin = origin();
    let (now, both) = (tokio::time::Instant::now(), Instant::from_nanos(origin.monotonic_nanos));
    match now.checked_duration_since(origin.runtime) {
        Some(since) => both + since,
        // A clock that was paused before the time was first read.
        None => before(both, origin.runtime - now),
    }
}

/// Returns microseconds since 1970: the wall clock as it was when this process first read the time,
/// and what [`now`] has counted since. The system steers both at one rate, and a wall clock that is
/// set later changes nothing. It stands and leaps where a test has paused the clock.
pub fn stamp_us() -> u64 {
    let since = now().as_nanos().saturating_sub(origin().monotonic_nanos);
    origin().wall_micros.saturating_add(since / 1000)
}

/// The system's coarse clock, in nanoseconds: a few nanoseconds to read, and it ticks every 1 to 10
/// ms.
#[inline]
pub(crate) fn tick() -> u64 {
    nanos_of(rustix::time::ClockId::MonotonicCoarse)
}

#[inline]
fn nanos_of(clock: rustix::time::ClockId) -> u64 {
    let time = rustix::time::clock_gettime(clock);
    (time.tv_sec * 1_000_000_000 + time.tv_nsec).cast_unsigned()
}

/// Whether a test has paused this thread's clock. Takes a microsecond.
pub(crate) fn clock_stands() -> bool {
    let (before, since) = (tokio::time::Instant::now(), std::time::Instant::now());
    while since.elapsed() < Duration::from_micros(1) {
        hint::spin_loop();
    }
    tokio::time::Instant::now() == before
}

/// Waits for so long on this thread's clock, while other tasks of the thread run.
///
/// In a component, [a timer](crate::Context::after) leaves it free to serve meanwhile.
pub async fn sleep(span: Duration) {
    tokio::time::sleep(span).await;
}

/// What tokio's timers call `at`.
pub(crate) fn timer_at(at: Instant) -> tokio::time::Instant {
    let (origin, both) = (origin(), Instant::from_nanos(origin().monotonic_nanos));
    match both - at {
        Duration::ZERO => origin.runtime + (at - both),
        ahead => origin.runtime - ahead,
    }
}

fn before(at: Instant, span: Duration) -> Instant {
    let nanos = u64::try_from(span.as_nanos()).unwrap_or(u64::MAX);
    Instant::from_nanos(at.as_nanos().saturating_sub(nanos))
}

/// The incarnation of a node whose process starts now: milliseconds of the wall clock, so that it
/// is larger than that of any earlier process unless the clock was set back in between. A node with
/// keys keeps the last one in a file.
pub(crate) fn node_incarnation() -> Incarnation {
    let since = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default();
    Incarnation(u64::try_from(since.as_millis()).unwrap_or(u64::MAX))
}

/// Has the allocator keep the memory of large messages for the next ones: from a kernel that hands
/// out each page of four kibibytes by itself, fresh memory costs as much as all else that is done
/// with them.
///
/// What glibc has once mapped and freed, it takes from its heaps from then on, and gives their ends
/// back when they are twice as large (mallopt(3), `M_MMAP_THRESHOLD`). Other allocators see a block
/// come and go.
pub(crate) fn keep_freed_memory() {
    /// What is on its way between a sender and its peer, 5 MiB, and some of other sizes.
    const KEPT: usize = 8 << 20;
    drop(hint::black_box(Vec::<u8>::with_capacity(KEPT)));
}

/// The time on the wall clock.
pub(crate) fn wall_clock() -> wall_time::WallTime {
    let micros = match SystemTime::now().duration_since(SystemTime::UNIX_EPOCH) {
        Ok(since) => i64::try_from(since.as_micros()).unwrap_or(i64::MAX),
        Err(before) => -i64::try_from(before.duration().as_micros()).unwrap_or(i64::MAX),
    };
    wall_time::WallTime::from_micros(micros)
}

/// A seed that differs from run to run.
pub(crate) fn random_seed() -> u64 {
    RandomState::new().hash_one(0u64)
}

/// 32 bytes of the system's random source. They are wiped when they are dropped.
///
/// # Errors
/// The system gives none, as some do in the first seconds after they were switched on.
pub fn random_bytes() -> io::Result<zeroize::Zeroizing<[u8; 32]>> {
    let mut bytes = zeroize::Zeroizing::new([0; 32]);
    let mut filled = 0;
    while filled < bytes.len() {
        match rustix::rand::getrandom(&mut bytes[filled..], rustix::rand::GetRandomFlags::empty()) {
            Ok(more) => filled += more,
            Err(rustix::io::Errno::INTR) => {}
            Err(error) => return Err(error.into()),
        }
    }
    Ok(bytes)
}

/// Whether this processor has instructions for AES.
pub(crate) fn has_aes() -> bool {
    #[cfg(target_arch = "x86_64")]
    return std::arch::is_x86_feature_detected!("aes");
    #[cfg(target_arch = "aarch64")]
    return std::arch::is_aarch64_feature_detected!("aes");
    #[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
    return false;
}

/// `EMFILE` and `ENFILE`, which have no kind of their own: the process may open no more files, the
/// system may not.
const TOO_MANY_FILES: [i32; 2] = [24, 23];

/// Starts a thread of the middleware's own.
///
/// # Errors
/// The operating system has no thread left.
pub(crate) fn start_thread(
    name: &str,
    body: impl FnOnce() + Send + 'static,
) -> io::Result<thread::JoinHandle<()>> {
    thread::Builder::new().name(name.into()).spawn(body)
}

/// An arbiter on a thread of its own.
///
/// # Errors
/// The operating system has no thread left, or no files for its event loop.
pub(crate) fn own_arbiter() -> io::Result<actix_rt::ArbiterHandle> {
    scheduled_arbiter(ThreadScheduling::default())
}

/// The same, on a thread that is scheduled so.
///
/// # Errors
/// As above, or the operating system forbids such a thread.
pub(crate) fn scheduled_arbiter(
    scheduling: ThreadScheduling,
) -> io::Result<actix_rt::ArbiterHandle> {
    let arbiter = actix_rt::Arbiter::try_with_tokio_rt(move || {
        scheduling.apply().map_err(io::Error::other)?;
        tokio::runtime::Builder::new_current_thread().enable_all().build()
    });
    match arbiter {
        Ok(arbiter) => Ok(arbiter.handle()),
        Err(error) if error.raw_os_error().is_some_and(|it| TOO_MANY_FILES.contains(&it)) => {
            let advice = "raise the limit (`ulimit -n`, or `LimitNOFILE=` of a systemd service)";
            Err(io::Error::new(error.kind(), format!("{error}: {advice}")))
        }
        Err(error) => Err(error),
    }
}

/// How many more files this process may open, where the system says so.
pub(crate) fn files_left() -> Option<usize> {
    let most = rustix::process::getrlimit(rustix::process::Resource::Nofile).current?;
    let open = std::fs::read_dir("/proc/self/fd").ok()?.count();
    Some(usize::try_from(most).unwrap_or(usize::MAX).saturating_sub(open))
}

/// Writes to standard error what has happened to a node, and when.
pub(crate) fn tell_of_node(text: &str) {
    tell_person(format!("{} blastema: {text}", wall_clock()));
}

/// Ends the process at once.
pub(crate) fn end_process(code: i32) -> ! {
    finish_printing();
    process::exit(code)
}

/// Lets this thread wait, which is not an arbiter.
pub(crate) fn wait(span: Duration) {
    thread::sleep(span);
}

/// Asks the kernel to end this process when its parent ends, however that happens.
///
/// # Errors
/// The parent is already gone, or the kernel does not offer it.
pub fn end_with_parent(parent: u32) -> io::Result<()> {
    let signal = rustix::process::Signal::KILL;
    rustix::process::set_parent_process_death_signal(Some(signal))?;
    // The parent may have ended before the kernel knew that we care.
    let present = rustix::process::getppid().map(|pid| pid.as_raw_nonzero().get());
    if present.and_then(|pid| u32::try_from(pid).ok()) == Some(parent) {
        Ok(())
    } else {
        Err(io::Error::other("the process that started this one has ended"))
    }
}
