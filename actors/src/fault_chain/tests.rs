//! Monitor, detector and notifier together, with probes where their half of the chain ends.

pub(crate) mod scripted;

use super::detection::DetectionActor;
use crate::platform;
use crate::runtime::guardian::Guardian;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::{FaultEvent, FaultOutcome, ReadRecord, Subscribe};
use blastema_contract::monitor::{LinkReported, NodeReported, ReadTable, Register};
use blastema_contract::notifier::AddPort;
use blastema_contract::recoverer::{CancelRecovery, Recover};
use blastema_contract::reports::{
    Alive, AreYouAlive, ExitReason, Exited, LivenessReported, StateReported,
};
use blastema_core::detection::hang::LivenessEvent;
use blastema_core::detection::{
    FaultTransition, Finding, LinkCondition, NodeCondition, Opinion, RecovererPort,
    RecoveryOutcome, Registration,
};
use blastema_core::{FaultKind, Incarnation, Lifecycle, NodeName, ObjectName};
use blastema_doubles::{Probe, advance, paused, settle};
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
    stand_downs: Probe<CancelRecovery>,
    deaths: Probe<Exited>,
    events: Probe<FaultEvent>,
}

impl Chain {
    fn start() -> Self {
        let deaths = Probe::start();
        let guardian = Guardian::reporting_to(deaths.recipient());
        let actor = guardian.start(object("chain"), None, |_| DetectionActor::new(node("m")));
        let recoverer = Probe::replying(|_: &Recover| Confirmed);
        let stand_downs = Probe::replying(|_: &CancelRecovery| Confirmed);
        let stand_down = Some(stand_downs.recipient());
        let recover = recoverer.recipient();
        actor.do_send(AddPort { port: RecovererPort::Local, recover, stand_down });
        let events = Probe::start();
        actor.do_send(Subscribe(events.recipient()));
        Chain { actor, recoverer, stand_downs, deaths, events }
    }

    fn enrol(&self, enrolment: Registration) {
        self.actor.do_send(Register { enrolment, pings: None });
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

    fn speech(&self, name: &str) {
        let spoke = LivenessEvent::Component {
            object: object(name),
            incarnation: ONE,
            finding: Finding::Spoke,
        };
        self.actor.do_send(LivenessReported(spoke));
    }

    fn panic(&self, name: &str) {
        let exit =
            ExitReason::Panicked { text: "boom".into(), at: "arm.rs:7".into(), during: "Move" };
        let object = object(name);
        self.actor.do_send(Exited { object, incarnation: ONE, exit, restarted_as: None });
    }
}

#[test]
fn a_panic_reaches_the_recoverer_without_any_time_passing() {
    paused(async {
        let chain = Chain::start();
        let before = platform::now();

        chain.panic("arm");

        let fault = chain.recoverer.expect().await.fault;
        assert_eq!((fault.kind, fault.location.to_string()), (FaultKind::Panic, "m:arm".into()));
        assert_eq!(fault.detail, "boom, at arm.rs:7, in Move");
        assert_eq!(platform::now(), before);
        assert_eq!(chain.events.expect().await.turn, FaultTransition::Found);
    });
}

#[test]
fn a_silent_arm_is_reported_once_and_cleared_when_it_speaks_again() {
    paused(async {
        let chain = Chain::start();
        chain.enrol(Registration::new(object("arm")));
        chain.silence("arm");
        let fault = chain.recoverer.expect().await.fault;
        assert_eq!(fault.kind, FaultKind::Silence);
        let decided = RecoveryOutcome::Decided { action: "restart".into() };
        let at = platform::now();
        chain.actor.do_send(FaultOutcome { id: fault.id, at, what: decided });
        chain.recoverer.expect_none_for(Duration::from_secs(10)).await;

        chain.speech("arm");
        assert_eq!(chain.stand_downs.expect().await.id, fault.id);
        let turns: Vec<FaultTransition> =
            chain.events.drain().into_iter().map(|e| e.turn).collect();
        let action = "restart".into();
        assert_eq!(
            turns,
            [FaultTransition::Found, FaultTransition::Decided { action }, FaultTransition::Cleared]
        );
    });
}

#[test]
fn an_object_that_is_asked_and_answers_is_trusted() {
    paused(async {
        let chain = Chain::start();
        let arm =
            Probe::replying(|_: &AreYouAlive| Alive { incarnation: ONE, state: Lifecycle::Active });
        let enrolment = Registration::new(object("arm"));
        chain.actor.do_send(Register { enrolment, pings: Some(arm.recipient()) });
        advance(Duration::from_millis(9500)).await;

        assert_eq!(arm.recorded(), 10);
        let table = chain.actor.send(ReadTable).await.expect("the monitor lives");
        assert_eq!(table[0].opinion, Opinion::Trusted);
        assert_eq!(chain.recoverer.recorded(), 0);
    });
}

#[test]
fn one_that_never_answers_is_asked_once_and_found_silent() {
    paused(async {
        let chain = Chain::start();
        let enrolment = Registration::new(object("arm"));
        let pings = Some(Mute(0).start().recipient());
        chain.actor.do_send(Register { enrolment, pings });

        advance(Duration::from_millis(5500)).await;
        assert_eq!(chain.recoverer.recorded(), 0);
        advance(Duration::from_secs(1)).await;

        assert_eq!(chain.recoverer.drain()[0].fault.kind, FaultKind::Silence);
    });
}

#[test]
fn one_that_does_not_answer_while_the_node_starves_has_five_times_as_long() {
    paused(async {
        let chain = Chain::start();
        let enrolment = Registration::new(object("arm"));
        let pings = Some(Mute(0).start().recipient());
        chain.actor.do_send(Register { enrolment, pings });
        settle().await;
        let starve = async |intervals: u32| {
            for _ in 0..intervals {
                tokio::time::advance(Duration::from_millis(1200)).await;
                settle().await;
            }
        };

        starve(28).await;
        assert_eq!(chain.recoverer.recorded(), 0);
        starve(4).await;

        assert_eq!(chain.recoverer.drain()[0].fault.kind, FaultKind::Silence);
    });
}

#[test]
fn a_stall_of_the_whole_process_condemns_nobody() {
    paused(async {
        let chain = Chain::start();
        let enrolment = Registration::new(object("arm"));
        let pings = Some(Mute(0).start().recipient());
        chain.actor.do_send(Register { enrolment, pings });
        settle().await;

        // The clock jumps: every timer is late at once, before anything can answer.
        let gap = Duration::from_secs(30);
        tokio::time::advance(gap).await;
        chain.actor.do_send(LivenessReported(LivenessEvent::Stalled { gap }));
        advance(Duration::from_secs(4)).await;

        assert_eq!(chain.recoverer.recorded(), 0);
    });
}

#[test]
fn the_links_of_a_lost_node_are_told_as_its_symptoms() {
    paused(async {
        let chain = Chain::start();
        for link in ["ethernet", "ieee1394"] {
            let reason = "three hellos missed".into();
            chain.actor.do_send(LinkReported {
                node: node("m"),
                link: link.into(),
                neighbour: Some(node("n")),
                condition: LinkCondition::Down { reason },
            });
        }
        let condition = NodeCondition::Lost { reason: "no path is left".into() };
        chain.actor.do_send(NodeReported {
            node: node("n"),
            incarnation: Incarnation(77),
            condition,
        });
        settle().await;

        let record = chain.actor.send(ReadRecord).await.expect("the detector lives");

        let kinds: Vec<_> = record.entries.iter().map(|e| e.fault.kind.clone()).collect();
        assert_eq!(kinds, [FaultKind::NodeLost, FaultKind::LinkDown, FaultKind::LinkDown]);
        let root = Some(record.entries[0].fault.id);
        assert!(record.entries[1..].iter().all(|entry| entry.fault.symptom_of == root));
    });
}

#[test]
fn a_recoverer_that_cannot_be_reached_gets_the_fault_when_it_is_back() {
    paused(async {
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
    });
}

#[test]
fn the_chain_survives_being_struck_with_all_it_knew() {
    paused(async {
        let chain = Chain::start();
        chain.enrol(Registration::new(object("arm")));
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
    });
}

#[test]
fn what_was_seen_while_the_chain_was_struck_is_judged_afterwards() {
    paused(async {
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
    });
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
