//! Nodes that use the time, and when a tick is due.

use crate::scripted::Bench;
use std::time::Duration;

const fn ms(msec: u64) -> Option<Duration> {
    Some(Duration::from_millis(msec))
}

#[test]
fn a_delay_waits_and_starts_again_after_its_childs_answer() {
    let mut bench = Bench::new("A=SRS", r#"<Delay delay_msec="100"><A/></Delay>"#);

    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(100)));
    assert_eq!((bench.after(99), bench.tree.next_tick()), ('R', ms(100)));
    assert_eq!(bench.calls(), "");
    assert_eq!((bench.after(1), bench.calls()), ('S', "A:start:S".into()));
    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(200)));
    assert_eq!((bench.after(150), bench.calls()), ('R', "A:start:R".into()));
    // The child runs: nothing is waited for.
    assert_eq!(bench.tree.next_tick(), None);
    assert_eq!((bench.after(1), bench.calls()), ('S', "A:run:S".into()));
}

#[test]
fn a_delay_of_no_time_is_running_once_and_a_skipped_child_does_not_start_it_again() {
    let body = r#"<Delay delay_msec="0"><A _skipIf="skip"/></Delay>"#;
    let mut bench = Bench::new("A=R", body);
    bench.tree.set("skip", true).unwrap();

    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(0)));
    assert_eq!(bench.tick(), 'K');
    bench.tree.set("skip", false).unwrap();
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:R".into()));
}

#[test]
fn a_halted_delay_begins_from_the_start() {
    let mut bench = Bench::new("A=S", r#"<Delay delay_msec="100"><A/></Delay>"#);
    bench.tick();
    bench.after(60);
    bench.tree.halt(bench.now).unwrap();

    assert_eq!((bench.after(60), bench.tree.next_tick()), ('R', ms(220)));
}

#[test]
fn a_timeout_halts_its_child_in_the_first_tick_after_the_time() {
    let mut bench = Bench::new("A=R", r#"<Timeout msec="100"><A/></Timeout>"#);

    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(100)));
    assert_eq!(bench.after(99), 'R');
    bench.calls();
    assert_eq!((bench.after(1), bench.calls()), ('F', "A:halt".into()));
    // It starts again.
    assert_eq!((bench.tick(), bench.calls()), ('R', "A:start:R".into()));
    assert_eq!(bench.tree.next_tick(), ms(200));
}

#[test]
fn a_timeout_of_0_ms_is_none() {
    let mut bench = Bench::new("A=R", r#"<Timeout msec="0"><A/></Timeout>"#);

    assert_eq!((bench.tick(), bench.after(1_000_000), bench.tree.next_tick()), ('R', 'R', None));
}

#[test]
fn a_run_after_a_skipped_one_is_limited_too() {
    let mut bench = Bench::new("A=R", r#"<Timeout msec="100"><A _skipIf="skip"/></Timeout>"#);
    bench.tree.set("skip", true).unwrap();
    assert_eq!(bench.tick(), 'K');
    bench.tree.set("skip", false).unwrap();

    assert_eq!((bench.after(500), bench.after(99), bench.after(1)), ('R', 'R', 'F'));
}

#[test]
fn sleep_is_over_at_its_time_and_at_once_after_0_ms() {
    let mut bench = Bench::new("", r#"<Sequence><Sleep msec="0"/><Sleep msec="50"/></Sequence>"#);

    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(50)));
    assert_eq!((bench.after(49), bench.after(1)), ('R', 'S'));
    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(100)));
}

#[test]
fn the_next_tick_is_due_at_the_earliest_timer() {
    let body = r#"<ParallelAll><Sleep msec="300"/><Timeout msec="200"><A/></Timeout>
        <Sleep msec="400"/></ParallelAll>"#;
    let mut bench = Bench::new("A=R", body);

    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', ms(200)));
    assert_eq!((bench.after(200), bench.tree.next_tick()), ('R', ms(300)));
    assert_eq!((bench.after(100), bench.tree.next_tick()), ('R', ms(400)));
    assert_eq!((bench.after(100), bench.tree.next_tick()), ('F', None));
}

#[test]
fn a_node_that_yields_asks_for_the_next_tick_at_once() {
    let mut bench = Bench::new("Y=S Z=R", "<AsyncSequence><Y/><Z/></AsyncSequence>");
    bench.now = Duration::from_secs(7);

    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', Some(bench.now)));
    assert_eq!((bench.tick(), bench.tree.next_tick()), ('R', None));
}

#[test]
fn a_tree_that_always_yields_ends_its_ticks_all_the_same() {
    let mut bench = Bench::new("Y=S", r#"<Repeat num_cycles="-1"><Y/></Repeat>"#);

    bench.tree.tick_while_yielding(Duration::ZERO).unwrap();

    assert_eq!(bench.calls.take().len(), 1_000);
    assert_eq!(bench.tree.next_tick(), Some(Duration::ZERO));

    // A large tree takes as long as a small one.
    let many = "<AlwaysSuccess/>".repeat(998);
    let body = format!("<Repeat num_cycles=\"-1\"><Sequence><Y/>{many}</Sequence></Repeat>");
    let mut bench = Bench::new("Y=S", &body);
    bench.tree.tick_while_yielding(Duration::ZERO).unwrap();
    assert_eq!(bench.calls.take().len(), 99);
}

#[test]
fn a_clock_that_is_set_back_stretches_no_delay() {
    let mut bench = Bench::new("", r#"<Sleep msec="100"/>"#);
    bench.now = Duration::from_secs(10);
    bench.tick();
    bench.now = Duration::from_secs(5);
    bench.tick();

    bench.now = Duration::from_millis(10_100);

    assert_eq!(bench.tick(), 'S');
}
