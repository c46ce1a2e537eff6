//! The language of scripts, as version 4.10 of the library has it.

use crate::scripted::{Bench, factory, file};
use blastema_trees::Factory;
use std::time::Duration;

/// The value of `x` after a script, as text, or the error.
fn run(code: &str) -> String {
    let escaped = code.replace('&', "&amp;").replace('<', "&lt;").replace('"', "&quot;");
    let factory = Factory::new();
    let body = format!("<Script code=\"{escaped}\"/>");
    let mut tree = match factory.load("test.xml", &file(&body)) {
        Ok(tree) => tree,
        Err(errors) => return errors.iter().next().unwrap().problem.to_string(),
    };
    tree.set("two", 2).unwrap();
    tree.set("flag", true).unwrap();
    match tree.tick(Duration::ZERO) {
        Ok(_) => tree.value("x").map_or("none".into(), ToString::to_string),
        Err(error) => error.to_string().rsplit_once("fails: ").unwrap().1.to_owned(),
    }
}

#[track_caller]
fn check(cases: &[(&str, &str)]) {
    for (code, expected) in cases {
        assert_eq!(run(code), *expected, "{code}");
    }
}

#[test]
fn arithmetic_is_real_and_groups_to_the_left() {
    check(&[
        ("x := 10 - 5 - 2", "3.000000"),
        ("x := 16 / 4 / 2", "2.000000"),
        ("x := 7 / two", "3.500000"),
        ("x := 1 + 2 * 3", "7.000000"),
        ("x := (1 + 2) * -3", "-9.000000"),
        ("x := 1 / 0", "inf"),
        ("x := 0x1F", "31"),
        ("x := 2.5e1", "25.000000"),
        ("x := 1e-1 + 1", "1.100000"),
        ("x := 7", "7"),
        ("x := true", "1.000000"),
        ("x := - - 2", "2.000000"),
    ]);
}

#[test]
fn bits_are_of_integers_and_bind_tighter_than_comparisons() {
    check(&[
        ("x := 6 & 3 | 8", "10.000000"),
        ("x := 6 ^ 3", "5.000000"),
        ("x := ~0 == -1", "1.000000"),
        ("x := 1 | 2 == 3", "1.000000"),
        ("x := 1.5 & 1", "`&` does not take `1.500000`"),
    ]);
}

#[test]
fn both_sides_of_and_and_or_are_evaluated_and_are_true_or_false() {
    check(&[
        ("x := true || false && false", "1.000000"),
        ("x := 1 && flag", "1.000000"),
        ("x := !flag || 0", "0.000000"),
        ("x := false && unknown", "the entry `unknown` has no value"),
        ("x := 2 && 1", "`&&` does not take `2`"),
        ("x := 0.5 && 1", "1.000000"),
    ]);
}

#[test]
fn comparisons_chain_and_numbers_are_equal_within_the_precision_of_a_float() {
    check(&[
        ("x := 1 < 2 < 3", "1.000000"),
        ("x := 3 > 2 > 2", "0.000000"),
        ("x := (3 > 2) == 1", "1.000000"),
        ("x := 0.1 + 0.2 == 0.3", "1.000000"),
        ("x := 1 != 1.00000001", "0.000000"),
        ("x := 2 >= 2 <= 2", "1.000000"),
    ]);
}

#[test]
fn texts_are_joined_compared_and_read_as_numbers() {
    check(&[
        ("x := 'a' + 'b'", "ab"),
        ("x := 'a' .. 1 .. 1.5", "a11.500000"),
        ("x := 1..'a'", "1a"),
        ("x := 'a' < 'b'", "1.000000"),
        ("x := '2' == two", "1.000000"),
        ("x := 'true' == flag", "1.000000"),
        ("x := 'a' == 1", "`==` does not take `a`"),
        ("x := 'a' - 1", "`-` does not take `a`"),
        ("x := 1 .. 2", "`..` does not take `1`"),
        ("x := -'a'", "`-` does not take `a`"),
        ("x := ''", ""),
    ]);
}

#[test]
fn a_choice_takes_one_branch() {
    check(&[
        ("x := flag ? 1 : unknown", "1"),
        ("x := '2' ? 1 : 2", "1"),
        ("x := 'text' ? 1 : 2", "`?` does not take `text`"),
        ("x := 0 ? 1 : two == 2 ? 3 : 4", "3"),
        ("flag ? x := 1 : (x := 2)", "1"),
    ]);
}

#[test]
fn assignments_create_change_and_give_their_value() {
    check(&[
        ("x := y := 3", "3"),
        ("x := 1; x += 2; x *= 4; x -= 2; x /= 5", "2"),
        ("x := 'a'; x += 'b'", "ab"),
        ("x = 1", "the entry `x` does not exist; `:=` creates it"),
        ("x += 1", "the entry `x` does not exist; `:=` creates it"),
        ("x := 1; x = 2.5", "the entry `x` keeps an integer, to which `2.500000` does not convert"),
        ("x := 1; x := 'abc'", "`==` does not take `abc`"),
        ("x := 1.5; x := '2'", "2.000000"),
        ("x := 'a'; x = 1", "the entry `x` keeps a text, to which `1` does not convert"),
        ("two = 1.0; x := two", "1"),
        ("two = 1.5", "the entry `two` keeps int, to which `1.500000` does not convert"),
        ("x := 1 x := 2;; x := 3", "3"),
        ("@x := 4", "4"),
    ]);
}

#[test]
fn what_is_no_script_is_an_error_at_load_with_its_place() {
    check(&[
        ("x := ", "expected a value"),
        ("x := (1", "expected `)`"),
        ("x := 1 ? 2", "expected `:`"),
        ("1 := 2", "only the name of an entry can be assigned to"),
        ("x + 1 := 2", "only the name of an entry can be assigned to"),
        ("x := 1.", "`1.` is no number"),
        ("x := 3foo", "`3foo` is no number"),
        ("x := 0xZ", "`0xZ` is no number"),
        ("x := 1e", "`1e` is no number"),
        ("x := 99999999999999999999", "`99999999999999999999` is no number"),
        ("x := 'abc", "a text without its end"),
        ("x := #", "no symbol of a script"),
        (";", "expected a value"),
    ]);
    let (factory, _) = factory("A=S");
    let text = file("\n<A _skipIf=\"a &amp;&amp; b &lt; ) \"/>");
    let errors = factory.load("test.xml", &text).err().unwrap();
    let shown = errors.to_string();
    let place = "<A _skipIf=\"a &amp;&amp; b &lt; ".len() + 1;
    assert!(shown.starts_with(&format!("test.xml:2:{place}: expected a value\n")), "{shown}");
}

#[test]
fn scripts_have_bounds() {
    assert_eq!(run(&format!("x := {}1", "-".repeat(100))), "nested deeper than 64");
    assert_eq!(run(&format!("x := {}1", "1+".repeat(1_000))), "a script has at most 1000 symbols");
    assert_eq!(run(&format!("x := {}1", "1+".repeat(400))), "401.000000");
    let joined = |times| run(&format!("x := '12345678';{}", "x := x .. x;".repeat(times)));
    assert_eq!(joined(13).len(), 64 << 10);
    assert_eq!(joined(14), "the joined text has more than 64 KiB");
}

#[test]
fn conditions_are_true_or_false() {
    for (code, answer) in [("1", 'S'), ("0", 'F'), ("0.1", 'S'), ("2", '!'), ("'a'", '!')] {
        let mut bench = Bench::new("", &format!("<ScriptCondition code=\"{code}\"/>"));
        assert_eq!(bench.tick(), answer, "{code}");
    }
}

#[test]
fn an_empty_script_does_nothing_and_an_empty_condition_is_an_error() {
    assert_eq!(Bench::new("", r#"<Script code=""/>"#).tick(), 'S');
    let (factory, _) = factory("A=S");
    for body in [r#"<ScriptCondition code=""/>"#, r#"<A _skipIf=""/>"#] {
        let errors = factory.load("test.xml", &file(body)).err().unwrap();
        assert!(errors.to_string().contains("an empty script"), "{errors}");
    }
}

#[test]
fn an_error_of_a_script_names_the_node_and_the_script() {
    let mut bench = Bench::new("A=S", r#"<Sequence><A name="go" _onSuccess="n += 1"/></Sequence>"#);

    let error = bench.tree.tick(bench.now).unwrap_err();

    let text = "go: its script `n += 1` fails: the entry `n` does not exist; `:=` creates it";
    assert_eq!(error.to_string(), text);
}
