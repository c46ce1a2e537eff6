//! The node's side of its processes: starts a launcher for each, and follows its reports.
//!
//! One thread has them all, so that a component that hangs neither ends a program nor holds up its
//! output.

use super::launcher::{LaunchOrder, ProcessEnd, ProcessStatus, STAGE, TICK};
use super::output_lines::read_lines;
use super::{print_error_line, sleep, start_thread};
use rustix::process::{Pid, Signal, kill_process_group};
use serde::{Deserialize, Serialize};
use std::ffi::OsString;
use std::io;
use std::os::fd::OwnedFd;
use std::path::PathBuf;
use std::process::Stdio;
use std::sync::{Arc, OnceLock};
use std::time::Duration;
use tokio::io::{AsyncBufReadExt, AsyncRead, BufReader};
use tokio::net::UnixStream;
use tokio::process::Command;
use tokio::runtime::Handle;
use tokio::sync::watch;
use tokio::task::JoinHandle;
use tracing::info;

/// What the program has written is in the pipe when its launcher ends.
const PRINTED_WITHIN: Duration = Duration::from_secs(1);
/// A launcher that has missed so many reports in a row stands still. They are counted one by one:
/// a node that stood still itself misses one.
const REPORTS_MISSED: u32 = 4;

/// The program that is run as a launcher: the one that is named, else this one.
static LAUNCHER: [OnceLock<PathBuf>; 2] = [const { OnceLock::new() }; 2];

/// Lets this program launch the [processes](crate::ProcessSpec) of its nodes: write it as the first
/// line of `main`. [`#[blastema::main]`](macro@crate::main) and `blastema_robot::Types::main` do so
/// by themselves.
///
/// A node runs its own program again for each process, as a launcher that ends with the node. Such
/// a run does not return from here.
pub fn launch_processes() {
    super::launcher::take_stage();
    let _ = LAUNCHER[1].set("/proc/self/exe".into());
}

/// Has another program launch the [processes](crate::ProcessSpec) of this program's nodes: one
/// whose `main` begins with [`launch_processes`], such as `blastema`. For tests, whose `main` is
/// not their own. The first program that is named counts.
pub fn launch_processes_by(program: impl Into<PathBuf>) {
    let _ = LAUNCHER[0].set(program.into());
}

/// The program that launches processes, where there is one.
pub(crate) fn launcher() -> Option<&'static PathBuf> {
    LAUNCHER.iter().find_map(OnceLock::get)
}

/// A program to run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(crate) struct ProgramCall {
    /// What its output is called in the log.
    pub(crate) name: String,
    pub(crate) program: PathBuf,
    pub(crate) arguments: Vec<OsString>,
    pub(crate) variables: Vec<(OsString, OsString)>,
    pub(crate) folder: Option<PathBuf>,
}

/// A process that was started.
#[derive(Clone)]
pub(crate) struct RunningProcess {
    pub(crate) status: watch::Receiver<ProcessStatus>,
    stop: Arc<watch::Sender<bool>>,
}

impl RunningProcess {
    /// Asks the program to stop: SIGTERM, and SIGKILL when its time has passed.
    pub(crate) fn stop(&self) {
        self.stop.send_replace(true);
    }

    /// It was asked to stop.
    pub(crate) fn is_stopped(&self) -> bool {
        *self.stop.borrow()
    }

    /// Waits until nothing of it is left.
    pub(crate) async fn ended(&self) -> ProcessEnd {
        let mut status = self.status.clone();
        let ended = status.wait_for(|status| status.end.is_some()).await;
        let end = ended.ok().and_then(|status| status.end.clone());
        end.unwrap_or_else(|| ProcessEnd::Failed("the thread of processes has ended".to_owned()))
    }
}

/// Starts the program.
///
/// # Errors
/// The operating system has no thread left, or no files.
pub(crate) fn start_process(call: ProgramCall, order: LaunchOrder) -> io::Result<RunningProcess> {
    let (sender, status) = watch::channel(ProcessStatus::default());
    let (stop, stopped) = watch::channel(false);
    let running = RunningProcess { status, stop: Arc::new(stop) };
    thread()?.spawn(async move {
        let failed = |error: io::Error| ProcessEnd::Failed(error.to_string());
        let end = follow(call, &order, &sender, stopped).await.unwrap_or_else(failed);
        sender.send_modify(|status| status.end = Some(end));
    });
    Ok(running)
}

/// The thread of all processes.
fn thread() -> io::Result<&'static Handle> {
    static THREAD: OnceLock<Handle> = OnceLock::new();
    if let Some(thread) = THREAD.get() {
        return Ok(thread);
    }
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    let handle = runtime.handle().clone();
    start_thread("processes", move || runtime.block_on(std::future::pending::<()>()))?;
    // Where two have started one, both run, and each has its processes.
    Ok(THREAD.get_or_init(|| handle))
}

/// Runs the launcher to its end.
async fn follow(
    call: ProgramCall,
    order: &LaunchOrder,
    sender: &watch::Sender<ProcessStatus>,
    mut stopped: watch::Receiver<bool>,
) -> io::Result<ProcessEnd> {
    let (own, theirs) = std::os::unix::net::UnixStream::pair()?;
    own.set_nonblocking(true)?;
    let program = launcher().ok_or_else(|| io::Error::other("there is no launcher"))?;
    let mut command = Command::new(program);
    command.arg(serde_json::to_string(order)?).arg(&call.program).args(&call.arguments);
    command.envs(call.variables).env(STAGE, "launch");
    if let Some(folder) = &call.folder {
        command.current_dir(folder);
    }
    command.stdin(Stdio::from(OwnedFd::from(theirs)));
    // A key that interrupts the node interrupts no program: the node stops them in order.
    command.stdout(Stdio::piped()).stderr(Stdio::piped()).process_group(0);
    let mut launcher = command.spawn()?;
    drop(command);
    let outputs =
        [log(&call.name, launcher.stdout.take()), log(&call.name, launcher.stderr.take())];
    let (reports, socket) = UnixStream::from_std(own)?.into_split();
    let (mut reports, mut socket) = (BufReader::new(reports).lines(), Some(socket));
    let (mut end, mut process, mut missed, mut stood_still) = (None, None, 0, false);
    loop {
        let line = tokio::select! {
            biased;
            line = reports.next_line() => line,
            _ = stopped.wait_for(|stopped| *stopped), if socket.is_some() => {
                // Its end is what the launcher takes for the order to stop.
                socket = None;
                continue;
            }
            // It says nothing while its program begins.
            () = sleep(TICK), if process.is_some() || socket.is_none() => {
                missed += 1;
                if missed == REPORTS_MISSED {
                    stood_still = true;
                    launcher.start_kill()?;
                }
                continue;
            }
        };
        let Ok(Some(line)) = line else { break };
        let mut status: ProcessStatus = serde_json::from_str(&line)?;
        (end, process, missed) = (status.end.take(), status.process, 0);
        sender.send_if_modified(|known| {
            let is_new = *known != status;
            *known = status;
            is_new
        });
    }
    drop(socket);
    let exit = launcher.wait().await?;
    if let (None, Some(group)) = (&end, process.and_then(Pid::from_raw)) {
        // The program has died with its launcher, and others of its group may live.
        let _ = kill_process_group(group, Signal::KILL);
    }
    // It is there if the launcher was killed.
    let _ = std::fs::remove_dir_all(&order.folder);
    finish_output(outputs).await;
    let lost = || {
        let why = match stood_still {
            true => {
                "it stood still for more than 3 s: look for who stopped it (SIGSTOP, a debugger), or \
                 for what keeps the computer from running it"
            }
            false => {
                "it was killed, or its `main` does not begin with `blastema::launch_processes()`"
            }
        };
        ProcessEnd::Failed(format!("its launcher {} ended with {exit}: {why}", program.display()))
    };
    Ok(end.unwrap_or_else(lost))
}

/// Writes each line of an output to the log; to standard error where the program keeps no log.
fn log(
    name: &str,
    output: Option<impl AsyncRead + Unpin + Send + 'static>,
) -> Option<JoinHandle<()>> {
    let (output, name) = (output?, name.to_owned());
    Some(tokio::spawn(read_lines(output, move |line| match tracing::dispatcher::has_been_set() {
        true => info!(process = name, "{line}"),
        false => print_error_line(format!("[{name}] {line}")),
    })))
}

/// Waits until what a process that has ended had written is read. What still holds its output open
/// writes into nothing.
pub async fn finish_output(outputs: [Option<JoinHandle<()>>; 2]) {
    let mut outputs: Vec<_> = outputs.into_iter().flatten().collect();
    let all = async {
        for output in &mut outputs {
            let _ = output.await;
        }
    };
    tokio::select! {
        () = all => {}
        () = sleep(PRINTED_WITHIN) => {}
    }
    for output in outputs {
        output.abort();
    }
}
