//! What errors and faults tell a user who has to act on them.

use crate::puppet::{Deed, Do, Pull, Puppet, Strings};
use blastema::prelude::*;
use blastema::{FaultTransition, RestartError};
use blastema_testkit::TestNode;
use std::time::Duration;

const MS: Duration = Duration::from_millis(1);

/// A component of another type than those of the node.
struct Radar;

impl Component for Radar {}

#[blastema_testkit::test]
async fn an_actor_of_another_type_is_told_from_one_that_is_not_there() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("laser"))).await;

    let told = node.actor::<Radar>("laser").expect_err("it is a puppet").to_string();
    for part in ["`laser`", "puppet::Puppet", "error_texts::Radar"] {
        assert!(told.contains(part), "{part} is missing in {told}");
    }

    let misspelt = node.actor::<Puppet>("lasr").expect_err("none is called so").to_string();
    assert!(misspelt.contains("did you mean `laser`?"), "{misspelt}");
}

#[blastema_testkit::test]
async fn a_child_that_is_to_be_restarted_under_a_misspelt_name_is_suggested() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("laser"))).await;

    for misspelt in ["lasr", "las er"] {
        let refused = node.restart_child(misspelt).await.expect_err("none is called so");
        assert!(matches!(refused, RestartError::Unknown { .. }), "{refused:?}");
        assert!(refused.to_string().contains("did you mean `laser`?"), "{refused}");
    }
    let unlike = node.restart_child("gripper").await.expect_err("none is called so").to_string();
    assert!(!unlike.contains("did you mean"), "{unlike}");
}

#[blastema_testkit::test]
async fn who_asks_a_component_that_waits_for_its_device_is_told_that_and_since_when() {
    let strings = Strings::default();
    for _ in 0..100 {
        strings.pull("laser", "on_initialize", Pull::Unavailable("/dev/laser is not there"));
    }
    let node = TestNode::start(Node::builder("module1").child(strings.spec("laser"))).await;
    let laser = node.sender::<Do>("laser").unwrap();
    node.advance(1500 * MS).await;

    let late = laser.ask(Do(Deed::Nothing)).await.expect_err("its device is not there");

    assert_eq!(late.kind, DeliveryError::DeadlinePassed);
    let told = late.to_string();
    for part in ["module1:laser", "/dev/laser is not there", "for 2.5 s"] {
        assert!(told.contains(part), "{part} is missing in {told}");
    }

    strings.cut_all();
    node.advance(Duration::from_secs(6)).await;
    laser.ask(Do(Deed::Nothing)).await.expect("its device has come");
    let late = laser.ask_within(Do(Deed::Await(5000)), 100 * MS).await.unwrap_err();
    assert!(!late.to_string().contains("/dev/laser"), "{late}");
}

#[blastema_testkit::test]
async fn a_hook_that_hangs_while_its_node_ends_is_a_fault_about_which_nothing_is_decided() {
    let strings = Strings::default();
    strings.pull("arm", "on_finalize", Pull::Wait(Duration::from_secs(3600)));
    let arm = strings.spec("arm").max_wait(200 * MS);
    let node = TestNode::start(Node::builder("module1").child(arm)).await;
    let mut events = node.fault_events();

    node.shutdown().await;

    let (mut hangs, mut decided) = (0, Vec::new());
    while let Some(event) = events.next().await {
        match event.turn {
            FaultTransition::Found => hangs += usize::from(event.fault.kind == FaultKind::Hang),
            turn @ FaultTransition::Decided { .. } => decided.push(turn),
            _ => {}
        }
    }
    assert!(hangs > 0, "it is told");
    assert_eq!(decided, []);
}
