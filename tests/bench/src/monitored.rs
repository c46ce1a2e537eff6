//! What it costs to watch ten thousand components.

use crate::measure::Table;
use crate::process::{cpu_seconds, fresh, settle};
use blastema::prelude::*;
use std::time::{Duration, Instant};

struct Idle;
impl Component for Idle {}

/// In a process of its own: prints the percentage of one core that so many components take.
pub(crate) fn child(arguments: &[String]) {
    let count: usize = arguments.first().and_then(|text| text.parse().ok()).unwrap_or(0);
    let percent = blastema::run(async move {
        let mut builder = Node::builder("watched");
        for number in 0..count {
            builder = builder.child(ChildSpec::new(&format!("idle/{number}"), || Idle));
        }
        let node = builder.start().await.expect("a node of idle components starts");
        settle().await;
        let (cpu, start) = (cpu_seconds(), Instant::now());
        tokio::time::sleep(Duration::from_secs(3)).await;
        let percent = (cpu_seconds() - cpu) / start.elapsed().as_secs_f64() * 100.0;
        drop(node);
        percent
    });
    println!("{percent}");
}

pub(crate) fn run(rounds: usize) {
    let mut table = Table::new("components watched every 100 ms", "% of one core");
    for _ in 0..rounds {
        for count in [0, 100, 10_000] {
            table.add(&format!("{count} components"), fresh("monitored", &[&count.to_string()]));
        }
    }
    table.print();
}
