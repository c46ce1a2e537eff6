//! What the driver of a tree does: completes leaves, limits them, and reads what has changed.

use crate::scripted::{Bench, factory, file};
use blastema_trees::{
    CalledLeaf, Factory, Halt, Leaf, LeafContext, LeafResult, Port, Status, TickProblem, Tree,
};
use std::sync::{Arc, Mutex};
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

/// A request whose reply the driver gives.
struct Ask;

impl Leaf for Ask {
    fn ports() -> Vec<Port> {
        vec![Port::input::<String>("question"), Port::output::<i32>("reply")]
    }

    fn start(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
        Ok(Status::Running)
    }
}

#[test]
fn a_leaf_that_waits_for_a_reply_is_completed_by_its_driver() {
    let mut factory = Factory::new();
    factory.leaf("Ask", || Ask);
    let body = r#"<Ask question="how many" reply="{count}"/>"#;
    let mut tree = factory.load("test.xml", &file(body)).unwrap();
    assert_eq!(tree.tick(SECOND).unwrap(), Status::Running);
    let (run, since) = tree.running().next().unwrap();

    let mut cx = tree.leaf_context(run).unwrap();
    assert_eq!(cx.input::<String>("question").unwrap(), "how many");
    cx.output("reply", 3).unwrap();
    assert!(tree.complete(run, Status::Success));

    assert_eq!((tree.path(run.node), since), ("Ask::1", SECOND));
    assert_eq!(tree.next_tick(), Some(SECOND), "its answer changes something at once");
    assert_eq!(tree.tick(SECOND).unwrap(), Status::Success);
    assert_eq!(tree.value("count").unwrap().as_int(), Some(3));
}

#[test]
fn an_answer_for_an_earlier_start_is_not_taken_for_a_later_one() {
    let mut bench = Bench::new("A=R", "<A/>");
    bench.tick();
    let (first, _) = bench.tree.running().next().unwrap();
    bench.tree.halt(bench.now).unwrap();
    bench.tick();

    assert!(!bench.tree.complete(first, Status::Success));

    assert_eq!(bench.tick(), 'R');
}

#[test]
fn a_leaf_that_takes_too_long_is_halted_and_fails() {
    let mut bench = Bench::new("A=R Y=S", "<Fallback><A/><Y/></Fallback>");
    bench.tick();
    bench.calls();
    let (run, since) = bench.tree.running().next().unwrap();
    assert_eq!(since, Duration::ZERO);

    assert!(bench.tree.fail(run.node, bench.now));

    assert_eq!(bench.calls(), "A:halt");
    assert_eq!((bench.tick(), bench.calls()), ('S', "Y:tick:S".into()));
}

#[test]
fn a_leaf_that_is_tried_again_is_halted_and_started_while_its_parents_wait() {
    let mut bench = Bench::new("A=RRS Y=S", "<Sequence><A/><Y/></Sequence>");
    bench.tick();
    bench.calls();
    let (run, _) = bench.tree.running().next().unwrap();

    assert!(bench.tree.retry(run.node, bench.now));

    assert_eq!(bench.calls(), "A:halt");
    assert_eq!(bench.tree.next_tick(), Some(bench.now));
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:R".into()));
    assert_eq!((bench.tick(), bench.calls()), ('S', "A:run:S Y:tick:S".into()));
}

#[test]
fn a_leaf_is_failed_from_outside_by_its_path() {
    let trees = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><SubTree ID="Arm" name="left"/></BehaviorTree>
        <BehaviorTree ID="Arm"><Sequence><A name="reach"/></Sequence></BehaviorTree></root>"#;
    let (factory, _) = factory("A=R");
    let mut tree = factory.load("test.xml", trees).unwrap();
    tree.tick(Duration::ZERO).unwrap();

    let node = tree.find("left/reach").unwrap();
    assert!(tree.fail(node, SECOND));

    assert_eq!(tree.tick(SECOND).unwrap(), Status::Failure);
}

#[test]
fn changes_of_a_tick_are_text_and_a_tick_like_the_last_one_has_none() {
    let mut bench = Bench::new("C=SSF A=R", "<ReactiveSequence><C/><A/></ReactiveSequence>");

    bench.tick();
    let first =
        "C::2: IDLE -> SUCCESS\nA::3: IDLE -> RUNNING\nReactiveSequence::1: IDLE -> RUNNING\n";
    assert_eq!(bench.tree.changes_as_text(), first);
    bench.tick();
    assert_eq!(bench.tree.changes_as_text(), "");
    bench.tick();
    let last = "C::2: SUCCESS -> FAILURE\nA::3: RUNNING -> IDLE\nReactiveSequence::1: RUNNING -> FAILURE\n";
    assert_eq!(bench.tree.changes_as_text(), last);
    assert_eq!(bench.tree.changes().len(), 3);
}

#[test]
fn a_leafs_error_ends_the_tick_names_the_leaf_and_halts_nothing() {
    let body = r#"<Parallel success_count="2" failure_count="2"><A/><B/></Parallel>"#;
    let mut bench = Bench::new("A=R B=RXS", body);
    bench.tick();

    let error = bench.tree.tick(bench.now).unwrap_err();

    assert_eq!(error.to_string(), "B::3: the leaf has an error: the leaf's own");
    assert!(matches!(error.problem, TickProblem::Leaf(_)));
    assert_eq!(error.node, bench.tree.find("B::3").unwrap());
    bench.calls();
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:run:R B:run:S".into()));
}

#[test]
fn answers_that_a_leaf_may_not_give_are_errors() {
    for (leaf, answer) in [("Y", "R"), ("Y", "I"), ("C", "I"), ("A", "I"), ("A", "RI")] {
        let mut bench = Bench::new(&format!("{leaf}={answer}"), &format!("<{leaf}/>"));
        let answers = bench.ticks(answer.len());
        assert!(answers.ends_with('!'), "{leaf} {answer}: {answers}");
    }
}

#[test]
fn a_leaf_reads_and_writes_only_the_ports_that_it_declares() {
    let mut factory = Factory::new();
    let ports = [Port::input::<i32>("a").or("1"), Port::input::<i32>("b").optional()];
    factory.action("Use", ports, |cx| {
        assert_eq!(cx.input::<i32>("a")?, 1);
        assert_eq!(cx.optional_input::<i32>("b")?, None);
        let errors = [
            cx.input::<i32>("b").unwrap_err().to_string(),
            cx.input::<i32>("c").unwrap_err().to_string(),
            cx.output("d", 1).unwrap_err().to_string(),
            cx.input::<bool>("a").map(|_| "true").unwrap().to_owned(),
        ];
        assert_eq!(errors[0], "the port `b` is not given");
        assert_eq!(errors[1], "the leaf has no port `c`");
        assert_eq!(errors[2], "the leaf has no port `d`");
        Ok(Status::Success)
    });
    let mut tree = factory.load("test.xml", &file("<Use/>")).unwrap();

    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Success);
}

#[test]
fn a_port_whose_entry_has_no_value_or_another_one_is_an_error_with_both_names() {
    let mut factory = Factory::new();
    factory.condition("Is", [Port::input::<i32>("of")], |cx| {
        cx.input::<i32>("of")?;
        Ok(Status::Success)
    });
    let mut tree = factory.load("test.xml", &file(r#"<Is of="{x}"/>"#)).unwrap();

    let error = tree.tick(Duration::ZERO).unwrap_err();

    let text = "Is::1: the leaf has an error: the port `of` reads `x`, which has no value";
    assert_eq!(error.to_string(), text);
}

#[test]
fn nodes_are_listed_in_the_order_of_the_file_with_their_paths() {
    let trees = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><Sequence name="main">
            <SubTree ID="Arm" name="left"/><SubTree ID="Arm"/><A name="A"/><A/></Sequence></BehaviorTree>
        <BehaviorTree ID="Arm"><Inverter><A/></Inverter></BehaviorTree></root>"#;
    let (factory, _) = factory("A=R");
    let tree = factory.load("test.xml", trees).unwrap();

    let nodes: Vec<String> = tree
        .nodes()
        .map(|node| format!("{} {} {}", node.depth, node.path, node.type_name))
        .collect();

    let expected = [
        "0 main Sequence",
        "1 left Arm",
        "2 left/Inverter::3 Inverter",
        "3 left/A::4 A",
        "1 Arm::5 Arm",
        "2 Arm::5/Inverter::6 Inverter",
        "3 Arm::5/A::7 A",
        "1 A::8 A",
        "1 A::9 A",
    ];
    assert_eq!(nodes, expected);
}

#[test]
fn two_leaves_of_one_name_have_two_paths() {
    let body = r#"<Sequence><A name="go"/><A name="go"/></Sequence>"#;
    let bench = Bench::new("A=R", body);

    let paths: Vec<&str> = bench.tree.nodes().map(|node| node.path).collect();

    assert_eq!(paths, ["Sequence::1", "go", "go::3"]);
}

#[test]
fn a_leaf_that_is_completed_and_then_left_is_not_halted() {
    let mut bench = Bench::new("C=SF A=R", "<ReactiveSequence><C/><A/></ReactiveSequence>");
    bench.tick();
    let (run, _) = bench.tree.running().next().unwrap();
    assert!(bench.tree.complete(run, Status::Success));
    bench.calls();

    assert_eq!((bench.tick(), bench.calls()), ('F', "C:tick:F".into()));
}

/// An action that says when it comes to rest.
struct Brakes(Duration);

impl Leaf for Brakes {
    fn start(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
        Ok(Status::Running)
    }

    fn halt(&mut self, cx: &mut LeafContext<'_>) -> Halt {
        self.0 = cx.now() + SECOND;
        self.halting(cx)
    }

    fn halting(&mut self, cx: &mut LeafContext<'_>) -> Halt {
        if cx.now() >= self.0 {
            return Halt::Done;
        }
        cx.wake_at(self.0);
        Halt::Pending
    }
}

#[test]
fn a_leaf_that_comes_to_rest_asks_for_the_tick_in_which_it_does() {
    let (mut factory, calls) = factory("C=SF A=R");
    factory.leaf("Brakes", || Brakes(Duration::ZERO));
    let body = "<ReactiveFallback><Sequence><C/><Brakes/></Sequence><A/></ReactiveFallback>";
    let tree =
        factory.load("test.xml", &file(&body.replace("Sequence", "ReactiveSequence"))).unwrap();
    let mut bench = Bench { tree, calls, now: Duration::ZERO };
    assert_eq!(bench.tick(), 'R');
    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', Some(SECOND)));
    bench.calls();

    assert_eq!((bench.after(500), bench.calls()), ('R', "C:tick:F".into()));
    assert_eq!(bench.tree.next_tick(), Some(SECOND));
    assert_eq!((bench.after(500), bench.calls()), ('R', "C:tick:F A:start:R".into()));
}

#[test]
fn a_leaf_that_is_failed_while_it_comes_to_rest_fails_and_comes_to_rest() {
    let mut factory = Factory::new();
    factory.leaf("Brakes", || Brakes(Duration::ZERO));
    let mut tree = factory.load("test.xml", &file("<Brakes/>")).unwrap();
    tree.tick(Duration::ZERO).unwrap();
    let (run, _) = tree.running().next().unwrap();

    assert!(tree.fail(run.node, Duration::ZERO));

    assert_eq!(tree.halting().count(), 1);
    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Failure);
    assert_eq!(tree.halting().count(), 1);
    assert_eq!(tree.tick(SECOND).unwrap(), Status::Running);
    assert_eq!(tree.halting().count(), 0);
}

#[test]
fn a_failed_script_of_a_halt_is_an_error_and_all_nodes_are_halted() {
    let body =
        r#"<Parallel success_count="2" failure_count="2"><A _onHalted="n = 1"/><B/></Parallel>"#;
    let mut bench = Bench::new("A=R B=R", body);
    bench.tick();
    bench.calls();

    let error = bench.tree.halt(bench.now).unwrap_err();

    assert_eq!(error.path, "A::2");
    assert_eq!(bench.calls(), "A:halt B:halt");
    assert!(bench.tree.nodes().all(|node| node.status == Status::Idle));
}

#[test]
fn a_tree_without_nodes_is_skipped_and_trees_go_from_thread_to_thread() {
    fn goes<T: Send>(value: T) -> T {
        value
    }

    assert_eq!(goes(Tree::default()).tick(SECOND).unwrap(), Status::Skipped);
}

#[test]
fn a_leaf_that_failed_to_start_is_failed_by_its_driver_and_the_tree_goes_on() {
    let mut bench =
        Bench::new("Y=S B=X Z=S", "<Fallback><Sequence><Y/><B/></Sequence><Z/></Fallback>");
    let error = bench.tree.tick(bench.now).unwrap_err();
    bench.calls();

    assert!(bench.tree.fail(error.node, bench.now));
    let fallback = bench.tree.find("Fallback::1").unwrap();
    assert!(!bench.tree.fail(fallback, bench.now), "it is no leaf");

    assert_eq!((bench.tick(), bench.calls()), ('S', "Z:start:S".into()));
}

#[test]
fn a_leaf_uses_what_its_driver_lends_and_is_known_while_it_is_called() {
    let mut factory = Factory::new();
    factory.driven("Wait", []);
    factory.condition("IsLent", [], |cx| {
        let called = cx.lent::<Mutex<CalledLeaf>>().expect("the driver lends it").lock().unwrap();
        assert_eq!(called.node().map(|node| node == cx.run().node), Some(true));
        Ok(Status::Success)
    });
    let mut tree =
        factory.load("test.xml", &file("<Sequence><IsLent/><Wait/></Sequence>")).unwrap();
    let called = tree.called();
    tree.lend(Arc::new(Mutex::new(called.clone())));

    assert_eq!(tree.tick(SECOND).unwrap(), Status::Running);

    assert_eq!(called.node(), None);
    assert_eq!(factory.names().collect::<Vec<_>>(), ["IsLent", "Wait"]);
}
