//! The component whose life cycle is that of a program.
//!
//! ```text
//! on_activated     starts it, waits for READY=1     it ends by itself, or     fatal
//! on_deactivated   stops it                         exceeds its memory
//! on_aborting      stops it                         it misses its watchdog    silence
//! on_finalize      stops it                         exit status 0, STOPPING=1 the incarnation ends
//! ```

use super::ProcessSpec;
use crate::component::context::Context;
use crate::component::{Component, Failure};
use crate::platform::launcher::{LaunchOrder, ProcessEnd, ProcessStatus, runtime_folder};
use crate::platform::processes::{RunningProcess, start_process};
use crate::platform::{lock, random_seed, sleep};
use blastema_contract::reports::StateReported;
use blastema_core::{FaultKind, Lifecycle};
use std::future::poll_fn;
use std::os::unix::process::ExitStatusExt;
use std::process::{ExitStatus, id};
use std::sync::{Arc, Mutex};
use std::task::Poll;
use std::time::Duration;
use tracing::{info, warn};

/// What all incarnations of a process share.
pub(super) struct ProcessSettings {
    pub(super) spec: ProcessSpec,
    /// The program that was started last. Of an incarnation that hangs, it is stopped by the next.
    pub(super) latest: Mutex<Option<RunningProcess>>,
}

/// The component that stands for a program on its node; see [`ProcessSpec`].
pub struct SupervisedProcess {
    settings: Arc<ProcessSettings>,
    running: Option<RunningProcess>,
}

impl Drop for SupervisedProcess {
    fn drop(&mut self) {
        self.running.iter().for_each(RunningProcess::stop);
    }
}

/// What is done within a limit is done a little before it, so that it is told in its own words.
fn before(limit: Duration) -> Duration {
    limit - (limit / 10).min(Duration::from_millis(200))
}

impl SupervisedProcess {
    pub(super) fn new(settings: Arc<ProcessSettings>) -> Self {
        SupervisedProcess { settings, running: None }
    }

    /// Starts the program when the one before has ended.
    async fn start(&mut self, cx: &Context<Self>) -> Result<RunningProcess, String> {
        let limits = &cx.cell.record.limits;
        let earlier = lock(&self.settings.latest).take();
        if let Some(earlier) = earlier {
            earlier.stop();
            earlier.ended().await;
        }
        let spec = &self.settings.spec;
        if let Some((_, why)) = spec.problem() {
            return Err(why);
        }
        let order = LaunchOrder {
            stop_within: before(limits.shutdown_within),
            watchdog: spec.watchdog,
            memory_limit: spec.memory_limit,
            ready_at_start: spec.ready_at_start,
            folder: runtime_folder().join(format!("blastema-{}-{:016x}", id(), random_seed())),
        };
        let running = start_process(spec.call.clone(), order).map_err(|error| error.to_string())?;
        *lock(&self.settings.latest) = Some(running.clone());
        self.running = Some(running.clone());
        Ok(running)
    }

    /// Has the program stop, and waits until it has ended.
    async fn stop(&mut self, cx: &Context<Self>) {
        let Some(running) = self.running.clone() else { return };
        let within = cx.cell.record.limits.shutdown_within;
        let _long = cx.long_operation(within);
        let had_ended = running.status.borrow().end.is_some();
        running.stop();
        let end = running.ended().await;
        self.running = None;
        let (name, within) = (cx.name(), before(within));
        match end {
            ProcessEnd::Ended { is_killed: true, .. } => warn!(
                "{name} had not ended {within:?} after SIGTERM, and was killed: have it end then, or raise \
                 `shutdown_within`"
            ),
            _ if had_ended => {}
            ProcessEnd::Failed(why) => warn!("{name}: {why}"),
            ProcessEnd::Ended { .. } => info!("{name} has stopped"),
        }
    }

    /// Follows the program while it works.
    fn follow(&self, cx: &mut Context<Self>, running: RunningProcess) {
        let (cell, state) = (cx.cell.clone(), cx.state.clone());
        let settings = self.settings.clone();
        cx.spawn(async move {
            // After the report of the incarnation that it is active, which has no reason.
            tokio::task::yield_now().await;
            let (mut status, mut reported) = (running.status.clone(), ProcessStatus::default());
            loop {
                let now = status.borrow_and_update().clone();
                // What it does when it was asked to stop is as it should be.
                if running.is_stopped() {
                    return;
                }
                if now.status != reported.status
                    && let Some(states) = &cell.record.environment.reports.states
                {
                    let (object, incarnation) = (cell.record.name.clone(), state.incarnation);
                    let reason = Some(now.status.clone());
                    let state = Lifecycle::Active;
                    states.do_send(StateReported { object, incarnation, state, reason });
                }
                let with_status = |text: String| match now.status.as_str() {
                    "" => text,
                    said => format!("{text}; its last STATUS was {said:?}"),
                };
                let fail = |text: String| {
                    let failure = Failure::fatal(with_status(text));
                    state.defer(|wishes| wishes.failure = Some(failure));
                };
                if let Some(text) = now.end.as_ref().and_then(describe) {
                    return fail(text);
                }
                if now.end.is_some() || now.is_stopping {
                    info!("{} ends by itself", cell.record.name);
                    return state.defer(|wishes| wishes.stop = true);
                }
                if let Some(resident) = now.resident {
                    let limit = settings.spec.memory_limit.unwrap_or_default();
                    let (resident, limit) = (mebibytes(resident), mebibytes(limit));
                    return fail(format!(
                        "its processes have {resident} of memory resident, and {limit} are allowed: look for \
                         a leak, or raise `memory_limit`"
                    ));
                }
                if let (Some(triggered), None) = (now.is_silent, reported.is_silent) {
                    let text = match (triggered, settings.spec.watchdog) {
                        (false, Some(watchdog)) => format!(
                            "it did not say that it is alive (WATCHDOG=1) for {watchdog:?}: it hangs, or \
                             `watchdog` is too short"
                        ),
                        _ => "it said WATCHDOG=trigger: see what it wrote last in the log".to_owned(),
                    };
                    cell.record.declare(FaultKind::Silence, with_status(text));
                }
                reported = now;
                if status.changed().await.is_err() {
                    return;
                }
            }
        });
    }
}

impl Component for SupervisedProcess {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let limit = cx.cell.record.limits.ready_within;
        let _long = cx.long_operation(limit);
        let state = cx.state.clone();
        let is_ready = async {
            let running = self.start(cx).await?;
            let mut status = running.status.clone();
            let found = status.wait_for(|status| status.is_ready || status.end.is_some()).await;
            let found = found.map(|found| found.clone()).map_err(|error| error.to_string())?;
            match found.end {
                Some(end) if !found.is_ready => Err(match describe(&end) {
                    Some(text) => format!("before it was ready, {text}"),
                    None => "it ended before it was ready, with exit status 0: have it say READY=1 and run on"
                        .to_owned(),
                }),
                _ => Ok(running),
            }
        };
        let started = tokio::select! {
            biased;
            () = poll_fn(|_| match state.is_leaving.get() {
                // The order to leave wakes the component.
                true => Poll::Ready(()),
                false => Poll::Pending,
            }) => Err("it was stopped before it was ready".to_owned()),
            started = is_ready => started,
            () = sleep(before(limit)) => Err(format!(
                "it was not ready within {limit:?}: have it say READY=1 (sd_notify), raise `ready_within`, or \
                 let it count as ready when it was started"
            )),
        };
        let running = started.map_err(Failure::fatal)?;
        cx.cell.record.clear(FaultKind::Silence);
        self.follow(cx, running);
        Ok(())
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.stop(cx).await;
        Ok(())
    }

    async fn on_aborting(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.stop(cx).await;
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.stop(cx).await;
        Ok(())
    }
}

/// Why a program has ended, and what to do; `None` where it ended in order.
fn describe(end: &ProcessEnd) -> Option<String> {
    let status = match end {
        ProcessEnd::Failed(why) => return Some(why.clone()),
        ProcessEnd::Ended { status, .. } => ExitStatus::from_raw(*status),
    };
    let Some(number) = status.signal() else {
        let code = status.code().filter(|code| *code != 0)?;
        return Some(format!(
            "its program ended with exit status {code}: see what it wrote last in the log"
        ));
    };
    let named = status.to_string();
    // As in `signal: 11 (SIGSEGV) (core dumped)`.
    let name = named.split(['(', ')']).nth(1).unwrap_or("unknown");
    let what = format!("its program was ended by signal {number}, {name}");
    Some(match (status.core_dumped(), name) {
        (true, _) => format!("{what}, and left a core dump: read it, as by `coredumpctl`"),
        (_, "SIGKILL") => format!("{what}: unless a person sent it, memory ran out; see `dmesg`"),
        _ => format!("{what}: see what it wrote last in the log"),
    })
}

fn mebibytes(bytes: u64) -> String {
    format!("{:.1} MiB", bytes as f64 / f64::from(1 << 20))
}
