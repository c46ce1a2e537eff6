//! What version 4.10 of the library does that the recorded 4.8.2 does not, and what random trees
//! do not have.

use crate::scripted::Bench;

#[test]
fn the_child_of_an_update_decorator_is_halted_with_it() {
    let body = r#"<ReactiveSequence><C/><WaitValueUpdate entry="{e}"><A/></WaitValueUpdate>
        </ReactiveSequence>"#;
    let mut bench = Bench::new("C=SF A=R", body);
    bench.tree.set("e", 1).unwrap();

    assert_eq!((bench.tick(), bench.calls()), ('R', "C:tick:S A:start:R".into()));
    assert_eq!((bench.tick(), bench.calls()), ('F', "C:tick:F A:halt".into()));
}

#[test]
fn skip_unless_updated_looks_at_each_write_once() {
    let body = r#"<SkipUnlessUpdated entry="e"><Y/></SkipUnlessUpdated>"#;
    let mut bench = Bench::new("Y=S", body);

    assert_eq!(bench.tick(), 'K');
    bench.tree.set("e", 1).unwrap();
    assert_eq!(bench.ticks(2), "SK");
    bench.tree.set("e", 1).unwrap();
    assert_eq!(bench.ticks(2), "SK");
}

#[test]
fn a_switch_compares_texts_and_numbers() {
    let cases =
        [("1", 'A'), ("1.0", 'A'), ("1x", 'D'), ("RED", 'B'), ("idle", 'E'), ("other", 'D')];
    for (value, expected) in cases {
        let (factory, calls) = crate::scripted::factory("A=S B=S E=S D=S");
        let body = r#"<Switch3 variable="{v}" case_1="1" case_2="RED" case_3="idle">
            <A/><B/><E/><D/></Switch3>"#;
        let tree = factory.load("test.xml", &crate::scripted::file(body)).unwrap();
        let mut bench = Bench { tree, calls, now: Default::default() };
        bench.tree.set("v", value.to_owned()).unwrap();

        bench.tick();

        assert_eq!(bench.calls(), format!("{expected}:start:S"), "{value}");
    }
}

#[test]
fn a_switch_without_a_value_takes_its_default_and_an_integer_entry_is_compared_too() {
    let body = r#"<Switch2 variable="{v}" case_1="1" case_2="2"><A/><B/><D/></Switch2>"#;
    let mut bench = Bench::new("A=S B=S D=S", body);

    assert_eq!((bench.tick(), bench.calls()), ('S', "D:start:S".into()));
    bench.tree.set("v", "2".to_owned()).unwrap();
    assert_eq!((bench.tick(), bench.calls()), ('S', "B:start:S".into()));
}

#[test]
fn a_threshold_from_an_entry_is_checked_in_the_tick() {
    let body = r#"<Parallel success_count="{n}"><A/><B/></Parallel>"#;
    let mut bench = Bench::new("A=R B=R", body);
    bench.tree.set("n", 3).unwrap();

    let error = bench.tree.tick(bench.now).unwrap_err();

    assert_eq!(error.to_string(), "Parallel::1: a threshold of 3 with 2 children");
}

#[test]
fn loops_go_through_lists_texts_and_literals_of_each_type() {
    let cases = [
        ("LoopInt", "1;2;3", "3"),
        ("LoopDouble", "1.5;2.25", "2.250000"),
        ("LoopString", "a;b", "b"),
        ("LoopBool", "true;0", "0"),
    ];
    for (node, queue, last) in cases {
        let body = format!("<{node} queue=\"{queue}\" value=\"{{v}}\"><Y/></{node}>");
        let mut bench = Bench::new("Y=S", &body);
        while bench.tick() == 'R' {}
        assert_eq!(bench.tree.value("v").unwrap().to_string(), last, "{node}");
    }

    let body = r#"<LoopDouble queue="{q}" value="{v}" if_empty="SKIPPED"><Y/></LoopDouble>"#;
    let mut bench = Bench::new("Y=S", body);
    assert_eq!(bench.tick(), 'K', "an entry without a value is empty");
    bench.tree.set("q", vec![0.5, 1.5]).unwrap();
    assert_eq!(bench.ticks(3), "RRK");
    assert_eq!(bench.tree.value("v").unwrap().as_real(), Some(1.5));
}

#[test]
fn an_element_that_does_not_convert_is_an_error() {
    let mut bench = Bench::new("Y=S", r#"<LoopInt queue="{q}" value="{v}"><Y/></LoopInt>"#);
    bench.tree.set("q", "1;two".to_owned()).unwrap();

    let error = bench.tree.tick(bench.now).unwrap_err();

    assert_eq!(error.to_string(), "LoopInt::1: the port `queue` is `1;two`, which is no int");
}
