//! A component panics, wherever it may.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask, incarnation, strike};
use blastema::prelude::*;
use blastema::{Incarnation, Severity};
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
async fn a_panic_with_something_that_is_no_text_is_reported_all_the_same() {
    let (_, mut node) = Strings::robot(["laser"]).await;

    let _ = ask(&node, "laser", Deed::PanicOddly).await;

    let fault = node.await_fault(FaultKind::Panic, "laser").await;
    assert!(fault.detail.starts_with("a panic whose payload is no text"), "{}", fault.detail);
    assert_eq!(incarnation(&node, "laser").await, 2);
}
