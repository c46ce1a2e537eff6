//! How long a tick of a reactive sequence of 1,000 nodes takes: the median of many, in µs.
//!
//! `cargo bench -p blastema-trees`. The library takes 139 to 150 µs on the same computer.
#![allow(clippy::print_stdout, reason = "a benchmark shows what it has measured")]

use blastema_trees::{Factory, Status, Tree};
use std::time::{Duration, Instant};

/// A tree of this outermost node, of which a leaf `Run` is always RUNNING.
fn tree(body: &str) -> Tree {
    let mut factory = Factory::new();
    factory.condition("Run", [], |_| Ok(Status::Running));
    factory.condition("Holds", [], |_| Ok(Status::Success));
    let text = format!("<root><BehaviorTree ID=\"Main\">{body}</BehaviorTree></root>");
    let mut tree = factory.load("bench.xml", &text).expect("the bench's own trees are right");
    tree.set("x", 1).expect("nothing else has written the entry");
    tree
}

/// The median of the times of a tick, in µs.
fn median_us(tree: &mut Tree) -> f64 {
    let mut times: Vec<Duration> = (0..5_000)
        .map(|_| {
            let start = Instant::now();
            tree.tick(Duration::ZERO).expect("the bench's own trees have no errors");
            start.elapsed()
        })
        .collect();
    times.sort_unstable();
    times[times.len() / 2].as_secs_f64() * 1e6
}

fn main() {
    let sequence = |child: &str, last: &str| {
        format!("<ReactiveSequence>{}{last}</ReactiveSequence>", child.repeat(999))
    };
    let trees = [
        ("999 AlwaysSuccess, the last one running", sequence("<AlwaysSuccess/>", "<Run/>")),
        ("999 conditions of the application", sequence("<Holds/>", "<Run/>")),
        ("999 ScriptCondition x == 1", sequence(r#"<ScriptCondition code="x == 1"/>"#, "<Run/>")),
        ("999 AlwaysSuccess _skipIf", sequence(r#"<AlwaysSuccess _skipIf="x == 2"/>"#, "<Run/>")),
    ];
    for (name, body) in trees {
        println!("{name:45} {:7.2} µs", median_us(&mut tree(&body)));
    }
}
