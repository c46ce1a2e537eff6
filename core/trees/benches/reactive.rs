//! How long a tick of a reactive sequence of 1,000 nodes takes: the median of many, in µs.
//!
//! `cargo bench -p blastema-trees`. The library takes 150 µs for the first one, and 345 for the last.
#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "it shows a measurement")]

use blastema_trees::{Factory, Status};
use std::time::{Duration, Instant};

fn main() {
    let mut factory = Factory::new();
    factory.condition("Run", [], |_| Ok(Status::Running));
    factory.condition("Holds", [], |_| Ok(Status::Success));
    for child in ["AlwaysSuccess", "Holds", "ScriptCondition code='x == 1'"] {
        let children = format!("<{child}/>").repeat(998);
        let tree = format!("<ReactiveSequence>{children}<Run/></ReactiveSequence>");
        let file = format!("<root><BehaviorTree>{tree}</BehaviorTree></root>");
        let mut tree = factory.load("bench.xml", &file).expect("the bench's own tree is right");
        tree.set("x", 1).expect("nothing else has written the entry");
        let mut times: Vec<Duration> = (0..5_000)
            .map(|_| {
                let start = Instant::now();
                tree.tick(Duration::ZERO).expect("the bench's own tree has no errors");
                start.elapsed()
            })
            .collect();
        times.sort_unstable();
        println!("998 times {child:30} {:6.2} µs", times[2_500].as_secs_f64() * 1e6);
    }
}
