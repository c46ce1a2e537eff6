//! A flooded component: its queue is bounded, its policy says what gives way, what was lost is
//! counted, and the commands of the framework still get through.
#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "it shows what happens")]

use blastema::DeadReason;
use blastema::prelude::*;
use std::time::Duration;

/// One reading of a sensor.
#[derive(Clone, Debug, Event)]
#[contract(name = "sensor/reading")]
struct Reading {
    number: u32,
}

/// Says which reading was the last.
#[derive(Debug, Request)]
#[contract(name = "sensor/last", reply = u32)]
struct Last;

/// Slow: a millisecond for each reading.
#[derive(Default)]
struct Filter {
    last: u32,
}

impl Component for Filter {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Reading>().serve::<Last>();
    }
}

impl Handle<Reading> for Filter {
    async fn handle(&mut self, reading: Reading, _: &mut Context<Self>) {
        std::thread::sleep(Duration::from_millis(1));
        self.last = reading.number;
    }
}

impl Handle<Last> for Filter {
    async fn handle(&mut self, _: Last, _: &mut Context<Self>) -> u32 {
        self.last
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let spec = |name, when_full| ChildSpec::new(name, Filter::default).queue(8, when_full);
    let node = Node::builder("module1")
        .child(spec("newest", WhenFull::DropOldest))
        .child(spec("careful", WhenFull::Refuse))
        .start()
        .await?;

    // For data of which the newest counts: nothing is refused, and the oldest gives way.
    let newest = node.actor::<Filter>("newest")?;
    for number in 1..=1000 {
        newest.tell(Reading { number })?;
    }
    println!("newest: reading {} was the last", newest.ask(Last).await?);
    let lost = node.dead_letters().count(newest.name(), DeadReason::Full);
    println!("newest: some gave way: {}", lost > 0);

    // For orders, each of which counts: the sender gets back what does not fit, and may wait for
    // room.
    let careful: Sender<Reading> = node.sender("careful")?;
    let refused = (1..=1000).find_map(|number| careful.tell(Reading { number }).err());
    if let Some(refused) = refused {
        println!("careful: a reading came back: {refused}");
        careful.deliver(refused.message).await?;
        println!("careful: it was taken when there was room");
    }

    // Orders of the framework do not queue behind messages: a flooded component ends when it is
    // told to.
    for number in 1..=1000 {
        newest.tell(Reading { number })?;
    }
    node.remove_child("newest").await?;
    println!("newest: removed with {} waiting", newest.queued());
    node.shutdown().await;
    Ok(())
}
