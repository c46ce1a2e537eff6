//! Publish and subscribe: a listener says on which events it wants to be called, and events of one
//! contract can travel on several topics.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use std::sync::mpsc::{SyncSender, sync_channel};

/// The charge of a battery.
#[derive(Clone, Debug, Event)]
#[contract(name = "battery/charge")]
struct Charge {
    percent: u8,
}

/// Hands on what it hears. Its conditions are asked before anything is put into its queue.
struct Display {
    heard: SyncSender<u8>,
}

impl Component for Display {
    fn ports(ports: &mut Ports<Self>) {
        // The topic of an event is its contract's name, unless `on` names another.
        ports.listen::<Charge>().only_if(|charge| charge.percent < 20);
        ports.listen::<Charge>().on("battery/of/arm");
    }
}

impl Handle<Charge> for Display {
    async fn handle(&mut self, charge: Charge, cx: &mut Context<Self>) {
        if self.heard.try_send(charge.percent).is_err() {
            cx.stop(); // the display is switched off
        }
    }
}

/// Publishes as it empties.
struct Battery;

impl Component for Battery {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        for percent in [80, 40, 15, 5] {
            cx.publish(Charge { percent }); // never waits
        }
        cx.publisher::<Charge>("battery/of/arm")?.publish(Charge { percent: 99 })?;
        Ok(())
    }
}

#[blastema::main]
async fn main() -> Result<(), StartError> {
    let (heard, hears) = sync_channel(16);
    let node = Node::builder("module1")
        .child(ChildSpec::new("display", move || Display { heard: heard.clone() }))
        .child(ChildSpec::new("battery", || Battery)) // speaks when the display listens
        .start()
        .await?;
    for percent in hears.iter().take(3) {
        println!("{percent} %");
    }
    node.shutdown().await;
    Ok(())
}
