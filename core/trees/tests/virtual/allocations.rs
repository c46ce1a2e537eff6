//! A tick allocates nothing, whatever it does, unless a text is made.

use blastema_trees::{Factory, Port, Status};
use std::time::Duration;

/// How many allocations ten ticks make after the first ones.
fn allocations(body: &str) -> u64 {
    let mut factory = Factory::new();
    let ports = [Port::input::<f64>("at_least"), Port::output::<f64>("seen")];
    factory.condition("Check", ports, |cx| {
        let seen = cx.input::<f64>("at_least")? + 1.0;
        cx.output("seen", seen)?;
        Ok(Status::from(seen > 1.0))
    });
    factory.condition("Run", [], |_| Ok(Status::Running));
    let text = format!("<root><BehaviorTree ID=\"Main\">{body}</BehaviorTree></root>");
    let mut tree = factory.load("test.xml", &text).unwrap();
    tree.set("x", 1.0).unwrap();
    tree.set("s", "3".to_owned()).unwrap();
    let mut now = Duration::ZERO;
    let mut tick = || {
        now += Duration::from_millis(10);
        tree.tick(now).unwrap();
        tree.next_tick();
        tree.changes();
    };
    tick();
    tick();
    allocation_counter::measure(|| (0..10).for_each(|_| tick())).count_total
}

#[test]
fn a_tick_of_a_reactive_sequence_of_a_thousand_nodes_allocates_nothing() {
    let child = r#"<Check at_least="{x}" seen="{seen}"/>"#.repeat(999);
    let body = format!("<ReactiveSequence>{child}<Run/></ReactiveSequence>");

    assert_eq!(allocations(&body), 0);
}

#[test]
fn ticks_in_which_everything_changes_allocate_nothing() {
    let body = r#"<KeepRunningUntilFailure><Sequence>
        <Script code="n := x + 1; x = n / 2 - 0.5 * (n &gt; 100 ? n : 0)"/>
        <ScriptCondition code="x &lt; 1000 &amp;&amp; n != 0" _skipIf="n == 3" _post="n += 1"/>
        <Switch2 variable="{s}" case_1="1" case_2="2"><Check at_least="1"/><AlwaysSuccess/>
            <ForceSuccess><Timeout msec="15"><Sleep msec="20"/></Timeout></ForceSuccess></Switch2>
        <Parallel success_count="1"><Delay delay_msec="5"><AlwaysSuccess/></Delay></Parallel>
        <RetryUntilSuccessful num_attempts="3"><Inverter><AlwaysFailure/></Inverter>
        </RetryUntilSuccessful></Sequence></KeepRunningUntilFailure>"#;

    assert_eq!(allocations(body), 0);
}
