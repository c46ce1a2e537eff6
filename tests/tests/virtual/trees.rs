//! Behaviour trees as components, in virtual time.

use blastema::prelude::*;
use blastema::trees::{
    BehaviorTree, Halt, Leaf, LeafContext, LeafFault, LeafResult, LeafRules, LeafTask, Port,
    Status, TreeLeaves,
};
use blastema::{FaultStatus, Lifecycle};
use blastema_testkit::{Probe, TestNode, owner};
use blastema_tests::{MS, Notes};
use std::sync::Arc;
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

/// The tree of the source, word for word, in the `root` that each file has.
const SOURCE: &str = r#"<root BTCPP_format="4">
<BehaviorTree ID="CommsAwareOperation">
<Fallback>
<Sequence>
<Condition ID="IsCommsConnected"
topic_name="/operator/heartbeat"
timeout_sec="3.0"/>
<Action ID="TeleoperatedMission"/>
</Sequence>
<Sequence>
<Action ID="AutonomousSafeReturn"/>
</Sequence>
</Fallback>
</BehaviorTree>
</root>"#;

/// What leaves did, in order.
type Log = Notes<String>;

/// Notes the end of a leaf's future.
struct Noted(Log, &'static str);

impl Drop for Noted {
    fn drop(&mut self) {
        self.0.note(format!("{} ends", self.1));
    }
}

/// A leaf that works until it is halted.
fn works(log: &Log, name: &'static str) -> impl Fn(LeafTask) -> Work + Send + Sync + 'static {
    let log = log.clone();
    move |leaf| {
        let log = log.clone();
        Box::pin(async move {
            log.note(format!("{name} begins"));
            let _noted = Noted(log, name);
            loop {
                leaf.alive();
                blastema::sleep(SECOND).await;
            }
        })
    }
}

type Work = std::pin::Pin<Box<dyn Future<Output = LeafResult>>>;

fn root(tree: &str) -> String {
    format!("<root><BehaviorTree ID=\"Main\">{tree}</BehaviorTree></root>")
}

fn tree(leaves: &TreeLeaves, tree: &str) -> ChildSpec<BehaviorTree> {
    BehaviorTree::of_text("tree", leaves, &root(tree)).unwrap_or_else(|errors| panic!("{errors}"))
}

/// Each change of the tree that is kept, without its tick.
async fn changes(node: &TestNode) -> Vec<String> {
    node.tree_changes().into_iter().map(|row| row.changes).collect()
}

async fn rover(text: &str) -> (TestNode, Log) {
    let log = Log::default();
    let leaves = TreeLeaves::new()
        .task("TeleoperatedMission", [], works(&log, "teleoperation"))
        .task("AutonomousSafeReturn", [], works(&log, "return"));
    let tree = BehaviorTree::of_text("tree", &leaves, text).unwrap();
    (TestNode::start(Node::builder("rover").child(tree)).await, log)
}

#[blastema_testkit::test]
async fn the_tree_of_the_source_runs_as_it_is_and_does_not_look_again() {
    let (rover, log) = rover(SOURCE).await;
    rover.advance(SECOND).await;
    assert_eq!(log.take(), ["return begins"], "the operator was never heard");
    rover.shutdown().await;
    assert_eq!(log.take(), ["return ends"]);

    let (rover, log) = self::rover(SOURCE).await;
    rover.actor::<BehaviorTree>("tree").unwrap().deactivate();
    let beats = rover.heartbeat("operator/heartbeat", 100 * MS).unwrap();
    rover.advance(SECOND).await;
    log.take();
    rover.actor::<BehaviorTree>("tree").unwrap().activate();
    rover.advance(SECOND).await;
    assert_eq!(log.take(), ["teleoperation begins"]);
    drop(beats);
    rover.advance(60 * SECOND).await;
    // A plain sequence ticks the leaf that is RUNNING, and not the condition before it.
    assert_eq!(log.take(), [""; 0]);
}

#[blastema_testkit::test]
async fn a_reactive_tree_returns_when_the_operator_is_lost_and_goes_on_when_he_is_back() {
    let text = SOURCE.replace("<Sequence>", "<ReactiveSequence>");
    let text = text.replace("</Sequence>", "</ReactiveSequence>");
    let text = text.replace("<Fallback>", "<ReactiveFallback>");
    let (mut rover, log) = rover(&text.replace("</Fallback>", "</ReactiveFallback>")).await;
    let beats = rover.heartbeat("operator/heartbeat", 100 * MS).unwrap();
    rover.advance(SECOND).await;
    assert_eq!(log.take(), ["return begins", "return ends", "teleoperation begins"]);

    drop(beats);
    rover.advance(2800 * MS).await;
    assert_eq!(log.take(), [""; 0]);
    rover.advance(400 * MS).await;
    assert_eq!(log.take(), ["teleoperation ends", "return begins"]);
    let name = "conditions/operator/heartbeat/heard-within-3s";
    assert_eq!(rover.await_fault(FaultKind::ConnectionLost, name).await.count, 1);

    let _beats = rover.heartbeat("operator/heartbeat", 100 * MS).unwrap();
    rover.advance(SECOND).await;
    assert_eq!(log.take(), ["return ends", "teleoperation begins"]);
    rover.actor::<BehaviorTree>("tree").unwrap().deactivate();
    rover.settle().await;
    assert_eq!(log.take(), ["teleoperation ends"], "a tree that leaves work halts all");
    let rows = rover.trees();
    assert!(rows.iter().all(|row| row.answer != "RUNNING"), "{rows:?}");
}

#[blastema_testkit::test]
async fn each_of_several_channels_must_be_heard_and_quality_outlasts_silence_between_beats() {
    let log = Log::default();
    let condition = |name: &'static str, element: &str| {
        format!("<Sequence><Inverter>{element}</Inverter><Note text=\"not {name}\"/></Sequence>")
    };
    let noting = log.clone();
    let leaves = TreeLeaves::new().action("Note", [Port::input::<String>("text")], move |cx| {
        noting.note(cx.input::<String>("text")?);
        Ok(Status::Failure)
    });
    let all = r#"<AreAllCommsConnected heartbeat_topics="/a/beat; b/beat"/>"#;
    let text = [
        condition("all", all),
        condition("well", r#"<IsCommsQualityAcceptable topic_name="a/beat"/>"#),
        condition("whole", r#"<IsCommsLossAcceptable topic_name="a/beat"/>"#),
        condition("steady", r#"<IsCommsJitterAcceptable topic_name="a/beat"/>"#),
        condition("there", r#"<IsNodeConnected node="base"/>"#),
    ];
    let tree = tree(&leaves, &format!("<Fallback>{}</Fallback>", text.concat())).rate_hz(1.0);
    let node = TestNode::start(Node::builder("rover").child(tree)).await;
    // Four beats in ten ticks: no beat since the last tick is no loss of quality.
    let _a = node.heartbeat("a/beat", 400 * MS).unwrap();
    node.advance(5 * SECOND).await;
    log.take();
    node.advance(SECOND).await;
    assert_eq!(log.take(), ["not all", "not there"], "b was never heard, and there is no base");

    let _b = node.heartbeat("b/beat", 400 * MS).unwrap();
    node.advance(2 * SECOND).await;
    log.take();
    node.advance(10 * SECOND).await;
    assert_eq!(log.take(), ["not there"; 10]);
}

#[blastema_testkit::test]
async fn a_leaf_that_panics_is_named_by_its_path_and_the_tree_is_halted_shown_and_begins_again() {
    let log = Log::default();
    let leaves = TreeLeaves::new().task("Watch", [], works(&log, "watch")).task(
        "Reach",
        [Port::input::<i32>("tries")],
        |leaf| async move {
            blastema::sleep(50 * MS).await;
            assert!(leaf.input::<i32>("tries")? > 1, "the arm is stuck");
            Ok(Status::Success)
        },
    );
    // The second time it succeeds: its blackboard outlives the halt.
    let text = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><Sequence>
            <RunOnce><Script code="n := 0"/></RunOnce><Script code="n += 1"/>
            <Parallel success_count="1"><Watch/><SubTree ID="Arm" name="left" tries="{n}"/></Parallel>
            <Sleep msec="60000"/></Sequence></BehaviorTree>
        <BehaviorTree ID="Arm"><Sequence><Reach name="reach" tries="{tries}"/></Sequence>
        </BehaviorTree></root>"#;
    let tree = BehaviorTree::of_text("tree", &leaves, text).unwrap();
    let mut node = TestNode::start(Node::builder("rover").child(tree)).await;

    let fault = node.await_fault(FaultKind::CheckFailed, "tree").await;
    let begins = "leaf left/reach: panicked at tests/tests/virtual/trees.rs:";
    assert!(fault.detail.starts_with(begins), "{}", fault.detail);
    assert!(fault.detail.ends_with("the arm is stuck"), "{}", fault.detail);
    assert_eq!(log.take(), ["watch begins", "watch ends"]);
    assert!(changes(&node).await.last().is_some_and(|last| last.contains("RUNNING -> IDLE")));

    node.advance(200 * MS).await;
    assert_eq!(log.take(), ["watch begins", "watch ends"]);
    assert_eq!(node.row("tree").await.restarts, 0);
    let record = node.faults().await;
    let entry = record.entries.iter().find(|entry| entry.fault.id == fault.id).unwrap();
    assert_eq!(entry.status(), FaultStatus::Closed, "it has succeeded since");
}

/// A tree whose leaf `Stuck` never ends, and what comes after 5 s of that.
async fn stuck(then: LeafFault) -> (TestNode, Log) {
    let log = Log::default();
    let (begun, next) = (log.clone(), log.clone());
    let rules = LeafRules { within: 5 * SECOND, on_error: then, ..LeafRules::default() };
    let leaves = TreeLeaves::new()
        .task("Stuck", [], move |_| {
            let log = begun.clone();
            async move {
                log.note("begins");
                let _noted = Noted(log, "stuck");
                std::future::pending().await
            }
        })
        .action("Other", [], move |_| {
            next.note("other");
            Ok(Status::Success)
        })
        .rules("Stuck", rules);
    let tree = tree(
        &leaves,
        "<Fallback><Stuck/><Sequence><Other/><Sleep msec=\"9000\"/></Sequence></Fallback>",
    );
    (TestNode::start(Node::builder("rover").child(tree)).await, log)
}

#[blastema_testkit::test]
async fn a_leaf_that_never_answers_does_at_its_time_limit_what_its_rule_says() {
    let detail = "leaf Stuck::2: it has not answered for 5s";

    let (mut node, log) = stuck(LeafFault::Fail).await;
    node.advance(4900 * MS).await;
    assert_eq!(log.take(), ["begins"]);
    node.advance(200 * MS).await;
    assert_eq!(log.take(), ["other", "stuck ends"]);
    assert_eq!(node.await_fault(FaultKind::CheckFailed, "tree").await.detail, detail);

    let (node, log) = stuck(LeafFault::Retry(2)).await;
    node.advance(15_100 * MS).await;
    let again = ["stuck ends", "begins"];
    let all = [&["begins"][..], &again, &again, &["other", "stuck ends"]].concat();
    assert_eq!(log.take(), all);

    let (node, log) = stuck(LeafFault::RestartTree).await;
    node.advance(11 * SECOND).await;
    assert_eq!(log.take(), ["begins", "stuck ends", "begins", "stuck ends", "begins"]);
    assert_eq!(node.row("tree").await.state, Some(Lifecycle::Active));

    let (mut node, log) = stuck(LeafFault::Plan).await;
    assert_eq!(node.await_fault(FaultKind::ErrorState, "tree").await.detail, detail);
    node.await_recovered(FaultKind::ErrorState, "tree").await;
    node.advance(100 * MS).await;
    assert_eq!(log.take(), ["begins", "stuck ends", "begins"], "the plan resets it");
    assert_eq!(node.row("tree").await.restarts, 0);
}

#[blastema_testkit::test]
async fn the_errors_of_leaves_at_once_follow_their_rules_in_the_same_turn() {
    let log = Log::default();
    let noting = log.clone();
    let leaves = TreeLeaves::new()
        .action("Wrong", [], move |_| {
            noting.note("wrong");
            Err("out of range".into())
        })
        .action("Panics", [], |_| panic!("oh"))
        .rules("Wrong", LeafRules { on_error: LeafFault::Retry(2), ..LeafRules::default() })
        .rules("Panics", LeafRules { on_panic: LeafFault::Fail, ..LeafRules::default() });
    let tree = tree(&leaves, "<Fallback><Wrong/><Panics/><Sleep msec=\"9000\"/></Fallback>");
    let mut node = TestNode::start(Node::builder("rover").child(tree.rate_hz(1.0))).await;

    node.advance(100 * MS).await;
    assert_eq!(log.take(), ["wrong"; 3]);
    let fault = node.await_fault(FaultKind::CheckFailed, "tree").await;
    assert!(fault.detail.starts_with("leaf Panics::3: panicked at "), "{}", fault.detail);
    let last = changes(&node).await.pop().unwrap();
    let expected =
        "Panics::3: IDLE -> FAILURE, Sleep::4: IDLE -> RUNNING, Fallback::1: IDLE -> RUNNING";
    assert_eq!(last, expected);
}

#[blastema_testkit::test]
async fn a_tree_ticks_when_something_has_changed_and_does_not_wait_for_its_round() {
    let log = Log::default();
    let noting = log.clone();
    let leaves = TreeLeaves::new()
        .task("Wait", [Port::input::<f64>("seconds")], |leaf| async move {
            blastema::sleep(Duration::from_secs_f64(leaf.input("seconds")?)).await;
            Ok(Status::Success)
        })
        .action("Note", [], move |cx| {
            noting.note(cx.now().as_millis().to_string());
            Ok(Status::Success)
        });
    let text = "<Sequence><Note/><Wait seconds=\"0.3\"/><Note/><Sleep msec=\"200\"/><Note/><Delay delay_msec=\"90000\"><Note/></Delay></Sequence>";
    let node =
        TestNode::start(Node::builder("rover").child(tree(&leaves, text).rate_hz(0.1))).await;
    node.advance(9 * SECOND).await;
    let at: Vec<u64> = log.take().iter().map(|at| at.parse().unwrap()).collect();
    let after: Vec<u64> = at.iter().map(|now| now - at[0]).collect();
    assert_eq!(after, [0, 300, 500]);
}

#[derive(Clone, Debug, PartialEq, Structure)]
struct Found {
    name_of_it: String,
    distance: f64,
}

#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "map/find", reply = Result<Found, String>)]
struct Find {
    what: String,
    within: f32,
    most: u32,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "voice/say")]
struct Say {
    text: String,
    loud: bool,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "voice/label")]
struct Label {
    text: Option<String>,
    number: Option<u32>,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "voice/ping")]
struct Ping {}

#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "rover/mode")]
struct Mode {
    level: i32,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "wheels/drive")]
struct Drive {
    speed: f64,
}

#[blastema_testkit::test]
async fn leaves_ask_publish_read_write_and_command_with_a_port_for_each_field() {
    let (said, asked, driven) = (Probe::<Say>::new(), Probe::<Find>::new(), Probe::<Drive>::new());
    let leaves = TreeLeaves::new()
        .request::<Find>("Find")
        .publish::<Say>("Say")
        .variable::<Mode>("Mode")
        .actuator::<Drive>("Wheels");
    let text = r#"<Sequence>
        <Fallback><Find component="map" what="nothing" within="1" most="1"/>
            <Find component="map" what="dock" within="2.5" most="3" name_of_it="{it}" distance="{d}"/></Fallback>
        <Say text="{it}" loud="true"/>
        <ReadMode component="state" level="{level}"/>
        <Script code="level += 1"/>
        <WriteMode component="state" level="{level}"/>
        <ClaimWheels actuator="wheels"/>
        <CommandWheels actuator="wheels" speed="{d}"/>
        <Fallback><CommandWheels actuator="no_such" speed="1"/><AlwaysSuccess/></Fallback>
        <ReleaseWheels actuator="wheels"/>
        <ClaimWheels actuator="wheels"/>
        <KeepRunningUntilFailure><AlwaysSuccess/></KeepRunningUntilFailure></Sequence>"#;
    let answer = |find: &Find| match find.what.as_str() {
        "dock" => Ok(Found { name_of_it: "dock 7".into(), distance: f64::from(find.within) }),
        other => Err(format!("no {other} here")),
    };
    let node = Node::builder("rover")
        .child(said.listener("listener"))
        .child(asked.server("map", answer))
        .child(owner("state", Mode { level: 4 }))
        .child(driven.actuator("wheels", Drive { speed: 0.0 }))
        .child(tree(&leaves, text));
    let node = TestNode::start(node).await;
    node.advance(SECOND).await;

    let finds = asked.drain();
    assert_eq!(finds.len(), 2, "a reply that is an error is a failure");
    assert_eq!(finds[1], Find { what: "dock".into(), within: 2.5, most: 3 });
    assert_eq!(said.drain(), [Say { text: "dock 7".into(), loud: true }]);
    assert_eq!(node.variable::<Mode>("state").unwrap().read().await.unwrap().value.level, 5);
    assert_eq!(driven.drain(), [Drive { speed: 2.5 }, Drive { speed: 0.0 }]);

    // A lease that the tree holds ends with it.
    node.actor::<BehaviorTree>("tree").unwrap().deactivate();
    node.advance(100 * MS).await;
    assert_eq!(driven.drain(), [Drive { speed: 0.0 }]);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn a_text_that_may_be_left_out_is_a_text_and_a_message_without_fields_has_no_port() {
    let (labels, pings) = (Probe::<Label>::new(), Probe::<Ping>::new());
    let leaves = TreeLeaves::new().publish::<Label>("Label").publish::<Ping>("Ping");
    let text = r#"<Sequence><Label text="12" number="7"/><Label/><Ping/>
        <Sleep msec="60000"/></Sequence>"#;
    let node = Node::builder("rover")
        .child(labels.listener("labels"))
        .child(pings.listener("pings"))
        .child(tree(&leaves, text));
    let node = TestNode::start(node).await;
    node.advance(SECOND).await;

    let (text, number) = (Some("12".to_owned()), Some(7));
    assert_eq!(labels.drain(), [Label { text, number }, Label { text: None, number: None }]);
    assert_eq!(pings.drain(), [Ping {}]);
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn conditions_of_leaves_end_when_no_leaf_looks_at_them_and_their_faults_with_them() {
    let next = std::sync::atomic::AtomicU32::new(0);
    let leaves = TreeLeaves::new().action("Next", [Port::output::<String>("topic")], move |cx| {
        let number = next.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        // The first one for four seconds, so that it is a fault that it was never heard.
        cx.output("topic", format!("beat/{}", number.saturating_sub(40)))?;
        Ok(Status::Success)
    });
    let text = r#"<Sequence><Next topic="{topic}"/>
        <ForceSuccess><IsCommsConnected topic_name="{topic}"/></ForceSuccess></Sequence>"#;
    let mut node = TestNode::start(Node::builder("rover").child(tree(&leaves, text))).await;
    // More topics than a node has conditions.
    node.advance(34 * SECOND).await;
    let first = "conditions/beat/0/heard-within-3s";
    node.await_fault(FaultKind::ConnectionLost, first).await;
    let mut standing = node.faults().await.entries;
    standing.retain(|entry| entry.status() != FaultStatus::Closed);
    assert!(standing.len() <= 1, "{standing:?}");
    assert!(standing.iter().all(|of| of.fault.kind == FaultKind::ConnectionLost), "{standing:?}");
}

#[blastema_testkit::test]
async fn the_fault_of_a_halted_leaf_whose_future_panics_ends_when_the_leaf_succeeds() {
    struct Panics;
    impl Drop for Panics {
        fn drop(&mut self) {
            panic!("it is held")
        }
    }
    let first = std::sync::atomic::AtomicBool::new(true);
    let leaves = TreeLeaves::new().task("Grip", [], move |_| {
        let panics = first.swap(false, std::sync::atomic::Ordering::Relaxed).then(|| Panics);
        async move {
            if let Some(_held) = panics {
                blastema::sleep(SECOND).await;
            }
            Ok(Status::Success)
        }
    });
    let text = r#"<Sequence><ForceSuccess><Timeout msec="100"><Grip name="grip"/></Timeout>
        </ForceSuccess><Sleep msec="500"/></Sequence>"#;
    let mut node = TestNode::start(Node::builder("rover").child(tree(&leaves, text))).await;
    let fault = node.await_fault(FaultKind::CheckFailed, "tree").await;
    assert!(fault.detail.starts_with("leaf grip: halted, its future"), "{}", fault.detail);
    node.advance(5 * SECOND).await;
    let record = node.faults().await;
    let entry = record.entries.iter().find(|entry| entry.fault.id == fault.id).unwrap();
    assert_eq!(entry.status(), FaultStatus::Closed, "it has succeeded since");
}

/// An arm that is told to stop and never comes to rest.
struct Swings;

impl Leaf for Swings {
    fn start(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
        Ok(Status::Running)
    }

    fn halt(&mut self, _: &mut LeafContext<'_>) -> Halt {
        Halt::Pending
    }
}

#[blastema_testkit::test]
async fn a_halted_leaf_that_does_not_come_to_rest_is_an_error_and_the_tree_begins_again_without_it()
{
    let log = Log::default();
    let rules = LeafRules { within: 5 * SECOND, ..LeafRules::default() };
    let leaves = TreeLeaves::new().leaf("Swing", || Swings).rules("Swing", rules).task(
        "Return",
        [],
        works(&log, "return"),
    );
    let text = r#"<ReactiveFallback><ReactiveSequence><IsCommsConnected topic_name="beat"/><Swing/>
        </ReactiveSequence><Return/></ReactiveFallback>"#;
    let mut node = TestNode::start(Node::builder("rover").child(tree(&leaves, text))).await;
    let beats = node.heartbeat("beat", 100 * MS).unwrap();
    node.advance(SECOND).await;
    log.take();
    drop(beats);
    node.advance(7 * SECOND).await;
    assert_eq!(log.take(), [""; 0], "two actions do not move one arm");

    let fault = node.await_fault(FaultKind::ErrorState, "tree").await;
    assert_eq!(fault.detail, "leaf Swing::4: halted, it has not come to rest for 5s");
    node.await_recovered(FaultKind::ErrorState, "tree").await;
    node.advance(SECOND).await;
    assert_eq!(log.take(), ["return begins"]);
    assert_eq!(node.row("tree").await.restarts, 0, "the plan has reset it");
}

#[blastema_testkit::test]
async fn ten_thousand_leaves_wait_at_once_and_each_has_one_future() {
    let started = Arc::new(std::sync::atomic::AtomicU32::new(0));
    let counted = started.clone();
    let leaves = TreeLeaves::new().task("Wait", [], move |leaf| {
        counted.fetch_add(1, std::sync::atomic::Ordering::Relaxed);
        async move {
            leaf.alive();
            blastema::sleep(3 * SECOND).await;
            Ok(Status::Success)
        }
    });
    let text = format!("<Parallel>{}</Parallel>", "<Wait/>".repeat(10_000));
    let node = TestNode::start(Node::builder("rover").child(tree(&leaves, &text))).await;
    node.advance(SECOND).await;
    let started = started.load(std::sync::atomic::Ordering::Relaxed);
    assert_eq!(started, 10_000, "each has one future");
    node.expect_no_faults().await;
}

#[blastema_testkit::test]
async fn leaves_with_almost_the_same_timeout_have_conditions_of_their_own() {
    let text = r#"<Sequence><IsCommsConnected topic_name="beat" timeout_sec="3.0"/>
        <IsCommsConnected topic_name="beat" timeout_sec="3.0001"/>
        <Sleep msec="60000"/></Sequence>"#;
    let tree = tree(&TreeLeaves::new(), text);
    let node = TestNode::start(Node::builder("rover").child(tree)).await;
    let _beats = node.heartbeat("beat", 100 * MS).unwrap();
    node.advance(SECOND).await;
    node.expect_no_faults().await;
    assert!(node.trees().iter().any(|row| row.path == "Sleep::4"));
}

struct Arm;

impl Component for Arm {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let flood = cx.heartbeat("arm/beat", MS / 10).unwrap_err().to_string();
        assert!(flood.ends_with("write 10 ms to an hour"), "{flood}");
        cx.heartbeat("arm/beat", SECOND)?;
        Ok(())
    }
}

#[blastema_testkit::test]
async fn leaves_steer_a_life_cycle_and_look_at_components_and_faults() {
    let leaves = TreeLeaves::new();
    let text = r#"<Sequence>
        <IsComponentInState component="arm"/>
        <Inverter><IsCommsConnected topic_name="beat"/></Inverter>
        <DeactivateComponent component="arm"/>
        <IsComponentInState component="arm" state="initialized"/>
        <ActivateComponent component="arm"/>
        <RetryUntilSuccessful num_attempts="-1"><Sequence>
            <Sleep msec="10"/>
            <IsFaultPresent code="B27" object="conditions/beat/heard-within-3s"/>
        </Sequence></RetryUntilSuccessful>
        <Sleep name="last" msec="60000"/></Sequence>"#;
    let builder = Node::builder("rover").child(ChildSpec::new("arm", || Arm));
    let node = TestNode::start(builder.child(tree(&leaves, text))).await;
    let runs = async |path: &str| {
        let rows = node.trees();
        rows.iter().any(|row| row.path == path && row.answer == "RUNNING")
    };
    node.advance(SECOND).await;
    assert_eq!(node.row("arm").await.state, Some(Lifecycle::Active));
    assert!(runs("Sleep::10").await && !runs("last").await, "no fault stands yet");
    node.advance(3 * SECOND).await;
    assert!(runs("last").await, "the connection was never there");

    let wrong = r#"<Sequence><Script code="state:='lazy'"/>
        <IsComponentInState component="arm" state="{state}"/></Sequence>"#;
    let wrong = tree(&leaves, wrong);
    let builder = Node::builder("rover").child(ChildSpec::new("arm", || Arm));
    let mut node = TestNode::start(builder.child(wrong)).await;
    let fault = node.await_fault(FaultKind::CheckFailed, "tree").await;
    assert!(fault.detail.contains("`lazy`, which is no state of a component"), "{}", fault.detail);
}

#[test]
fn a_file_is_refused_with_all_its_mistakes_and_the_model_names_each_leaf() {
    let leaves = TreeLeaves::new().request::<Find>("Find");
    let text = root(r#"<Sequence><Find component="map" what="x" within="far"/><Fnd/></Sequence>"#);
    let errors = BehaviorTree::of_text("tree", &leaves, &text).unwrap_err().to_string();
    for part in ["tree.xml:1:", "`far`", "most", "did you mean `Find`?"] {
        assert!(errors.contains(part), "{part} is missing in {errors}");
    }
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("main.xml");
    let main = r#"<root main_tree_to_execute="Main"><include path="more.xml"/>
        <BehaviorTree ID="Main"><SubTree ID="More"/></BehaviorTree></root>"#;
    std::fs::write(&file, main).unwrap();
    let error = BehaviorTree::of_file("tree", &leaves, &file).unwrap_err().to_string();
    assert!(error.contains("more.xml"), "{error}");
    let more = r#"<root><BehaviorTree ID="More"><AlwaysSuccess/></BehaviorTree></root>"#;
    std::fs::write(folder.path().join("more.xml"), more).unwrap();
    assert!(BehaviorTree::of_file("tree", &leaves, &file).is_ok());

    let model = leaves.model();
    for part in [
        r#"<Condition ID="IsCommsConnected">"#,
        r#"<input_port name="timeout_sec" type="double" default="3.0">"#,
        r#"<input_port name="most" type="int64_t">"#,
        r#"<output_port name="distance" type="double">"#,
    ] {
        assert!(model.contains(part), "{part} is missing in {model}");
    }
}
