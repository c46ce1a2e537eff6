//! What is done about a fault: actions that help, fail, panic, or take too long.

use crate::scenarios::puppet::{Deed, News, Note, Strings, ask, incarnation, strike};
use blastema::core::recovery::{ChildState, RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::prelude::*;
use blastema::{FaultStatus, NodeBuilder, RecoveryStrategy, StrategyContext};
use blastema_testkit::TestNode;
use std::time::Duration;

fn oil() -> FaultKind {
    FaultKind::Custom("OIL".into())
}

/// A node with a `joint`, whose faults `OIL` are answered so.
fn robot(strings: &Strings, ladder: Ladder) -> NodeBuilder {
    Node::builder("module1")
        .fault_kind("OIL")
        .plan(Plan::default().on(oil(), ladder))
        .child(strings.spec("joint"))
}

async fn declare(node: &TestNode) {
    ask(node, "joint", Deed::Declare("OIL".into())).await.expect("it answers");
}

/// Does not help, each time in another way.
enum Useless {
    Fails,
    Panics,
    NeverEnds,
    PanicsInDrop,
}

impl RecoveryStrategy for Useless {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        context: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        match self {
            Useless::Fails => Err("the can is empty".into()),
            Useless::Panics => panic!("the can explodes"),
            Useless::NeverEnds => std::future::pending().await,
            Useless::PanicsInDrop => context.restart(&order.fault).await,
        }
    }
}

impl Drop for Useless {
    fn drop(&mut self) {
        if let Useless::PanicsInDrop = self {
            panic!("the can explodes when it is thrown away");
        }
    }
}

#[blastema_testkit::test]
async fn where_a_strategy_fails_the_next_rung_follows() {
    let makes: [fn() -> Useless; 4] = [
        || Useless::Fails,
        || Useless::Panics,
        || Useless::NeverEnds,
        || panic!("there is no can"),
    ];
    for (n, make) in makes.into_iter().enumerate() {
        let strings = Strings::default();
        let ladder = Ladder::first(RecoveryAction::Custom("oil".into()))
            .within(Duration::from_millis(500))
            .then(RecoveryAction::Restart);
        let mut node = TestNode::start(robot(&strings, ladder).recovery("oil", make)).await;

        for incarnation_now in 1..=2 {
            declare(&node).await;
            node.await_fault(oil(), "joint").await;
            node.await_recovered(oil(), "joint").await;
            assert_eq!(incarnation(&node, "joint").await, incarnation_now + 1, "case {n}");
            node.advance(Duration::from_secs(60)).await;
        }
        node.expect_no_faults().await;
    }
}

#[blastema_testkit::test]
async fn a_strategy_whose_drop_panics_harms_nobody() {
    let strings = Strings::default();
    let ladder = Ladder::first(RecoveryAction::Custom("oil".into()));
    let builder = robot(&strings, ladder).recovery("oil", || Useless::PanicsInDrop);
    let mut node = TestNode::start(builder).await;

    declare(&node).await;
    node.await_recovered(oil(), "joint").await;
    node.shutdown().await;
    assert_eq!(node.state(), NodeState::Stopped);
}

#[blastema_testkit::test]
async fn a_ladder_that_is_exhausted_ends_in_safe_rest() {
    let strings = Strings::default();
    let ladder = Ladder::first(RecoveryAction::Custom("oil".into()));
    let mut node =
        TestNode::start(robot(&strings, ladder).recovery("oil", || Useless::Fails)).await;

    declare(&node).await;
    let reason = node.await_given_up(oil(), "joint").await;
    node.advance(Duration::from_secs(1)).await;

    assert!(reason.contains("the can is empty"), "{reason}");
    assert_eq!(node.tree().await.unwrap().children[0].state, ChildState::Resting);
    assert!(strings.lines("on_finalize").contains(&"joint#1 on_finalize".into()));
    assert_eq!(node.state(), NodeState::Running, "the others go on");
}

#[blastema_testkit::test]
async fn an_isolated_object_neither_sends_nor_receives_but_lives_until_it_is_restarted() {
    let strings = Strings::default();
    let ladder = Ladder::first(RecoveryAction::Isolate);
    let builder = robot(&strings, ladder).child(strings.spec("ear"));
    let mut node = TestNode::start(builder).await;
    let notes = node.sender::<Note>("joint").unwrap();

    // It has something to say just after it was found to be faulty.
    ask(&node, "joint", Deed::PublishSoon(3)).await.unwrap();
    declare(&node).await;
    let reason = node.await_given_up(oil(), "joint").await;

    assert!(reason.contains("isolate"), "{reason}");
    let refused = notes.tell(Note(1)).expect_err("nothing gets in");
    let reason = node.faults().await.entries[0].fault.as_reason();
    let isolated = DeliveryError::Isolated { object: "joint".into(), reason };
    assert_eq!((refused.kind, refused.message), (isolated, Note(1)));
    node.publisher::<News>("test/news").unwrap().publish(News(1)).unwrap();
    node.advance(Duration::from_secs(1)).await;
    assert_eq!(strings.lines("news"), ["ear#1 news 1"], "nor an event, in or out");
    assert!(node.row("joint").await.isolated);
    assert!(node.tree().await.unwrap().children[0].isolated);
    assert_eq!(strings.lines("joint#1 on_finalize"), [""; 0], "its incarnation goes on");

    node.kill("joint");
    node.await_recovered(FaultKind::Panic, "joint").await;
    // Its second incarnation works, and is isolated as the first was.
    let refused = ask(&node, "joint", Deed::Nothing).await.unwrap_err().kind;
    assert!(matches!(refused, DeliveryError::Isolated { .. }), "{refused}");
    let record = node.faults().await;
    let contained = record.entries.iter().find(|entry| entry.fault.kind == oil());
    assert_eq!(contained.map(|entry| entry.status()), Some(FaultStatus::GivenUp), "{record:?}");
    node.restart_child("joint").await.unwrap();
    node.await_recovered(oil(), "joint").await;
    assert_eq!(incarnation(&node, "joint").await, 3);
}

#[blastema_testkit::test]
async fn safe_stop_applies_the_safe_outputs_even_if_they_panic() {
    let strings = Strings::default();
    let builder = robot(&strings, Ladder::first(RecoveryAction::SafeStop))
        .safe_outputs(|fault| panic!("no brake for {}", fault.location));
    let mut node = TestNode::start(builder.child(strings.spec("ear"))).await;

    declare(&node).await;
    node.await_given_up(oil(), "joint").await;
    node.advance(Duration::from_secs(1)).await;

    assert_eq!(node.tree().await.unwrap().children[0].state, ChildState::Resting);
    strike(&node, "ear").await;
    assert_eq!(incarnation(&node, "ear").await, 2, "the chain is unharmed");
}
