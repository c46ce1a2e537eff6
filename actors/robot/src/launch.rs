//! All nodes of a robot on one computer: each is a process, which is started again when it dies.

use blastema::core::SlidingWindow;
use blastema::core::recovery::Backoff;
use blastema::platform::{self, Terminations, finish_output, print_line, read_lines};
use blastema::sleep;
use rustix::process::{Pid, Signal, kill_process};
use std::ffi::OsString;
use std::pin::pin;
use std::process::{ExitStatus, Stdio};
use std::time::Duration;
use tokio::io::AsyncRead;
use tokio::process::{Child, Command};
use tokio::sync::{mpsc, oneshot, watch};
use tokio::task::{JoinHandle, spawn_local};

/// The file has a mistake, or the robot did not run to its end.
pub(crate) const FAILED: u8 = 1;
/// The first start of a node failed or was interrupted, and was undone.
pub(crate) const NOT_UP: u8 = 3;

/// Tells a node to end in order when its standard input does: then it outlives no launcher.
pub(crate) const UNTIL_STDIN_ENDS: &str = "--until-stdin-ends";

/// So many deaths of one node in one period are mended; more are a robot that does not work.
const RESTARTS: u32 = 3;
const PERIOD: Duration = Duration::from_secs(10);
/// Longer than a node takes to stop with the default `shutdown-within` of a few components.
const STOP_WITHIN: Duration = Duration::from_secs(30);
/// Between two signals to a node that is to end at once: longer than it takes to see one.
const SIGNAL_INTERVAL: Duration = Duration::from_millis(50);

/// The nodes to start, in this order.
pub(crate) struct Launch<'a> {
    pub(crate) nodes: Vec<&'a str>,
    /// Those of this program, to which `--node` is added.
    pub(crate) arguments: Vec<OsString>,
}

/// Why a robot does not run, and the exit status that says so.
#[derive(Debug)]
pub(crate) struct LaunchFailure {
    pub(crate) status: u8,
    pub(crate) reason: String,
}

fn failed(reason: String) -> LaunchFailure {
    LaunchFailure { status: FAILED, reason }
}

impl Launch<'_> {
    /// Runs all nodes until a signal, or until one of them cannot be kept.
    ///
    /// # Errors
    /// Which node did not come up, could not be kept, or did not stop. All others have been
    /// stopped.
    pub(crate) async fn run(self) -> Result<(), LaunchFailure> {
        let mut signals = Terminations::listen().map_err(|e| failed(format!("signals: {e}")))?;
        let hurry = watch::Sender::new(false);
        let (ends, mut failures) = mpsc::channel(self.nodes.len().max(1));
        let mut kept = Vec::new();
        for name in &self.nodes {
            let (stop, stopped) = oneshot::channel();
            let (name, arguments) = ((*name).to_owned(), self.arguments.clone());
            let (ends, hurried) = (ends.clone(), hurry.subscribe());
            let ended = spawn_local(async move {
                if let Err(LaunchFailure { status, reason }) =
                    keep(&name, &arguments, stopped, hurried).await
                {
                    let reason = format!("node {name}: {reason}");
                    // There is capacity for a failure of each node.
                    let _ = ends.send(LaunchFailure { status, reason }).await;
                }
            });
            kept.push((stop, ended));
        }
        drop(ends);
        let failure = tokio::select! {
            _ = signals.next() => None,
            failure = failures.recv() => failure,
        };
        let is_failure = failure.is_some();
        let stopped = async {
            // As children of a supervisor: the last that was started stops first.
            for (stop, ended) in kept.into_iter().rev() {
                let _ = stop.send(());
                let _ = ended.await;
            }
        };
        let again = async {
            if is_failure {
                signals.next().await;
            }
            let signal = signals.next().await;
            hurry.send_replace(true);
            signal
        };
        let (mut stopped, mut again) = (pin!(stopped), pin!(again));
        let second = tokio::select! {
            () = &mut stopped => None,
            signal = &mut again => {
                stopped.await;
                Some(signal)
            }
        };
        if let Some(signal) = second {
            let status = u8::try_from(signal.exit_code()).unwrap_or(FAILED);
            let reason = "a second signal ended the nodes at once".to_owned();
            return Err(LaunchFailure { status, reason });
        }
        // One that did not stop is the failure of a robot that had none before.
        failure.or_else(|| failures.try_recv().ok()).map_or(Ok(()), Err)
    }
}

/// Keeps the process of one node until it is to stop, or ends in order.
async fn keep(
    name: &str,
    arguments: &[OsString],
    mut stopped: oneshot::Receiver<()>,
    mut hurried: watch::Receiver<bool>,
) -> Result<(), LaunchFailure> {
    let (mut deaths, mut attempt) = (SlidingWindow::new(RESTARTS, PERIOD), 1);
    loop {
        let mut process = start(name, arguments)?;
        // The node ends when this is dropped; waiting would drop it at once.
        let stdin = process.stdin.take();
        let printing =
            [print_lines(name, process.stdout.take()), print_lines(name, process.stderr.take())];
        let status = tokio::select! {
            status = process.wait() => Some(status.map_err(|error| failed(error.to_string()))?),
            _ = &mut stopped => None,
            _ = hurried.wait_for(|hurried| *hurried) => None,
        };
        let Some(status) = status else {
            drop(stdin);
            let id = process.id();
            let stopped = tokio::select! {
                ended = process.wait() => match ended.is_ok_and(is_not_up) {
                    true if attempt == 1 => Err(LaunchFailure {
                        status: NOT_UP,
                        reason: "its start is undone".to_owned(),
                    }),
                    _ => Ok(()),
                },
                () = end_at_once(id, &mut hurried) => Ok(()),
                () = sleep(STOP_WITHIN) => {
                    let _ = process.kill().await;
                    Err(failed(format!("it did not stop within {STOP_WITHIN:?}, and was killed")))
                }
            };
            finish_output(printing).await;
            return stopped;
        };
        finish_output(printing).await;
        if status.success() {
            return Ok(());
        }
        if attempt == 1 && is_not_up(status) {
            let reason = "it did not come up, and the start of the robot is undone".to_owned();
            return Err(LaunchFailure { status: NOT_UP, reason });
        }
        let now = platform::now();
        if !deaths.add((), now) {
            return Err(failed(format!(
                "its process ended {} times in {PERIOD:?}, at last with {status}; all others stop",
                RESTARTS + 1
            )));
        }
        print_line(format!("[{name}] its process ended with {status}, and is started again"));
        attempt = if deaths.recent(now) == 1 { 2 } else { attempt + 1 };
        tokio::select! {
            () = sleep(Backoff::default().delay(attempt, u64::from(attempt))) => {}
            _ = &mut stopped => return Ok(()),
        }
    }
}

/// Has a node end at once, after its cut-offs, as soon as the launcher is in a hurry.
async fn end_at_once(id: Option<u32>, hurried: &mut watch::Receiver<bool>) {
    let id = id.and_then(|id| Pid::from_raw(id.cast_signed()));
    if let (Ok(_), Some(id)) = (hurried.wait_for(|hurried| *hurried).await, id) {
        // A node ends in order at the first signal and at once at the second, and signals that come
        // before it has seen the first are one.
        while kill_process(id, Signal::TERM).is_ok() {
            sleep(SIGNAL_INTERVAL).await;
        }
    }
    std::future::pending().await
}

fn is_not_up(status: ExitStatus) -> bool {
    status.code() == Some(i32::from(NOT_UP))
}

fn start(name: &str, arguments: &[OsString]) -> Result<Child, LaunchFailure> {
    let program = std::env::current_exe().map_err(|error| failed(error.to_string()))?;
    let mut command = Command::new(program);
    command.args(arguments).args(["--node", name, UNTIL_STDIN_ENDS]);
    command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped());
    // A key that interrupts the launcher interrupts no node: the launcher stops them in order.
    command.process_group(0).kill_on_drop(true);
    command.spawn().map_err(|error| failed(format!("its process does not start: {error}")))
}

/// Prints what a process writes, each line behind the name of its node.
fn print_lines(
    name: &str,
    output: Option<impl AsyncRead + Unpin + 'static>,
) -> Option<JoinHandle<()>> {
    let (output, name) = (output?, name.to_owned());
    Some(spawn_local(read_lines(output, move |line| print_line(format!("[{name}] {line}")))))
}
