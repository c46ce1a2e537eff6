//! The launcher: a process between a node and a program, so that nothing of the program outlives
//! either of them.
//!
//! ```text
//!  node ── socket: its end asks to stop ──► launcher ── starts ──► starter ── exec ──► program
//!       ◄─ one ProcessStatus a line ──────  adopts orphans         dies with the launcher
//! ```
//!
//! The program of the node is run again for both. The launcher adopts what the program leaves
//! behind (`PR_SET_CHILD_SUBREAPER`), samples memory, and listens as sd_notify(3) asks of a service
//! manager. Deliberately not here: what is done about a program that fails, which is the node's.

use super::signals::Terminations;
use super::{end_with_parent, now, wait};
use blastema_core::Instant;
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::process::{
    Pid, PidfdFlags, Signal, WaitOptions, getpid, kill_process, kill_process_group, pidfd_open,
    set_child_subreaper,
};
use serde::{Deserialize, Serialize};
use std::env;
use std::fs::{self, DirBuilder, File};
use std::io::{self, Read, Write};
use std::os::fd::{AsFd, BorrowedFd};
use std::os::unix::fs::{DirBuilderExt, MetadataExt};
use std::os::unix::net::{UnixDatagram, UnixStream};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, Stdio, exit};
use std::time::Duration;

/// Tells a process what it is to be: `launch`, or `start` and the launcher's process.
pub(crate) const STAGE: &str = "BLASTEMA_STAGE";

/// The launcher reports, samples memory and collects orphans that have ended so often.
pub(crate) const TICK: Duration = Duration::from_secs(1);
/// Longer than a launcher waits for a busy processor.
const LATE: Duration = Duration::from_millis(100);
/// systemd takes no longer messages (`NOTIFY_BUFFER_MAX`).
const MESSAGE_MAX: usize = 4096;
/// A program that sends more at once waits, since its socket is full: 6,400 messages a second.
const MESSAGES: usize = 64;
const PAUSE: Duration = Duration::from_millis(10);
/// As much of a `STATUS=` as a table shows.
const STATUS_MAX: usize = 200;

/// What the launcher is to know of a program.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct LaunchOrder {
    /// From SIGTERM to SIGKILL.
    pub(crate) stop_within: Duration,
    /// How far apart two `WATCHDOG=1` may be.
    pub(crate) watchdog: Option<Duration>,
    /// In bytes; `None` for no limit.
    pub(crate) memory_limit: Option<u64>,
    /// It does not say `READY=1`.
    pub(crate) ready_at_start: bool,
    /// Where the launcher hears the program. The node removes it after a launcher that was killed.
    pub(crate) folder: PathBuf,
}

/// What is known of a process. The launcher sends it whenever it changes, and at each tick.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(crate) struct ProcessStatus {
    /// The program's process, whose process group it leads.
    pub(crate) process: Option<i32>,
    /// It has said `READY=1`, or was started and is not to say it.
    pub(crate) is_ready: bool,
    /// The text of its last `STATUS=`.
    pub(crate) status: String,
    /// It has said `STOPPING=1`.
    pub(crate) is_stopping: bool,
    /// It has said no `WATCHDOG=1` for too long (false), or `WATCHDOG=trigger` (true).
    pub(crate) is_silent: Option<bool>,
    /// So many bytes are above its limit.
    pub(crate) resident: Option<u64>,
    /// All that it had started has ended with it.
    pub(crate) end: Option<ProcessEnd>,
}

/// How a process has ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) enum ProcessEnd {
    /// It was not started, or its launcher has ended.
    Failed(String),
    /// As wait(2) says, and whether the launcher had to kill it.
    Ended { status: i32, is_killed: bool },
}

/// Becomes the launcher or the starter where the environment says so; then it does not return.
pub(crate) fn take_stage() {
    let Ok(stage) = env::var(STAGE) else { return };
    match stage.strip_prefix("start ") {
        Some(launcher) => start(launcher),
        None => {
            let node = io::stdin().as_fd().try_clone_to_owned().map(UnixStream::from);
            let order = env::args().nth(1).and_then(|order| serde_json::from_str(&order).ok());
            let (Ok(node), Some(order)) = (node, order) else { exit(1) };
            let (reported, next_tick) = (ProcessStatus::default(), now() + TICK);
            let mut launcher =
                Launcher { node, order, sign: None, is_judged: false, reported, next_tick };
            let end = launcher.run().unwrap_or_else(|error| ProcessEnd::Failed(error.to_string()));
            launcher.report(|status| status.end = Some(end));
            exit(0)
        }
    }
}

/// Becomes the program, which dies with the launcher from then on.
fn start(launcher: &str) -> ! {
    let mut arguments = env::args_os().skip(1);
    let program = arguments.next().unwrap_or_default();
    let outcome = io::stdin().as_fd().try_clone_to_owned().map(File::from);
    let bound = launcher.parse::<u32>().map_err(io::Error::other).and_then(end_with_parent);
    let error = match bound {
        Ok(()) => Command::new(&program)
            .args(arguments)
            .env_remove(STAGE)
            .env("WATCHDOG_PID", std::process::id().to_string())
            .stdin(Stdio::null())
            .exec(),
        Err(error) => error,
    };
    if let Ok(mut outcome) = outcome {
        // A launcher that has ended needs no answer.
        let _ = write!(
            outcome,
            "{} could not be started: {error}; a script needs the program of its first line",
            program.display()
        );
    }
    exit(127)
}

struct Launcher {
    node: UnixStream,
    order: LaunchOrder,
    /// When the program was ready, or gave its last sign of life after that.
    sign: Option<Instant>,
    /// A failure was reported, or it is to stop: what it does until its end is of no interest.
    is_judged: bool,
    /// What is reported to the node.
    reported: ProcessStatus,
    next_tick: Instant,
}

impl Launcher {
    /// Reports to the node what has changed.
    fn report(&mut self, change: impl FnOnce(&mut ProcessStatus)) {
        change(&mut self.reported);
        let line = serde_json::to_string(&self.reported).expect("a status is plain data");
        // A node that has ended is found by the end of the socket.
        let _ = self.node.write_all(format!("{line}\n").as_bytes());
    }

    /// Runs the program to its end.
    fn run(&mut self) -> io::Result<ProcessEnd> {
        set_child_subreaper(Some(getpid()))?;
        // A service manager ends all processes of a service at once by SIGTERM: the node says when
        // it is the program's turn.
        let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
        let _entered = runtime.enter();
        let _signals = Terminations::listen()?;
        let socket = NotifySocket::open(self.order.folder.clone())?;
        let ended = spawn(self.order.watchdog, &socket).and_then(|program| {
            let lives = pidfd_open(program, PidfdFlags::empty())?;
            let is_ready = self.order.ready_at_start;
            self.sign = is_ready.then(now);
            let process = Some(program.as_raw_nonzero().get());
            self.report(|status| (status.process, status.is_ready) = (process, is_ready));
            self.watch(program, &socket.socket, lives.as_fd())
        });
        self.end_descendants();
        ended
    }

    /// Watches the program until it has ended.
    fn watch(
        &mut self,
        program: Pid,
        socket: &UnixDatagram,
        lives: BorrowedFd<'_>,
    ) -> io::Result<ProcessEnd> {
        let (mut kill_at, mut is_killed) = (None::<Instant>, false);
        loop {
            let wakes = [self.due(), kill_at.filter(|_| !is_killed)];
            let wake = wakes.into_iter().flatten().fold(self.next_tick, Instant::min);
            let mut sources = vec![
                PollFd::from_borrowed_fd(lives, PollFlags::IN),
                PollFd::from_borrowed_fd(socket.as_fd(), PollFlags::IN),
            ];
            if kill_at.is_none() {
                sources.push(PollFd::new(&self.node, PollFlags::IN));
            }
            let span = Timespec::try_from(wake - now()).map_err(io::Error::other)?;
            match poll(&mut sources, Some(&span)) {
                Ok(_) | Err(rustix::io::Errno::INTR) => {}
                Err(error) => return Err(error.into()),
            }
            let is_asked = sources.get(2).is_some_and(|node| !node.revents().is_empty());
            let mut end = None;
            while let Ok(Some((process, status))) = rustix::process::wait(WaitOptions::NOHANG) {
                if process == program {
                    end = Some(ProcessEnd::Ended { status: status.as_raw(), is_killed });
                }
            }
            // What the program said before its end counts.
            self.take_messages(socket);
            if let Some(end) = end {
                return Ok(end);
            }
            if is_asked {
                kill_at = Some(now() + self.order.stop_within);
                self.is_judged = true;
                // One that was stopped by SIGSTOP would not take the signal.
                for signal in [Signal::TERM, Signal::CONT] {
                    let _ = kill_process_group(program, signal);
                }
            }
            if kill_at.is_some_and(|at| now() >= at) && !is_killed {
                is_killed = true;
                let _ = kill_process_group(program, Signal::KILL);
            }
            self.judge_signs();
            if self.tick() {
                self.judge_memory();
            }
        }
    }

    /// At each tick, reports that the launcher runs; not to a node that stands still, which would
    /// hold it up.
    fn tick(&mut self) -> bool {
        let is_due = now() >= self.next_tick;
        if is_due {
            self.next_tick = now() + TICK;
            let mut node = [PollFd::new(&self.node, PollFlags::OUT)];
            if poll(&mut node, Some(&Timespec::default())) == Ok(1) {
                self.report(|_| {});
            }
        }
        is_due
    }

    /// Kills all processes that are left, and waits until there is none.
    fn end_descendants(&mut self) {
        loop {
            match rustix::process::wait(WaitOptions::NOHANG) {
                Ok(Some(_)) | Err(rustix::io::Errno::INTR) => {}
                Err(_) => return,
                Ok(None) => {
                    for (process, _) in descendants() {
                        let _ = kill_process(process, Signal::KILL);
                    }
                    wait(Duration::from_millis(1));
                }
            }
            self.tick();
        }
    }

    /// When the next sign of life is due.
    fn due(&self) -> Option<Instant> {
        let watched = self.sign.filter(|_| !self.is_judged).zip(self.order.watchdog);
        watched.map(|(sign, watchdog)| sign + watchdog)
    }

    /// Reports a program that has given no sign of life in time.
    fn judge_signs(&mut self) {
        let Some(due) = self.due().filter(|due| now() >= *due) else { return };
        // One that wakes so late stood still itself, and with it perhaps the program.
        if now() > due + LATE.max(self.order.watchdog.unwrap_or_default() / 2) {
            self.sign = Some(now());
            return;
        }
        self.is_judged = true;
        self.report(|status| status.is_silent = Some(false));
    }

    /// Reports a program that has more memory than it may.
    fn judge_memory(&mut self) {
        let Some(limit) = self.order.memory_limit.filter(|_| !self.is_judged) else { return };
        let page = u64::try_from(rustix::param::page_size()).unwrap_or(4096);
        let resident = descendants().iter().map(|(_, pages)| pages * page).sum();
        if resident > limit {
            self.is_judged = true;
            self.report(|status| status.resident = Some(resident));
        }
    }

    /// Takes what the program has said.
    fn take_messages(&mut self, socket: &UnixDatagram) {
        let mut message = [0; MESSAGE_MAX + 1];
        for _ in 0..MESSAGES {
            let Ok(length) = socket.recv(&mut message) else { return };
            if length <= MESSAGE_MAX {
                self.hear(&String::from_utf8_lossy(&message[..length]));
            }
        }
        wait(PAUSE);
    }

    /// Goes by one message of the program. As systemd, it ignores lines that it does not know.
    fn hear(&mut self, message: &str) {
        for line in message.lines() {
            match line {
                "READY=1" if self.sign.is_none() => {
                    self.sign = Some(now());
                    self.report(|status| status.is_ready = true);
                }
                // Before it is ready its watchdog does not count.
                "WATCHDOG=1" => self.sign = self.sign.map(|_| now()),
                "WATCHDOG=trigger" | "STOPPING=1" if self.is_judged => {}
                "WATCHDOG=trigger" | "STOPPING=1" => {
                    self.is_judged = true;
                    self.report(|status| match line {
                        "STOPPING=1" => status.is_stopping = true,
                        _ => status.is_silent = Some(true),
                    });
                }
                _ => {
                    if let Some(status) = line.strip_prefix("STATUS=") {
                        let plain = status.chars().map(|c| if c.is_control() { ' ' } else { c });
                        // For the next report, at the latest that of the next tick.
                        self.reported.status = plain.take(STATUS_MAX).collect();
                    }
                }
            }
        }
    }
}

/// Starts the program. Returns when it runs.
fn spawn(watchdog: Option<Duration>, socket: &NotifySocket) -> io::Result<Pid> {
    let (mut outcome, theirs) = io::pipe()?;
    let mut command = Command::new("/proc/self/exe");
    // Behind the order come the program and its arguments.
    command.args(env::args_os().skip(2)).env(STAGE, format!("start {}", std::process::id()));
    command.env("NOTIFY_SOCKET", socket.folder.join(NotifySocket::NAME));
    match watchdog {
        Some(watchdog) => command.env("WATCHDOG_USEC", watchdog.as_micros().to_string()),
        None => command.env_remove("WATCHDOG_USEC"),
    };
    let child = command.stdin(theirs).process_group(0).spawn()?;
    // The last end of the pipe on this side.
    drop(command);
    let mut failure = String::new();
    outcome.read_to_string(&mut failure)?;
    if failure.is_empty() { Ok(Pid::from_child(&child)) } else { Err(io::Error::other(failure)) }
}

/// Where the program says how it is. Its folder is this user's alone: no other user is heard.
struct NotifySocket {
    socket: UnixDatagram,
    folder: PathBuf,
}

impl NotifySocket {
    const NAME: &str = "notify";

    fn open(folder: PathBuf) -> io::Result<Self> {
        DirBuilder::new().mode(0o700).create(&folder).map_err(|error| {
            let text = format!(
                "{}: {error}: set XDG_RUNTIME_DIR to a folder of the user of this program",
                folder.display()
            );
            io::Error::new(error.kind(), text)
        })?;
        let socket = UnixDatagram::bind(folder.join(Self::NAME)).inspect_err(|_| {
            let _ = fs::remove_dir_all(&folder);
        })?;
        socket.set_nonblocking(true)?;
        Ok(NotifySocket { socket, folder })
    }
}

/// Where sockets of this user's processes are: in `XDG_RUNTIME_DIR` if that folder is the user's,
/// as the XDG Base Directory Specification asks, or else among the temporary files.
pub fn runtime_folder() -> PathBuf {
    let user = rustix::process::geteuid().as_raw();
    let is_ours = |path: &PathBuf| {
        path.metadata().is_ok_and(|folder| folder.is_dir() && folder.uid() == user)
    };
    let runtime = env::var_os("XDG_RUNTIME_DIR").map(PathBuf::from);
    runtime.filter(is_ours).unwrap_or_else(env::temp_dir)
}

impl Drop for NotifySocket {
    fn drop(&mut self) {
        // Another program may have deleted it.
        let _ = fs::remove_dir_all(&self.folder);
    }
}

/// The processes that this one has started or adopted, with those below them, and their resident
/// memory in pages.
fn descendants() -> Vec<(Pid, u64)> {
    let listed = fs::read_dir("/proc").into_iter().flatten().flatten();
    let all: Vec<(i32, i32, u64)> = listed
        .filter_map(|entry| {
            let process = entry.file_name().to_str()?.parse().ok()?;
            let stat = fs::read_to_string(entry.path().join("stat")).ok()?;
            // The name, in brackets, may hold anything: proc_pid_stat(5).
            let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
            Some((process, fields.get(1)?.parse().ok()?, fields.get(21)?.parse().ok()?))
        })
        .collect();
    let own = getpid().as_raw_nonzero().get();
    let mut family = vec![(own, 0)];
    let mut at = 0;
    while let Some(&(parent, _)) = family.get(at) {
        let children = all.iter().filter(|(_, of, _)| *of == parent);
        family.extend(children.map(|(process, _, pages)| (*process, *pages)));
        at += 1;
    }
    let below = family.into_iter().skip(1);
    below.filter_map(|(process, pages)| Some((Pid::from_raw(process)?, pages))).collect()
}
