//! Trees that change while they run: supervisors and components come and go whole.

use crate::scenarios::puppet::{
    Deed, Do, News, Note, Pull, Puppet, Strings, ask, incarnation, strike,
};
use blastema::core::recovery::ChildState;
use blastema::prelude::*;
use blastema::{
    ComponentOrder, Incarnation, NodeBuilder, OrderVerb, RemoveError, RestartedChild, SpecError,
    Subtree,
};
use blastema_testkit::TestNode;
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

/// A supervisor of `left`, of `low` above `deep`, and of `right`, all of which need each other.
fn group(strings: &Strings) -> SupervisorSpec {
    let low = SupervisorSpec::new("low", Strategy::OneForOne).child(strings.spec("deep"));
    SupervisorSpec::new("group", Strategy::OneForAll)
        .child(strings.spec("left"))
        .supervisor(low)
        .child(strings.spec("right").depends_on(["left", "arm"]))
}

fn with_arm(strings: &Strings) -> NodeBuilder {
    Node::builder("module1").child(strings.spec("arm"))
}

/// What is told of the node's objects, in all places that list them.
async fn shown(node: &TestNode) -> (usize, String, usize, Vec<String>) {
    node.settle().await;
    let names = |tree: blastema::SupervisionTree| format!("{:?}", tree.children);
    let listeners = node.topics().iter().map(|row| row.listeners.len()).sum();
    let order = ComponentOrder { verb: OrderVerb::List, name: None };
    let rows = node.order(&order).await.rows;
    let tree = node.tree().await.map(names).unwrap_or_default();
    (node.table().await.len(), tree, listeners, rows.into_iter().map(|row| row.name).collect())
}

async fn no_fault_stands(node: &TestNode) -> bool {
    node.settle().await;
    node.faults().await.entries.iter().all(|entry| !entry.stands())
}

/// Adds it in a task, so that the test can let time pass.
fn adding(
    node: &TestNode,
    parent: Option<&'static str>,
    subtree: impl Into<Subtree>,
) -> tokio::task::JoinHandle<Result<(), SpecError>> {
    let (node, subtree) = (Node::clone(node), subtree.into());
    tokio::task::spawn_local(async move { node.add(parent, subtree).await })
}

#[blastema_testkit::test]
async fn a_supervisor_is_added_with_all_below_it_and_is_kept_like_any_other() {
    let strings = Strings::default();
    let mut node = TestNode::start(with_arm(&strings)).await;

    node.add(None, group(&strings)).await.expect("all start");
    let last = strings.spec("last").depends_on(["right"]);
    node.add(Some("group"), (last, Restart::Transient)).await.expect("it starts");

    let begun = ["+arm#1", "+left#1", "+deep#1", "+right#1", "+last#1"];
    assert_eq!(strings.begins_and_ends(), begun);
    let tree = node.tree().await.unwrap();
    let below = tree.children[1].below.as_ref().expect("a supervisor").children.iter();
    let below: Vec<_> = below.map(|child| (child.name.as_str(), child.state)).collect();
    assert_eq!(below, ["left", "low", "right", "last"].map(|name| (name, ChildState::Running)));
    for name in ["left", "deep", "right", "last"] {
        assert_eq!(node.row(name).await.restarts, 0);
    }

    strike(&node, "right").await;
    node.await_recovered(FaultKind::Panic, "right").await;

    let again = ["-last#1", "-deep#1", "-left#1", "+left#2", "+deep#2", "+right#2", "+last#2"];
    assert_eq!(strings.begins_and_ends(), again);
    node.expect_no_faults().await;
    let restarted = node.restart_child("group").await.unwrap();
    assert_eq!(restarted, RestartedChild::Running(Incarnation(2)));
    assert_eq!(incarnation(&node, "last").await, 3);
    strings.diary();

    node.shutdown().await;

    assert_eq!(strings.begins_and_ends(), ["-last#3", "-right#3", "-deep#3", "-left#3", "-arm#1"]);
}

#[blastema_testkit::test]
async fn a_supervisor_is_removed_in_reverse_unless_others_need_it_and_its_names_are_free_again() {
    let strings = Strings::default();
    let mut node = TestNode::start(with_arm(&strings)).await;
    let before = shown(&node).await;
    node.add(None, group(&strings)).await.expect("all start");
    node.add(None, strings.spec("hand").depends_on(["deep"])).await.expect("it starts");
    let (notes, actor) = (node.sender::<Note>("deep").unwrap(), node.actor::<Puppet>("left"));
    strings.diary();

    for (name, by) in [("left", "right"), ("low", "hand"), ("group", "hand"), ("arm", "right")] {
        let refused = node.remove_child(name).await.expect_err("it is needed");
        assert!(matches!(refused, RemoveError::Needed(_)), "{refused}");
        assert!(refused.to_string().ends_with(&format!("remove {by} first")), "{refused}");
    }
    for name in ["root", "absent", "not a name", "lefd"] {
        let refused = node.remove_child(name).await.expect_err("no supervisor keeps it");
        assert!(matches!(refused, RemoveError::Unknown { .. }), "{refused}");
    }
    assert_eq!(strings.begins_and_ends(), [""; 0], "nothing was touched");

    node.remove_child("hand").await.expect("it is not needed");
    node.remove_child("group").await.expect("it is not needed any more");

    let ended = strings.begins_and_ends();
    assert_eq!(ended, ["-hand#1", "-right#1", "-deep#1", "-left#1"]);
    let refused = notes.tell(Note(1)).expect_err("it is gone");
    assert_eq!((refused.kind, refused.message), (DeliveryError::Stopped, Note(1)));
    assert!(actor.unwrap().ask(Do(Deed::Nothing)).await.is_err());
    assert!(matches!(node.sender::<Note>("deep"), Err(DeliveryError::Unknown { .. })));
    assert_eq!(shown(&node).await, before);
    node.expect_no_faults().await;
    assert!(matches!(node.restart_child("low").await, Err(blastema::RestartError::Unknown { .. })));

    // Other kinds of objects have the names now.
    let left = SupervisorSpec::new("left", Strategy::OneForOne).child(strings.spec("group"));
    node.add(None, left).await.expect("the names are free");
    strike(&node, "group").await;
    node.await_recovered(FaultKind::Panic, "group").await;
    assert_eq!(incarnation(&node, "group").await, 2);
}

#[blastema_testkit::test]
async fn an_addition_whose_third_child_fails_to_start_is_undone_in_reverse() {
    let strings = Strings::default();
    let node = TestNode::start(with_arm(&strings)).await;
    let before = shown(&node).await;
    (0..99).for_each(|_| strings.pull("right", "on_initialize", Pull::Fail("no device")));

    let undone = adding(&node, None, group(&strings));
    node.advance(60 * SECOND).await;
    let undone = undone.await.unwrap().expect_err("right has no device");

    let told = undone.to_string();
    assert!(matches!(undone, SpecError::NotStarted { .. }), "{told}");
    assert!(told.starts_with("group could not be started, and is not added: "), "{told}");
    assert!(told.contains("right") && told.contains("no device"), "{told}");
    let diary = strings.begins_and_ends();
    assert_eq!(diary[diary.len() - 2..], ["-deep#4", "-left#4"], "{diary:?}");
    assert_eq!(incarnation(&node, "arm").await, 1);
    assert_eq!(shown(&node).await, before);
    assert!(no_fault_stands(&node).await);
    assert_eq!(node.state(), NodeState::Running);

    strings.cut_all();
    node.add(None, group(&strings)).await.expect("its names are free, and it has its device");
}

#[blastema_testkit::test]
async fn a_wrong_addition_is_refused_and_leaves_no_trace() {
    let strings = Strings::default();
    let node = TestNode::start(with_arm(&strings)).await;
    let before = shown(&node).await;
    let of = |name, child| SupervisorSpec::new(name, Strategy::OneForOne).child(child);
    let spec = |name, needed| strings.spec(name).depends_on([needed]);
    let circle = of("group", spec("left", "right")).child(spec("right", "left"));
    let twice = of("group", strings.spec("left")).child(strings.spec("left"));

    for (parent, wrong, text) in [
        (None, Subtree::from(circle), "left -> right -> left"),
        (None, twice.into(), "left is taken by a component"),
        (None, of("root", strings.spec("left")).into(), "root is taken by a supervisor"),
        (None, of("arm", strings.spec("left")).into(), "arm is taken by a component"),
        (None, of("group", strings.spec("group")).into(), "group is taken by a supervisor"),
        (None, of("chain/x", strings.spec("left")).into(), "reserved"),
        (None, strings.spec("conditions/operator").into(), "reserved"),
        (None, strings.spec("leases").into(), "reserved: the middleware's own are"),
        (None, of("group", strings.spec("left").rate_hz(-1.0)).into(), "rate_hz"),
        (None, spec("left", "arms").into(), "did you mean \"arm\"?"),
        (Some("rot"), strings.spec("left").into(), "no supervisor rot: did you mean `root`?"),
        (Some("arm"), strings.spec("left").into(), "no supervisor arm"),
    ] {
        let refused = node.add(parent, wrong).await.expect_err(text).to_string();
        assert!(refused.contains(text), "{refused}");
    }

    assert_eq!(shown(&node).await, before);
    let lines = strings.lines("#1 on_initialize");
    assert_eq!(lines, ["arm#1 on_initialize"], "nothing was started");
    node.add(None, group(&strings)).await.expect("all names are free");
}

#[blastema_testkit::test]
async fn additions_and_removals_during_a_recovery_and_under_load_lose_nothing() {
    let strings = Strings::default();
    let mut node = TestNode::start(with_arm(&strings).supervisor(group(&strings))).await;
    let (notes, news) = (node.sender::<Note>("arm").unwrap(), node.publisher("test/news").unwrap());
    strings.pull("left", "on_initialize", Pull::Wait(SECOND));
    strike(&node, "right").await;
    node.settle().await;
    strings.diary();

    let added = adding(&node, Some("group"), strings.spec("extra"));
    let remover = Node::clone(&node);
    let removed = tokio::task::spawn_local(async move { remover.remove_child("low").await });
    for n in 0..200 {
        notes.tell(Note(n)).unwrap();
        let _ = news.publish(News(1));
        node.advance(SECOND / 100).await;
    }

    added.await.unwrap().expect("it is the last to start");
    removed.await.unwrap().expect("it is removed");
    let diary = strings.diary();
    let of_arm = diary.iter().filter(|line| line.starts_with("arm#1 note")).count();
    assert_eq!(of_arm, 200);
    let begun: Vec<_> = diary.iter().filter(|line| line.ends_with("on_initialize")).collect();
    assert_eq!(begun, ["right#2 on_initialize", "extra#1 on_initialize"]);
    node.await_recovered(FaultKind::Panic, "right").await;
    assert_eq!(incarnation(&node, "extra").await, 1);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn an_order_that_is_not_waited_for_is_carried_out_and_undone_all_the_same() {
    let strings = Strings::default();
    let node = TestNode::start(with_arm(&strings)).await;
    let before = shown(&node).await;
    strings.pull("extra", "on_initialize", Pull::Wait(SECOND));
    let given_up = adding(&node, None, strings.spec("extra"));
    node.settle().await;

    given_up.abort();
    node.advance(2 * SECOND).await;

    assert_eq!(incarnation(&node, "extra").await, 1);
    let removal = node.remove_child("extra");
    drop(tokio::time::timeout(Duration::ZERO, removal).await);
    node.advance(SECOND).await;
    assert_eq!(shown(&node).await, before);
}

#[blastema_testkit::test]
async fn a_person_resets_all_below_a_supervisor_that_is_in_error() {
    let strings = Strings::default();
    let plan = Plan::default().on(FaultKind::ErrorState, Ladder::first(RecoveryAction::Observe));
    let builder = with_arm(&strings).supervisor(group(&strings)).plan(plan);
    let node = TestNode::start(builder).await;
    let reset = ComponentOrder { verb: OrderVerb::Reset, name: Some("group".to_owned()) };
    let refused = node.order(&reset).await.refused.expect("none is in error");
    assert!(refused.contains("no component below it is in error"), "{refused}");
    ask(&node, "deep", Deed::Fail("it is stuck".into())).await.unwrap();
    node.settle().await;

    assert_eq!(node.order(&reset).await.refused, None);

    assert_eq!(strings.lines("on_reset"), ["deep#1 on_reset"]);
    assert_eq!(incarnation(&node, "deep").await, 1);
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
