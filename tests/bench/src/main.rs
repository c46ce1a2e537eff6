//! Benchmarks of the middleware beside what it is built on, as ratios within one run.
//!
//! `cargo run --release -p blastema-bench [messages] [restart] [fanout] [remote] [throughput]
//! [memory] [monitored] [failover] [devices]`; without arguments, all of them. `ROUNDS=n` sets how
//! often the rows of a table are run in turn.
#![allow(clippy::print_stdout, reason = "tables are what this program is for")]

mod devices;
mod failover;
mod fanout;
mod keys;
mod measure;
mod memory;
mod messages;
mod monitored;
mod process;
mod remote;
mod restart;
mod throughput;

use std::process::ExitCode;

/// What is run, and how often its rows are.
type Part = (&'static str, fn(usize));

const PARTS: [Part; 9] = [
    ("messages", |rounds| blastema::run(messages::run(rounds))),
    ("restart", |rounds| blastema::run(restart::run(rounds))),
    ("fanout", |rounds| blastema::run(fanout::run(rounds))),
    ("remote", remote::run),
    ("throughput", throughput::run),
    ("memory", |rounds| memory::run(rounds.min(3))),
    ("monitored", |rounds| monitored::run(rounds.min(3))),
    ("failover", |_| blastema::run(failover::run())),
    ("devices", |rounds| blastema::run(devices::run(rounds))),
];

fn main() -> ExitCode {
    restart::silence_panics();
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    if let Some(at) = arguments.iter().position(|argument| argument == "--child") {
        arguments.remove(at);
        return child(&arguments);
    }
    let is_part = |name: &String| PARTS.iter().any(|(part, _)| part == name);
    if let Some(unknown) = arguments.iter().find(|name| !is_part(name)) {
        println!(
            "there is no benchmark {unknown:?}; there are {}",
            PARTS.map(|(p, _)| p).join(", ")
        );
        return ExitCode::from(2);
    }
    let rounds = std::env::var("ROUNDS").ok().and_then(|text| text.parse().ok()).unwrap_or(9);
    for (part, run) in PARTS {
        if arguments.is_empty() || arguments.iter().any(|argument| argument == part) {
            run(rounds);
        }
    }
    ExitCode::SUCCESS
}

/// A part of a benchmark that needs a process of its own.
fn child(arguments: &[String]) -> ExitCode {
    match arguments.first().map(String::as_str) {
        Some("remote") => remote::child(&arguments[1..]),
        Some("throughput") => throughput::child(&arguments[1..]),
        Some("memory") => memory::child(&arguments[1..]),
        Some("monitored") => monitored::child(&arguments[1..]),
        _ => return ExitCode::from(2),
    }
    ExitCode::SUCCESS
}
