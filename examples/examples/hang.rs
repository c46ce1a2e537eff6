//! A handler that does not return keeps its thread, and a thread cannot be killed. So the culprit
//! is named and fenced off, its next incarnation begins on another thread, and its neighbours,
//! which stood still behind it, move there too, with what waits in their queues.
#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "it shows what happens")]

use blastema::FaultTransition;
use blastema::prelude::*;
use std::time::Duration;

/// Looks for something on the map. Where there is nothing, it looks for ever.
#[derive(Debug, Request)]
#[contract(name = "map/search", reply = bool)]
struct Search {
    exists: bool,
}

struct Map;

impl Component for Map {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Search>();
    }
}

impl Handle<Search> for Map {
    async fn handle(&mut self, search: Search, _: &mut Context<Self>) -> bool {
        if search.exists {
            return true;
        }
        loop {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// Adds one to the count, and is answered with the count.
#[derive(Debug, Request)]
#[contract(name = "counter/count", reply = u32)]
struct Count;

#[derive(Default)]
struct Counter {
    count: u32,
}

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Count>();
    }
}

impl Handle<Count> for Counter {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u32 {
        self.count += 1;
        self.count
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1")
        .work_threads(1) // so that both live on one thread
        .grace(Duration::from_millis(100))
        .child(ChildSpec::new("map", || Map).max_block(Duration::from_millis(200)))
        .child(ChildSpec::new("counter", Counter::default))
        .start()
        .await?;
    let map: Sender<Search> = node.sender("map")?;
    let counter: Sender<Count> = node.sender("counter")?;
    let mut faults = node.fault_events();

    println!("count {}", counter.ask(Count).await?);
    map.tell(Search { exists: false })?; // it will not come back from there
    while let Some(event) = faults.next().await {
        if event.turn == FaultTransition::Found {
            println!("{} of {}", event.fault.kind, event.fault.location);
            break;
        }
    }
    counter.tell(Count)?; // its thread stands still: this has to wait

    let timeout = Duration::from_secs(5);
    println!("found again: {}", map.ask_within(Search { exists: true }, timeout).await?);
    // The counter is restarted on another thread, and the messages that wait for it come along.
    println!("count {}", counter.ask_within(Count, timeout).await?);
    println!("threads given up: {}", node.abandoned_threads());
    node.shutdown().await;
    Ok(())
}
