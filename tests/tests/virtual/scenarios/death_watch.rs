//! Death watch: anyone may ask to be told.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask, strike};
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::time::Duration;

async fn node_of(strings: &Strings) -> TestNode {
    let builder = Node::builder("module1").child(strings.spec("arm")).child(strings.spec("widow"));
    let node = TestNode::start(builder).await;
    ask(&node, "widow", Deed::Watch("arm".into())).await.unwrap();
    node
}

async fn mourned(node: &TestNode, strings: &Strings) -> Vec<String> {
    node.settle().await;
    strings.lines("mourns")
}

#[blastema_testkit::test]
async fn who_watches_is_told_of_every_death_and_how_it_came() {
    let strings = Strings::default();
    let node = node_of(&strings).await;
    assert_eq!(mourned(&node, &strings).await, [""; 0], "it lives");

    strike(&node, "arm").await;
    let first = mourned(&node, &strings).await;
    ask(&node, "arm", Deed::Stop).await.unwrap();
    let second = mourned(&node, &strings).await;
    node.advance(Duration::from_secs(1)).await;
    node.remove_child("arm").await.unwrap();
    let third = mourned(&node, &strings).await;

    assert_eq!(first.len(), 1, "{first:?}");
    assert!(first[0].starts_with("widow#1 mourns arm#1: Panicked { text: \"struck\""), "{first:?}");
    assert_eq!(second, ["widow#1 mourns arm#2: Returned"]);
    assert_eq!(third, ["widow#1 mourns arm#3: Stopped"]);
}

#[blastema_testkit::test]
async fn one_that_does_not_come_to_work_has_failed_whichever_hook_failed() {
    for hook in ["on_initialize", "on_startup", "on_activated"] {
        let strings = Strings::default();
        let node = node_of(&strings).await;
        strings.pull("arm", hook, Pull::Fail("jammed"));
        strings.pull("arm", "on_aborting", Pull::Wait(Duration::from_millis(50)));

        // Whether the second incarnation or the third answers it is not the question here.
        let _ = node.restart_child("arm").await;
        node.advance(Duration::from_secs(1)).await;

        let told = mourned(&node, &strings).await;
        let expected = ["widow#1 mourns arm#1: Stopped", "widow#1 mourns arm#2: Fatal"];
        assert_eq!(told, expected, "{hook}");
        let kinds = node.faults().await.entries.into_iter().map(|entry| entry.fault.kind);
        let kinds: Vec<_> = kinds.collect();
        assert_eq!(kinds.len(), 1, "{hook}: {kinds:?}");
    }
}

#[blastema_testkit::test]
async fn who_watches_somebody_who_is_not_there_is_told_at_once() {
    let strings = Strings::default();
    let node = node_of(&strings).await;

    ask(&node, "widow", Deed::Watch("absent".into())).await.unwrap();

    assert_eq!(mourned(&node, &strings).await, ["widow#1 mourns absent#0: Unknown"]);
}

#[blastema_testkit::test]
async fn a_watch_ends_with_the_incarnation_that_asked_for_it_and_counts_once() {
    let strings = Strings::default();
    let node = node_of(&strings).await;

    ask(&node, "widow", Deed::Watch("arm".into())).await.unwrap();
    strike(&node, "arm").await;
    assert_eq!(mourned(&node, &strings).await.len(), 1, "asking twice is asking once");
    strike(&node, "widow").await;
    strike(&node, "arm").await;

    assert_eq!(mourned(&node, &strings).await, [""; 0]);
}
