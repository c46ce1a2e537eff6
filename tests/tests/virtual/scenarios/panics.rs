//! A component panics, wherever it may.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Strings, ask, incarnation, strike};
use blastema::prelude::*;
use blastema::{Incarnation, Severity};
use blastema_testkit::TestNode;
use std::time::Duration;

#[blastema_testkit::test]
async fn a_panic_is_recovered_on_the_spot_and_recorded() {
    let (_, mut node) = Strings::robot(["laser"]).await;
    assert_eq!(incarnation(&node, "laser").await, 1);

    let struck = ask(&node, "laser", Deed::Panic("mirror stuck".into())).await;

    let first = Incarnation(1);
    let error = struck.expect_err("its receiver died");
    assert_eq!(error.kind, DeliveryError::PeerDied { incarnation: first });
    assert_eq!(error.message, None, "it was taken up");
    assert_eq!(
        incarnation(&node, "laser").await,
        2,
        "the same sender reaches the next incarnation"
    );

    let fault = node.await_fault(FaultKind::Panic, "laser").await;
    assert_eq!((fault.incarnation, fault.severity, fault.count), (first, Severity::Error, 1));
    assert!(fault.detail.starts_with("mirror stuck, at tests/tests/virtual/scenarios/puppet.rs:"));
    assert!(fault.detail.ends_with(", in test/do"), "{}", fault.detail);
    assert_eq!(node.await_recovered(FaultKind::Panic, "laser").await, Duration::ZERO);
    let row = node.row("laser").await;
    assert_eq!((row.incarnation, row.restarts), (Incarnation(2), 1));
    let tree = node.tree().await.expect("the root answers");
    assert_eq!((tree.restarts_left, tree.children[0].restarts), (2, 1));
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn what_was_queued_behind_a_deadly_message_is_served_by_the_next_incarnation() {
    let (strings, node) = Strings::robot(["laser"]).await;
    let (deadly, notes) = (node.sender::<Do>("laser"), node.sender::<Note>("laser"));

    deadly.unwrap().tell(Do(Deed::Panic("first".into()))).unwrap();
    (1..=3).for_each(|n| notes.as_ref().unwrap().tell(Note(n)).unwrap());
    node.settle().await;

    assert_eq!(strings.lines("note"), ["laser#2 note 1", "laser#2 note 2", "laser#2 note 3"]);
    assert_eq!(node.dead_letters().total(), 1, "only the deadly one");
}

#[blastema_testkit::test]
async fn a_panic_in_a_task_or_timer_of_its_own_is_the_components_death() {
    let (_, mut node) = Strings::robot(["laser"]).await;
    let deeds = [
        (Deed::PanicInTask("a task".into()), "a task, at", "in a task of its own"),
        (Deed::PanicInTimer("a timer".into()), "a timer, at", "in a timer"),
    ];

    for (n, (deed, text, during)) in deeds.into_iter().enumerate() {
        let before = u64::try_from(n).unwrap() + 1;
        assert_eq!(ask(&node, "laser", deed).await.unwrap(), before);
        node.advance(Duration::from_millis(9)).await;
        node.expect_no_faults().await;
        node.advance(Duration::from_millis(1)).await;

        let fault = node.await_fault(FaultKind::Panic, "laser").await;
        assert!(fault.detail.starts_with(text) && fault.detail.ends_with(during), "{fault:?}");
        node.await_recovered(FaultKind::Panic, "laser").await;
        assert_eq!(incarnation(&node, "laser").await, before + 1);
    }
}

#[blastema_testkit::test]
async fn a_panic_in_a_hook_is_the_components_death() {
    for hook in ["on_activated", "on_startup", "on_initialize", "factory"] {
        let (strings, mut node) = Strings::robot(["laser"]).await;
        // The incarnation after this one dies as it begins; its supervisor tries once more.
        strings.pull("laser", hook, Pull::Panic("in a hook"));
        strike(&node, "laser").await;

        node.await_fault(FaultKind::Panic, "laser").await;
        node.await_recovered(FaultKind::Panic, "laser").await;

        assert_eq!(incarnation(&node, "laser").await, 3, "{hook}");
        let record = node.faults().await;
        let during = if hook == "factory" { "its factory" } else { hook };
        let [entry] = &record.entries[..] else { panic!("{record:?}") };
        assert_eq!(entry.fault.count, 2, "the second panic came before the first was recovered");
        assert!(entry.fault.detail.ends_with(&format!("in {during}")), "{}", entry.fault.detail);
        node.expect_no_faults().await;
    }
}

#[blastema_testkit::test]
async fn a_panic_in_a_round_is_the_components_death_and_rounds_go_on() {
    let strings = Strings::default();
    let spec = strings.spec("laser").rate_hz(10.0);
    let mut node = TestNode::start(Node::builder("module1").child(spec)).await;
    strings.pull("laser", "on_execute", Pull::Panic("odd scan"));

    node.advance(Duration::from_millis(100)).await;
    let fault = node.await_fault(FaultKind::Panic, "laser").await;

    assert!(fault.detail.ends_with("in on_execute"), "{}", fault.detail);
    strings.pull("laser", "on_execute", Pull::Panic("odd again"));
    node.advance(Duration::from_millis(100)).await;
    assert_eq!(node.await_fault(FaultKind::Panic, "laser").await.incarnation, Incarnation(2));
}

#[blastema_testkit::test]
async fn a_panic_with_something_that_is_no_text_is_reported_all_the_same() {
    let (_, mut node) = Strings::robot(["laser"]).await;

    let _ = ask(&node, "laser", Deed::PanicOddly).await;

    let fault = node.await_fault(FaultKind::Panic, "laser").await;
    assert!(fault.detail.starts_with("a panic whose payload is no text"), "{}", fault.detail);
    assert_eq!(incarnation(&node, "laser").await, 2);
}
