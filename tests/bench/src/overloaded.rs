//! A component with rounds of its own beside a neighbour that gets more than it can serve.
//!
//! Both live on one thread. The neighbour needs 30 ms for a message and gets 40 a second, so that
//! its queue is full and the thread never idle. It is stopped, and started again, many times: a
//! stop has to wait for the handler that runs, and for no other. `STOPS=n` sets how often.

use crate::measure::{Quantiles, Table};
use blastema::prelude::*;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

const HANDLER: Duration = Duration::from_millis(30);
const PACE: Duration = Duration::from_millis(25);
const RATE_HZ: f64 = 20.0;
const SPAN: Duration = Duration::from_secs(5);

/// Takes its receiver's thread for a while.
#[derive(Clone, Debug, Event)]
struct Work;

struct Overloaded;

impl Component for Overloaded {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Work>();
    }
}

impl Handle<Work> for Overloaded {
    async fn handle(&mut self, _: Work, _: &mut Context<Self>) {
        let start = Instant::now();
        while start.elapsed() < HANDLER {
            std::hint::spin_loop();
        }
    }
}

/// Counts its rounds.
struct Rounds(Arc<AtomicU64>);

impl Component for Rounds {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.0.fetch_add(1, Relaxed);
        Ok(())
    }
}

fn overloaded() -> ChildSpec<Overloaded> {
    ChildSpec::new("overloaded", || Overloaded).queue(64, WhenFull::DropOldest)
}

/// The share of its rounds that a component keeps, in percent, with such a neighbour or without.
async fn share(with_neighbour: bool) -> f64 {
    let rounds = Arc::new(AtomicU64::new(0));
    let counted = rounds.clone();
    let spec = ChildSpec::new("rounds", move || Rounds(counted.clone())).rate_hz(RATE_HZ);
    let builder = Node::builder("overload").work_threads(1).child(spec).child(overloaded());
    let node = builder.start().await.expect("a node of two components starts");
    let work = node.sender::<Work>("overloaded").expect("it is there");
    let (before, start) = (rounds.load(Relaxed), Instant::now());
    while start.elapsed() < SPAN {
        if with_neighbour {
            work.tell(Work).expect("the oldest makes room");
        }
        tokio::time::sleep(PACE).await;
    }
    let kept = rounds.load(Relaxed) - before;
    let wanted = start.elapsed().as_secs_f64() * RATE_HZ;
    node.shutdown().await;
    kept as f64 / wanted * 100.0
}

async fn stops(count: usize) {
    let node = Node::builder("overload").work_threads(1).start().await.expect("a node starts");
    let mut latency = Quantiles::default();
    for _ in 0..count {
        let busy = node.add_child(overloaded()).await.expect("it starts");
        (0..32).for_each(|_| busy.tell(Work).expect("there is room"));
        tokio::time::sleep(HANDLER + PACE / 2).await;
        let start = Instant::now();
        node.remove_child("overloaded").await.expect("it is there");
        latency.add(start.elapsed());
    }
    latency.print("stop of the overloaded one, ms");
    node.shutdown().await;
}

pub(crate) async fn run(rounds: usize) {
    let mut table = Table::new("rounds kept by a 20 Hz component", "% of its rounds");
    for _ in 0..rounds {
        table.add("beside an idle neighbour", share(false).await);
        table.add("beside one with 40 handlers of 30 ms a second", share(true).await);
    }
    table.print();
    let count = std::env::var("STOPS").ok().and_then(|text| text.parse().ok()).unwrap_or(200);
    stops(count).await;
}
