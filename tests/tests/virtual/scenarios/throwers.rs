//! Things of the user's that panic in unusual places: in `Drop`, while stopping.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask, incarnation};
use blastema::SpecError;
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::prelude::*;
use blastema_testkit::TestNode;
use std::time::Duration;

#[blastema_testkit::test]
async fn a_component_that_fails_to_come_to_rest_has_a_fault_that_is_over() {
    for pull in [Pull::Fail("jammed"), Pull::Fatal("jammed"), Pull::Wait(Duration::from_secs(60))] {
        let (strings, node) = Strings::robot(["hand"]).await;
        strings.pull("hand", "on_deactivated", pull.clone());

        node.shutdown().await;

        let record = node.faults().await;
        let [ref entry] = record.entries[..] else { panic!("{pull:?}: {record:?}") };
        assert_eq!(entry.fault.kind, FaultKind::ErrorState, "{pull:?}");
        assert!(entry.fault.detail.starts_with("on_deactivated "), "{}", entry.fault.detail);
        assert_eq!(entry.status(), blastema::FaultStatus::Closed, "{pull:?}");
        assert!(entry.decided.is_none(), "{pull:?}");
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

/// Asks for a bomb, which explodes where it is not taken.
#[derive(Clone, Debug, Request)]
#[contract(name = "test/fetch", reply = Bomb)]
struct Fetch;

struct Depot;

impl Component for Depot {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Bomb>().serve::<Fetch>();
    }
}

impl Handle<Fetch> for Depot {
    async fn handle(&mut self, _: Fetch, _: &mut Context<Self>) -> Bomb {
        tokio::time::sleep(Duration::from_millis(500)).await;
        armed()
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
async fn messages_whose_drop_panics_are_counted_when_their_receiver_ends() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .child(ChildSpec::new("depot", || Depot).queue(2, WhenFull::DropOldest))
        .child(strings.spec("arm"));
    let mut node = TestNode::start(builder).await;
    let bombs = node.sender("depot").unwrap();

    bombs.tell(Bomb { armed: false }).unwrap();
    node.settle().await;
    (0..5).for_each(|_| bombs.tell(Bomb { armed: true }).unwrap());
    node.remove_child("depot").await.unwrap();

    let name = "depot".parse().unwrap();
    let letters = node.dead_letters();
    assert_eq!(letters.count(&name, DeadReason::Full), 3);
    assert_eq!(letters.count(&name, DeadReason::Stopped), 2);
    let fault = node.await_fault(FaultKind::CheckFailed, "depot").await;
    assert!(fault.detail.starts_with("the Drop of a message of test/bomb"), "{}", fault.detail);
    assert_eq!(incarnation(&node, "arm").await, 1);
    assert_eq!(node.state(), NodeState::Running);
}

struct Rash;

impl Component for Rash {
    fn ports(_: &mut Ports<Self>) {
        panic!("no ports today");
    }
}

#[blastema_testkit::test]
async fn ports_that_panic_are_an_error_that_names_the_component() {
    let builder = Node::builder("module1").child(ChildSpec::new("rash", || Rash));
    let Err(refused) = TestNode::try_start(builder).await else { panic!("it has no ports") };
    let text = refused.to_string();
    assert!(text.contains("rash") && text.contains("no ports today"), "{text}");
    assert!(text.contains("throwers.rs"), "{text}");

    let strings = Strings::default();
    let more = strings.spec("hasty").with_ports(|_| panic!("no more ports"));
    let Err(refused) = TestNode::try_start(Node::builder("module1").child(more)).await else {
        panic!("it has no ports")
    };
    let text = refused.to_string();
    assert!(text.contains("hasty") && text.contains("no more ports"), "{text}");

    let node = TestNode::start(Node::builder("module1").child(strings.spec("arm"))).await;
    let refused = node.add_child(ChildSpec::new("rash", || Rash)).await.expect_err("no ports");
    assert!(matches!(refused, SpecError::Ports { name, .. } if name.as_str() == "rash"));
    assert_eq!(incarnation(&node, "arm").await, 1);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_component_whose_drop_panics_after_an_orderly_end_is_named_and_replaced() {
    let (strings, mut node) = Strings::robot(["arm", "hand"]).await;
    strings.pull("hand", "drop", Pull::Panic("while it goes"));

    ask(&node, "hand", Deed::Stop).await.unwrap();
    let fault = node.await_fault(FaultKind::CheckFailed, "hand").await;

    let detail = &fault.detail;
    assert!(detail.starts_with("the Drop of the component panicked at"), "{detail}");
    assert!(detail.ends_with("while it goes"), "{detail}");
    node.advance(Duration::from_secs(1)).await;
    assert_eq!((incarnation(&node, "hand").await, incarnation(&node, "arm").await), (2, 1));
}

/// Holds bombs in tasks and timers.
struct Arsenal;

impl Component for Arsenal {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let hour = Duration::from_secs(3600);
        for _ in 0..2 {
            let (one, two, three) = (armed(), armed(), armed());
            cx.every(hour, move |_, _| drop(one.clone()));
            cx.after(hour, move |_, _| drop(two));
            cx.spawn(async move {
                tokio::time::sleep(hour).await;
                drop(three);
            });
        }
        Ok(())
    }
}

fn armed() -> Bomb {
    Bomb { armed: true }
}

#[blastema_testkit::test]
async fn timers_and_tasks_whose_drops_panic_end_with_their_incarnation_and_are_named() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .child(ChildSpec::new("arsenal", || Arsenal))
        .child(strings.spec("arm"));
    let mut node = TestNode::start(builder).await;

    node.remove_child("arsenal").await.unwrap();

    let fault = node.await_fault(FaultKind::CheckFailed, "arsenal").await;
    assert!(fault.detail.ends_with("boom"), "{}", fault.detail);
    assert_eq!(incarnation(&node, "arm").await, 1);
    assert_eq!(node.state(), NodeState::Running);
}

#[blastema_testkit::test]
async fn a_reply_whose_drop_panics_when_nobody_waits_is_the_callees_panic() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .child(ChildSpec::new("depot", || Depot))
        .child(strings.spec("arm"));
    let mut node = TestNode::start(builder).await;

    let fetch = node.sender::<Fetch>("depot").unwrap();
    let late = fetch.ask_within(Fetch, Duration::from_millis(100)).await.expect_err("too slow");
    assert_eq!(late.kind, DeliveryError::DeadlinePassed);

    let fault = node.await_fault(FaultKind::Panic, "depot").await;
    assert!(fault.detail.starts_with("boom"), "{}", fault.detail);
    node.await_recovered(FaultKind::Panic, "depot").await;
    assert_eq!(incarnation(&node, "arm").await, 1);
}
