//! The thread outside of the fault chain that watches it.
//!
//! ```text
//!  chain-watch ─ every 10 ms ─► callbacks: which take longer than they may?
//!       │      ─ are you alive ─► detection, recoverer, controller, one after the other
//!       │      ◄─ all answered ─┘
//!       └─ stroke ─► systemd, /dev/watchdog
//! ```
//!
//! Nothing of the application can keep the fault chain's thread but its log, and two things when
//! they are dropped: the messages that wait for a component that is not started again, and what the
//! factory of a removed component had captured. Should the chain not answer all the same, what can
//! still be done is done from here: the safe outputs are applied, and the watchdogs of the process
//! are stroked no more. It is not restarted on another thread: its log would block
//! that one too. There is no such thread in a node that runs on one thread.

use crate::platform::{self, ProcessWatchdog};
use crate::runtime::callbacks::Callbacks;
use actix::Recipient;
use blastema_contract::reports::AreYouAlive;
use blastema_core::ObjectName;
use std::future::pending;
use std::io;
use std::pin::Pin;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, mpsc};
use std::time::Duration;
use tokio::sync::{oneshot, watch};
use tokio::time::MissedTickBehavior;
use tracing::{error, info, warn};

/// A fiftieth of what a call may take by default.
const TICK: Duration = Duration::from_millis(10);
/// More than this between two ticks, and the whole process stood still: that is not held against
/// what it watches.
const STALL: Duration = Duration::from_millis(50);
/// How often the chain is asked, unless a watchdog wants to be stroked more often.
const PING_INTERVAL: Duration = Duration::from_millis(250);
/// A chain that has not answered for so long stands. It answers in microseconds: this is no matter
/// of load.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(5);
/// The thread ends after the present tick, unless a watchdog's driver blocks it.
const END_TIMEOUT: Duration = Duration::from_secs(1);

/// What the thread is given.
pub(crate) struct OutsideSetup {
    pub(crate) callbacks: Callbacks,
    /// The actors of the chain.
    pub(crate) pings: Vec<(ObjectName, Recipient<AreYouAlive>)>,
    pub(crate) watchdogs: Vec<Box<dyn ProcessWatchdog>>,
    /// Whether the chain stands.
    pub(crate) stands: watch::Sender<bool>,
    /// How much longer the chain may take to answer: while actuators are being stopped in order, a
    /// log that blocks the chain is not to cut them off.
    pub(crate) stop_limit: Box<dyn Fn() -> Duration + Send>,
    /// Is called with the reason when the chain begins to stand.
    pub(crate) last_resort: Box<dyn Fn(String) + Send>,
}

/// Ends the thread when dropped.
pub(crate) struct ChainWatch {
    end: Option<oneshot::Sender<bool>>,
    ended: mpsc::Receiver<()>,
}

impl ChainWatch {
    /// Watches a chain from now on.
    ///
    /// # Errors
    /// The operating system has no thread left, or nothing for its event loop.
    pub(crate) fn start(setup: OutsideSetup) -> io::Result<Self> {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build()?;
        let (end, end_order) = oneshot::channel();
        let (tell, ended) = mpsc::sync_channel(1);
        platform::start_thread("chain-watch", move || {
            runtime.block_on(Watching::new(setup).run(end_order));
            // The caller that started it may not wait.
            let _ = tell.send(());
        })?;
        Ok(ChainWatch { end: Some(end), ended })
    }

    /// Ends the thread. Where the process ends in order, its watchdogs are closed.
    pub(crate) fn end(mut self, in_order: bool) {
        self.tell(in_order);
    }

    fn tell(&mut self, in_order: bool) {
        if let Some(end) = self.end.take() {
            // It may have panicked; what it would have done is not done then.
            let _ = end.send(in_order);
            let _ = self.ended.recv_timeout(END_TIMEOUT);
        }
    }
}

impl Drop for ChainWatch {
    fn drop(&mut self) {
        self.tell(false);
    }
}

/// How long the chain has not answered, and what follows from that.
#[derive(Debug, Default)]
struct Silence {
    since: Duration,
    stands: bool,
}

impl Silence {
    /// Time passes without an answer. Says whether the chain stands from now on.
    fn handle_silent(&mut self, span: Duration, stop_limit: Duration) -> bool {
        self.since += span;
        let begins = !self.stands && self.since > ANSWER_TIMEOUT.saturating_add(stop_limit);
        self.stands |= begins;
        begins
    }

    /// All actors of the chain have answered. Says whether it had stood.
    fn handle_answered(&mut self) -> bool {
        self.since = Duration::ZERO;
        std::mem::take(&mut self.stands)
    }
}

struct Watching {
    setup: OutsideSetup,
    /// Which actor of the chain is being asked.
    asked: Arc<AtomicUsize>,
    silence: Silence,
    /// Each watchdog, with the time until its next stroke, and whether the last one failed.
    strokes: Vec<(Duration, bool)>,
}

impl Watching {
    fn new(setup: OutsideSetup) -> Self {
        let strokes = setup.watchdogs.iter().map(|_| (Duration::ZERO, false)).collect();
        Watching { setup, asked: Arc::default(), silence: Silence::default(), strokes }
    }

    async fn run(mut self, end_order: oneshot::Receiver<bool>) {
        let wanted = self.setup.watchdogs.iter().map(|watchdog| watchdog.interval());
        let every = wanted.fold(PING_INTERVAL, Duration::min).max(TICK);
        let mut ticks = tokio::time::interval(TICK);
        ticks.set_missed_tick_behavior(MissedTickBehavior::Delay);
        let mut last = platform::now();
        let (mut round_trip, mut rested) = (Some(self.round_trip()), Duration::ZERO);
        tokio::pin!(end_order);
        loop {
            let answered = async {
                match &mut round_trip {
                    Some(round_trip) => round_trip.await,
                    None => pending().await,
                }
            };
            tokio::select! {
                biased;
                in_order = &mut end_order => {
                    if in_order == Ok(true) {
                        self.setup.watchdogs.iter_mut().for_each(|watchdog| watchdog.close());
                    }
                    return;
                }
                () = answered => {
                    (round_trip, rested) = (None, Duration::ZERO);
                    self.handle_answered();
                }
                _ = ticks.tick() => {
                    let now = platform::now();
                    let since = (now - last).min(STALL);
                    last = now;
                    self.setup.callbacks.look(since);
                    self.strokes.iter_mut().for_each(|(left, _)| *left = left.saturating_sub(since));
                    if round_trip.is_some() {
                        self.handle_silent(since);
                        continue;
                    }
                    rested += since;
                    // Half a tick is not another one.
                    if rested + TICK / 2 >= every {
                        round_trip = Some(self.round_trip());
                    }
                }
            }
        }
    }

    /// Completes when each actor of the chain has answered.
    fn round_trip(&self) -> Pin<Box<dyn Future<Output = ()>>> {
        let pings = self.setup.pings.clone();
        let asked = self.asked.clone();
        Box::pin(async move {
            for (number, (_, pings)) in pings.into_iter().enumerate() {
                asked.store(number, Relaxed);
                if pings.send(AreYouAlive).await.is_err() {
                    // It has ended, and nothing starts it again.
                    return pending().await;
                }
            }
        })
    }

    fn handle_silent(&mut self, since: Duration) {
        if !self.silence.handle_silent(since, (self.setup.stop_limit)()) {
            return;
        }
        let (name, _) = &self.setup.pings[self.asked.load(Relaxed)];
        let reason =
            format!("the fault chain has not answered for {ANSWER_TIMEOUT:?} (asked was {name})");
        self.setup.stands.send_replace(true);
        // Before it is logged: the log may be what the chain waits for.
        (self.setup.last_resort)(reason.clone());
        platform::tell_of_node(&format!("{reason}; the safe outputs are applied"));
        error!(reason, "safe outputs applied; the watchdogs of the process are stroked no more");
    }

    fn handle_answered(&mut self) {
        if self.silence.handle_answered() {
            info!("the fault chain answers again");
            self.setup.stands.send_replace(false);
        }
        for (watchdog, (left, failed)) in self.setup.watchdogs.iter_mut().zip(&mut self.strokes) {
            // Early by a tick rather than late by one.
            if *left > TICK {
                continue;
            }
            *left = watchdog.interval();
            let result = watchdog.stroke();
            if let Err(error) = &result
                && !*failed
            {
                warn!(watchdog = watchdog.name(), %error, "a watchdog of the process cannot be stroked");
            }
            *failed = result.is_err();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::runtime::guardian::alive;
    use actix::prelude::*;
    use blastema_contract::reports::Alive;
    use std::io;
    use std::sync::atomic::AtomicBool;
    use std::sync::{Condvar, Mutex};

    const MS: Duration = Duration::from_millis(1);
    /// For threads of a busy computer.
    const PATIENCE: Duration = Duration::from_secs(30);

    #[test]
    fn a_chain_stands_once_until_it_answers_again() {
        let mut silence = Silence::default();
        assert!(!silence.handle_silent(ANSWER_TIMEOUT, Duration::ZERO));
        assert!(!silence.handle_answered());

        assert!(!silence.handle_silent(ANSWER_TIMEOUT, Duration::ZERO), "counted from the answer");
        assert!(silence.handle_silent(MS, Duration::ZERO));
        assert!(!silence.handle_silent(ANSWER_TIMEOUT, Duration::ZERO), "once");
        assert!(silence.handle_answered());
        assert!(!silence.handle_answered());
    }

    #[derive(Clone, Default)]
    struct Seen(Arc<(Mutex<(usize, usize)>, Condvar)>);

    impl Seen {
        fn wait_for(&self, wanted: impl Fn((usize, usize)) -> bool) -> (usize, usize) {
            let (seen, changed) = &*self.0;
            let seen = seen.lock().unwrap();
            let (seen, timeout) =
                changed.wait_timeout_while(seen, PATIENCE, |seen| !wanted(*seen)).unwrap();
            assert!(!timeout.timed_out(), "{seen:?}");
            *seen
        }
    }

    struct Counting(Seen);

    impl ProcessWatchdog for Counting {
        fn name(&self) -> String {
            "counting".into()
        }

        fn interval(&self) -> Duration {
            20 * MS
        }

        fn stroke(&mut self) -> io::Result<()> {
            self.0.0.0.lock().unwrap().0 += 1;
            self.0.0.1.notify_all();
            Ok(())
        }

        fn close(&mut self) {
            self.0.0.0.lock().unwrap().1 += 1;
        }
    }

    /// Answers unless it is stuck.
    struct Link {
        stuck: Arc<AtomicBool>,
    }

    impl Actor for Link {
        type Context = Context<Self>;
    }

    impl Handler<AreYouAlive> for Link {
        type Result = ResponseFuture<Alive>;

        fn handle(&mut self, _: AreYouAlive, _: &mut Context<Self>) -> ResponseFuture<Alive> {
            let stuck = self.stuck.clone();
            Box::pin(async move {
                while stuck.load(Relaxed) {
                    tokio::time::sleep(MS).await;
                }
                alive()
            })
        }
    }

    #[test]
    fn watchdogs_are_stroked_while_each_actor_of_the_chain_answers() {
        System::new().block_on(async {
            let (seen, stuck) = (Seen::default(), Arc::new(AtomicBool::new(false)));
            let pings = ["first", "second"].map(|name| {
                let stuck = if name == "second" { stuck.clone() } else { Arc::default() };
                (name.parse().unwrap(), Link { stuck }.start().recipient())
            });
            let setup = OutsideSetup {
                callbacks: Callbacks::default(),
                pings: pings.into(),
                watchdogs: vec![Box::new(Counting(seen.clone()))],
                stands: watch::channel(false).0,
                stop_limit: Box::new(|| Duration::ZERO),
                last_resort: Box::new(|_| {}),
            };
            let watch = ChainWatch::start(setup).unwrap();
            let wait = async |least: usize| {
                let seen = seen.clone();
                tokio::task::spawn_blocking(move || seen.wait_for(|(n, _)| n >= least))
                    .await
                    .unwrap()
                    .0
            };

            wait(3).await;
            stuck.store(true, Relaxed);
            // A round trip that had passed it already may end.
            tokio::time::sleep(100 * MS).await;
            let before = wait(0).await;
            tokio::time::sleep(300 * MS).await;
            assert_eq!(wait(0).await, before, "one of the chain does not answer");
            stuck.store(false, Relaxed);
            wait(before + 2).await;

            watch.end(true);
            assert_eq!(seen.wait_for(|_| true).1, 1);
        });
    }
}
