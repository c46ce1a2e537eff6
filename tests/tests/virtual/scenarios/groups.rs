//! Siblings that cannot do without each other.

use crate::scenarios::puppet::{Deed, Do, Pull, Strings, ask, incarnation, strike};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{FaultStatus, NodeBuilder};
use blastema_testkit::TestNode;
use std::time::Duration;

/// Three siblings `a`, `b` and `c` under a supervisor of their own, beside a stranger.
async fn node_of(strings: &Strings, strategy: Strategy) -> TestNode {
    let group = SupervisorSpec::new("group", strategy)
        .child(strings.spec("a"))
        .child(strings.spec("b"))
        .child(strings.spec("c"));
    let builder = Node::builder("module1").child(strings.spec("stranger")).supervisor(group);
    let node = TestNode::start(builder).await;
    strings.diary();
    node
}

async fn incarnations(node: &TestNode) -> [u64; 4] {
    [
        incarnation(node, "a").await,
        incarnation(node, "b").await,
        incarnation(node, "c").await,
        incarnation(node, "stranger").await,
    ]
}

#[blastema_testkit::test]
async fn those_that_the_strategy_names_stop_in_reverse_order_and_start_in_order() {
    // The one that panicked has no last word.
    let cases: [(_, &[&str], _); 3] = [
        (Strategy::OneForAll, &["-c#1", "-a#1", "+a#2", "+b#2", "+c#2"], [2, 2, 2, 1]),
        (Strategy::RestForOne, &["-c#1", "+b#2", "+c#2"], [1, 2, 2, 1]),
        (Strategy::OneForOne, &["+b#2"], [1, 2, 1, 1]),
    ];
    for (strategy, order, begun) in cases {
        let strings = Strings::default();
        let mut node = node_of(&strings, strategy).await;

        strike(&node, "b").await;
        node.await_fault(FaultKind::Panic, "b").await;
        node.await_recovered(FaultKind::Panic, "b").await;

        assert_eq!(strings.begins_and_ends(), order, "{strategy:?}");
        assert_eq!(incarnations(&node).await, begun, "{strategy:?}");
        node.expect_no_faults().await;
    }
}

/// What becomes of `a`, `b`, a supervisor of `c` and `d`, `e` and `f` in this order, some on
/// threads of their own, the others spread over three arbiters, when `b` panics. Their ends and
/// beginnings take time.
async fn over_all_arbiters(strategy: Strategy) -> Vec<String> {
    let strings = Strings::default();
    let pair = SupervisorSpec::new("pair", Strategy::OneForOne)
        .child(strings.spec("c"))
        .child(strings.spec("d").on_own_thread());
    let group = SupervisorSpec::new("group", strategy)
        .child(strings.spec("a"))
        .child(strings.spec("b").on_own_thread())
        .supervisor(pair)
        .child(strings.spec("e"))
        .child(strings.spec("f"));
    let builder = Node::builder("module1").work_threads(3).supervisor(group);
    let mut node = TestNode::of(builder.start().await.expect("the node starts")).await;
    strings.diary();
    for name in ["a", "c", "d", "e", "f"] {
        strings.pull(name, "on_deactivated", Pull::Wait(Duration::from_millis(5)));
        strings.pull(name, "on_initialize", Pull::Wait(Duration::from_millis(5)));
    }

    strike(&node, "b").await;
    node.await_recovered(FaultKind::Panic, "b").await;
    let last = node.sender::<Do>("f").expect("a puppet of this name");
    let incarnation = last.ask_within(Do(Deed::Nothing), Duration::from_secs(30)).await;
    assert_eq!(incarnation.expect("all are at work"), 2);
    node.shutdown().await;
    strings.begins_and_ends()
}

#[blastema_testkit::test]
async fn a_member_that_fails_while_the_group_starts_holds_up_those_behind_it_only() {
    let strings = Strings::default();
    let mut node = node_of(&strings, Strategy::OneForAll).await;
    strings.pull("b", "on_initialize", Pull::Fail("jammed"));

    strike(&node, "a").await;
    node.await_recovered(FaultKind::InitializationFailed, "b").await;

    let order = strings.begins_and_ends();
    assert_eq!(&order[..4], ["-c#1", "-b#1", "+a#2", "+b#2"]);
    let tree = node.tree().await.unwrap();
    let group = tree.children[1].below.as_ref().expect("the group answers");
    assert!(group.children.iter().all(|leaf| leaf.state == ChildState::Running), "{group:?}");
}

#[blastema_testkit::test]
async fn a_sibling_that_does_not_stop_is_given_up_after_its_time() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::OneForAll)
        .child(strings.spec("a"))
        .child(strings.spec("b").shutdown_within(Duration::from_secs(2)));
    let mut node = TestNode::start(Node::builder("module1").supervisor(group)).await;
    strings.pull("b", "on_deactivated", Pull::Wait(Duration::from_secs(3600)));

    strike(&node, "a").await;
    let took = node.await_recovered(FaultKind::Panic, "a").await;

    assert!(took >= Duration::from_secs(2) && took < Duration::from_secs(3), "{took:?}");
    assert_eq!((incarnation(&node, "a").await, incarnation(&node, "b").await), (2, 2));
    node.await_fault(FaultKind::Panic, "a").await;
    node.await_fault(FaultKind::ErrorState, "b").await;
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_member_that_needs_another_and_fails_while_that_one_returns_holds_up_neither() {
    let strings = Strings::default();
    let group = SupervisorSpec::new("group", Strategy::RestForOne)
        .child(strings.spec("a"))
        .child(strings.spec("b").depends_on(["a"]))
        .child(strings.spec("c").depends_on(["b"]));
    let mut node = TestNode::start(Node::builder("module1").supervisor(group)).await;
    strings.pull("b", "on_initialize", Pull::Fail("no a"));

    strike(&node, "a").await;
    node.await_fault(FaultKind::Panic, "a").await;
    let took = node.await_recovered(FaultKind::InitializationFailed, "b").await;

    assert!(took < Duration::from_secs(1), "a deadline had to pass: {took:?}");
    assert_eq!(incarnation(&node, "a").await, 2);
    assert_eq!((incarnation(&node, "b").await, incarnation(&node, "c").await), (3, 2));
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_temporary_member_is_stopped_with_its_group_and_does_not_return() {
    for strategy in [Strategy::OneForAll, Strategy::RestForOne] {
        let strings = Strings::default();
        let group = SupervisorSpec::new("group", strategy)
            .child(strings.spec("a"))
            .child_with(strings.spec("guest"), Restart::Temporary)
            .child(strings.spec("c"));
        let mut node = TestNode::start(Node::builder("module1").supervisor(group)).await;
        strings.diary();

        strike(&node, "a").await;
        node.await_recovered(FaultKind::Panic, "a").await;

        let order = ["-c#1", "-guest#1", "+a#2", "+c#2"];
        assert_eq!(strings.begins_and_ends(), order, "{strategy:?}");
        let refused = ask(&node, "guest", Deed::Nothing).await.expect_err("it is not missed");
        assert_eq!(refused.kind, DeliveryError::Stopped);
        let tree = node.tree().await.unwrap();
        let group = tree.children[0].below.as_ref().expect("the group answers");
        assert_eq!(group.children[1].state, ChildState::Finished, "{group:?}");
    }
}

/// A node whose member `struck` panics six times, each time right after it has answered, while
/// members of the seed's choice are slow to start.
async fn struck_after_each_answer(
    strings: &Strings,
    builder: NodeBuilder,
    members: &[&'static str],
    struck: &str,
    seed: usize,
) -> TestNode {
    let node = TestNode::start(builder).await;
    for round in 0..6 {
        for (at, member) in members.iter().enumerate() {
            let takes = Duration::from_millis((seed * 7 + round * 5 + at * 11) as u64 % 24);
            strings.pull(member, "on_initialize", Pull::Wait(takes));
        }
        let target = node.sender::<Do>(struck).unwrap();
        let limit = Duration::from_secs(30);
        target.ask_within(Do(Deed::Nothing), limit).await.expect("it is at work");
        target.ask(Do(Deed::Panic("struck".into()))).await.expect_err("it dies");
    }
    node.advance(Duration::from_secs(3)).await;
    node
}

fn often(spec: SupervisorSpec) -> SupervisorSpec {
    spec.intensity(1000, Duration::from_secs(10))
}

/// Every fault is over, and was treated by one attempt.
async fn expect_one_attempt_each(node: &TestNode, told: &str) {
    for entry in node.faults().await.entries {
        let decided = entry.decided.as_ref().map_or("", |(_, action)| action.as_str());
        assert!(!decided.contains("attempt"), "{told}: {entry:?}");
        assert_eq!(entry.status(), FaultStatus::Closed, "{told}: {entry:?}");
    }
}

#[blastema_testkit::test]
async fn three_levels_of_groups_lose_no_member_whose_faults_are_recovered() {
    let members = ["x", "y", "a", "b", "z"];
    let strategies = [Strategy::OneForOne, Strategy::OneForAll, Strategy::RestForOne];
    for seed in 0..32 {
        let (outer, middle) = (strategies[seed % 3], strategies[seed / 3 % 3]);
        let (strings, told) = (Strings::default(), format!("{seed} {outer:?} {middle:?}"));
        let inner = often(SupervisorSpec::new("inner", Strategy::OneForAll))
            .child(strings.spec("a"))
            .child(strings.spec("b"));
        let middle =
            often(SupervisorSpec::new("middle", middle)).child(strings.spec("y")).supervisor(inner);
        let outer = often(SupervisorSpec::new("outer", outer))
            .child(strings.spec("x"))
            .supervisor(middle)
            .child(strings.spec("z"));
        let builder = Node::builder("module1").supervisor(outer);
        let struck = members[seed % members.len()];
        let node = struck_after_each_answer(&strings, builder, &members, struck, seed).await;

        expect_one_attempt_each(&node, &told).await;
        for member in members {
            ask(&node, member, Deed::Nothing).await.expect("it is at work");
        }
    }
}

#[blastema_testkit::test]
async fn the_fault_of_a_restart_storm_ends_with_the_group_that_it_has_ended() {
    for strategy in [Strategy::OneForAll, Strategy::RestForOne] {
        let strings = Strings::default();
        let group = SupervisorSpec::new("group", strategy)
            .child(strings.spec("a"))
            .child(strings.spec("b"));
        let builder = Node::builder("module1").supervisor(group);
        let node = struck_after_each_answer(&strings, builder, &["a", "b"], "a", 0).await;

        expect_one_attempt_each(&node, "by default").await;
        let storms = node.faults().await.entries.into_iter();
        let storms = storms.filter(|entry| entry.fault.kind == FaultKind::RestartStorm);
        assert_eq!(storms.count(), 1, "three restarts of six were within the intensity");
        assert_eq!(incarnation(&node, "a").await, 7);

        for _ in 0..20 {
            // In the end the group is not worth another restart, and none serves.
            let _ = ask(&node, "a", Deed::Panic("struck".into())).await;
        }
        node.advance(Duration::from_secs(3)).await;
        assert_eq!(node.tree().await.unwrap().children[0].state, ChildState::Resting);
        for entry in node.faults().await.entries {
            let is_storm = entry.fault.kind == FaultKind::RestartStorm;
            assert!(!is_storm || entry.status() == FaultStatus::Closed, "{entry:?}");
        }
    }
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn a_group_stops_in_reverse_order_and_starts_in_order_also_across_arbiters() {
        let _turn = blastema_doubles::turn();
        blastema::run(async {
            let shutdown = ["-f#2", "-e#2", "-d#2", "-c#2", "-b#2"];
            let replaced = ["+b#2", "+c#2", "+d#2", "+e#2", "+f#2"];
            let stopped = ["-f#1", "-e#1", "-d#1", "-c#1"];
            let all = [&stopped[..], &["-a#1", "+a#2"], &replaced, &shutdown, &["-a#2"]];
            assert_eq!(over_all_arbiters(Strategy::OneForAll).await, all.concat());
            let rest = [&stopped[..], &replaced, &shutdown, &["-a#1"]];
            assert_eq!(over_all_arbiters(Strategy::RestForOne).await, rest.concat());
        });
    }
}

/// The robot of Biggs, Ando and Kotoku (2011), Fig. 2, and their Listing 1.
#[blastema_testkit::test]
async fn an_error_of_a_member_resets_it_and_restarts_the_others_around_it() {
    let strings = Strings::default();
    let drive = SupervisorSpec::new("drive", Strategy::OneForAll)
        .child(strings.spec("local_pp"))
        .child(strings.spec("global_pp"))
        .child(strings.spec("motors"));
    let builder = Node::builder("robot").child(strings.spec("laser")).supervisor(drive);
    let mut node = TestNode::start(builder).await;
    let moved = |strings: &Strings| {
        let mut diary = strings.diary();
        diary.retain(|line| {
            ["on_initialize", "on_reset", "on_finalize"].iter().any(|hook| line.ends_with(hook))
        });
        diary
    };
    moved(&strings);

    ask(&node, "laser", Deed::Fail("no echo".into())).await.expect("it answers before it fails");
    node.await_recovered(FaultKind::ErrorState, "laser").await;
    assert_eq!(moved(&strings), ["laser#1 on_reset"]);

    ask(&node, "global_pp", Deed::Fail("no path".into())).await.expect("it answers");
    node.await_recovered(FaultKind::ErrorState, "global_pp").await;
    assert_eq!(
        moved(&strings),
        [
            "motors#1 on_finalize",
            "local_pp#1 on_finalize",
            "local_pp#2 on_initialize",
            "global_pp#1 on_reset",
            "motors#2 on_initialize",
        ]
    );

    // A component that cannot be reset is restarted.
    node.advance(Duration::from_secs(60)).await;
    strings.pull("global_pp", "on_reset", Pull::Fail("the map is gone"));
    ask(&node, "global_pp", Deed::Fail("no path".into())).await.expect("it answers");
    node.await_recovered(FaultKind::ErrorState, "global_pp").await;
    let moves = moved(&strings);
    let [.., first, second, third] = &moves[..] else { panic!("{moves:?}") };
    assert_eq!(second, "global_pp#2 on_initialize", "{moves:?}");
    assert!(first.starts_with("local_pp#") && first.ends_with(" on_initialize"), "{moves:?}");
    assert!(third.starts_with("motors#") && third.ends_with(" on_initialize"), "{moves:?}");
    let of = async |name| incarnation(&node, name).await;
    assert_eq!((of("laser").await, of("global_pp").await), (1, 2));
    let tree = node.tree().await.expect("the node is at work");
    let drive = tree.children[1].below.as_ref().expect("the group answers");
    assert!(drive.children.iter().all(|leaf| leaf.state == ChildState::Running), "{drive:?}");
}
