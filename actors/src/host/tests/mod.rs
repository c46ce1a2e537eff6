//! What the host promises, each as a test.

mod bounds;
mod busy;
mod chores;
mod death;
mod fencing;
mod hang;
mod incarnations;
mod lifecycle;
mod plain_actors;
mod reporting;
mod serving;
mod skeleton;
mod stubs;
mod subscriptions;
mod topics;
mod watching;

use super::spec::ChildSpec;
use crate::actuator::ActuatorTable;
use crate::arbiter::pool::ArbiterPool;
use crate::component::environment::ComponentEnvironment;
use crate::liveness::sampler::{self, SamplerGuard};
use crate::node::assembly::with_features;
use crate::runtime::reports::FaultReports;
use crate::{ActorRef, Component, Context, Event, Handle, Ports, Request};
use blastema_contract::child::{Child, ChildEvent, ChildOrder, ChildReport};
use blastema_contract::reports::{Exited, FaultDeclared, LivenessReported, StateReported};
use blastema_core::Incarnation;
use blastema_core::detection::Finding;
use blastema_core::detection::hang::{HangDetectorConfig, LivenessEvent};
use blastema_doubles::Probe;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// An environment whose every ear is a probe.
pub(super) struct Stage {
    pub(super) environment: Arc<ComponentEnvironment>,
    pub(super) exits: Probe<Exited>,
    pub(super) states: Probe<StateReported>,
    pub(super) faults: Probe<FaultDeclared>,
    pub(super) reports: Probe<ChildReport>,
}

impl Stage {
    pub(super) fn new() -> Self {
        Self::on(ArbiterPool::here())
    }

    pub(super) fn on(arbiters: ArbiterPool) -> Self {
        let (exits, states, faults) = (Probe::start(), Probe::start(), Probe::start());
        let reports = FaultReports {
            exits: Some(exits.recipient()),
            states: Some(states.recipient()),
            faults: Some(faults.recipient()),
            cleared: None,
        };
        let environment =
            with_features(ComponentEnvironment::new(arbiters, reports), ActuatorTable::default());
        Stage { environment: Arc::new(environment), exits, states, faults, reports: Probe::start() }
    }

    /// A component that is not started.
    pub(super) fn add<C: Component>(&self, spec: ChildSpec<C>) -> (Box<dyn Child>, ActorRef<C>) {
        spec.into_child(&self.environment).unwrap()
    }

    /// Begins an incarnation, and waits for what comes of it.
    pub(super) async fn begin(&self, child: &mut dyn Child, incarnation: u64) -> ChildEvent {
        child.start(Incarnation(incarnation), self.reports.recipient().into());
        self.reports.wait(|report| report.object == *child.name()).await.event
    }

    /// A component in its first incarnation.
    pub(super) async fn start<C: Component>(
        &self,
        spec: ChildSpec<C>,
    ) -> (Box<dyn Child>, ActorRef<C>) {
        let (mut child, reference) = self.add(spec);
        assert_eq!(self.begin(&mut *child, 1).await, ChildEvent::Started);
        (child, reference)
    }
}

/// The component's guard may restart it once.
pub(super) const GRANT: ChildOrder = ChildOrder::GrantRestart(true);

pub(super) type Log = Arc<Mutex<Vec<u64>>>;

pub(super) fn logged(log: &Log) -> Vec<u64> {
    std::mem::take(&mut *log.lock().unwrap())
}

/// A component that is made with this log in each incarnation.
pub(super) fn logging<C: Component>(
    name: &str,
    make: impl Fn(Log) -> C + Send + Sync + 'static,
) -> (ChildSpec<C>, Log) {
    let log = Log::default();
    let kept = log.clone();
    (ChildSpec::new(name, move || make(kept.clone())), log)
}

/// The watch of the stage's threads, with this grace.
pub(super) fn watched(stage: &Stage, grace: Duration) -> (Probe<LivenessReported>, SamplerGuard) {
    let sighted = Probe::start();
    let config = HangDetectorConfig { grace, gap: Duration::from_secs(1) };
    let environment = &stage.environment;
    let (list, arbiters) = (environment.watch_list.clone(), environment.arbiters.clone());
    let guard = sampler::start(list, arbiters, config, sighted.recipient(), true).unwrap();
    (sighted, guard)
}

pub(super) async fn hang(sighted: &Probe<LivenessReported>) -> LivenessReported {
    let hangs = |sighted: &LivenessReported| {
        matches!(sighted.0, LivenessEvent::Component { finding: Finding::Hangs { .. }, .. })
    };
    sighted.wait(hangs).await
}

/// Waits until this holds. It may take as long as a busy machine needs.
pub(super) async fn until(what: &str, mut holds: impl FnMut() -> bool) {
    for _ in 0..4000 {
        if holds() {
            return;
        }
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    panic!("{what}: never");
}

/// Adds to a sum, and replies with it.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64)]
pub(super) struct Add(pub(super) u64);

/// Waits so many milliseconds, then replies with the sum.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64)]
pub(super) struct Slow(pub(super) u64);

/// Panics with this text.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = ())]
pub(super) struct Boom(pub(super) String);

/// Is written down.
#[derive(Clone, Debug, PartialEq, Event)]
pub(super) struct Note(pub(super) u64);

pub(super) fn boom(text: &str) -> Boom {
    Boom(text.to_owned())
}

/// Does what it is told, and panics when it is dropped.
pub(super) struct Acc {
    sum: u64,
    log: Log,
}

impl Component for Acc {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>().serve::<Slow>().serve::<Boom>().accept::<Note>();
    }
}

impl Handle<Add> for Acc {
    async fn handle(&mut self, Add(n): Add, _: &mut Context<Self>) -> u64 {
        self.sum += n;
        self.sum
    }
}

impl Handle<Slow> for Acc {
    async fn handle(&mut self, Slow(millis): Slow, cx: &mut Context<Self>) -> u64 {
        let (sum, me) = (&mut self.sum, &cx); // Both borrows live across the await.
        tokio::time::sleep(Duration::from_millis(millis)).await;
        *sum += 1000 * me.incarnation().0;
        *sum
    }
}

impl Handle<Boom> for Acc {
    async fn handle(&mut self, Boom(text): Boom, _: &mut Context<Self>) {
        panic!("{text}")
    }
}

impl Handle<Note> for Acc {
    async fn handle(&mut self, Note(n): Note, _: &mut Context<Self>) {
        self.log.lock().unwrap().push(n);
    }
}

impl Drop for Acc {
    fn drop(&mut self) {
        panic!("in drop");
    }
}

pub(super) fn acc(name: &str) -> (ChildSpec<Acc>, Log) {
    logging(name, |log| Acc { sum: 0, log })
}
