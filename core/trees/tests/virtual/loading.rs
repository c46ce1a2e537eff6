//! Errors of files: all at once, each with its place and the nearest right spelling.

use crate::scripted::{Bench, factory, file};
use blastema_trees::{Factory, Port, Status, TreeErrors};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

#[track_caller]
fn errors(text: &str) -> TreeErrors {
    let (mut factory, _) = factory("Wait=S Move=S");
    factory.action("Turn", [Port::input::<f64>("angle"), Port::output::<i32>("steps")], |_| {
        Ok(Status::Success)
    });
    factory.load("test.xml", text).err().unwrap()
}

/// The problems of the tree with this outermost node, with their places in the line.
#[track_caller]
fn problems(body: &str) -> Vec<String> {
    let before = file("").find("</Beh").unwrap();
    errors(&file(body))
        .iter()
        .map(|error| {
            let hint = error.suggestion.as_ref().map(|hint| format!(" ({hint})"));
            format!("{}: {}{}", error.column - before, error.problem, hint.unwrap_or_default())
        })
        .collect()
}

#[test]
fn all_errors_of_a_file_are_shown_with_line_column_excerpt_and_the_nearest_spelling() {
    let text = r#"<root BTCPP_format="4">
  <BehaviorTree ID="Main">
    <Sequnce>
      <Turn angel="1.5"/>
      <Inverter><Wait/><Move/></Inverter>
      <Wait _skipIf="a &amp;&amp;"/>
    </Sequnce>
  </BehaviorTree>
</root>"#;

    let shown = errors(text).to_string();

    let expected = r#"test.xml:3:5: no type of node is called `Sequnce`; did you mean `Sequence`?
  3 |     <Sequnce>
    |     ^
test.xml:4:13: `Turn` has no port `angel`; did you mean `angle`?
  4 |       <Turn angel="1.5"/>
    |             ^
test.xml:4:7: `Turn` needs the port `angle`
  4 |       <Turn angel="1.5"/>
    |       ^
test.xml:5:7: `Inverter` has 2 children instead of 1
  5 |       <Inverter><Wait/><Move/></Inverter>
    |       ^
test.xml:6:34: expected a value
  6 |       <Wait _skipIf="a &amp;&amp;"/>
    |                                  ^"#;
    assert_eq!(shown, expected);
}

#[test]
fn unknown_nodes_are_named() {
    assert_eq!(problems("<Wate/>"), ["1: no type of node is called `Wate` (Wait)"]);
    assert_eq!(problems("<Unheard/>"), ["1: no type of node is called `Unheard`"]);
    assert_eq!(problems(r#"<Action ID="wait"/>"#), ["13: no type of node is called `wait` (Wait)"]);
    assert_eq!(
        problems("<Main/>"),
        ["1: no type of node is called `Main` (<SubTree ID=\"Main\"/>)"]
    );
    assert_eq!(problems("<Action/>"), ["1: <Action> needs the attribute `ID`"]);
    assert_eq!(problems("<SubTree/>"), ["1: <SubTree> needs the attribute `ID`"]);
    let unknown = ["14: no tree is called `Mian` (Main)"];
    assert_eq!(problems(r#"<SubTree ID="Mian"/>"#), unknown);
    assert_eq!(problems(r#"<Wait ID="x"/>"#), ["7: `Wait` has no port `ID`"]);
    let old = "1: no type of node is called `RetryUntilSuccesful` (RetryUntilSuccessful)";
    assert_eq!(problems("<RetryUntilSuccesful/>"), [old]);
}

#[test]
fn ports_are_checked() {
    let cases = [
        (r#"<Turn angle="fast"/>"#, "14: `fast` is no double"),
        (r#"<Turn angle="1x"/>"#, "14: `1x` is no double"),
        (r#"<Turn angle="{}"/>"#, "14: `` is no name of an entry"),
        (r#"<Turn angle="{@a@b}"/>"#, "14: `@a@b` is no name of an entry"),
        (
            r#"<Turn angle="1" steps="2"/>"#,
            "24: `2` is no key in braces, to which the node could write",
        ),
        (r#"<Turn/>"#, "1: `Turn` needs the port `angle`"),
        (r#"<Repeat><Wait/></Repeat>"#, "1: `Repeat` needs the port `num_cycles`"),
        (r#"<Sleep msec="-1"/>"#, "14: `-1` is no unsigned int"),
        (r#"<RunOnce then_skip="yes"><Wait/></RunOnce>"#, "21: `yes` is no bool"),
        (
            r#"<Precondition if="1" else="IDLE"><Wait/></Precondition>"#,
            "28: `IDLE` is no BT::NodeStatus",
        ),
        (r#"<Script code="{x}"/>"#, "15: a script is not taken from an entry"),
        (r#"<Wait _skipIf="{x}"/>"#, "16: a script is not taken from an entry"),
        (r#"<Wait _skipif="x"/>"#, "7: `_skipif` is no condition of a node (_skipIf)"),
        (r#"<SubTree ID="Main" _autoremap="maybe"/>"#, "32: `maybe` is no bool"),
    ];
    for (body, expected) in cases {
        let found = problems(body);
        assert!(found.iter().any(|problem| problem == expected), "{body}: {found:?}");
    }
}

#[test]
fn numbers_of_children_are_checked() {
    let cases = [
        ("<Sequence/>", "`Sequence` has 0 children instead of at least 1"),
        ("<Wait><Move/></Wait>", "`Wait` has 1 children instead of 0"),
        ("<Inverter/>", "`Inverter` has 0 children instead of 1"),
        ("<IfThenElse><Wait/></IfThenElse>", "`IfThenElse` has 1 children instead of 2 to 3"),
        ("<Switch2><Wait/></Switch2>", "`Switch2` has 1 children instead of 3"),
        ("<TryCatch><Wait/></TryCatch>", "`TryCatch` has 1 children instead of at least 2"),
        (
            r#"<Parallel success_count="3"><Wait/><Move/></Parallel>"#,
            "a threshold of 3 with 2 children",
        ),
    ];
    for (body, expected) in cases {
        assert_eq!(problems(body), [format!("1: {expected}")]);
    }
    let nested = problems(r#"<SubTree ID="Main"><Wait/></SubTree>"#);
    assert!(nested.contains(&"1: `SubTree` has 1 children instead of 0".into()), "{nested:?}");
}

#[test]
fn circles_of_subtrees_are_errors() {
    let text = r#"<root main_tree_to_execute="A">
<BehaviorTree ID="A"><Sequence><Wait/><SubTree ID="B"/></Sequence></BehaviorTree>
<BehaviorTree ID="B"><SubTree ID="C"/></BehaviorTree>
<BehaviorTree ID="C"><Inverter><SubTree ID="B"/></Inverter></BehaviorTree></root>"#;

    let errors = errors(text);

    let found: Vec<String> =
        errors.iter().map(|error| format!("{}: {}", error.line, error.problem)).collect();
    assert_eq!(found, ["4: a circle: B -> C -> B"]);
}

/// Loads `main.xml` of these files.
fn load(files: &[(&str, &str)]) -> Result<usize, String> {
    let files: BTreeMap<&str, &str> = files.iter().copied().collect();
    let mut include = |path: &str| match files.get(path) {
        Some(text) => Ok((*text).to_owned()),
        None => Err("no such file".to_owned()),
    };
    let tree = Factory::new().load_with("main.xml", files["main.xml"], Some("Main"), &mut include);
    tree.map(|tree| tree.nodes().count()).map_err(|errors| {
        errors.iter().map(|e| format!("{}: {}", e.file, e.problem)).collect::<Vec<_>>().join("; ")
    })
}

#[test]
fn files_are_included_relative_to_the_one_that_includes_them_and_once() {
    let tree = |id: &str, inner: &str| format!("<BehaviorTree ID=\"{id}\">{inner}</BehaviorTree>");
    let main = format!(
        r#"<root><include path="lib/a.xml"/><include path="./lib/../lib/b.xml"/>{}</root>"#,
        tree("Main", "<Sequence><SubTree ID=\"A\"/><SubTree ID=\"B\"/></Sequence>")
    );
    let a = format!(r#"<root><include path="b.xml"/>{}</root>"#, tree("A", "<AlwaysSuccess/>"));
    let b = format!("<root>{}</root>", tree("B", "<AlwaysSuccess/>"));

    assert_eq!(load(&[("main.xml", &main), ("lib/a.xml", &a), ("lib/b.xml", &b)]), Ok(5));
}

#[test]
fn circles_of_files_and_files_that_are_not_there_are_errors() {
    let main = r#"<root><include path="a.xml"/><BehaviorTree ID="Main"><AlwaysSuccess/></BehaviorTree></root>"#;
    let a = r#"<root><include path="./main.xml"/></root>"#;

    let circle = load(&[("main.xml", main), ("a.xml", a)]);
    assert_eq!(circle, Err("a.xml: a circle: main.xml -> a.xml -> main.xml".into()));
    let itself = load(&[("main.xml", &main.replace("a.xml", "main.xml"))]);
    assert_eq!(itself, Err("main.xml: a circle: main.xml -> main.xml".into()));
    assert_eq!(
        load(&[("main.xml", main)]),
        Err("main.xml: cannot include `a.xml`: no such file".into())
    );
    let nameless = load(&[("main.xml", &main.replace(" path=\"a.xml\"", ""))]);
    assert_eq!(nameless, Err("main.xml: <include> needs the attribute `path`".into()));
}

#[test]
fn a_chain_of_files_without_end_ends() {
    let mut count = 0;
    let mut include = |_: &str| {
        count += 1;
        Ok(format!("<root><include path=\"{count}.xml\"/></root>"))
    };
    let text = "<root><include path=\"0.xml\"/></root>";

    let errors = Factory::new().load_with("main.xml", text, None, &mut include).err().unwrap();

    assert!(errors.to_string().contains("more than 256 files"), "{errors}");

    // So is a file that includes as many others.
    let includes: String = (0..300).map(|file| format!("<include path=\"{file}.xml\"/>")).collect();
    let mut include = |_: &str| Ok("<root/>".to_owned());
    let text = format!("<root>{includes}</root>");
    let errors = Factory::new().load_with("main.xml", &text, None, &mut include).err().unwrap();
    assert!(errors.to_string().contains("more than 256 files"), "{errors}");
}

#[test]
fn trees_have_names_of_their_own_and_one_is_the_main_tree() {
    let two = |ids: [&str; 2], main: &str| {
        let trees = ids.map(|id| format!("<BehaviorTree{id}><AlwaysSuccess/></BehaviorTree>"));
        let text = format!("<root{main}>{}</root>", trees.concat());
        match Factory::new().load("test.xml", &text) {
            Ok(_) => "loaded".to_owned(),
            Err(errors) => errors.iter().next().unwrap().problem.to_string(),
        }
    };
    assert_eq!(two([" ID=\"A\"", " ID=\"B\""], " main_tree_to_execute=\"B\""), "loaded");
    assert_eq!(
        two([" ID=\"A\"", " ID=\"B\""], " main_tree_to_execute=\"C\""),
        "no tree is called `C`"
    );
    let unsaid = "<root> needs the attribute `main_tree_to_execute`";
    assert_eq!(two([" ID=\"A\"", " ID=\"B\""], ""), unsaid);
    assert_eq!(two([" ID=\"A\"", " ID=\"A\""], ""), "the name `A` is taken");
    assert_eq!(two([" ID=\"A\"", " ID=\"Sequence\""], ""), "the name `Sequence` is taken");
    assert_eq!(two([" ID=\"A\"", ""], ""), "<BehaviorTree> needs the attribute `ID`");
    assert_eq!(two([" ID=\"A\"", " ID=\"a b\""], ""), "`a b` cannot be the name of a tree");
    assert_eq!(two([" ID=\"A\"", " ID=\"root\""], ""), "`root` cannot be the name of a tree");
}

#[test]
fn what_is_no_tree_file_is_refused() {
    let cases = [
        ("<root><BehaviorTree></root>", "1:21: no XML: "),
        ("<tree/>", "1:1: <tree> has no meaning here\n"),
        ("<root/>", "1:1: `root` has 0 children instead of at least 1"),
        (
            "<root BTCPP_format=\"3\"><BehaviorTree><AlwaysSuccess/></BehaviorTree></root>",
            "1:21: `3` is no format that is read here; it is 4",
        ),
        (
            "<root>\n<BehaviourTree/></root>",
            "2:1: <BehaviourTree> has no meaning here; did you mean `BehaviorTree`?",
        ),
        (
            "<root><TreeNodeModel/></root>",
            "1:7: <TreeNodeModel> has no meaning here; did you mean `TreeNodesModel`?",
        ),
        ("<root><BehaviorTree/></root>", "1:7: `BehaviorTree` has 0 children instead of 1"),
        ("", "1:1: no XML: the document does not have a root node\n  1 | \n    | ^"),
    ];
    for (text, expected) in cases {
        let shown = errors(text).to_string();
        assert!(shown.starts_with(&format!("test.xml:{expected}")), "{text}: {shown}");
    }
}

#[test]
fn ports_of_one_entry_have_one_type() {
    let found = problems(r#"<Sequence><Sleep msec="{x}"/><Turn angle="{x}"/></Sequence>"#);
    assert_eq!(found, ["43: the entry `x` is of type unsigned int already, and not double"]);

    // The library's exception: what is first a text is read as anything.
    let body = r#"<Sequence><UnsetBlackboard key="{x}"/><Sleep msec="{x}"/></Sequence>"#;
    assert!(Factory::new().load("test.xml", &file(body)).is_ok());
}

#[test]
fn a_type_clash_across_subtrees_is_found_before_the_first_tick() {
    let text = r#"<root main_tree_to_execute="Main">
<BehaviorTree ID="Main"><Sequence><Sleep msec="{x}"/><SubTree ID="T" y="{x}"/></Sequence></BehaviorTree>
<BehaviorTree ID="T"><Turn angle="{y}"/></BehaviorTree></root>"#;

    let shown = errors(text).to_string();

    let expected = "test.xml:3:35: the entry `y` is of type unsigned int already, and not double";
    assert!(shown.starts_with(expected), "{shown}");
}

#[test]
fn subtrees_are_given_the_ports_of_their_models_and_have_different_paths() {
    let text = |attributes: &str, other: &str| {
        format!(
            r#"<root main_tree_to_execute="Main"><BehaviorTree ID="Main"><Sequence>
<SubTree ID="T" {attributes}/>{other}</Sequence></BehaviorTree>
<BehaviorTree ID="T"><AlwaysSuccess/></BehaviorTree>
<TreeNodesModel><SubTree ID="T"><input_port name="goal"/></SubTree></TreeNodesModel></root>"#
        )
    };
    let factory = Factory::new();

    let missing = factory.load("test.xml", &text("", "")).err().unwrap().to_string();
    assert!(missing.starts_with("test.xml:2:1: `T` needs the port `goal`"), "{missing}");
    assert!(factory.load("test.xml", &text("_autoremap=\"true\"", "")).is_ok());
    assert!(factory.load("test.xml", &text("goal=\"{g}\"", "")).is_ok());
    let same = "<SubTree ID=\"T\" goal=\"1\" name=\"arm\"/>";
    let twice = text("goal=\"1\" name=\"arm\"", same);
    let twice = factory.load("test.xml", &twice).err().unwrap().to_string();
    assert!(twice.contains("the name `arm` is taken"), "{twice}");
}

#[test]
fn what_editors_write_is_ignored() {
    let body =
        r#"<Sequence _uid="1" _fullpath="x" _description="y"><AlwaysSuccess _x="{"/></Sequence>"#;

    assert!(Factory::new().load("test.xml", &file(body)).is_ok());
}

#[test]
fn explicit_and_compact_elements_are_the_same() {
    let (factory, _) = factory("C=S A=S");
    let body = r#"<Control ID="Sequence"><Condition ID="C"/><Action ID="A" name="go"/>
        <Decorator ID="Inverter"><Condition ID="AlwaysFailure"/></Decorator></Control>"#;

    let tree = factory.load("test.xml", &file(body)).unwrap();

    let types: Vec<&str> = tree.nodes().map(|node| node.type_name).collect();
    assert_eq!(types, ["Sequence", "C", "A", "Inverter", "AlwaysFailure"]);
}

#[test]
fn hostile_files_are_refused_without_a_crash() {
    let nested = |depth: usize| {
        file(&format!(
            "{}<AlwaysSuccess/>{}",
            "<Inverter>".repeat(depth),
            "</Inverter>".repeat(depth)
        ))
    };
    assert!(Factory::new().load("test.xml", &nested(255)).is_ok());
    for depth in [256, 300, 3_000] {
        let shown = errors(&nested(depth)).to_string();
        assert!(shown.contains("more than 256"), "{depth}: {shown}");
    }

    // Each level doubles the nodes.
    let levels: String = (0..18)
        .map(|level| {
            let inner = format!("<SubTree ID=\"T{}\"/>", level + 1);
            format!(
                "<BehaviorTree ID=\"T{level}\"><Sequence>{inner}{inner}</Sequence></BehaviorTree>"
            )
        })
        .collect();
    let last = "<BehaviorTree ID=\"T18\"><AlwaysSuccess/></BehaviorTree>";
    let text = format!("<root main_tree_to_execute=\"T0\">{levels}{last}</root>");
    assert!(errors(&text).to_string().contains("more than 65,535 nodes"));

    // So are long names.
    let text = text.replace("<Sequence>", &format!("<Sequence name=\"{}\">", "x".repeat(10_000)));
    assert!(errors(&text).to_string().contains("more than 16 MiB"));

    // So are the defaults of subtrees.
    let levels: String = (0..10)
        .map(|level| {
            let inner = format!("<SubTree ID=\"T{}\"/>", level + 1).repeat(2);
            format!("<BehaviorTree ID=\"T{level}\"><Sequence>{inner}</Sequence></BehaviorTree>")
        })
        .collect();
    let port = format!("<input_port name=\"p\" default=\"{}\"/>", "x".repeat(100_000));
    let text = format!(
        "<root main_tree_to_execute=\"T0\">{levels}{}<TreeNodesModel><SubTree ID=\"T10\">{port}\
         </SubTree></TreeNodesModel></root>",
        last.replace("T18", "T10")
    );
    assert!(errors(&text).to_string().contains("more than 16 MiB"));

    // A chain of trees is nested as deep as their nodes.
    let chain: String = (0..1_000)
        .map(|level| {
            format!("<BehaviorTree ID=\"T{level}\"><SubTree ID=\"T{}\"/></BehaviorTree>", level + 1)
        })
        .collect();
    let text =
        format!("<root main_tree_to_execute=\"T0\">{chain}{}</root>", last.replace("T18", "T1000"));
    assert!(errors(&text).to_string().contains("more than 256 nodes"));

    assert!(errors(&" ".repeat(5 << 20)).to_string().contains("more than 4 MiB"));
    let many = "<Unknown/>".repeat(1_000);
    assert_eq!(errors(&file(&format!("<Sequence>{many}</Sequence>"))).iter().count(), 100);
}

#[test]
fn wrong_registrations_are_mistakes_of_the_program() {
    let registers = |name: &'static str, ports: Vec<Port>| {
        std::panic::catch_unwind(move || {
            Factory::new().condition(name, ports, |_| Ok(Status::Success));
        })
        .is_ok()
    };

    assert!(registers("Fine", vec![Port::input::<i32>("a").or("{b}")]));
    assert!(!registers("Sequence", vec![]));
    assert!(!registers("a b", vec![]));
    assert!(!registers("Leaf", vec![Port::input::<i32>("name")]));
    assert!(!registers("Leaf", vec![Port::input::<i32>("_a")]));
    assert!(!registers("Leaf", vec![Port::input::<i32>("a"), Port::output::<i32>("a")]));
    assert!(!registers("Leaf", vec![Port::input::<i32>("a").or("one")]));
}

#[test]
fn a_plain_tree_of_lost_communication_loads_as_written_and_only_a_reactive_one_looks_again() {
    let (mut factory, calls) = factory("TeleoperatedMission=R AutonomousSafeReturn=R");
    let ports = [Port::input::<String>("topic_name"), Port::input::<f64>("timeout_sec").or("3.0")];
    let connected = Arc::new(AtomicBool::new(true));
    let shared = connected.clone();
    factory.condition("IsCommsConnected", ports, move |cx| {
        assert_eq!(cx.input::<String>("topic_name")?, "/operator/heartbeat");
        assert_eq!(cx.input::<f64>("timeout_sec")?, 3.0);
        Ok(Status::from(shared.load(Ordering::Relaxed)))
    });
    let tree = r#"<BehaviorTree ID="CommsAwareOperation">
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
</BehaviorTree>"#;
    let run = |tree: String| {
        connected.store(true, Ordering::Relaxed);
        let tree = factory.load("test.xml", &format!("<root>{tree}</root>")).unwrap();
        let mut bench = Bench { tree, calls: calls.clone(), now: Duration::ZERO };
        bench.tick();
        connected.store(false, Ordering::Relaxed);
        bench.tick();
        bench.calls()
    };

    let plain = "TeleoperatedMission:start:R TeleoperatedMission:run:R";
    assert_eq!(run(tree.into()), plain, "a plain sequence goes on with its mission");
    let right =
        tree.replace("Sequence", "ReactiveSequence").replace("Fallback", "ReactiveFallback");
    let reactive =
        "TeleoperatedMission:start:R TeleoperatedMission:halt AutonomousSafeReturn:start:R";
    assert_eq!(run(right), reactive);
}
