//! The blackboard: types, remapping, literals, and the leaves that write it.

use crate::scripted::{Bench, file};
use blastema_trees::{Factory, Port, PortType, PortValue, Status, Tree, Value};
use std::time::Duration;

/// A main tree with a subtree `T`.
#[track_caller]
fn with_subtree(main: &str, subtree: &str) -> Tree {
    let text = format!(
        r#"<root main_tree_to_execute="Main"><BehaviorTree ID="Main">{main}</BehaviorTree>
        <BehaviorTree ID="T">{subtree}</BehaviorTree></root>"#
    );
    Factory::new().load("test.xml", &text).unwrap()
}

fn tick(tree: &mut Tree) -> String {
    match tree.tick(Duration::ZERO) {
        Ok(status) => status.to_string(),
        Err(error) => error.to_string(),
    }
}

#[test]
fn a_subtree_sees_only_what_is_remapped() {
    let script = r#"<Script code="a := 1"/>"#;
    let main =
        |attributes: &str| format!("<Sequence>{script}<SubTree ID=\"T\" {attributes}/></Sequence>");
    let inner = r#"<ScriptCondition code="a == 1"/>"#;

    let unseen = tick(&mut with_subtree(&main(""), inner));
    assert!(unseen.ends_with("fails: the entry `a` has no value"), "{unseen}");
    assert_eq!(tick(&mut with_subtree(&main(r#"a="{a}""#), inner)), "SUCCESS");
    assert_eq!(tick(&mut with_subtree(&main(r#"a="{=}""#), inner)), "SUCCESS");
    assert_eq!(tick(&mut with_subtree(&main(r#"_autoremap="true""#), inner)), "SUCCESS");
    assert_eq!(
        tick(&mut with_subtree(&main(""), r#"<ScriptCondition code="@a == 1"/>"#)),
        "SUCCESS"
    );
}

#[test]
fn what_a_subtree_creates_is_the_parents_where_it_is_remapped() {
    let inner = r#"<Script code="mine := 1; shared := 2; _own := 3"/>"#;
    let mut mapped = with_subtree(r#"<SubTree ID="T" shared="{outer}"/>"#, inner);
    tick(&mut mapped);
    assert_eq!(mapped.value("outer").unwrap().as_int(), Some(2));
    assert!(!mapped.has_key("mine") && !mapped.has_key("shared"));

    let mut auto = with_subtree(r#"<SubTree ID="T" _autoremap="1"/>"#, inner);
    tick(&mut auto);
    assert!(auto.has_key("mine") && auto.has_key("shared") && !auto.has_key("_own"));
}

#[test]
fn a_literal_of_a_subtree_is_a_number_where_the_whole_text_is_one_and_of_open_type() {
    let checks =
        r#"<ScriptCondition code="i + 1 == 8 &amp;&amp; r == 0.5 &amp;&amp; t == '1;2'"/>"#;
    let mut tree = with_subtree(r#"<SubTree ID="T" i="7" r="5e-1" t="1;2"/>"#, checks);
    assert_eq!(tick(&mut tree), "SUCCESS");

    let mut factory = Factory::new();
    factory.condition("Fast", [Port::input::<f64>("speed")], |cx| {
        Ok(Status::from(cx.input::<f64>("speed")? > 0.5))
    });
    let text = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><SubTree ID="T" v="1"/></BehaviorTree>
        <BehaviorTree ID="T"><Fast speed="{v}"/></BehaviorTree></root>"#;
    assert_eq!(tick(&mut factory.load("test.xml", text).unwrap()), "SUCCESS");
}

#[test]
fn a_literal_is_local_also_where_all_keys_are_remapped() {
    let main = r#"<Sequence><Script code="c := 1"/><SubTree ID="T" c="7" _autoremap="true"/>
        <ScriptCondition code="c == 1 &amp;&amp; d == 7"/></Sequence>"#;
    let mut tree = with_subtree(main, r#"<Script code="d := c; c = 8"/>"#);

    assert_eq!(tick(&mut tree), "SUCCESS");
}

#[test]
fn models_of_subtrees_give_defaults() {
    let text = r#"<root main_tree_to_execute="Main">
        <BehaviorTree ID="Main"><Sequence><Script code="k := 5"/>
            <SubTree ID="T" b="{k}"/></Sequence></BehaviorTree>
        <BehaviorTree ID="T"><ScriptCondition code="a == 1 &amp;&amp; b == 5 &amp;&amp; c == 5"/></BehaviorTree>
        <TreeNodesModel><SubTree ID="T">
            <input_port name="a" default="1"/><input_port name="b"/>
            <inout_port name="c" default="{k}"/></SubTree></TreeNodesModel></root>"#;

    assert_eq!(tick(&mut Factory::new().load("test.xml", text).unwrap()), "SUCCESS");
}

#[test]
fn an_entry_keeps_its_type() {
    let mut tree = Factory::new().load("test.xml", &file("<AlwaysSuccess/>")).unwrap();

    tree.set("int", 1).unwrap();
    assert!(tree.set("int", 2.0).is_ok() && tree.set("int", "3".to_owned()).is_ok());
    assert_eq!(tree.value("int").unwrap().as_int(), Some(3));
    assert!(tree.set("int", 2.5).is_err() && tree.set("int", "x".to_owned()).is_err());

    // The first text leaves the type open, and the next value sets it.
    tree.set("open", "a".to_owned()).unwrap();
    tree.set("open", 1.5).unwrap();
    assert!(tree.set("open", "b".to_owned()).is_err());

    tree.set("flag", true).unwrap();
    assert!(tree.set("flag", 2).is_err() && tree.set("flag", 0).is_ok());
}

#[test]
fn set_blackboard_copies_values_and_texts_to_the_entry_that_it_names() {
    let body = r#"<Sequence><SetBlackboard value="{from}" output_key="to"/>
        <SetBlackboard value="42" output_key="text"/><ScriptCondition code="text == 42"/>
        <Script code="name := 'named'"/><SetBlackboard value="9" output_key="{name}"/></Sequence>"#;
    let mut bench = Bench::new("", body);
    assert_eq!(bench.tick(), 'F', "an entry without a value is not copied");
    bench.tree.set("from", 1.5).unwrap();

    assert_eq!(bench.tick(), 'S');

    assert_eq!(bench.tree.value("to").unwrap().as_real(), Some(1.5));
    assert!(bench.tree.set("to", "x".to_owned()).is_err(), "the type is copied too");
    assert_eq!(bench.tree.value("named").unwrap().to_string(), "9");
}

#[test]
fn set_blackboard_under_an_unset_name_or_of_a_wrong_type_is_an_error() {
    let mut bench = Bench::new("", r#"<SetBlackboard value="1" output_key="{name}"/>"#);
    let error = bench.tree.tick(bench.now).unwrap_err().to_string();
    assert_eq!(error, "SetBlackboard::1: the port `output_key` reads `name`, which has no value");

    let mut bench = Bench::new("", r#"<SetBlackboard value="x" output_key="n"/>"#);
    bench.tree.set("n", 1).unwrap();
    let error = bench.tree.tick(bench.now).unwrap_err().to_string();
    assert_eq!(error, "SetBlackboard::1: the port `value` is `x`, which is no int");
}

#[test]
fn unset_blackboard_erases_only_what_its_own_board_has() {
    let body = r#"<Sequence><Script code="a := 1"/><UnsetBlackboard key="a"/></Sequence>"#;
    let mut bench = Bench::new("", body);
    bench.tick();
    assert!(!bench.tree.has_key("a"));

    let main = r#"<Sequence><Script code="a := 1"/><SubTree ID="T" a="{a}"/></Sequence>"#;
    let mut tree = with_subtree(main, r#"<UnsetBlackboard key="a"/>"#);
    assert_eq!(tick(&mut tree), "SUCCESS");
    assert!(tree.has_key("a"));
}

#[test]
fn what_is_written_again_after_it_was_erased_is_updated() {
    let body = r#"<Sequence><SetBlackboard value="1" output_key="e"/>
        <WasEntryUpdated entry="e"/><UnsetBlackboard key="e"/></Sequence>"#;

    assert_eq!(Bench::new("", body).ticks(3), "SSS");
}

#[test]
fn made_up_keys_are_bounded() {
    let body = r#"<Sequence><Script code="i += 1; name = 'key' .. i"/>
        <SetBlackboard value="1" output_key="{name}"/></Sequence>"#;
    let mut bench = Bench::new("", body);
    bench.tree.set("i", 0).unwrap();
    bench.tree.set("name", String::new()).unwrap();

    let error = (0..70_000).find_map(|_| bench.tree.tick(bench.now).err()).unwrap();

    assert_eq!(error.to_string(), "SetBlackboard::3: the blackboard is full");
    assert!(bench.tree.set("one more", 1).is_err());
}

/// A type of the application.
#[derive(Clone, Debug, PartialEq)]
struct Pose(f64, f64);

impl PortValue for Pose {
    const TYPE: PortType = PortType::of::<Pose>("Pose");

    fn from_value(value: &Value) -> Option<Pose> {
        match value {
            Value::Text(text) => {
                let (x, y) = text.split_once(',')?;
                Some(Pose(x.parse().ok()?, y.parse().ok()?))
            }
            other => other.as_object().cloned(),
        }
    }

    fn into_value(self) -> Value {
        Value::object(self)
    }
}

#[test]
fn ports_have_types_of_the_application() {
    let mut factory = Factory::new();
    factory.action("Shift", [Port::input::<Pose>("from"), Port::output::<Pose>("to")], |cx| {
        let Pose(x, y) = cx.input("from")?;
        cx.output("to", Pose(x + 1.0, y))?;
        Ok(Status::Success)
    });
    let body =
        r#"<Sequence><Shift from="1,2" to="{pose}"/><Shift from="{pose}" to="{pose}"/></Sequence>"#;
    let mut tree = factory.load("test.xml", &file(body)).unwrap();

    assert_eq!(tick(&mut tree), "SUCCESS");

    assert_eq!(tree.value("pose").unwrap().as_object(), Some(&Pose(3.0, 2.0)));
    let wrong = factory.load("test.xml", &file(r#"<Shift from="here"/>"#)).err().unwrap();
    assert!(wrong.to_string().contains("`here` is no Pose"), "{wrong}");
    // A script cannot read it as a number.
    assert!(tree.set("pose", 1).is_err());
}
