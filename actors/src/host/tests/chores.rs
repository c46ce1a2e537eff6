//! Timers, tasks, threads and isolation.

use super::{GRANT, Log, Stage, logged, logging};
use crate::liveness::sampler::AliveSource;
use crate::platform;
use crate::{
    ChildSpec, Component, Context, DeliveryError, Event, Failure, Handle, Ports, Request, Sender,
};
use blastema_core::Instant;
use blastema_doubles::{advance, settle};
use std::sync::{Arc, Mutex};
use std::time::Duration;

const TICK: Duration = Duration::from_millis(10);

#[derive(Clone, Event)]
enum Job {
    Every,
    EveryAndCancel,
    TellEvery,
    After,
    Block(u64),
    Wait(u64),
    Task,
    TaskWhileWaiting,
    Die,
    Detach,
}

#[derive(Clone, Event)]
struct Tick;

#[derive(Clone, Debug, PartialEq, Event)]
struct Said(u64);

struct Worker {
    log: Log,
    detached: Arc<Mutex<Option<Sender<Said>>>>,
}

impl Component for Worker {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Said>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Ok(())
    }
}

impl Handle<Tick> for Worker {
    async fn handle(&mut self, _: Tick, _: &mut Context<Self>) {
        self.log.lock().unwrap().push(2);
    }
}

impl Handle<Said> for Worker {
    async fn handle(&mut self, Said(n): Said, _: &mut Context<Self>) {
        self.log.lock().unwrap().push(n);
    }
}

impl Handle<Job> for Worker {
    async fn handle(&mut self, job: Job, cx: &mut Context<Self>) {
        let log = self.log.clone();
        match job {
            Job::Every => {
                cx.every(TICK, |worker: &mut Worker, _| worker.log.lock().unwrap().push(1));
            }
            Job::EveryAndCancel => {
                let mut left = 2;
                let id = Arc::new(Mutex::new(None));
                let known = id.clone();
                *id.lock().unwrap() = Some(cx.every(TICK, move |worker, cx| {
                    worker.log.lock().unwrap().push(1);
                    left -= 1;
                    if left == 0 {
                        cx.cancel(known.lock().unwrap().unwrap());
                    }
                }));
            }
            Job::TellEvery => drop(cx.tell_every(TICK, Tick)),
            Job::After => {
                cx.after(TICK, |worker, _| worker.log.lock().unwrap().push(3));
                cx.tell_after(2 * TICK, Tick);
            }
            Job::Block(millis) => {
                // Stands for a handler that blocks: its arbiter's clock moves, its loop does not.
                tokio::time::advance(Duration::from_millis(millis)).await;
            }
            Job::Wait(millis) => tokio::time::sleep(Duration::from_millis(millis)).await,
            Job::Task => cx.spawn(async move {
                loop {
                    tokio::time::sleep(TICK).await;
                    log.lock().unwrap().push(4);
                }
            }),
            Job::TaskWhileWaiting => {
                let (done, wait) = tokio::sync::oneshot::channel();
                cx.spawn(async move {
                    tokio::time::sleep(TICK).await;
                    let _ = done.send(5);
                });
                let n = wait.await.unwrap();
                log.lock().unwrap().push(n);
            }
            Job::Die => panic!("as told"),
            Job::Detach => {
                let sender = cx.sender::<Said>("ear").unwrap();
                *self.detached.lock().unwrap() = Some(cx.detached(&sender));
            }
        }
    }
}

struct Kit {
    stage: Stage,
    _child: Box<dyn blastema_contract::child::Child>,
    worker: crate::ActorRef<Worker>,
    log: Log,
    detached: Arc<Mutex<Option<Sender<Said>>>>,
}

async fn kit() -> Kit {
    let stage = Stage::new();
    let (log, detached) = (Log::default(), Arc::new(Mutex::new(None)));
    let (l, d) = (log.clone(), detached.clone());
    let spec = ChildSpec::new("worker", move || Worker { log: l.clone(), detached: d.clone() });
    let (mut child, worker) = stage.start(spec).await;
    child.order(GRANT);
    Kit { stage, _child: child, worker, log, detached }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn timers_fire_while_the_component_is_active_and_can_be_cancelled() {
    let kit = kit().await;
    for (job, expected) in
        [(Job::EveryAndCancel, vec![1, 1]), (Job::After, vec![3, 2]), (Job::TellEvery, vec![2; 10])]
    {
        kit.worker.tell(job).unwrap();
        advance(Duration::from_millis(104)).await;
        assert_eq!(logged(&kit.log), expected);
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn ticks_that_were_missed_are_skipped() {
    let kit = kit().await;
    kit.worker.tell(Job::Every).unwrap();
    settle().await;
    kit.worker.tell(Job::Wait(1000)).unwrap();
    advance(Duration::from_millis(1004)).await;
    assert!(logged(&kit.log).len() <= 2, "one that was due, and the next");

    kit.worker.tell(Job::Block(1000)).unwrap();
    settle().await;
    assert!(logged(&kit.log).len() <= 2, "one that was due, and the next");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn timers_and_tasks_end_with_the_incarnation_that_started_them() {
    let kit = kit().await;
    kit.worker.tell(Job::Every).unwrap();
    kit.worker.tell(Job::TellEvery).unwrap();
    kit.worker.tell(Job::Task).unwrap();
    advance(Duration::from_millis(25)).await;
    let mut ran = logged(&kit.log);
    ran.sort_unstable();
    assert_eq!(ran, [1, 1, 2, 2, 4, 4]);

    kit.worker.tell(Job::Die).unwrap();
    advance(Duration::from_secs(1)).await;

    assert_eq!(logged(&kit.log), [0; 0]);
    assert_eq!(kit.stage.exits.drain().len(), 1);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_handler_may_wait_for_a_task_that_it_started() {
    let kit = kit().await;
    kit.worker.tell(Job::TaskWhileWaiting).unwrap();
    advance(Duration::from_millis(20)).await;
    assert_eq!(logged(&kit.log), [5]);
}

struct Ear(Log);
impl Component for Ear {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Said>();
    }
}
impl Handle<Said> for Ear {
    async fn handle(&mut self, Said(n): Said, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(n);
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_detached_sender_ends_with_the_incarnation_that_made_it() {
    let kit = kit().await;
    let received = Log::default();
    let kept = received.clone();
    let (_ear, _) = kit.stage.start(ChildSpec::new("ear", move || Ear(kept.clone()))).await;
    kit.worker.tell(Job::Detach).unwrap();
    settle().await;
    let sender = kit.detached.lock().unwrap().take().unwrap();
    std::thread::scope(|scope| scope.spawn(|| sender.tell(Said(1))).join().unwrap().unwrap());

    kit.worker.tell(Job::Die).unwrap();
    settle().await;

    let refused = sender.tell(Said(2)).unwrap_err();
    assert_eq!((refused.kind, refused.message), (DeliveryError::Fenced, Said(2)));
    assert_eq!(sender.ask(Said(3)).await.unwrap_err().kind, DeliveryError::Fenced);
    assert_eq!(logged(&received), [1]);
}

/// Sets its interval in each round.
struct Setter {
    log: Log,
    interval: fn(u64) -> Duration,
}
impl Component for Setter {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let mut log = self.log.lock().unwrap();
        let round = log.len() as u64;
        log.push(round);
        cx.set_interval(Some((self.interval)(round)));
        Ok(())
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_interval_that_is_set_in_each_round_keeps_its_rate() {
    let stage = Stage::new();
    let alternating = |round| Duration::from_millis(if round % 2 == 0 { 50 } else { 150 });
    for (name, interval) in
        [("same", (|_| 10 * TICK) as fn(u64) -> Duration), ("other", alternating)]
    {
        let (spec, log) = logging(name, move |log| Setter { log, interval });
        let (_child, _) = stage.start(spec.rate_hz(10.0)).await;

        advance(Duration::from_secs(10)).await;

        let rounds = logged(&log).len();
        assert!((99..=101).contains(&rounds), "{name}: {rounds} rounds in 10 s at 10 Hz");
    }
}

/// Has rounds that take so many milliseconds each, as long as there are any, and logs when they
/// begin, in milliseconds after the first.
struct Overrunner {
    log: Log,
    first: Option<Instant>,
    spans: Vec<u64>,
}
impl Component for Overrunner {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        let now = platform::now();
        let since = now - *self.first.get_or_insert(now);
        self.log.lock().unwrap().push(u64::try_from(since.as_millis()).unwrap());
        if let Some(span) = self.spans.pop() {
            tokio::time::sleep(Duration::from_millis(span)).await;
        }
        Ok(())
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_round_that_overruns_misses_rounds_and_the_next_ones_are_whole_periods_after_the_start() {
    let stage = Stage::new();
    let make = |log| Overrunner { log, first: None, spans: vec![250, 0, 0] };
    let (spec, log) = logging("overrunner", make);
    let (_child, reference) = stage.start(spec.rate_hz(10.0)).await;

    advance(Duration::from_millis(750)).await;

    // The round of 300 ms is missed, that of 400 ms begins 50 ms late.
    assert_eq!(logged(&log), [0, 100, 200, 450, 500, 600, 700]);
    let late = reference.0.round_lateness().expect("it has had rounds");
    assert_eq!((late.p50, late.max), (Duration::ZERO, Duration::from_millis(50)));
}

/// Sets so many timers, and cancels them if it is told to.
#[derive(Clone, Event)]
struct Timers {
    count: u32,
    cancel: bool,
}

struct Keeper(Arc<()>);
impl Component for Keeper {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Timers>();
    }
}
impl Handle<Timers> for Keeper {
    async fn handle(&mut self, timers: Timers, cx: &mut Context<Self>) {
        let mut set = Vec::new();
        for at in 0..timers.count {
            let held = self.0.clone();
            let span = Duration::from_secs(3600);
            set.push(match at % 2 {
                0 => cx.after(span, move |_, _| drop(held)),
                _ => cx.every(span, move |_, _| drop(held.clone())),
            });
        }
        if timers.cancel {
            set.into_iter().for_each(|timer| cx.cancel(timer));
        }
    }
}

fn keeper(held: &Arc<()>) -> ChildSpec<Keeper> {
    let held = held.clone();
    ChildSpec::new("keeper", move || Keeper(held.clone()))
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn timers_are_bounded_and_those_that_were_cancelled_hold_nothing() {
    let (stage, held) = (Stage::new(), Arc::new(()));
    let (_child, keeper) = stage.start(keeper(&held)).await;
    let idle = Arc::strong_count(&held);

    for _ in 0..3 {
        keeper.tell(Timers { count: 1024, cancel: true }).unwrap();
        settle().await;
        assert_eq!(Arc::strong_count(&held), idle, "nothing is kept until it would fire");
    }
    keeper.tell(Timers { count: 1024, cancel: false }).unwrap();
    settle().await;
    assert_eq!(Arc::strong_count(&held), idle + 1024);
    assert_eq!(stage.exits.drain(), []);

    keeper.tell(Timers { count: 1, cancel: false }).unwrap();
    settle().await;
    let exits = stage.exits.drain();
    assert!(
        matches!(&exits[..], [exited] if format!("{:?}", exited.exit).contains("1024 timers")),
        "{exits:?}"
    );
    let end = format!("{:?}", exits[0].exit);
    assert!(end.contains("chores.rs"), "where it was set one too many: {end}");
}

/// Sets a timer and cancels it, as often as that; says how many closures were held at most.
#[derive(Clone, Debug, Request)]
#[contract(reply = u64)]
struct Churn(u32);

impl Handle<Churn> for Keeper {
    async fn handle(&mut self, Churn(times): Churn, cx: &mut Context<Self>) -> u64 {
        let idle = Arc::strong_count(&self.0);
        let mut most = 0;
        for _ in 0..times {
            let held = self.0.clone();
            let timer = cx.after(Duration::from_secs(3600), move |_, _| drop(held));
            most = most.max(Arc::strong_count(&self.0) - idle);
            cx.cancel(timer);
            cx.cancel(timer);
        }
        most as u64
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_timer_cancelled_in_the_handler_that_set_it_holds_nothing() {
    let (stage, held) = (Stage::new(), Arc::new(()));
    let (_child, keeper) = stage.start(keeper(&held)).await;

    for _ in 0..2 {
        assert_eq!(keeper.ask(Churn(100_000)).await.unwrap(), 1);
    }

    assert_eq!(Arc::strong_count(&held), 3, "the test, the factory and the component");
    assert_eq!(stage.exits.drain(), []);
}
