//! What others fell into, each by the number of its report.

use crate::scripted::{Bench, factory, file};
use blastema_trees::{Factory, Halt, Leaf, LeafContext, LeafResult, Port, Status};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

/// BehaviorTree.CPP#652.
#[test]
fn a_reactive_sequence_whose_first_child_turns_running_halts_the_second_once_and_is_running() {
    let body = "<ReactiveSequence><A/><B/></ReactiveSequence>";
    let mut bench = Bench::new("A=SRRR B=R", body);

    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:S B:start:R".into()));
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:R B:halt".into()));
}

/// BehaviorTree.CPP#875.
#[test]
fn two_asynchronous_children_of_one_reactive_sequence_are_refused_at_load() {
    let (factory, _) = factory("Y=S");
    let child = "<AsyncSequence><Y/></AsyncSequence>";
    let body = format!("<ReactiveSequence>{child}{child}</ReactiveSequence>");

    let errors = factory.load("test.xml", &file(&body)).err().unwrap();

    let problems: Vec<_> = errors.iter().map(|error| &*error.problem).collect();
    assert_eq!(problems, ["a ReactiveSequence has at most one AsyncSequence as its child"]);
}

/// BehaviorTree.CPP#605.
#[test]
fn blanks_around_a_key_change_no_type() {
    let mut factory = Factory::new();
    factory.action("Write", [Port::output::<i32>("to")], |cx| {
        cx.output("to", 7)?;
        Ok(Status::Success)
    });
    factory.condition("IsSeven", [Port::input::<i32>("of")], |cx| {
        Ok(Status::from(cx.input::<i32>("of")? == 7))
    });
    let body = r#"<Sequence><Write to=" {x} "/><IsSeven of="{ x }"/></Sequence>"#;
    let mut tree = factory.load("test.xml", &file(body)).unwrap();

    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Success);

    assert_eq!(tree.value("x").unwrap().as_int(), Some(7));
    assert!(tree.set("x", 0.5).is_err(), "the entry is no longer an integer");
}

/// BehaviorTree.CPP#1192.
#[test]
fn the_roots_key_in_a_remap_is_read_written_and_created() {
    let trees = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><SubTree ID="Outer"/></BehaviorTree>
        <BehaviorTree ID="Outer"><SubTree ID="Inner" old="{@old}" new="{@new}"/></BehaviorTree>
        <BehaviorTree ID="Inner"><Sequence>
            <ScriptCondition code="old == 1"/>
            <Script code="old = 2; new := 3"/>
        </Sequence></BehaviorTree>
    </root>"#;
    let mut tree = Factory::new().load("test.xml", trees).unwrap();
    tree.set("old", 1).unwrap();

    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Success);

    assert_eq!(tree.value("old").unwrap().as_int(), Some(2));
    assert_eq!(tree.value("new").unwrap().as_int(), Some(3));
    assert_eq!(tree.value("@new").unwrap().as_int(), Some(3));
}

/// navigation2#4004.
#[test]
fn a_remapped_key_exists_through_each_level_of_subtrees_before_the_first_tick() {
    let mut factory = Factory::new();
    factory.action("Use", [Port::input::<f64>("value")], |_| Ok(Status::Success));
    let trees = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><SubTree ID="Outer" outer="{speed}"/></BehaviorTree>
        <BehaviorTree ID="Outer"><SubTree ID="Inner" inner="{outer}"/></BehaviorTree>
        <BehaviorTree ID="Inner"><Use value="{inner}"/></BehaviorTree>
    </root>"#;

    let mut tree = factory.load("test.xml", trees).unwrap();

    assert!(tree.has_key("speed"));
    // It has the port's type as well.
    assert!(tree.set("speed", "fast".to_owned()).is_err());
    assert!(tree.set("speed", 1).is_ok());
}

/// An action that comes to rest when it is told to.
struct Slow(Arc<AtomicBool>);

impl Leaf for Slow {
    fn start(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
        Ok(Status::Running)
    }

    fn halt(&mut self, cx: &mut LeafContext<'_>) -> Halt {
        self.halting(cx)
    }

    fn halting(&mut self, _: &mut LeafContext<'_>) -> Halt {
        if self.0.load(Ordering::Relaxed) { Halt::Done } else { Halt::Pending }
    }
}

/// BehaviorTree.CPP#1117.
#[test]
fn an_action_takes_several_ticks_to_halt_and_nothing_new_starts_meanwhile() {
    let (mut factory, calls) = factory("C=SFFFFF A=RS Y=S");
    let rests = Arc::new(AtomicBool::new(false));
    let shared = rests.clone();
    factory.leaf("Slow", move || Slow(shared.clone()));
    let body = "<ReactiveFallback><ReactiveSequence><C/><Slow/></ReactiveSequence>
        <Sequence><Y/><A/></Sequence></ReactiveFallback>";
    let tree = factory.load("test.xml", &file(body)).unwrap();
    let mut bench = Bench { tree, calls, now: Duration::ZERO };
    assert_eq!((bench.tick(), bench.calls()), ('R', "C:tick:S".into()));

    // The condition fails: the slow action is halted, and the other branch has to wait.
    assert_eq!((bench.tick(), bench.calls()), ('R', "C:tick:F".into()));
    assert_eq!(bench.tree.halting().count(), 1);
    assert_eq!((bench.tick(), bench.calls()), ('R', "C:tick:F".into()));

    rests.store(true, Ordering::Relaxed);
    assert_eq!((bench.tick(), bench.calls()), ('R', "C:tick:F Y:tick:S A:start:R".into()));
    assert_eq!(bench.tree.halting().count(), 0);
    assert_eq!((bench.tick(), bench.calls()), ('S', "C:tick:F A:run:S".into()));
}

#[test]
fn the_driver_can_end_a_halt_and_a_tree_is_halted_while_a_leaf_comes_to_rest() {
    let (mut factory, _) = factory("");
    factory.leaf("Slow", || Slow(Arc::default()));
    let mut tree = factory.load("test.xml", &file("<Slow/>")).unwrap();
    tree.tick(Duration::ZERO).unwrap();
    let (run, _) = tree.running().next().unwrap();

    tree.halt(Duration::ZERO).unwrap();

    assert_eq!(tree.halting().count(), 1);
    // It is to start again, and waits for itself.
    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Running);
    assert_eq!(tree.running().count(), 0);
    assert!(tree.complete(run, Status::Failure));
    assert_eq!(tree.halting().count(), 0);
    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Running);
    assert_eq!(tree.running().count(), 1);

    // Or it drops what does not come to rest, and knows since when.
    let second = Duration::from_secs(1);
    tree.halt(second).unwrap();
    assert_eq!(tree.halting().map(|(_, since)| since).collect::<Vec<_>>(), [second]);
    tree.drop_halting();
    assert_eq!(tree.halting().count(), 0);
    assert_eq!(tree.tick(second).unwrap(), Status::Running);
    assert_eq!(tree.running().count(), 1);
}

/// BehaviorTree.CPP#1057.
#[test]
fn a_leafs_panic_names_its_node_and_the_tree_is_halted_and_shows_it() {
    let body = r#"<Parallel success_count="2" failure_count="2"><A/><B name="grip"/></Parallel>"#;
    let mut bench = Bench::new("A=R B=RP", body);
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:R grip:start:R".into()));

    let panic = catch_unwind(AssertUnwindSafe(|| bench.tick()));

    assert!(panic.is_err());
    let node = bench.tree.called().node().unwrap();
    assert_eq!(bench.tree.path(node), "grip");
    let now = bench.now;
    bench.calls();
    bench.tree.halt(now).unwrap();
    assert_eq!(bench.calls(), "A:halt");
    assert_eq!(bench.tree.called().node(), None);
    assert!(bench.tree.nodes().all(|node| node.status == Status::Idle));
    let changes = bench.tree.changes_as_text();
    assert_eq!(
        changes,
        "A::2: RUNNING -> IDLE\ngrip: RUNNING -> IDLE\nParallel::1: RUNNING -> IDLE\n"
    );
    // Its next start has a new value, which begins its answers from the first one.
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:R grip:start:R".into()));
}

#[test]
fn a_leaf_that_has_panicked_fails_in_the_next_tick_where_the_tree_goes_on() {
    let mut bench = Bench::new("A=RP Y=S", "<Fallback><A/><Y/></Fallback>");
    assert_eq!(bench.tick(), 'R');
    assert!(catch_unwind(AssertUnwindSafe(|| bench.tick())).is_err());
    bench.calls();

    assert_eq!((bench.tick(), bench.calls()), ('S', "Y:tick:S".into()));
}

#[test]
fn a_panic_while_halting_is_named_too() {
    struct Falls(Arc<AtomicU32>);
    impl Leaf for Falls {
        fn start(&mut self, _: &mut LeafContext<'_>) -> LeafResult {
            Ok(Status::Running)
        }
        fn halt(&mut self, _: &mut LeafContext<'_>) -> Halt {
            self.0.fetch_add(1, Ordering::Relaxed);
            panic!("its own");
        }
    }
    let halts = Arc::new(AtomicU32::new(0));
    let shared = halts.clone();
    let mut factory = Factory::new();
    factory.leaf("Falls", move || Falls(shared.clone()));
    let mut tree = factory.load("test.xml", &file("<Falls/>")).unwrap();
    tree.tick(Duration::ZERO).unwrap();

    assert!(catch_unwind(AssertUnwindSafe(|| tree.halt(Duration::ZERO))).is_err());

    assert_eq!(tree.path(tree.called().node().unwrap()), "Falls::1");
    tree.halt(Duration::ZERO).unwrap();
    assert_eq!(halts.load(Ordering::Relaxed), 1, "it is not asked again");
    assert_eq!(tree.tick(Duration::ZERO).unwrap(), Status::Running);
}
