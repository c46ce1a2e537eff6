//! Two nodes on two networks: the same code reaches components here and there, and when a cable is
//! cut, what was sent goes the other way, once and in order.
//!
//! Both nodes live in one process here, so that the example is one program; as two programs they
//! would be the same. Nodes on two computers have keys: `.keys("module1.key")` at each builder.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Direction, FaultLocation, Link, Network};
use blastema_examples::free_addresses;
use std::time::Duration;

/// For the nodes to find each other.
const PATIENCE: Duration = Duration::from_secs(10);

/// Adds to a sum, and answers it.
#[derive(Debug, Request)]
#[contract(name = "sum/add", reply = u32)]
struct Add(u32);

/// The sum has changed.
#[derive(Clone, Debug, Event)]
#[contract(name = "sum/changed")]
struct Changed(u32);

#[derive(Default)]
struct Sum(u32);

impl Component for Sum {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>();
    }
}

impl Handle<Add> for Sum {
    async fn handle(&mut self, add: Add, cx: &mut Context<Self>) -> u32 {
        self.0 += add.0;
        cx.publish(Changed(self.0));
        self.0
    }
}

/// Checks that it hears of every sum, once and in order.
#[derive(Default)]
struct Listener {
    heard: u32,
}

impl Component for Listener {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Changed>(); // from whichever node
        ports.serve::<Heard>();
    }
}

impl Handle<Changed> for Listener {
    async fn handle(&mut self, changed: Changed, _: &mut Context<Self>) {
        assert_eq!(changed.0, self.heard + 1);
        self.heard = changed.0;
    }
}

/// Says up to which sum it has heard them all.
#[derive(Debug, Request)]
#[contract(reply = u32)]
struct Heard;

impl Handle<Heard> for Listener {
    async fn handle(&mut self, _: Heard, _: &mut Context<Self>) -> u32 {
        self.heard
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [a1, a2, b1, b2] = free_addresses()?;
    let sums = Node::builder("module2")
        .network(Network::udp("ethernet", a2).link(Link::new("module1", a1)))
        .network(Network::udp("ieee1394", b2).link(Link::new("module1", b1).cost(20)))
        .child(ChildSpec::new("sum", Sum::default))
        .start()
        .await?;
    let node = Node::builder("module1")
        .network(Network::udp("ethernet", a1).link(Link::new("module2", a2)).with_faults(1))
        .network(Network::udp("ieee1394", b1).link(Link::new("module2", b2).cost(20)))
        .child(ChildSpec::new("listener", Listener::default))
        .start()
        .await?;
    let sum: Sender<Add> = node.sender("module2:sum")?;
    let listener: Sender<Heard> = node.sender("listener")?;
    // Both ways, so that `sums` knows who listens.
    assert!(node.connected("module2", PATIENCE).await && sums.connected("module1", PATIENCE).await);

    let mut faults = node.fault_events();
    let cable = node.cable("ethernet").expect("it was described with faults");
    for number in 1..=300 {
        if number == 100 {
            cable.cut(Direction::Both, false);
        }
        assert_eq!(sum.ask(Add(1)).await?, number); // nothing is lost, and nothing done twice
    }
    println!("300 requests answered, one after the other");

    while let Some(event) = faults.next().await {
        let FaultLocation::Link { link, .. } = &event.fault.location else { continue };
        if event.fault.kind == FaultKind::LinkDown && link.as_ref() == "ethernet" {
            println!("{}: {}", event.fault.kind, event.fault.location);
            break;
        }
    }

    while listener.ask(Heard).await? < 300 {} // an event may still be on its way
    println!("300 events heard, once and in order");
    node.shutdown().await;
    sums.shutdown().await;
    Ok(())
}
