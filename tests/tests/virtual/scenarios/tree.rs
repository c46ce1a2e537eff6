//! Components that come and go while the node runs.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Puppet, Strings, ask, incarnation, strike};
use blastema::SpecError;
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::time::Duration;

#[blastema_testkit::test]
async fn a_component_can_be_added_while_the_node_runs_and_is_kept_like_any_other() {
    let strings = Strings::default();
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;

    let hand = node.add_child(strings.spec("hand")).await.expect("a free name");

    assert_eq!(hand.ask(Do(Deed::Nothing)).await.unwrap(), 1);
    strike(&node, "hand").await;
    node.await_recovered(FaultKind::Panic, "hand").await;
    assert_eq!(hand.ask(Do(Deed::Nothing)).await.unwrap(), 2, "the reference outlives the restart");
    assert_eq!(node.actor::<Puppet>("hand").unwrap().incarnation().0, 2);
    assert_eq!(node.tree().await.unwrap().children[1].name.as_str(), "hand");
    assert_eq!(node.row("hand").await.restarts, 1);
}

#[blastema_testkit::test]
async fn a_name_that_is_taken_or_does_not_parse_is_refused() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;

    let taken = node.add_child(strings.spec("arm")).await.expect_err("it is taken");
    let wrong = node.add_child(strings.spec("not a name")).await.expect_err("it does not parse");

    assert!(matches!(taken, SpecError::Taken(_)), "{taken}");
    assert!(matches!(wrong, SpecError::Name(_)), "{wrong}");
    assert_eq!(incarnation(&node, "arm").await, 1, "the owner of the name is unharmed");
}

#[blastema_testkit::test]
async fn a_component_that_would_close_a_circle_of_dependencies_is_refused_and_leaves_no_trace() {
    let strings = Strings::default();
    let hand = || strings.spec("hand");
    let node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;

    let circle = node.add_child(hand().depends_on(["hand"])).await.expect_err("it needs itself");
    let typo = node.add_child(hand().depends_on(["arms"])).await.expect_err("there are no arms");

    assert!(circle.to_string().contains("hand -> hand"), "{circle}");
    assert!(typo.to_string().contains("did you mean \"arm\"?"), "{typo}");
    node.add_child(hand()).await.expect("its name is free");
}

#[blastema_testkit::test]
async fn a_component_that_is_removed_ends_in_order_and_leaves_no_trace() {
    let strings = Strings::default();
    let builder = Node::builder("module1").child(strings.spec("arm")).child(strings.spec("hand"));
    let mut node = TestNode::start(builder).await;
    let notes = node.sender::<Note>("hand").unwrap();
    strings.diary();

    node.remove_child("hand").await.expect("the root keeps it");

    let hooks = ["hand#1 on_deactivated", "hand#1 on_shutdown", "hand#1 on_finalize"];
    assert_eq!(strings.diary(), hooks);
    let refused = notes.tell(Note(1)).expect_err("absent is there");
    assert_eq!((refused.kind, refused.message), (DeliveryError::Stopped, Note(1)));
    assert!(matches!(node.sender::<Note>("hand"), Err(DeliveryError::Unknown { .. })));
    assert!(node.actor::<Puppet>("hand").is_err());
    assert_eq!(node.tree().await.unwrap().children.len(), 1);
    node.settle().await;
    assert!(node.table().await.iter().all(|row| !row.location.to_string().ends_with("hand")));
    node.expect_no_faults().await;

    // Its name is free again; the new one is another object.
    let hand = node.add_child(strings.spec("hand")).await.expect("a free name");
    assert_eq!(hand.ask(Do(Deed::Nothing)).await.unwrap(), 1);
    strike(&node, "hand").await;
    node.await_recovered(FaultKind::Panic, "hand").await;
}

#[blastema_testkit::test]
async fn what_waits_in_the_queue_of_a_component_that_is_removed_is_told_or_counted() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;
    let (deeds, notes) = (node.sender::<Do>("arm").unwrap(), node.sender::<Note>("arm").unwrap());
    deeds.tell(Do(Deed::Await(100))).unwrap();
    let waiting = tokio::task::spawn_local(async move { deeds.ask(Do(Deed::Nothing)).await });
    node.settle().await;
    notes.tell(Note(1)).unwrap();

    node.remove_child("arm").await.expect("the root keeps it");

    let error = waiting.await.unwrap().expect_err("it was not served");
    assert_eq!((error.kind, error.message), (DeliveryError::Stopped, Some(Do(Deed::Nothing))));
    assert_eq!(node.dead_letters().count(&"arm".parse().unwrap(), DeadReason::Stopped), 2);
    assert_eq!(strings.lines("note"), [""; 0]);
}

#[blastema_testkit::test]
async fn a_component_that_is_added_and_never_comes_up_is_put_to_rest() {
    let strings = Strings::default();
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;
    (0..99).for_each(|_| strings.pull("hand", "on_initialize", Pull::Fail("no device")));

    node.add_child(strings.spec("hand")).await.expect("the root takes it");
    node.await_given_up(FaultKind::InitializationFailed, "hand").await;
    node.advance(Duration::from_secs(1)).await;

    let tree = node.tree().await.unwrap();
    assert_eq!(tree.children[1].state, ChildState::Resting);
    assert_eq!(ask(&node, "arm", Deed::Nothing).await.unwrap(), 1);
    node.remove_child("hand").await.expect("a stopped child can be removed");
}
