//! Monitor, detector and notifier together, with probes where their half of the chain ends.

pub(crate) mod scripted;

use super::detector::DetectorActor;
use super::monitor::MonitorActor;
use super::notifier::NotifierActor;
use crate::platform;
use crate::runtime::guardian::Guardian;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::{FaultEvent, FaultOutcome, Observed, ReadRecord, Subscribe};
use blastema_contract::monitor::{LinkReported, NodeReported, ReadTable, Register};
use blastema_contract::notifier::{AddPort, ReadPorts};
use blastema_contract::recoverer::{CancelRecovery, Recover};
use blastema_contract::reports::{
    Alive, AreYouAlive, ExitReason, Exited, LivenessReported, StateReported,
};
use blastema_core::detection::hang::LivenessEvent;
use blastema_core::detection::{
    FaultTransition, LinkCondition, MonitorLimits, NodeCondition, Opinion, RecovererPort,
    RecoveryOutcome, Registration,
};
use blastema_core::{FaultKind, Incarnation, Lifecycle, NodeName, ObjectName};
use blastema_doubles::{Probe, advance, paused, settle};
use std::cell::RefCell;
use std::rc::Rc;
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

macro_rules! may_be_struck {
    ($($actor:ty),*) => {$(
        impl Handler<Strike> for $actor {
            type Result = ();
            fn handle(&mut self, _: Strike, _: &mut Context<Self>) {
                panic!("struck");
            }
        }
    )*};
}
may_be_struck!(MonitorActor, DetectorActor, NotifierActor);

/// The observing half of the chain, with probes where it ends.
struct Chain {
    monitor: Addr<MonitorActor>,
    detector: Addr<DetectorActor>,
    notifier: Addr<NotifierActor>,
    recoverer: Probe<Recover>,
    stand_downs: Probe<CancelRecovery>,
    deaths: Probe<Exited>,
    events: Probe<FaultEvent>,
}

impl Chain {
    fn start() -> Self {
        let deaths = Probe::start();
        let guardian = Guardian::reporting_to(deaths.recipient());
        let notifier =
            guardian.start(object("notifier"), None, |_| NotifierActor::new(Default::default()));
        let (found, cleared) = (notifier.clone().recipient(), notifier.clone().recipient());
        let detector = guardian.start(object("detector"), None, |_| {
            DetectorActor::new(node("m"), Default::default(), found, cleared)
        });
        let observed = detector.clone().recipient();
        let monitor = guardian.start(object("monitor"), None, |_| {
            MonitorActor::new(node("m"), MonitorLimits::default(), observed)
        });
        let recoverer = Probe::replying(|_: &Recover| Confirmed);
        let stand_downs = Probe::replying(|_: &CancelRecovery| Confirmed);
        let stand_down = Some(stand_downs.recipient());
        let recover = recoverer.recipient();
        notifier.do_send(AddPort { port: RecovererPort::Local, recover, stand_down });
        let events = Probe::start();
        detector.do_send(Subscribe(events.recipient()));
        Chain { monitor, detector, notifier, recoverer, stand_downs, deaths, events }
    }

    fn enrol(&self, enrolment: Registration) {
        self.monitor.do_send(Register { enrolment, pings: None });
    }

    fn silence(&self, name: &str) {
        let (object, silent_for) = (object(name), 3 * TENTH);
        let silent = LivenessEvent::Silent { object, incarnation: ONE, silent_for };
        self.monitor.do_send(LivenessReported(silent));
    }

    fn speech(&self, name: &str) {
        let spoke = LivenessEvent::Spoke { object: object(name), incarnation: ONE };
        self.monitor.do_send(LivenessReported(spoke));
    }

    fn panic(&self, name: &str) {
        let exit =
            ExitReason::Panicked { text: "boom".into(), at: "arm.rs:7".into(), during: "Move" };
        let object = object(name);
        self.monitor.do_send(Exited { object, incarnation: ONE, exit, restarted_as: None });
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
        chain.detector.do_send(FaultOutcome { id: fault.id, at, what: decided });
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
        chain.monitor.do_send(Register { enrolment, pings: Some(arm.recipient()) });
        advance(Duration::from_millis(9500)).await;

        assert_eq!(arm.recorded(), 10);
        let table = chain.monitor.send(ReadTable).await.expect("the monitor lives");
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
        chain.monitor.do_send(Register { enrolment, pings });

        advance(Duration::from_millis(5500)).await;
        assert_eq!(chain.recoverer.recorded(), 0);
        advance(Duration::from_secs(1)).await;

        assert_eq!(chain.recoverer.drain()[0].fault.kind, FaultKind::Silence);
    });
}

#[test]
fn a_stall_of_the_whole_process_condemns_nobody() {
    paused(async {
        let chain = Chain::start();
        let enrolment = Registration::new(object("arm"));
        let pings = Some(Mute(0).start().recipient());
        chain.monitor.do_send(Register { enrolment, pings });
        settle().await;

        // The clock jumps: every timer is late at once, before anything can answer.
        let gap = Duration::from_secs(30);
        tokio::time::advance(gap).await;
        chain.monitor.do_send(LivenessReported(LivenessEvent::Stalled { gap }));
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
            chain.monitor.do_send(LinkReported {
                node: node("m"),
                link: link.into(),
                neighbour: Some(node("n")),
                condition: LinkCondition::Down { reason },
            });
        }
        let condition = NodeCondition::Lost { reason: "no path is left".into() };
        chain.monitor.do_send(NodeReported {
            node: node("n"),
            incarnation: Incarnation(77),
            condition,
        });
        settle().await;

        let record = chain.detector.send(ReadRecord).await.expect("the detector lives");

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
        chain.notifier.do_send(AddPort { port, recover, stand_down: None });
        chain.panic("arm");
        advance(Duration::from_secs(1)).await;
        let rows = chain.notifier.send(ReadPorts).await.expect("the notifier lives");
        assert_eq!((rows[0].pending, rows[1].pending), (0, 1));

        let back = Probe::replying(|_: &Recover| Confirmed);
        let recover = back.recipient();
        chain.notifier.do_send(AddPort { port: there, recover, stand_down: None });
        advance(Duration::from_secs(10)).await;

        let rows = chain.notifier.send(ReadPorts).await.expect("the notifier lives");
        assert!(rows.iter().all(|row| row.pending == 0 && row.given_up == 0), "{rows:?}");
        assert_eq!(back.expect().await.fault.kind, FaultKind::Panic);
    });
}

#[test]
fn each_of_the_three_survives_being_struck_with_all_it_knew() {
    paused(async {
        let chain = Chain::start();
        chain.enrol(Registration::new(object("arm")));
        chain.monitor.do_send(StateReported {
            object: object("arm"),
            incarnation: ONE,
            state: Lifecycle::Active,
            reason: None,
        });
        chain.panic("leg");
        settle().await;
        chain.recoverer.drain();

        chain.monitor.do_send(Strike);
        chain.detector.do_send(Strike);
        chain.notifier.do_send(Strike);
        settle().await;
        assert_eq!(chain.deaths.drain().len(), 3);
        let alive = chain.detector.send(AreYouAlive).await.expect("the detector lives");
        assert_eq!(alive.incarnation, ONE.next());

        chain.silence("arm");
        let fault = chain.recoverer.expect().await.fault;
        assert_eq!((fault.kind, fault.id.0), (FaultKind::Silence, 2));
        let table = chain.monitor.send(ReadTable).await.expect("the monitor lives");
        assert_eq!(table[0].state, Some(Lifecycle::Active));
        assert_eq!(chain.events.drain().len(), 2);
    });
}

#[test]
fn what_was_seen_while_the_detector_was_struck_is_judged_afterwards() {
    paused(async {
        let chain = Chain::start();
        chain.detector.do_send(Strike);
        chain.panic("arm");
        chain.notifier.do_send(Strike);
        chain.detector.do_send(Strike);
        chain.panic("leg");

        let (first, second) = (chain.recoverer.expect().await, chain.recoverer.expect().await);

        let locations = [first, second].map(|recover| recover.fault.location.to_string());
        assert_eq!(locations, ["m:arm", "m:leg"]);
        chain.recoverer.expect_none_for(Duration::from_millis(900)).await;
    });
}

#[test]
fn an_observation_that_nobody_confirms_is_given_up_and_the_next_goes_on() {
    paused(async {
        let received = Rc::new(RefCell::new(Vec::new()));
        let detector = Deaf(received.clone()).start().recipient();
        let monitor = MonitorActor::new(node("m"), MonitorLimits::default(), detector).start();
        for name in ["a", "b"] {
            let enrolment = Registration::new(object(name));
            monitor.do_send(Register { enrolment, pings: None });
        }

        advance(Duration::from_secs(60)).await;

        let (a, b) = ("m:a".to_string(), "m:b".to_string());
        assert_eq!(*received.borrow(), [vec![a; 8], vec![b; 8]].concat());
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

/// A detector that never confirms anything.
struct Deaf(Rc<RefCell<Vec<String>>>);

impl Actor for Deaf {
    type Context = Context<Self>;
}

impl Handler<Observed> for Deaf {
    type Result = ResponseFuture<Confirmed>;

    fn handle(&mut self, message: Observed, _: &mut Context<Self>) -> Self::Result {
        self.0.borrow_mut().push(message.observation.location.to_string());
        Box::pin(std::future::pending())
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
