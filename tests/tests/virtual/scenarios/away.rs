//! A node that starts while it is waited for, and one that may be away.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask};
use blastema::core::detection::Opinion;
use blastema::prelude::*;
use blastema::{Direction, FaultLocation, MemoryMedium, Network, NodeBuilder};
use blastema_testkit::TestNode;
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

fn node(
    medium: &MemoryMedium,
    [own, peer]: [&str; 2],
    child: ChildSpec<impl Component>,
) -> NodeBuilder {
    let network = Network::memory("ethernet", medium, own).with_faults(7).peer(peer, peer);
    Node::builder(own).network(network).child(child)
}

#[blastema_testkit::test]
async fn a_node_is_connected_when_its_start_is_over_and_its_objects_answer() {
    let (medium, strings) = (MemoryMedium::default(), Strings::default());
    let base = node(&medium, ["base", "laptop"], strings.spec("planner"));
    let base = TestNode::start(base).await;
    let laptop = || node(&medium, ["laptop", "base"], strings.spec("pad"));
    let pull = || strings.pull("pad", "on_activated", Pull::Wait(SECOND));
    for _ in 0..3 {
        pull();
        let (laptop, connected) = tokio::join!(TestNode::start(laptop()), async {
            let connected = base.connected("laptop", 20 * SECOND).await;
            for _ in 0..20 {
                assert_eq!(ask(&base, "laptop:pad", Deed::Nothing).await.unwrap(), 1);
            }
            connected
        });
        assert!(connected);
        laptop.shutdown().await;
        base.advance(SECOND).await;
        assert!(!base.connected("laptop", SECOND).await);
    }
}

/// What the table of the base says of the laptop.
async fn row(base: &TestNode) -> (Opinion, String) {
    let laptop = FaultLocation::Node("laptop".parse().unwrap());
    let row = base.table().await.into_iter().find(|row| row.location == laptop).expect("a row");
    (row.opinion, row.note.unwrap_or_default())
}

#[blastema_testkit::test]
async fn the_absence_of_a_node_that_may_be_away_is_a_state_and_no_fault() {
    let (medium, strings) = (MemoryMedium::default(), Strings::default());
    let base = node(&medium, ["base", "laptop"], strings.spec("widow")).may_be_away("laptop");
    let base = TestNode::start(base).await;
    ask(&base, "widow", Deed::Watch("laptop:pad".into())).await.unwrap();
    base.advance(20 * SECOND).await;
    let (opinion, note) = row(&base).await;
    assert_eq!(opinion, Opinion::Stopped);
    assert_eq!(note, "it may be away, and is: it was not met yet");
    let told = strings.lines("mourns");
    assert!(told.len() == 1 && told[0].contains("laptop:pad#0: NodeLost"), "{told:?}");

    for in_order in [true, false, true] {
        let laptop = TestNode::start(node(&medium, ["laptop", "base"], strings.spec("pad"))).await;
        assert!(base.connected("laptop", 20 * SECOND).await);
        base.advance(2 * SECOND).await;
        assert_eq!(row(&base).await, (Opinion::Trusted, String::new()));
        strings.diary();
        let cable = base.cable("ethernet").unwrap();
        match in_order {
            true => laptop.shutdown().await,
            false => cable.cut(Direction::Both, false),
        }
        base.advance(20 * SECOND).await;

        assert_eq!(row(&base).await.0, Opinion::Stopped);
        let told = strings.lines("mourns");
        let [only] = &told[..] else { panic!("{in_order}: {told:?}") };
        assert!(only.contains("pad#0: NodeLost"), "{told:?}");
        if !in_order {
            laptop.shutdown().await;
            base.cable("ethernet").unwrap().restore();
        }
    }
    base.expect_no_faults().await;
    assert!(base.faults().await.entries.is_empty());
}

#[blastema_testkit::test]
async fn a_node_that_cannot_be_away_is_refused_with_a_reason() {
    let (medium, strings) = (MemoryMedium::default(), Strings::default());
    let base = || node(&medium, ["base", "laptop"], strings.spec("planner"));
    let alone = Node::builder("base").may_be_away("laptop");
    for (builder, why) in [
        (base().may_be_away("base"), "base may be away, as is described: it is this node"),
        (base().may_be_away("a b"), "the name of a node that may be away"),
        (alone, "laptop may be away, as is described: this node has no networks"),
    ] {
        let refused = builder.check();
        let [refused] = &refused[..] else { panic!("{refused:?}") };
        assert!(refused.to_string().contains(why), "{refused}");
    }
    assert!(base().may_be_away("laptop").check().is_empty());
}
