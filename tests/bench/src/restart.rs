//! From a panic to the replacement's first reply, one of a hundred siblings.

use crate::measure::{Table, median};
use blastema::prelude::*;
use std::sync::OnceLock;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};
use tokio::task::yield_now;

const SIBLINGS: usize = 100;
const KILLS: usize = 300;

static PANICKED: AtomicU64 = AtomicU64::new(0);
static REPLIED: AtomicU64 = AtomicU64::new(0);

fn nanos() -> u64 {
    static START: OnceLock<Instant> = OnceLock::new();
    START.get_or_init(Instant::now).elapsed().as_nanos() as u64
}

fn gap_us() -> f64 {
    REPLIED.load(Relaxed).saturating_sub(PANICKED.load(Relaxed)) as f64 / 1e3
}

/// Ends an incarnation.
#[derive(Clone, Debug, Event)]
struct Burst;

/// Asks an incarnation whether it is there.
#[derive(Debug, Request)]
#[contract(reply = u64)]
struct Hello;

struct Sibling;
impl Component for Sibling {}
impl Handle<Burst> for Sibling {
    async fn handle(&mut self, _: Burst, _: &mut Context<Self>) {
        PANICKED.store(nanos(), Relaxed);
        panic!("burst")
    }
}
impl Handle<Hello> for Sibling {
    async fn handle(&mut self, _: Hello, _: &mut Context<Self>) -> u64 {
        let now = nanos();
        REPLIED.store(now, Relaxed);
        now
    }
}

fn in_place() -> f64 {
    let figures = (0..KILLS).map(|_| {
        let _ = std::panic::catch_unwind(|| {
            PANICKED.store(nanos(), Relaxed);
            panic!("burst")
        });
        REPLIED.store(nanos(), Relaxed);
        gap_us()
    });
    median(figures.collect())
}

/// Keeps the panics that this part makes from being printed: that is not what it measures. To be
/// called before anything else, since the hook of the middleware is to stand before this one.
pub(crate) fn silence_panics() {
    let previous = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        if info.payload().downcast_ref::<&str>() != Some(&"burst") {
            previous(info);
        }
    }));
}

async fn respawned() -> f64 {
    let mut figures = Vec::new();
    for _ in 0..KILLS {
        let task = tokio::task::spawn_local(async {
            PANICKED.store(nanos(), Relaxed);
            panic!("burst")
        });
        let _: Result<(), _> = task.await;
        let next = tokio::task::spawn_local(async { REPLIED.store(nanos(), Relaxed) });
        next.await.expect("it does not panic");
        figures.push(gap_us());
    }
    median(figures)
}

async fn restarted(siblings: &[ActorRef<Sibling>]) -> f64 {
    let mut figures = Vec::new();
    for kill in 0..KILLS {
        let sibling = &siblings[kill * 37 % SIBLINGS];
        PANICKED.store(0, Relaxed);
        sibling.tell(Burst).expect("there is room");
        sibling.ask(Hello).await.expect("the replacement answers");
        figures.push(gap_us());
        yield_now().await;
    }
    median(figures)
}

/// How many faults the record has seen.
async fn recorded(node: &Node) -> u64 {
    let record = node.faults().await;
    record.dropped + record.entries.len() as u64
}

pub(crate) async fn run(rounds: usize) {
    let mut builder = Node::builder("siblings")
        .components_on_this_thread()
        .intensity(1000, Duration::from_secs(1));
    for number in 0..SIBLINGS {
        builder = builder.child(ChildSpec::new(&format!("sibling/{number}"), || Sibling));
    }
    let node = builder.start().await.expect("a node of siblings starts");
    let siblings: Vec<_> = (0..SIBLINGS)
        .map(|number| node.actor(&format!("sibling/{number}")).expect("it was just started"))
        .collect();
    let before = recorded(&node).await;
    let mut kills = 0;
    let mut table = Table::new("from the panic to the replacement's first reply, one of 100", "us");
    for _ in 0..rounds {
        table.add("limit: catch_unwind in place", in_place());
        table.add("tokio task, respawned by who awaits it", respawned().await);
        table.add("component, whole fault chain recording", restarted(&siblings).await);
        kills += KILLS as u64;
    }
    table.print();
    println!("Erlang/OTP took 7.2 times its catch_unwind in place, kameo 2.5, the paper 11,100 us");
    // The chain records on its own thread and may lag behind.
    while recorded(&node).await < before + kills {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    println!("faults recorded: {} of {kills}", recorded(&node).await - before);
    node.shutdown().await;
}
