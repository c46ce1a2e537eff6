//! Three hosts with two cables each, made of network namespaces, and what real cables do: they are
//! pulled, go silent, and flap.
//!
//! `tests/beds/run` starts it with the rights and tools that it needs. It is both the one who
//! breaks the cables and, in processes of their own, the nodes whose cables are broken.
#![allow(clippy::disallowed_methods, reason = "real cables are pulled for a while")]
#![allow(clippy::print_stdout, reason = "what happens is what this program is for")]

mod bed;
mod figures;
mod host;
mod node;
mod trial;

use std::process::ExitCode;

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.split_first() {
        Some((first, rest)) if first == "node" => blastema::run(node::run(rest)),
        Some((first, rest)) if first == "mirror" => blastema::run(node::mirror(rest)),
        Some((first, rest)) if first == "measure" => blastema::run(figures::measure(rest)),
        Some((first, wanted)) if first == "trials" => trial::run(wanted),
        Some((first, rest)) if first == "figures" => figures::run(rest),
        _ => Err("start tests/beds/run".into()),
    }
    .map_or_else(
        |error| {
            println!("FAILED: {error}");
            ExitCode::FAILURE
        },
        |()| ExitCode::SUCCESS,
    )
}
