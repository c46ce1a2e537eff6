//! Hangs, fences, lost arbiters; silence and waiting.

use super::{ChildOrder, GRANT, Log, Stage, acc, hang, logged, logging, until, watched};
use crate::arbiter::pool::ArbiterPool;
use crate::liveness::sampler::SamplerGuard;
use crate::topic::Topics;
use crate::{
    ChildSpec, Component, Context, DeliveryError, Down, Event, Failure, Handle, Incarnation,
    ObjectName, Ports, Sender,
};
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::LivenessReported;
use blastema_core::detection::hang::LivenessEvent;
use blastema_core::detection::{CurrentHandler, Finding, MonitorRow, ObjectKind};
use blastema_core::{FaultLocation, NodeName, ObjectAddress};
use blastema_doubles::Probe;
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

/// Says this when it is heard.
#[derive(Clone, Debug, PartialEq, Event)]
struct Said(u64);

/// Blocks the thread until the test lets it go; then says something, and replies.
#[derive(Clone, Debug, PartialEq, crate::Request)]
#[contract(reply = u64)]
struct Block(u64);

type Gate = Arc<Mutex<mpsc::Receiver<()>>>;
/// What came of what a component said after it was let go.
type Said0 = Arc<Mutex<Vec<Option<DeliveryError>>>>;

struct Blocker {
    gate: Gate,
    ear: Sender<Said>,
    refusals: Said0,
}

impl Component for Blocker {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Said>().on("news");
    }
}

impl Handle<Block> for Blocker {
    async fn handle(&mut self, Block(n): Block, cx: &mut Context<Self>) -> u64 {
        self.gate.lock().unwrap().recv().unwrap();
        cx.publish(Said(666));
        let refusals = self.ear.tell(Said(n)).map_err(|refused| refused.kind).err();
        self.refusals.lock().unwrap().push(refusals);
        n
    }
}

impl Handle<Said> for Blocker {
    async fn handle(&mut self, Said(n): Said, _: &mut Context<Self>) {
        let _ = self.ear.tell(Said(n));
    }
}

struct Ear(Log);
impl Component for Ear {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Said>();
        ports.listen::<Said>();
    }
}
impl Handle<Said> for Ear {
    async fn handle(&mut self, Said(n): Said, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(n);
    }
}

/// A stage on real threads, with the watch, an ear on a thread of its own, and what blocks.
struct Site {
    stage: Stage,
    sighted: Probe<LivenessReported>,
    open: mpsc::Sender<()>,
    gate: Gate,
    refusals: Said0,
    received: Log,
    ear: Sender<Said>,
    _ear: Box<dyn blastema_contract::child::Child>,
    _watch: SamplerGuard,
}

impl Site {
    async fn new(shared: usize, grace: Duration) -> Self {
        let stage = Stage::on(ArbiterPool::pool(shared));
        let (sighted, watch) = watched(&stage, grace);
        let (open, gate) = mpsc::channel();
        let (spec, received) = logging("ear", Ear);
        let (ear_child, ear) = stage.start(spec.on_own_thread()).await;
        Site {
            ear: ear.sender(),
            stage,
            sighted,
            open,
            gate: Arc::new(Mutex::new(gate)),
            refusals: Said0::default(),
            received,
            _ear: ear_child,
            _watch: watch,
        }
    }

    fn blocker(&self, name: &str) -> ChildSpec<Blocker> {
        let (gate, ear, refusals) = (self.gate.clone(), self.ear.clone(), self.refusals.clone());
        let make =
            move || Blocker { gate: gate.clone(), ear: ear.clone(), refusals: refusals.clone() };
        ChildSpec::new(name, make).max_block(Duration::from_millis(100))
    }

    async fn hangs(&self) -> (ObjectName, Incarnation, &'static str, Vec<ObjectName>) {
        match hang(&self.sighted).await {
            LivenessReported(LivenessEvent::Component {
                object,
                incarnation,
                finding: Finding::Hangs { during, victims, .. },
            }) => (object, incarnation, during, victims.to_vec()),
            other => panic!("{other:?}"),
        }
    }
}

fn name(text: &str) -> ObjectName {
    ObjectName::new(text).unwrap()
}

const LONG: Duration = Duration::from_secs(30);

/// Has its listener start a task that blocks.
#[derive(Clone, Event)]
struct Spawn;

struct Spawner(Gate);
impl Component for Spawner {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Spawn>();
    }
}
impl Handle<Spawn> for Spawner {
    async fn handle(&mut self, _: Spawn, cx: &mut Context<Self>) {
        let gate = self.0.clone();
        cx.spawn(async move { gate.lock().unwrap().recv().unwrap() });
    }
}

/// Blocks its listener.
#[derive(Clone, Event)]
struct Hold;

struct Holder(Gate);
impl Component for Holder {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Hold>();
    }
}
impl Handle<Hold> for Holder {
    async fn handle(&mut self, _: Hold, _: &mut Context<Self>) {
        self.0.lock().unwrap().recv().unwrap();
    }
}

/// Passes on that it was told to hold.
struct Witness(Sender<Said>);
impl Component for Witness {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Hold>();
    }
}
impl Handle<Hold> for Witness {
    async fn handle(&mut self, _: Hold, _: &mut Context<Self>) {
        self.0.tell(Said(9)).unwrap();
    }
}

/// Panics on what it hears. What is left of its first incarnation blocks when it is dropped.
struct Clingy(Option<Gate>);
impl Component for Clingy {}
impl Handle<Said> for Clingy {
    async fn handle(&mut self, Said(n): Said, _: &mut Context<Self>) {
        panic!("{n} breaks it");
    }
}
impl Drop for Clingy {
    fn drop(&mut self) {
        if let Some(gate) = self.0.take() {
            gate.lock().unwrap().recv().unwrap();
        }
    }
}

/// Has heard how the component that it watches has ended.
struct Watcher(Log);
impl Component for Watcher {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.watch("clingy").map_err(|error| error.to_string())?;
        Ok(())
    }
}
impl Handle<Down> for Watcher {
    async fn handle(&mut self, down: Down, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(down.incarnation.0);
    }
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_hang_is_fenced_and_replaced_with_its_queue() {
        let site = Site::new(1, LONG).await;
        let (mut child, blocker) = site.stage.start(site.blocker("blocker")).await;
        let (spec, _) = acc("neighbour");
        let (_neighbour, neighbour) = site.stage.start(spec).await;
        let hung = tokio::task::spawn_local({
            let blocker = blocker.clone();
            async move { blocker.ask_within(Block(1), LONG).await }
        });
        let (culprit, incarnation, during, victims) = site.hangs().await;
        assert_eq!((culprit, incarnation, during), (name("blocker"), Incarnation(1), "Block"));
        assert_eq!(victims, [name("neighbour")]);
        blocker.tell(Said(5)).unwrap();
        let here = NodeName::new("here").unwrap();
        let location = FaultLocation::Object(ObjectAddress::new(here.clone(), name("blocker")));
        let mut row = MonitorRow::blank(location, ObjectKind::Component);
        row.incarnation = Incarnation(1);
        site.stage.environment.watch_list.show_in(&here, std::slice::from_mut(&mut row));
        let CurrentHandler { during, .. } = row.current.unwrap();
        assert_eq!(during, "Block");
        assert_eq!(row.queue.unwrap().queued, 1);

        child.order(ChildOrder::Abandon);
        let died = hung.await.unwrap().unwrap_err().kind;
        assert_eq!(
            died,
            DeliveryError::PeerDied { incarnation: Incarnation(1) },
            "while it still blocks"
        );
        assert_eq!(site.stage.begin(&mut *child, 2).await, ChildEvent::Started);
        until("its queue came along", || logged(&site.received) == [5]).await;

        let early = site.sighted.drain();
        assert!(!early.iter().any(|s| matches!(s.0, LivenessEvent::Resumed { .. })), "{early:?}");
        site.open.send(()).unwrap();
        assert_eq!(neighbour.ask_within(super::super::Add(3), LONG).await, Ok(3));
        assert_eq!(neighbour.incarnation(), Incarnation(1), "it never moved");
        assert_eq!(*site.refusals.lock().unwrap(), [Some(DeliveryError::Fenced)]);
        assert_eq!(logged(&site.received), [0; 0], "what the zombie said went nowhere");
        assert_eq!(site.stage.environment.arbiters.abandoned(), 0);
        let resumed = site.sighted.wait(|s| matches!(s.0, LivenessEvent::Resumed { .. })).await;
        assert_eq!(
            resumed,
            LivenessReported(LivenessEvent::Resumed { objects: [name("neighbour")].into() })
        );
        site.stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn components_of_a_lost_arbiter_move_with_their_queues() {
        let site = Site::new(1, Duration::from_millis(100)).await;
        let reported = Arc::new(Mutex::new(vec![]));
        let kept = reported.clone();
        let arbiters = &site.stage.environment.arbiters;
        arbiters.on_abandoned(Box::new(move |lost| kept.lock().unwrap().push(lost.clone())));
        let (mut child, blocker) = site.stage.start(site.blocker("blocker")).await;
        let (mut moving, neighbour) = site.stage.start(site.blocker("neighbour")).await;
        blocker.tell(Block(1)).unwrap();
        site.hangs().await;
        neighbour.tell(Said(7)).unwrap();
        let topics = &site.stage.environment.feature::<Topics>();
        topics.publisher("news").unwrap().publish(Said(8)).unwrap();

        child.order(ChildOrder::Abandon);
        let lost =
            site.sighted.wait(|sighted| matches!(sighted.0, LivenessEvent::Lost { .. })).await;
        let (culprit, victims) = (name("blocker"), [name("neighbour")].into());
        let LivenessReported(LivenessEvent::Lost { culprit: by, victims: behind, .. }) = lost
        else {
            panic!("{lost:?}")
        };
        assert_eq!((by, behind), (culprit, victims));
        assert_eq!(arbiters.abandoned(), 1);
        assert_eq!(*reported.lock().unwrap(), [[(name("blocker"), 1)].into()]);
        moving.order(ChildOrder::Abandon);
        assert_eq!(site.stage.begin(&mut *moving, 2).await, ChildEvent::Started);
        until("queue and events came along", || site.received.lock().unwrap().len() == 2).await;
        assert_eq!(logged(&site.received), [7, 8]);
        assert_eq!(site.stage.begin(&mut *child, 2).await, ChildEvent::Started);
        until("the event, too", || logged(&site.received) == [8]).await;

        site.open.send(()).unwrap();
        until("the thread ends", || arbiters.abandoned() == 0).await;
        assert_eq!(*site.refusals.lock().unwrap(), [Some(DeliveryError::Fenced)]);
        assert_eq!(neighbour.incarnation(), Incarnation(2));
        arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_hang_on_a_thread_of_its_own_takes_nobody_along() {
        let site = Site::new(1, Duration::from_millis(100)).await;
        let (mut child, blocker) = site.stage.start(site.blocker("blocker").on_own_thread()).await;
        blocker.tell(Block(1)).unwrap();
        let (culprit, _, _, victims) = site.hangs().await;
        assert_eq!((culprit, victims), (name("blocker"), vec![]));

        child.order(ChildOrder::Abandon);
        assert_eq!(site.stage.begin(&mut *child, 2).await, ChildEvent::Started);
        let arbiters = &site.stage.environment.arbiters;
        until("the thread is given up", || arbiters.abandoned() == 1).await;

        site.open.send(()).unwrap();
        until("the thread ends", || arbiters.abandoned() == 0).await;
        arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_drop_that_blocks_after_a_panic_is_a_hang_and_the_component_is_replaced() {
        let site = Site::new(1, Duration::from_millis(100)).await;
        let first = Mutex::new(Some(site.gate.clone()));
        let spec = ChildSpec::new("clingy", move || Clingy(first.lock().unwrap().take()));
        let spec = spec.max_block(Duration::from_millis(100));
        let (mut child, clingy) = site.stage.start(spec).await;
        child.order(GRANT);
        let ended = Log::default();
        let told = ended.clone();
        let spec = ChildSpec::new("watcher", move || Watcher(told.clone())).on_own_thread();
        let (_watcher, _) = site.stage.start(spec).await;

        clingy.tell(Said(7)).unwrap();
        let (culprit, incarnation, _, _) = site.hangs().await;
        assert_eq!((culprit, incarnation), (name("clingy"), Incarnation(1)));
        child.order(ChildOrder::GrantRestart(false));
        child.order(ChildOrder::Abandon);
        until("its watcher is told", || logged(&ended) == [1]).await;
        assert_eq!(site.stage.begin(&mut *child, 2).await, ChildEvent::Started);

        site.open.send(()).unwrap();
        clingy.tell(Said(8)).unwrap();
        let exited = site.stage.exits.wait(|exited| exited.object == name("clingy")).await;
        assert_eq!((exited.incarnation, exited.restarted_as), (Incarnation(2), None));
        site.stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_task_that_hangs_is_named_and_not_the_handler_that_was_served_last() {
        let site = Site::new(1, LONG).await;
        let gate = site.gate.clone();
        let spec = ChildSpec::new("spawner", move || Spawner(gate.clone()));
        let spec = spec.max_block(Duration::from_millis(100));
        let (mut child, spawner) = site.stage.start(spec).await;

        spawner.tell(Spawn).unwrap();
        let (culprit, _, during, _) = site.hangs().await;
        assert_eq!((culprit, during), (name("spawner"), "a task of its own"));

        child.order(ChildOrder::Abandon);
        site.open.send(()).unwrap();
        until("the thread goes on", || site.stage.environment.arbiters.abandoned() == 0).await;
        site.stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_listener_that_hangs_in_an_event_is_the_culprit() {
        let site = Site::new(1, LONG).await;
        let gate = site.gate.clone();
        let spec = ChildSpec::new("holder", move || Holder(gate.clone()));
        let (mut child, _) = site.stage.start(spec.max_block(Duration::from_millis(100))).await;
        let ear = site.ear.clone();
        let spec = ChildSpec::new("witness", move || Witness(ear.clone()));
        let (_witness, witness) = site.stage.start(spec).await;
        let topics = &site.stage.environment.feature::<Topics>();
        let publisher = topics.publisher::<Hold>(<Hold as blastema_core::Contract>::NAME).unwrap();

        publisher.publish(Hold).unwrap();
        let (culprit, _, during, victims) = site.hangs().await;
        assert_eq!((culprit, during), (name("holder"), "Hold"));
        assert_eq!(victims, [name("witness")]);
        child.order(ChildOrder::Abandon);
        site.open.send(()).unwrap();

        until("it speaks", || logged(&site.received) == [9]).await;
        assert_eq!(witness.incarnation(), Incarnation(1));
        assert_eq!(site.stage.exits.drain(), []);
        site.stage.environment.arbiters.stop();
    }

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn events_that_a_lost_arbiter_was_handing_out_come_along() {
        let site = Site::new(1, Duration::from_millis(100)).await;
        let gate = site.gate.clone();
        let spec = ChildSpec::new("holder", move || Holder(gate.clone()));
        let spec = spec.max_block(Duration::from_millis(100));
        let (mut culprit, _) = site.stage.start(spec).await;
        let ear = site.ear.clone();
        let spec = ChildSpec::new("witness", move || Witness(ear.clone()));
        let (mut victim, witness) = site.stage.start(spec).await;
        let topics = &site.stage.environment.feature::<Topics>();
        let publisher = topics.publisher::<Hold>(<Hold as blastema_core::Contract>::NAME).unwrap();

        publisher.publish(Hold).unwrap();
        site.hangs().await;
        publisher.publish(Hold).unwrap();
        culprit.order(ChildOrder::Abandon);
        site.sighted.wait(|sighted| matches!(sighted.0, LivenessEvent::Lost { .. })).await;
        victim.order(ChildOrder::Abandon);
        assert_eq!(site.stage.begin(&mut *victim, 2).await, ChildEvent::Started);

        until("both events came along", || site.received.lock().unwrap().len() == 2).await;
        assert_eq!(witness.incarnation(), Incarnation(2));
        site.open.send(()).unwrap();
        until("the thread ends", || site.stage.environment.arbiters.abandoned() == 0).await;
        assert_eq!(logged(&site.received), [9, 9], "the old incarnation is fenced");
        site.stage.environment.arbiters.stop();
    }
}
