//! Every result of sending, and that each request resolves.

use crate::scenarios::puppet::{Deed, Do, Note, Pull, Strings, ask, strike};
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::prelude::*;
use blastema_testkit::{Harness, TestNode, now};
use blastema_tests::{Notes, part};
use std::time::Duration;

#[blastema_testkit::test]
async fn a_request_resolves_when_its_deadline_passes() {
    let (_, node) = Strings::robot(["arm"]).await;
    let arm = node.sender::<Do>("arm").unwrap();
    let start = now();

    let late = arm.ask_within(Do(Deed::Await(5000)), Duration::from_millis(700)).await;

    let error = late.expect_err("it takes too long");
    assert_eq!((error.kind, error.message), (DeliveryError::DeadlinePassed, None));
    let took = now() - start;
    assert!(took >= Duration::from_millis(700) && took <= Duration::from_millis(720), "{took:?}");
    assert_eq!(arm.ask_within(Do(Deed::Nothing), Duration::from_secs(60)).await.unwrap(), 1);
}

#[blastema_testkit::test]
async fn a_request_whose_deadline_passed_in_the_queue_is_not_served() {
    let (_, node) = Strings::robot(["arm"]).await;
    let arm = node.sender::<Do>("arm").unwrap();
    arm.tell(Do(Deed::Await(3000))).unwrap();

    let late = arm.ask(Do(Deed::Panic("too late".into()))).await;
    node.advance(Duration::from_secs(5)).await;

    assert_eq!(late.expect_err("it waits too long").kind, DeliveryError::DeadlinePassed);
    assert_eq!(ask(&node, "arm", Deed::Nothing).await.unwrap(), 1, "no life ended by it");
    let name = "arm".parse().unwrap();
    assert_eq!(node.dead_letters().count(&name, DeadReason::DeadlinePassed), 1);
}

#[blastema_testkit::test]
async fn between_two_incarnations_a_full_queue_says_restarting() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForAll)
        .child(strings.spec("first"))
        .child(strings.spec("arm").queue(2, WhenFull::Refuse));
    let node = TestNode::start(Node::builder("module1").supervisor(group)).await;
    let notes = node.sender::<Note>("arm").unwrap();
    strings.pull("first", "on_deactivated", Pull::Wait(Duration::from_secs(1)));

    strike(&node, "arm").await;
    node.settle().await;
    (1..=2).for_each(|n| notes.tell(Note(n)).unwrap());
    let refused = notes.tell(Note(3)).expect_err("there is no room for it");

    assert_eq!((refused.kind, refused.message), (DeliveryError::Restarting, Note(3)));
    notes.deliver(Note(3)).await.expect("it waits for room");
    node.advance(Duration::from_secs(1)).await;
    assert_eq!(strings.lines("note"), ["arm#2 note 1", "arm#2 note 2", "arm#2 note 3"]);
}

#[blastema_testkit::test]
async fn an_error_names_the_receiver_its_node_the_contract_and_the_limit() {
    let strings = Strings::default();
    let spec = strings.spec("arm").queue(2, WhenFull::Refuse);
    let node = TestNode::start(Node::builder("module1").child(spec)).await;
    let (arm, notes) = (node.sender::<Do>("arm").unwrap(), node.sender::<Note>("arm").unwrap());
    arm.tell(Do(Deed::Await(1000))).unwrap();
    node.settle().await;

    let full = (0..).find_map(|n| notes.tell(Note(n)).err()).expect("queues are bounded");
    let late = arm.ask_within(Do(Deed::Nothing), Duration::ZERO).await.expect_err("it is full");

    let named = full.receiver().expect("it is named");
    assert_eq!(named.to_string(), "module1:arm");
    assert_eq!((named.contract, named.queue), ("test/note", Some(2)));
    assert!(
        full.to_string().ends_with("module1:arm was not sent: its queue of 2 is full"),
        "{full}"
    );
    assert_eq!(late.receiver().expect("it is named").contract, "test/do");
}

#[blastema_testkit::test]
async fn who_asks_somebody_that_asks_back_gets_a_deadline_and_not_a_knot() {
    let (_, node) = Strings::robot(["arm", "leg"]).await;
    let (arm, leg) = (node.sender::<Do>("arm").unwrap(), node.sender::<Do>("leg").unwrap());
    let hour = Duration::from_secs(3600);

    arm.tell(Do(Deed::Consult("leg".into()))).unwrap();
    leg.tell(Do(Deed::Consult("arm".into()))).unwrap();

    assert_eq!(arm.ask_within(Do(Deed::Nothing), hour).await.unwrap(), 1);
    assert_eq!(leg.ask_within(Do(Deed::Nothing), hour).await.unwrap(), 1);
    let faults = node.faults().await.entries;
    let told = faults.iter().map(|entry| (entry.fault.location.to_string(), &*entry.fault.detail));
    let circle = |one, other| {
        let who = format!("{one} asks {other} asks {one}");
        format!(
            "components wait for each other until their deadlines: {who}; reply before asking, or `tell`"
        )
    };
    let (arm, leg) = (circle("arm", "leg"), circle("leg", "arm"));
    let expected = [("module1:arm".to_owned(), &*arm), ("module1:leg".to_owned(), &*leg)];
    assert_eq!(told.collect::<Vec<_>>(), expected);
    assert_eq!(faults[0].fault.severity, blastema::Severity::Warning);
}

/// Hands out a sender that belongs to the present incarnation, or dies.
#[derive(Clone, Debug, Event)]
enum Lend {
    Sender,
    Die,
}

#[blastema_testkit::test]
async fn what_a_thread_of_a_dead_incarnation_still_says_goes_nowhere() {
    let (strings, node) = Strings::robot(["arm"]).await;
    let lent = Notes::<Sender<Note>>::default();
    let spec = part("lender", lent.clone(), |lent, lend: Lend, cx| match lend {
        Lend::Sender => lent.note(cx.detached(&cx.sender::<Note>("arm").expect("it is there"))),
        Lend::Die => panic!("as it was told"),
    });
    let lender = Harness::within(node, spec).await;
    lender.tell(Lend::Sender).unwrap();
    lender.settle().await;
    let first = lent.take().remove(0);
    first.tell(Note(1)).expect("its incarnation lasts");

    lender.tell(Lend::Die).unwrap();
    lender.tell(Lend::Sender).unwrap();
    lender.settle().await;
    let second = lent.take().remove(0);

    let refused = first.tell(Note(2)).expect_err("that incarnation is over");
    assert_eq!((refused.kind, refused.message), (DeliveryError::Fenced, Note(2)));
    second.tell(Note(3)).expect("this one lasts");
    lender.settle().await;
    assert_eq!(strings.lines("note"), ["arm#1 note 1", "arm#1 note 3"]);
}
