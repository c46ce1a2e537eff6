//! Things of the user's that panic where nobody expects it: in `Drop`, while stopping.

use crate::puppet::{Deed, Note, Pull, Strings, ask, life, strike};
use blastema::core::dead_letters::DeadReason;
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::time::Duration;

#[blastema_testkit::test]
async fn a_component_whose_drop_panics_after_a_panic_is_replaced_all_the_same() {
    let strings = Strings::default();
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;
    strings.pull("arm", "drop", Pull::Panic("and in drop"));

    strike(&node, "arm").await;
    node.await_fault(FaultKind::Panic, "arm").await;

    assert_eq!(life(&node, "arm").await, 2);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_component_whose_drop_panics_while_it_is_restarted_is_replaced_all_the_same() {
    let strings = Strings::default();
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;
    strings.pull("arm", "drop", Pull::Panic("in drop"));

    ask(&node, "arm", Deed::FailFatally("bent".into())).await.unwrap();
    node.await_fault(FaultKind::Fatal, "arm").await;
    node.await_recovered(FaultKind::Fatal, "arm").await;

    assert_eq!(life(&node, "arm").await, 2);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_component_that_panics_while_it_stops_is_stopped() {
    for hook in ["on_deactivated", "on_shutdown", "on_finalize", "drop"] {
        let strings = Strings::default();
        let builder =
            Node::builder("module1").child(strings.spec("arm")).child(strings.spec("hand"));
        let node = TestNode::start(builder).await;
        strings.pull("hand", hook, Pull::Panic("while stopping"));

        let stopped = tokio::time::timeout(Duration::from_secs(6), node.shutdown()).await;

        assert!(stopped.is_ok(), "{hook}");
        assert_eq!(node.state(), NodeState::Stopped, "{hook}");
        assert!(strings.diary().contains(&"arm#1 on_finalize".into()), "{hook}");
    }
}

#[blastema_testkit::test]
async fn a_component_that_panics_while_it_is_restarted_is_replaced() {
    for hook in ["on_deactivated", "on_shutdown", "on_finalize"] {
        let strings = Strings::default();
        let group = SupervisorSpec::new("group", Strategy::OneForAll)
            .child(strings.spec("arm"))
            .child(strings.spec("hand"));
        let mut node = TestNode::start(Node::builder("module1").supervisor(group)).await;
        strings.pull("hand", hook, Pull::Panic("while stopping"));

        strike(&node, "arm").await;
        node.await_recovered(FaultKind::Panic, "arm").await;
        node.advance(Duration::from_secs(1)).await;

        assert!(life(&node, "arm").await >= 2, "{hook}");
        assert!(life(&node, "hand").await >= 2, "{hook}");
        let record = node.faults().await;
        assert!(
            record.entries.iter().all(|entry| entry.status() != blastema::FaultStatus::Open),
            "{hook}: {record:?}"
        );
        let group = node.tree().await.unwrap().children[0].below.clone().unwrap();
        assert!(group.children.iter().all(|leaf| leaf.state == ChildState::Running), "{hook}");
    }
}

/// Explodes when it is dropped without having been defused.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/bomb")]
struct Bomb {
    armed: bool,
}

impl Drop for Bomb {
    fn drop(&mut self) {
        if self.armed && !std::thread::panicking() {
            panic!("boom");
        }
    }
}

struct Depot;

impl Component for Depot {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Bomb>();
    }
}

impl Handle<Bomb> for Depot {
    async fn handle(&mut self, bomb: Bomb, _: &mut Context<Self>) {
        // Long enough for others to queue up behind it.
        tokio::time::sleep(Duration::from_secs(1)).await;
        drop(bomb);
    }
}

#[blastema_testkit::test]
async fn a_message_whose_drop_panics_in_a_handler_is_the_handlers_panic() {
    let builder = Node::builder("module1").child(ChildSpec::new("depot", || Depot));
    let mut node = TestNode::start(builder).await;

    node.sender("depot").unwrap().tell(Bomb { armed: true }).unwrap();
    let fault = node.await_fault(FaultKind::Panic, "depot").await;

    assert!(fault.detail.starts_with("boom"), "{}", fault.detail);
    node.await_recovered(FaultKind::Panic, "depot").await;
}

#[blastema_testkit::test]
async fn messages_whose_drop_panics_are_counted_when_their_receiver_ends() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .child(ChildSpec::new("depot", || Depot).queue(2, WhenFull::DropOldest))
        .child(strings.spec("arm"));
    let node = TestNode::start(builder).await;
    let bombs = node.sender("depot").unwrap();

    bombs.tell(Bomb { armed: false }).unwrap();
    node.settle().await;
    (0..5).for_each(|_| bombs.tell(Bomb { armed: true }).unwrap());
    node.remove_child("depot").await.unwrap();

    let name = "depot".parse().unwrap();
    let letters = node.dead_letters();
    assert_eq!(letters.count(&name, DeadReason::Full), 3);
    assert_eq!(letters.count(&name, DeadReason::Stopped), 2);
    assert_eq!(life(&node, "arm").await, 1);
    assert_eq!(node.state(), NodeState::Running);
}

#[blastema_testkit::test]
async fn a_message_that_killed_three_lives_is_quarantined_and_no_other() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;
    let arm = node.sender::<crate::puppet::Do>("arm").unwrap();
    let deadly = arm.repeatable(crate::puppet::Do(Deed::Panic("poison".into())));

    for n in 1..=3 {
        let why = deadly.ask().await.expect_err("it kills").why;
        assert!(matches!(why, Why::PeerDied { incarnation } if incarnation.0 == n), "{why}");
        node.advance(Duration::from_secs(11)).await;
    }
    let refused = deadly.ask().await.expect_err("it is not let in");

    assert_eq!(refused.why, Why::Quarantined { kills: 3 });
    assert!(refused.message.is_some());
    assert_eq!(life(&node, "arm").await, 4, "nobody died of it this time");
    let name = "arm".parse().unwrap();
    assert_eq!(node.dead_letters().count(&name, DeadReason::Quarantined), 1);
    // Another message of the same contract, word for word, is another message.
    let other = ask(&node, "arm", Deed::Panic("poison".into())).await.expect_err("it kills");
    assert!(matches!(other.why, Why::PeerDied { .. }));
    node.sender("arm").unwrap().tell(Note(1)).unwrap();
}
