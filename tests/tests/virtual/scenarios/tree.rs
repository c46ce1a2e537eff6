//! Components that come and go while the node runs.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Puppet, Strings, ask, strike};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use std::time::Duration;

#[blastema_testkit::test]
async fn a_component_can_be_added_while_the_node_runs_and_is_kept_like_any_other() {
    let (strings, mut node) = Strings::robot(["arm"]).await;

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
async fn a_component_that_is_removed_ends_in_order_and_leaves_no_trace() {
    let (strings, mut node) = Strings::robot(["arm", "hand"]).await;
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
async fn a_component_that_is_added_and_never_comes_up_is_put_to_rest() {
    let (strings, mut node) = Strings::robot(["arm"]).await;
    (0..99).for_each(|_| strings.pull("hand", "on_initialize", Pull::Fail("no device")));

    node.add_child(strings.spec("hand")).await.expect("the root takes it");
    node.await_given_up(FaultKind::InitializationFailed, "hand").await;
    node.advance(Duration::from_secs(1)).await;

    let tree = node.tree().await.unwrap();
    assert_eq!(tree.children[1].state, ChildState::Resting);
    assert_eq!(ask(&node, "arm", Deed::Nothing).await.unwrap(), 1);
    node.remove_child("hand").await.expect("a stopped child can be removed");
}
