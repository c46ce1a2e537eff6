//! Incarnations that end in an unusual place: while they stop, before they work, or between two.

use crate::scenarios::puppet::{Deed, News, Pull, Strings, ask, incarnation, strike};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema_testkit::TestNode;
use blastema_tests::MS;
use std::sync::{Arc, Mutex};
use std::time::Duration;

const HOUR: Duration = Duration::from_secs(3600);

#[blastema_testkit::test]
async fn one_that_stops_by_itself_and_does_not_end_in_time_is_replaced() {
    let strings = Strings::default();
    let spec = strings.spec("arm").shutdown_within(1000 * MS);
    let mut node = TestNode::start(Node::builder("module1").child(spec)).await;
    strings.pull("arm", "on_deactivated", Pull::Wait(HOUR));

    ask(&node, "arm", Deed::Stop).await.unwrap();
    node.await_fault(FaultKind::UnexpectedExit, "arm").await;
    node.await_recovered(FaultKind::UnexpectedExit, "arm").await;

    assert_eq!(incarnation(&node, "arm").await, 2);
}

#[blastema_testkit::test]
async fn one_that_did_not_come_to_work_and_panics_is_left_to_its_supervisor() {
    let (strings, mut node) = Strings::robot(["arm"]).await;
    strings.pull("arm", "on_activated", Pull::Fail("no torque"));
    strings.pull("arm", "on_error", Pull::Panic("and worse"));

    ask(&node, "arm", Deed::FailFatally("bent".into())).await.unwrap();
    node.await_recovered(FaultKind::Panic, "arm").await;
    node.advance(10_000 * MS).await;

    let arm = node.tree().await.unwrap().children[0].clone();
    assert_eq!(
        (arm.state, arm.incarnation.0),
        (ChildState::Running, incarnation(&node, "arm").await)
    );
}

#[blastema_testkit::test]
async fn one_that_does_not_come_to_work_ends_in_order_also_where_none_follows() {
    let strings = Strings::default();
    let builder = Node::builder("module1").intensity(0, 10_000 * MS).child(strings.spec("arm"));
    let mut node = TestNode::start(builder).await;
    strings.pull("arm", "on_activated", Pull::Fail("no torque"));
    strings.diary();

    node.restart_child("arm").await.unwrap_err();
    node.await_given_up(FaultKind::ErrorState, "arm").await;

    let second: Vec<String> = strings.lines("arm#2");
    assert_eq!(second.last().map(String::as_str), Some("arm#2 on_finalize"), "{second:?}");
}

#[blastema_testkit::test]
async fn the_end_of_a_temporary_one_that_did_not_come_to_work_is_told_once() {
    let strings = Strings::default();
    strings.pull("arm", "on_initialize", Pull::Unavailable("no device"));
    strings.pull("arm", "on_initialize", Pull::Unavailable("no device"));
    strings.pull("arm", "on_initialize", Pull::Fail("a broken device"));
    strings.pull("arm", "on_finalize", Pull::Wait(300 * MS));
    let builder = Node::builder("module1")
        .child(strings.spec("ear"))
        .child_with(strings.spec("arm"), Restart::Temporary);
    let mut node = TestNode::start(builder).await;
    ask(&node, "ear", Deed::Watch("arm".into())).await.unwrap();

    node.await_given_up(FaultKind::InitializationFailed, "arm").await;
    node.advance(1000 * MS).await;

    let told = strings.lines("watched");
    assert!(matches!(&told[..], [one] if one.starts_with("ear#1 watched arm#1")), "{told:?}");
}

#[blastema_testkit::test]
async fn one_that_does_not_come_to_work_has_failed_whichever_hook_failed() {
    for hook in ["on_initialize", "on_startup", "on_activated"] {
        let (strings, node) = Strings::robot(["arm", "watcher"]).await;
        ask(&node, "watcher", Deed::Watch("arm".into())).await.unwrap();
        strings.pull("arm", hook, Pull::Fail("jammed"));
        strings.pull("arm", "on_aborting", Pull::Wait(50 * MS));

        // Whether the second incarnation or the third answers it is not the question here.
        let _ = node.restart_child("arm").await;
        node.advance(1000 * MS).await;

        let told = strings.lines("watched");
        let expected = ["watcher#1 watched arm#1: Stopped", "watcher#1 watched arm#2: Fatal"];
        assert_eq!(told, expected, "{hook}");
        let kinds = node.faults().await.entries.into_iter().map(|entry| entry.fault.kind);
        let kinds: Vec<_> = kinds.collect();
        assert_eq!(kinds.len(), 1, "{hook}: {kinds:?}");
    }
}

#[blastema_testkit::test]
async fn a_condition_that_panics_between_two_incarnations_is_a_failed_check() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForAll)
        .child(strings.spec("arm"))
        .child(strings.spec("ear"));
    let mut node = TestNode::start(Node::builder("module1").supervisor(group)).await;
    let news = node.publisher::<News>("test/news").unwrap();
    // The ear has ended, and its next incarnation begins when the arm's has.
    strings.pull("arm", "on_initialize", Pull::Wait(500 * MS));

    strike(&node, "arm").await;
    node.advance(100 * MS).await;
    news.publish(News(13)).unwrap();

    let fault = node.await_fault(FaultKind::CheckFailed, "ear").await;
    assert!(fault.detail.contains("unlucky"), "{}", fault.detail);
    node.await_recovered(FaultKind::Panic, "arm").await;
    assert_eq!(incarnation(&node, "ear").await, 2);
}

#[derive(Debug, Request)]
#[contract(reply = ())]
struct EndAll;

/// Shuts down the node in which it is itself, in a handler.
#[derive(Clone, Default)]
struct Pilot(Arc<Mutex<Option<Node>>>);

impl Pilot {
    fn spec(&self) -> ChildSpec<Pilot> {
        let pilot = self.clone();
        ChildSpec::new("pilot", move || pilot.clone()).max_wait(50 * MS)
    }
}

impl Component for Pilot {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<EndAll>();
    }
}

impl Handle<EndAll> for Pilot {
    async fn handle(&mut self, _: EndAll, _: &mut Context<Self>) {
        let node = self.0.lock().unwrap().take();
        if let Some(node) = node {
            node.shutdown().await;
        }
    }
}

/// Has the pilot shut the node down, and waits until that has been carried out to its end.
async fn ends_by_its_pilot(node: &Node, pilot: &Pilot) {
    *pilot.0.lock().unwrap() = Some(node.clone());

    node.sender::<EndAll>("pilot").unwrap().tell(EndAll).unwrap();

    assert_eq!(node.ended().await, NodeState::Stopped);
    let ended = DeliveryError::ShutDown { node: "module1".into() };
    let carried_out = async {
        while node.sender::<EndAll>("pilot").err() != Some(ended.clone()) {
            blastema::sleep(MS).await;
        }
    };
    let carried_out = tokio::time::timeout(Duration::from_secs(30), carried_out).await;
    carried_out.expect("it ends although the handler that waited for it was cut off");
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn a_shutdown_from_a_handler_that_is_cut_off_is_carried_out_on_threads() {
        let _turn = blastema_doubles::turn();
        blastema::run(async {
            let pilot = Pilot::default();
            let node = Node::builder("module1").child(pilot.spec()).start().await.unwrap();
            ends_by_its_pilot(&node, &pilot).await;
        });
    }
}
