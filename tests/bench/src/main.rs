//! Benchmarks of the middleware beside what it is built on, as ratios within one run.
//!
//! `cargo run --release -p blastema-bench [messages] [restart] [fanout] [remote] [throughput]
//! [memory] [monitored] [failover] [takeover] [overloaded] [devices] [robot] [rounds]`; without
//! arguments, all of them.
//! `cargo run --release -p blastema-bench mesh 20` measures a full mesh of so many processes.
//! `ROUNDS=n` sets how often the rows of a table are run in turn.
#![allow(clippy::print_stdout, reason = "tables are what this program is for")]

mod devices;
mod failover;
mod fanout;
mod keys;
mod measure;
mod memory;
mod mesh;
mod messages;
mod monitored;
mod overloaded;
mod process;
mod remote;
mod restart;
mod robot;
mod rounds;
mod takeover;
mod throughput;

use std::process::ExitCode;

const PARTS: [&str; 13] = [
    "messages",
    "restart",
    "fanout",
    "remote",
    "throughput",
    "memory",
    "monitored",
    "failover",
    "takeover",
    "overloaded",
    "devices",
    "robot",
    "rounds",
];

fn main() -> ExitCode {
    restart::silence_panics();
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    if let Some(at) = arguments.iter().position(|argument| argument == "--child") {
        arguments.remove(at);
        return child(&arguments);
    }
    // It takes the whole computer, and runs by its name alone.
    if arguments.first().is_some_and(|argument| argument == "mesh") {
        mesh::run(&arguments[1..]);
        return ExitCode::SUCCESS;
    }
    if let Some(unknown) = arguments.iter().find(|name| !PARTS.contains(&name.as_str())) {
        println!("there is no benchmark {unknown:?}; there are {}", PARTS.join(", "));
        return ExitCode::from(2);
    }
    let rounds = std::env::var("ROUNDS").ok().and_then(|text| text.parse().ok()).unwrap_or(9);
    let wanted = |name: &str| arguments.is_empty() || arguments.iter().any(|a| a == name);
    if wanted("messages") {
        blastema::run(messages::run(rounds));
    }
    if wanted("restart") {
        blastema::run(restart::run(rounds));
    }
    if wanted("fanout") {
        blastema::run(fanout::run(rounds));
    }
    if wanted("remote") {
        remote::run(rounds);
    }
    if wanted("throughput") {
        throughput::run(rounds);
    }
    if wanted("memory") {
        memory::run(rounds.min(3));
    }
    if wanted("monitored") {
        monitored::run(rounds.min(3));
    }
    if wanted("failover") {
        blastema::run(failover::run());
    }
    if wanted("takeover") {
        blastema::run(takeover::run());
    }
    if wanted("overloaded") {
        blastema::run(overloaded::run(rounds.min(3)));
    }
    if wanted("devices") {
        blastema::run(devices::run(rounds));
    }
    if wanted("robot") {
        blastema::run(robot::run(rounds));
    }
    if wanted("rounds") {
        blastema::run(rounds::run());
    }
    ExitCode::SUCCESS
}

/// A part of a benchmark that needs a process of its own.
fn child(arguments: &[String]) -> ExitCode {
    match arguments.first().map(String::as_str) {
        Some("remote") => remote::child(&arguments[1..]),
        Some("throughput") => throughput::child(&arguments[1..]),
        Some("takeover") => takeover::child(&arguments[1..]),
        Some("memory") => memory::child(&arguments[1..]),
        Some("mesh") => mesh::child(&arguments[1..]),
        Some("monitored") => monitored::child(&arguments[1..]),
        _ => return ExitCode::from(2),
    }
    ExitCode::SUCCESS
}
