//! What a component costs in memory besides its own state, beside a bare actix actor.

use crate::measure::Table;
use crate::process::{fresh, settle};
use actix::prelude::{Actor, Context as ActixContext};
use blastema::prelude::*;

/// Components without any state.
struct Idle;
impl Component for Idle {}
impl Handle<Touch> for Idle {
    async fn handle(&mut self, _: Touch, _: &mut Context<Self>) {}
}

/// Has a component serve a message once, so that everything it needs for that is there.
#[derive(Clone, Debug, Event)]
struct Touch;

struct Bare;
impl Actor for Bare {
    type Context = ActixContext<Self>;
}

/// Enough that what a process takes by itself does not show.
const COUNT: usize = 20_000;
/// More than any robot has.
const MANY: usize = 100_000;

/// What the operating system has given this process and keeps in memory, in bytes.
fn resident() -> f64 {
    let text = std::fs::read_to_string("/proc/self/status").expect("Linux has it");
    let line = text.lines().find_map(|line| line.strip_prefix("VmRSS:")).expect("it has this line");
    let number = line.trim().trim_end_matches(" kB").parse::<f64>();
    number.expect("it is a number of kibibytes") * 1024.0
}

/// In a process of its own: prints the bytes that each of so many takes.
pub(crate) fn child(arguments: &[String]) {
    let [kind, count] = arguments else { return };
    let count: usize = count.parse().unwrap_or(0);
    let bytes = blastema::run(async {
        let bytes = match kind.as_str() {
            "bare" => bare(count),
            kind => ours(count, kind == "used").await,
        };
        bytes / count as f64
    });
    println!("{bytes}");
}

fn bare(count: usize) -> f64 {
    let before = resident();
    let actors: Vec<_> = (0..count).map(|_| Bare.start()).collect();
    let bytes = resident() - before;
    drop(actors);
    bytes
}

async fn ours(count: usize, used: bool) -> f64 {
    // What a node costs that has one is not what another one costs.
    let small = Node::builder("small").child(ChildSpec::new("one", || Idle));
    let small = small.start().await.expect("a node of one component starts");
    settle().await;
    let before = resident();
    let mut builder = Node::builder("many");
    for number in 0..count {
        builder = builder.child(ChildSpec::new(&format!("idle/{number}"), || Idle));
    }
    let node = builder.start().await.expect("a node of idle components starts");
    if used {
        for number in 0..count {
            let idle = node.actor::<Idle>(&format!("idle/{number}")).expect("it was just started");
            idle.tell(Touch).expect("there is room");
        }
    }
    settle().await;
    let bytes = resident() - before;
    drop((small, node));
    bytes
}

pub(crate) fn run(rounds: usize) {
    let mut table = Table::new("memory of a component besides its own state", "bytes");
    for _ in 0..rounds {
        for (row, kind, count) in [
            ("bare actix actor", "bare", COUNT),
            ("component, idle", "idle", COUNT),
            ("component, used once", "used", COUNT),
            ("component, idle, one of 100,000", "idle", MANY),
        ] {
            table.add(row, fresh("memory", &[kind, &count.to_string()]));
        }
    }
    table.print();
}
