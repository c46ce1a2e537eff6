//! Conditions under guard and watch, hubs of ended incarnations, and events across a hang.

use super::{ChildOrder, Log, Stage, hang, logged, logging, until, watched};
use crate::arbiter::pool::ArbiterPool;
use crate::topic::Topics;
use crate::{ChildSpec, Component, Context, Event, Handle, ObjectName, Ports};
use blastema_contract::child::{Child, ChildEvent};
use blastema_contract::reports::LivenessReported;
use blastema_core::Contract;
use blastema_core::detection::Finding;
use blastema_core::detection::hang::LivenessEvent;
use blastema_doubles::settle;
use std::sync::atomic::AtomicUsize;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Condvar, Mutex};
use std::time::Duration;

#[derive(Clone, Debug, PartialEq, Event)]
struct Sample(u64);

/// Keeps whatever waits for it until it is let go.
#[derive(Clone, Default)]
struct Barrier(Arc<(Mutex<bool>, Condvar)>);

impl Barrier {
    fn wait(&self) {
        let closed = |open: &mut bool| !*open;
        drop(self.0.1.wait_while(self.0.0.lock().unwrap(), closed).unwrap());
    }

    fn open(&self) {
        *self.0.0.lock().unwrap() = true;
        self.0.1.notify_all();
    }
}

/// Writes down what it hears; a handler and a condition of it may block.
struct Ear {
    log: Log,
    blocks_on: Option<(u64, Barrier)>,
}

/// What the condition of the component `judge` does; conditions know no component.
static JUDGED: Mutex<Option<Barrier>> = Mutex::new(None);

impl Component for Ear {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Sample>();
    }
}
impl Handle<Sample> for Ear {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        self.log.lock().unwrap().push(n);
        if let Some((on, barrier)) = &self.blocks_on
            && *on == n
        {
            barrier.wait();
        }
    }
}

struct Judge(Log);
impl Component for Judge {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Sample>().only_if(|_| {
            let barrier = JUDGED.lock().unwrap().clone();
            if let Some(barrier) = barrier {
                barrier.wait();
            }
            true
        });
    }
}
impl Handle<Sample> for Judge {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(n);
    }
}

fn ear(name: &str, blocks_on: Option<(u64, Barrier)>) -> (ChildSpec<Ear>, Log) {
    let (spec, log) = logging(name, move |log| Ear { log, blocks_on: blocks_on.clone() });
    (spec.max_block(Duration::from_millis(100)), log)
}

fn publish(stage: &Stage, n: u64) {
    stage
        .environment
        .feature::<Topics>()
        .publisher(Sample::NAME)
        .unwrap()
        .publish(Sample(n))
        .unwrap();
}

fn hubs(stage: &Stage) -> usize {
    stage.environment.feature::<Topics>().hubs::<Sample>(Sample::NAME)
}

/// Panics when it is dropped, or when it is copied.
#[derive(Debug, Event)]
struct Bomb {
    drops: bool,
}

static DROPPED: AtomicUsize = AtomicUsize::new(0);

impl Clone for Bomb {
    fn clone(&self) -> Self {
        assert!(self.drops, "in clone");
        // The copy that a listener gets is the listener's.
        Bomb { drops: false }
    }
}

impl Drop for Bomb {
    fn drop(&mut self) {
        if self.drops {
            DROPPED.fetch_add(1, Relaxed);
            panic!("in drop");
        }
    }
}

struct Sapper(Log);
impl Component for Sapper {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Bomb>();
        ports.listen::<Sample>();
    }
}
impl Handle<Bomb> for Sapper {
    async fn handle(&mut self, _: Bomb, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(0);
    }
}
impl Handle<Sample> for Sapper {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(n);
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn events_whose_clone_or_drop_panics_are_a_fault_of_their_topic() {
    let stage = Stage::new();
    let log = Log::default();
    let start = |name: &str| {
        let kept = log.clone();
        ChildSpec::new(name, move || Sapper(kept.clone()))
    };
    let (_one, _): (Box<dyn Child>, _) = stage.start(start("one")).await;
    let (_two, _) = stage.start(start("two")).await;
    let bombs = stage.environment.feature::<Topics>().publisher::<Bomb>(Bomb::NAME).unwrap();

    (0..20).for_each(|_| bombs.publish(Bomb { drops: true }).unwrap());
    settle().await;
    assert_eq!((logged(&log), DROPPED.load(Relaxed)), (vec![0; 40], 20));
    bombs.publish(Bomb { drops: false }).unwrap();
    publish(&stage, 7);
    settle().await;

    assert_eq!(logged(&log), [7, 7]);
    assert_eq!(stage.exits.drain(), []);
    let faults = stage.faults.drain();
    assert_eq!(faults.len(), 1, "{faults:?}");
    assert_eq!(faults[0].object, ObjectName::new(Bomb::NAME).unwrap());
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_condition_that_blocks_on_the_first_event_is_named_and_its_neighbours_are_not() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let (sighted, _watch) = watched(&stage, Duration::from_secs(30));
        let (before, first) = ear("before", None);
        let (after, last) = ear("after", None);
        let (judge, log) = logging("judge", Judge);
        let (_before, _) = stage.start(before).await;
        let (_judge, _) = stage.start(judge.max_block(Duration::from_millis(100))).await;
        let (_after, _) = stage.start(after).await;
        let barrier = Barrier::default();
        *JUDGED.lock().unwrap() = Some(barrier.clone());

        publish(&stage, 1);
        let seen = hang(&sighted).await;
        barrier.open();

        let LivenessReported(LivenessEvent::Component {
            object,
            finding: Finding::Hangs { during, victims, .. },
            ..
        }) = seen
        else {
            unreachable!()
        };
        assert_eq!(object, ObjectName::new("judge").unwrap());
        assert_eq!(during, "a condition of a subscription");
        assert_eq!(victims.len(), 2);
        until("all got it", || [&first, &log, &last].iter().all(|log| *log.lock().unwrap() == [1]))
            .await;
        assert_eq!(stage.exits.drain(), [], "no component died of it");
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn an_event_that_a_condition_never_decided_on_is_a_dead_letter_of_its_contract() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let (sighted, _watch) = watched(&stage, Duration::from_millis(50));
        let (barrier, (spec, log)) = (Barrier::default(), ear("judge", None));
        let kept = barrier.clone();
        let judge = spec.with_ports(move |ports| {
            ports.listen::<Sample>().on("samples").only_if(move |Sample(n)| {
                if *n == 1 {
                    kept.wait();
                }
                true
            });
        });
        let (mut judge, _) = stage.start(judge).await;
        let publisher = stage.environment.feature::<Topics>().publisher("samples").unwrap();
        publisher.publish(Sample(1)).unwrap();
        publisher.publish(Sample(2)).unwrap();
        hang(&sighted).await;

        assert_eq!(stage.begin(&mut *judge, 2).await, ChildEvent::Started);
        until("what waited comes along", || *log.lock().unwrap() == [2]).await;
        let dead = stage.environment.dead_letters.counts();
        barrier.open();

        let dead: Vec<_> = dead.iter().map(|dead| (&dead.contract[..], dead.count)).collect();
        assert_eq!(dead, [(Sample::NAME, 1)]);
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn events_are_served_once_and_in_order_across_a_hang() {
        let stage = Stage::on(ArbiterPool::pool(2));
        let (sighted, _watch) = watched(&stage, Duration::from_millis(100));
        let barrier = Barrier::default();
        // Two arbiters with a listener each, and one that moves from the first to the second.
        let (culprit, _) = ear("culprit", Some((3, barrier.clone())));
        let (resident, resident_log) = ear("resident", None);
        let (moving, moving_log) = ear("moving", None);
        let (mut culprit, _) = stage.start(culprit).await;
        let (_resident, _) = stage.start(resident).await;
        let (mut moving, _) = stage.start(moving).await;
        until("two hubs", || hubs(&stage) == 2).await;

        (1..=6).for_each(|n| publish(&stage, n));
        hang(&sighted).await;
        (7..=9).for_each(|n| publish(&stage, n));
        culprit.order(ChildOrder::Abandon);
        sighted.wait(|sighted| matches!(sighted.0, LivenessEvent::Lost { .. })).await;
        moving.order(ChildOrder::Abandon);
        let begun = stage.begin(&mut *moving, 2).await;
        assert_eq!(begun, ChildEvent::Started);
        (10..=12).for_each(|n| publish(&stage, n));

        let all: Vec<u64> = (1..=12).collect();
        until("the resident", || *resident_log.lock().unwrap() == all).await;
        until("all came along", || moving_log.lock().unwrap().len() >= 12).await;
        barrier.open();
        until("the thread ends", || stage.environment.arbiters.abandoned() == 0).await;
        assert_eq!(logged(&moving_log), all);
        stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn the_hubs_of_ended_incarnations_are_released() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let (spec, log) = ear("restarted", None);
        let (mut child, _) = stage.add(spec.on_own_thread());
        for incarnation in 1..=20 {
            assert_eq!(stage.begin(&mut *child, incarnation).await, ChildEvent::Started);
            assert_eq!(hubs(&stage), 1, "in incarnation {incarnation}");
            child.order(ChildOrder::Abandon);
        }
        assert_eq!(stage.begin(&mut *child, 21).await, ChildEvent::Started);
        publish(&stage, 1);
        until("it hears", || logged(&log) == [1]).await;

        child.order(ChildOrder::Retire);
        assert_eq!(hubs(&stage), 0);
        stage.environment.arbiters.stop();
    }
}
