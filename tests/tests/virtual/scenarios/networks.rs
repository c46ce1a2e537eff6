//! Three nodes on two networks, all on one thread and in virtual time.
//!
//! ```text
//!            ethernet             ieee1394
//!   module2 ────────── module1 ────────── module3
//!            backup
//!   module2 ══════════ module1
//! ```

use crate::scenarios::puppet::{Deed, Do, Note, Strings, ask, incarnation};
use blastema::core::net::LinkState;
use blastema::core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::prelude::*;
use blastema::{
    Direction, FaultLocation, FaultStatus, Link, MemoryMedium, Network, NodeBuilder,
    RecoveryStrategy, SessionState, StrategyContext,
};
use blastema_testkit::TestNode;
use blastema_tests::MS;
use std::sync::{Arc, Mutex};

/// Another contract of the same name.
#[derive(Debug, Request)]
#[contract(name = "test/do", reply = u64)]
struct OtherDo {
    text: String,
}

/// The media of one robot.
#[derive(Default)]
struct Media {
    ethernet: MemoryMedium,
    ieee1394: MemoryMedium,
    backup: MemoryMedium,
}

impl Media {
    fn network(medium: &MemoryMedium, name: &str, own: &str, far: &str, cost: u16) -> Network {
        let link = Link::to(far, far).cost(cost);
        Network::memory(name, medium, own).link(link).with_faults(7)
    }

    fn module1(&self) -> NodeBuilder {
        Node::builder("module1")
            .network(Media::network(&self.ethernet, "ethernet", "module1", "module2", 10))
            .network(Media::network(&self.backup, "backup", "module1", "module2", 20))
            .network(Media::network(&self.ieee1394, "ieee1394", "module1", "module3", 10))
    }

    fn module2(&self) -> NodeBuilder {
        Node::builder("module2")
            .network(Media::network(&self.ethernet, "ethernet", "module2", "module1", 10))
            .network(Media::network(&self.backup, "backup", "module2", "module1", 20))
    }

    fn module3(&self) -> NodeBuilder {
        Node::builder("module3").network(Media::network(
            &self.ieee1394,
            "ieee1394",
            "module3",
            "module1",
            10,
        ))
    }
}

/// Its nodes, each with a puppet: `planner` on module1, `laser` on module2, `motors` on module3.
struct Robot {
    media: Media,
    module1: TestNode,
    module2: TestNode,
    module3: TestNode,
}

impl Robot {
    async fn start(strings: &Strings) -> Self {
        let media = Media::default();
        let module1 = TestNode::start(media.module1().child(strings.spec("planner"))).await;
        let module2 = TestNode::start(media.module2().child(strings.spec("laser"))).await;
        let module3 = TestNode::start(media.module3().child(strings.spec("motors"))).await;
        module1.advance(2000 * MS).await;
        Robot { media, module1, module2, module3 }
    }

    fn cut(&self, cable: &str) {
        let cable = self.module1.cable(cable).expect("a cable of this name");
        cable.cut(Direction::Both, false);
    }

    fn clear(&self, cable: &str) {
        self.module1.cable(cable).expect("a cable of this name").restore();
    }
}

#[blastema_testkit::test]
async fn objects_of_other_nodes_are_reached_by_name_over_one_hop_and_two_also_when_they_die() {
    let strings = Strings::default();
    let robot = Robot::start(&strings).await;

    assert_eq!(ask(&robot.module1, "module2:laser", Deed::Nothing).await.unwrap(), 1);
    assert_eq!(ask(&robot.module3, "module2:laser", Deed::Nothing).await.unwrap(), 1);
    ask(&robot.module2, "laser", Deed::Publish(1)).await.unwrap();
    robot.module1.advance(100 * MS).await;

    let mut heard = strings.lines("news 1");
    heard.sort();
    assert_eq!(heard, ["laser#1 news 1", "motors#1 news 1", "planner#1 news 1"]);
    robot.module1.expect_no_faults().await;

    let died = ask(&robot.module3, "module2:laser", Deed::Panic("struck".into())).await;
    let why = died.expect_err("it died").kind;
    assert!(matches!(why, DeliveryError::PeerDied { incarnation } if incarnation.0 == 1), "{why}");
    assert_eq!(ask(&robot.module3, "module2:laser", Deed::Nothing).await.unwrap(), 2);
}

#[blastema_testkit::test]
async fn who_is_unknown_or_different_on_another_node_is_told_so() {
    let robot = Robot::start(&Strings::default()).await;
    let unknown = robot.module1.sender::<Do>("module2:absent").unwrap();
    let differs = robot.module1.sender::<OtherDo>("module2:laser").unwrap();
    let nowhere = robot.module1.sender::<Do>("module9:laser").unwrap();

    let unknown = unknown.ask(Do(Deed::Nothing)).await.expect_err("it is not there").kind;
    let other = OtherDo { text: "hello".into() };
    let differs = differs.ask(other).await.expect_err("it is another contract").kind;
    let nowhere = nowhere.ask(Do(Deed::Nothing)).await.expect_err("there is no such node").kind;

    assert!(matches!(unknown, DeliveryError::Unknown { .. }), "{unknown}");
    let DeliveryError::ContractDiffers { difference } = differs else { panic!("{differs}") };
    assert!(difference.contains("test/do"), "{difference}");
    assert!(
        matches!(nowhere, DeliveryError::Unreachable { .. } | DeliveryError::DeadlinePassed),
        "{nowhere}"
    );
}

#[blastema_testkit::test]
async fn the_rows_of_sessions_tell_how_each_stands_what_is_repeated_and_what_differs() {
    let strings = Strings::default();
    let robot = Robot::start(&strings).await;
    let session = async || {
        let rows = robot.module1.sessions().await;
        rows.into_iter().find(|row| row.node.as_str() == "module3").expect("it is known")
    };
    let other = robot.module1.sender::<OtherDo>("module3:motors").unwrap();
    other.ask(OtherDo { text: "hello".into() }).await.expect_err("it is another contract");
    let before = session().await;
    assert_eq!(before.status.state, SessionState::Open);
    assert_eq!(before.status.incarnation, Some(robot.module3.incarnation()));
    assert!(before.status.round_trip.is_some() && before.status.window > 0);
    assert!(
        before.differences.len() == 1 && before.differences[0].contains("test/do"),
        "{before:?}"
    );

    robot.cut("ieee1394");
    robot.module1.sender("module3:motors").unwrap().tell(Note(1)).unwrap();
    robot.module1.advance(50 * MS).await;
    let cut = session().await.status;
    assert!(cut.unacknowledged > 0 && cut.in_flight > 0, "{cut:?}");
    robot.module1.advance(5000 * MS).await;
    assert_eq!(session().await.status.state, SessionState::Away);

    robot.clear("ieee1394");
    robot.module1.advance(5000 * MS).await;
    let after = session().await;
    assert_eq!((after.status.state, after.status.unacknowledged), (SessionState::Open, 0));
    assert!(after.status.counters.retransmitted > before.status.counters.retransmitted);
    assert_eq!(after.differences, before.differences, "it is the same incarnation");
}

#[blastema_testkit::test]
async fn a_cut_cable_stands_as_a_fault_though_the_second_takes_over_without_loss_or_doubles() {
    let strings = Strings::default();
    let mut robot = Robot::start(&strings).await;
    let laser = robot.module1.sender::<Note>("module2:laser").unwrap();

    for n in 0..200 {
        if n == 50 {
            robot.cut("ethernet");
        }
        laser.deliver(Note(n)).await.expect("it is reliable");
        robot.module1.advance(10 * MS).await;
    }
    robot.module1.advance(1000 * MS).await;

    let location = "module1 -ethernet- module2";
    let fault = robot.module1.await_fault(FaultKind::LinkDown, location).await;
    assert!(matches!(fault.location, FaultLocation::Link { .. }));
    robot.module1.await_recovered(FaultKind::LinkDown, location).await;
    let heard = strings.lines("note");
    let sent: Vec<String> = (0..200).map(|n| format!("laser#1 note {n}")).collect();
    assert_eq!(heard, sent);
    robot.module1.expect_no_faults().await;

    robot.module1.advance(60_000 * MS).await;
    let entry = async || {
        let record = robot.module1.faults().await;
        record.entries.into_iter().find(|entry| entry.fault.id == fault.id).expect("it is there")
    };
    let out = entry().await;
    assert_eq!(out.status(), FaultStatus::Recovered);
    let recovered = out.recovered_at.expect("the second cable takes over");
    let last_sign = async |location: &str| {
        let row = robot.module1.row(location).await;
        row.last_sign.expect("it gave one").as_millis()
    };
    assert!(last_sign(location).await >= 60_000, "no hello comes over it");
    assert!(last_sign("module2").await < 1_000, "hellos come over the other one");

    robot.clear("ethernet");
    robot.module1.advance(5000 * MS).await;
    let repaired = entry().await;
    assert_eq!((repaired.status(), repaired.recovered_at), (FaultStatus::Closed, Some(recovered)));
    assert!(repaired.repaired_after() > repaired.recovered_after(), "{repaired:?}");
    assert!(last_sign(location).await < 1_000);
    assert_eq!(ask(&robot.module1, "module2:laser", Deed::Nothing).await.unwrap(), 1);
}

#[blastema_testkit::test]
async fn when_all_cables_are_cut_the_node_is_lost_and_it_returns_when_one_is_mended() {
    let strings = Strings::default();
    let mut robot = Robot::start(&strings).await;

    robot.cut("ethernet");
    robot.cut("backup");
    let lost = robot.module1.await_fault(FaultKind::NodeLost, "module2").await;
    let far = ask(&robot.module1, "module2:laser", Deed::Nothing).await.expect_err("no way");
    assert!(
        matches!(far.kind, DeliveryError::Unreachable { .. } | DeliveryError::DeadlinePassed),
        "{}",
        far.kind
    );

    robot.clear("backup");
    robot.module1.advance(3000 * MS).await;
    assert_eq!(ask(&robot.module1, "module2:laser", Deed::Nothing).await.unwrap(), 1);
    assert_eq!(ask(&robot.module3, "module2:laser", Deed::Nothing).await.unwrap(), 1);
    let record = robot.module1.faults().await;
    let entry = record.entries.iter().find(|entry| entry.fault.id == lost.id).unwrap();
    assert!(!entry.stands(), "{entry:?}");
    let links = record.entries.iter().filter(|entry| entry.fault.kind == FaultKind::LinkDown);
    assert_eq!(links.count(), 2);
}

#[blastema_testkit::test]
async fn a_node_that_goes_and_comes_again_is_lost_and_found_and_serves_the_same_senders() {
    let strings = Strings::default();
    let mut robot = Robot::start(&strings).await;
    let laser = robot.module3.sender::<Do>("module2:laser").unwrap();
    assert_eq!(laser.ask(Do(Deed::Nothing)).await.unwrap(), 1);

    // It cannot say that it goes.
    robot.cut("ethernet");
    robot.cut("backup");
    robot.module2.shutdown().await;
    robot.module1.await_fault(FaultKind::NodeLost, "module2").await;
    robot.clear("ethernet");
    robot.clear("backup");
    let gone = laser.ask(Do(Deed::Nothing)).await.expect_err("it is gone");
    assert!(gone.message.is_none() || gone.kind != DeliveryError::DeadlinePassed, "{}", gone.kind);
    robot.module2 = TestNode::start(robot.media.module2().child(strings.spec("laser"))).await;
    robot.module1.advance(3000 * MS).await;

    assert_eq!(
        laser.ask(Do(Deed::Nothing)).await.unwrap(),
        1,
        "a new node, and its first incarnation"
    );
    assert_eq!(incarnation(&robot.module2, "laser").await, 1);
}

#[blastema_testkit::test]
async fn a_router_that_panics_in_between_loses_nothing_that_is_sent_reliably() {
    let strings = Strings::default();
    let mut robot = Robot::start(&strings).await;
    let laser = robot.module3.sender::<Note>("module2:laser").unwrap();

    for n in 0..100 {
        if n % 40 == 20 {
            robot.module1.panic_router();
        }
        laser.deliver(Note(n)).await.expect("it is reliable");
        robot.module1.advance(10 * MS).await;
    }
    robot.module1.advance(2000 * MS).await;

    robot.module1.await_fault(FaultKind::Panic, "net/stack").await;
    robot.module1.await_recovered(FaultKind::Panic, "net/stack").await;
    assert_eq!(robot.module1.row("net/stack").await.restarts, 2);
    let sent: Vec<String> = (0..100).map(|n| format!("laser#1 note {n}")).collect();
    assert_eq!(strings.lines("note"), sent);
}

/// Takes note of whom it was asked to stand in for.
struct TakeOver(Arc<Mutex<Vec<String>>>);

impl RecoveryStrategy for TakeOver {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        _: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        self.0.lock().unwrap().push(format!("{} of {}", order.fault.kind, order.fault.location));
        Ok(RecoveryDone::default())
    }
}

#[blastema_testkit::test]
async fn a_fault_of_another_node_is_told_to_the_recoverers_of_its_neighbours() {
    let strings = Strings::default();
    let media = Media::default();
    let ladder = Ladder::first(RecoveryAction::Custom("take over".into()));
    let plan = Plan::default().on_other_nodes(FaultKind::ErrorState, ladder);
    let told: Arc<Mutex<Vec<String>>> = Arc::default();
    let kept = told.clone();
    let builder = media.module1().plan(plan);
    let module1 =
        TestNode::start(builder.recovery("take over", move || TakeOver(kept.clone()))).await;
    let mut module2 = TestNode::start(media.module2().child(strings.spec("laser"))).await;
    module1.advance(2000 * MS).await;

    ask(&module2, "laser", Deed::Fail("the mirror sticks".into())).await.unwrap();
    module2.await_recovered(FaultKind::ErrorState, "laser").await;
    module1.advance(1000 * MS).await;

    assert_eq!(*told.lock().unwrap(), ["error state of module2:laser"]);
    assert_eq!(incarnation(&module2, "laser").await, 1, "its own node has recovered it");
}

#[blastema_testkit::test]
async fn a_partition_parts_from_some_neighbours_and_a_third_passes_on() {
    let (medium, strings) = (MemoryMedium::default(), Strings::default());
    let on_bus = |own: &'static str, peers: [&str; 2]| {
        let network = Network::memory("bus", &medium, own).with_faults(7);
        let network = peers.iter().fold(network, |network, peer| network.peer(peer, peer));
        Node::builder(own).network(network).child(strings.spec(own))
    };
    let module1 = TestNode::start(on_bus("module1", ["module2", "module3"])).await;
    let module2 = TestNode::start(on_bus("module2", ["module1", "module3"])).await;
    let _module3 = TestNode::start(on_bus("module3", ["module1", "module2"])).await;
    module1.advance(2000 * MS).await;

    let cable = module1.cable("bus").expect("it was described with faults");
    cable.part_from(Direction::Both, &["module2"]);
    module1.advance(1000 * MS).await;

    let links = module1.links().await;
    let up: Vec<_> =
        links.iter().filter(|row| row.state == LinkState::Up).map(|row| &*row.link).collect();
    assert_eq!(up, ["bus/module3"]);
    assert_eq!(ask(&module1, "module2:module2", Deed::Nothing).await.unwrap(), 1);
    assert_eq!(ask(&module2, "module1:module1", Deed::Nothing).await.unwrap(), 1);

    cable.restore();
    module1.advance(2000 * MS).await;
    assert!(module1.links().await.iter().all(|row| row.state == LinkState::Up));
}
