//! A service on three nodes: the one that serves is cut off while it is being asked, and another
//! one goes on counting where it was; when the first returns, it stands by.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Direction, Link, Network, Role, ServiceSpec, StandbyKind, Stateful};
use blastema_examples::free_addresses;
use std::net::SocketAddr;
use std::time::Duration;

/// For the nodes to find each other, and for a standby to take over.
const PATIENCE: Duration = Duration::from_secs(20);
const MEMBERS: [&str; 3] = ["module1", "module2", "module3"];

/// Adds one, and answers the sum.
#[derive(Clone, Debug, Request)]
#[contract(name = "counter/add", reply = u64)]
struct Add;

#[derive(Default)]
struct Counter(u64);

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>();
    }
}

impl Handle<Add> for Counter {
    async fn handle(&mut self, _: Add, _: &mut Context<Self>) -> u64 {
        self.0 += 1;
        self.0
    }
}

impl Stateful for Counter {
    fn save(&self) -> Vec<u8> {
        self.0.to_le_bytes().into()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        let bytes = state.try_into().map_err(|_| Failure::from("a sum has eight bytes"))?;
        self.0 = u64::from_le_bytes(bytes);
        Ok(())
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let addresses = free_addresses()?;
    let mut carriers = Vec::new();
    for number in 1..=3 {
        // The one line:
        let counter = ServiceSpec::new("counter", MEMBERS, Counter::default);
        let node = Node::builder(MEMBERS[number - 1]).network(ethernet(&addresses, number));
        carriers.push(node.service(counter.standby(StandbyKind::Hot)).start().await?);
    }
    let node = Node::builder("module0").network(ethernet(&addresses, 0)).start().await?;
    let counter = node.service::<Add>("counter")?;

    let mut sum = 0;
    while sum < 100 {
        sum = counter.ask_within(Add, PATIENCE).await?;
    }
    let primary = counter.primary().expect("a replica has answered");
    println!("{sum} counted");

    let old = carriers.iter().find(|node| *node.name() == primary).expect("it is one of them");
    let cable = old.cable("ethernet").expect("it was described with faults");
    cable.cut(Direction::Both, false);
    println!("-- the node that serves is cut off");
    while sum < 200 {
        let next = counter.ask_within(Add, PATIENCE).await?;
        assert_eq!(next, sum + 1); // nothing is forgotten, and nothing counted twice
        sum = next;
    }
    let follower = counter.primary().expect("a replica has answered");
    println!("{sum} counted, by another node: {}", follower != primary);

    cable.restore();
    assert!(node.connected(primary.as_str(), PATIENCE).await);
    let stands_by = |role| matches!(role, Some(Role::Standby { in_step: true, .. }));
    while !stands_by(old.service_role("counter")) {
        counter.ask_within(Add, PATIENCE).await?;
    }
    println!("the first one is back, and stands by");
    for node in carriers.iter().chain([&node]) {
        node.shutdown().await;
    }
    Ok(())
}

/// The network of node `own`, with a link to every other.
fn ethernet(addresses: &[SocketAddr; 4], own: usize) -> Network {
    let mut network = Network::udp("ethernet", addresses[own]).with_faults(1);
    for (number, address) in addresses.iter().enumerate().filter(|(number, _)| *number != own) {
        network = network.link(Link::new(&format!("module{number}"), *address));
    }
    network
}
