//! Publish and subscribe: a listener says on which events it wants to be called, and events of one
//! contract can travel on several topics.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;

/// The charge of a battery.
#[derive(Clone, Debug, Event)]
#[contract(name = "battery/charge")]
struct Charge {
    percent: u8,
}

/// Prints what it hears. Its conditions are asked before anything is put into its queue.
struct Display;

impl Component for Display {
    fn ports(ports: &mut Ports<Self>) {
        // The topic of an event is its contract's name, unless `on` names another.
        ports.listen::<Charge>().only_if(|charge| charge.percent < 20);
        ports.listen::<Charge>().on("battery/of/arm");
        ports.serve::<Shown>();
    }
}

impl Handle<Charge> for Display {
    async fn handle(&mut self, charge: Charge, _: &mut Context<Self>) {
        println!("{} %", charge.percent);
    }
}

/// Answers when everything that was queued before it has been shown.
#[derive(Debug, Request)]
#[contract(reply = ())]
struct Shown;

impl Handle<Shown> for Display {
    async fn handle(&mut self, _: Shown, _: &mut Context<Self>) {}
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
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1")
        .work_threads(1)
        .child(ChildSpec::new("display", || Display)) // listens before the battery speaks
        .child(ChildSpec::new("battery", || Battery))
        .start()
        .await?;
    node.sender::<Shown>("display")?.ask(Shown).await?;
    Ok(())
}
