//! Monitor, detector and notifier together, with probes where their half of the chain ends.

pub(crate) mod scripted;

use super::detection::DetectionActor;
use crate::platform;
use crate::runtime::guardian::Guardian;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::{FaultEvent, Subscribe};
use blastema_contract::monitor::{ReadTable, Register};
use blastema_contract::notifier::AddPort;
use blastema_contract::recoverer::Recover;
use blastema_contract::reports::{
    Alive, AreYouAlive, ExitReason, Exited, LivenessReported, StateReported,
};
use blastema_core::detection::hang::LivenessEvent;
use blastema_core::detection::{FaultTransition, Finding, RecovererPort, Registration};
use blastema_core::{FaultKind, Incarnation, Lifecycle, NodeName, ObjectName};
use blastema_doubles::{Probe, advance, settle};
use std::time::Duration;

const ONE: Incarnation = Incarnation::FIRST;
const TENTH: Duration = Duration::from_millis(100);

fn object(name: &str) -> ObjectName {
    ObjectName::new(name).expect("a name")
}

fn node(name: &str) -> NodeName {
    NodeName::new(name).expect("a name")
}

/// Strikes an actor in the middle of a message.
#[derive(Message)]
#[rtype(result = "()")]
struct Strike;

impl Handler<Strike> for DetectionActor {
    type Result = ();

    fn handle(&mut self, _: Strike, _: &mut Context<Self>) {
        panic!("struck");
    }
}

/// The observing half of the chain, with probes where it ends.
struct Chain {
    actor: Addr<DetectionActor>,
    recoverer: Probe<Recover>,
    deaths: Probe<Exited>,
    events: Probe<FaultEvent>,
}

impl Chain {
    fn start() -> Self {
        let deaths = Probe::start();
        let guardian = Guardian::reporting_to(deaths.recipient());
        let actor = guardian.start(object("chain"), None, |_| DetectionActor::new(node("m")));
        let recoverer = Probe::replying(|_: &Recover| Confirmed);
        let recover = recoverer.recipient();
        actor.do_send(AddPort { port: RecovererPort::Local, recover, stand_down: None });
        let events = Probe::start();
        actor.do_send(Subscribe(events.recipient()));
        Chain { actor, recoverer, deaths, events }
    }

    fn register(&self, registration: Registration) {
        self.actor.do_send(Register { registration, pings: None });
    }

    fn silence(&self, name: &str) {
        let (object, silent_for) = (object(name), 3 * TENTH);
        let silent = LivenessEvent::Component {
            object,
            incarnation: ONE,
            finding: Finding::Silent { age: silent_for },
        };
        self.actor.do_send(LivenessReported(silent));
    }

    fn panic(&self, name: &str) {
        let exit =
            ExitReason::Panicked { text: "boom".into(), at: "arm.rs:7".into(), during: "Move" };
        let object = object(name);
        self.actor.do_send(Exited { object, incarnation: ONE, exit, restarted_as: None });
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_panic_reaches_the_recoverer_without_any_time_passing() {
    let chain = Chain::start();
    let before = platform::now();

    chain.panic("arm");

    let fault = chain.recoverer.expect().await.fault;
    assert_eq!((fault.kind, fault.location.to_string()), (FaultKind::Panic, "m:arm".into()));
    assert_eq!(fault.detail, "boom, at arm.rs:7, in Move");
    assert_eq!(platform::now(), before);
    assert_eq!(chain.events.expect().await.turn, FaultTransition::Found);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn one_that_never_answers_is_asked_once_and_found_silent() {
    let chain = Chain::start();
    let registration = Registration::new(object("arm"));
    let pings = Some(Mute(0).start().recipient());
    chain.actor.do_send(Register { registration, pings });

    advance(Duration::from_millis(5500)).await;
    assert_eq!(chain.recoverer.len(), 0);
    advance(Duration::from_secs(1)).await;

    assert_eq!(chain.recoverer.drain()[0].fault.kind, FaultKind::Silence);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn one_that_does_not_answer_while_the_node_starves_has_five_times_as_long() {
    let chain = Chain::start();
    let registration = Registration::new(object("arm"));
    let pings = Some(Mute(0).start().recipient());
    chain.actor.do_send(Register { registration, pings });
    settle().await;
    let starve = async |intervals: u32| {
        for _ in 0..intervals {
            tokio::time::advance(Duration::from_millis(1200)).await;
            settle().await;
        }
    };

    starve(28).await;
    assert_eq!(chain.recoverer.len(), 0);
    starve(4).await;

    assert_eq!(chain.recoverer.drain()[0].fault.kind, FaultKind::Silence);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_stall_of_the_whole_process_condemns_nobody() {
    let chain = Chain::start();
    let registration = Registration::new(object("arm"));
    let pings = Some(Mute(0).start().recipient());
    chain.actor.do_send(Register { registration, pings });
    settle().await;

    // The clock jumps: every timer is late at once, before anything can answer.
    let gap = Duration::from_secs(30);
    tokio::time::advance(gap).await;
    chain.actor.do_send(LivenessReported(LivenessEvent::Stalled { gap }));
    advance(Duration::from_secs(4)).await;

    assert_eq!(chain.recoverer.len(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_recoverer_that_cannot_be_reached_gets_the_fault_when_it_is_back() {
    let chain = Chain::start();
    let there = RecovererPort::Remote(node("n"));
    let (port, recover) = (there.clone(), Gone.start().recipient());
    chain.actor.do_send(AddPort { port, recover, stand_down: None });
    chain.panic("arm");
    advance(Duration::from_secs(1)).await;
    chain.recoverer.expect().await;

    let back = Probe::replying(|_: &Recover| Confirmed);
    let recover = back.recipient();
    chain.actor.do_send(AddPort { port: there, recover, stand_down: None });
    advance(Duration::from_secs(10)).await;

    assert_eq!(back.expect().await.fault.kind, FaultKind::Panic);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn the_chain_survives_being_struck_with_all_it_knew() {
    let chain = Chain::start();
    chain.register(Registration::new(object("arm")));
    chain.actor.do_send(StateReported {
        object: object("arm"),
        incarnation: ONE,
        state: Lifecycle::Active,
        reason: None,
    });
    chain.panic("leg");
    settle().await;
    chain.recoverer.drain();

    chain.actor.do_send(Strike);
    settle().await;
    assert_eq!(chain.deaths.drain().len(), 1);
    let alive = chain.actor.send(AreYouAlive).await.expect("the detector lives");
    assert_eq!(alive.incarnation, ONE.next());

    chain.silence("arm");
    let fault = chain.recoverer.expect().await.fault;
    assert_eq!((fault.kind, fault.id.0), (FaultKind::Silence, 2));
    let table = chain.actor.send(ReadTable).await.expect("the monitor lives");
    assert_eq!(table[0].state, Some(Lifecycle::Active));
    assert_eq!(chain.events.drain().len(), 2);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_was_seen_while_the_chain_was_struck_is_judged_afterwards() {
    let chain = Chain::start();
    chain.actor.do_send(Strike);
    chain.panic("arm");
    chain.actor.do_send(Strike);
    chain.actor.do_send(Strike);
    chain.panic("leg");

    advance(Duration::from_millis(900)).await;

    let handed = chain.recoverer.drain().into_iter();
    let mut locations: Vec<_> = handed.map(|one| one.fault.location.to_string()).collect();
    // What was not confirmed before a strike is handed over again.
    locations.dedup();
    assert_eq!(locations, ["m:arm", "m:leg"]);
}

/// A recoverer that has stopped.
struct Gone;

impl Actor for Gone {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        context.stop();
    }
}

impl Handler<Recover> for Gone {
    type Result = Confirmed;

    fn handle(&mut self, _: Recover, _: &mut Context<Self>) -> Confirmed {
        panic!("it has stopped");
    }
}

/// Takes questions and never answers.
struct Mute(usize);

impl Actor for Mute {
    type Context = Context<Self>;
}

impl Handler<AreYouAlive> for Mute {
    type Result = ResponseFuture<Alive>;

    fn handle(&mut self, _: AreYouAlive, _: &mut Context<Self>) -> Self::Result {
        self.0 += 1;
        assert_eq!(self.0, 1, "there is one open question at most");
        Box::pin(std::future::pending())
    }
}
