//! Names without a node: two of three nodes can draw the map, and who asks for it need not know
//! which one does. The nodes also find each other by themselves: the asker has only described the
//! first, and finds the second by its beacons.
//!
//! All nodes live in one process here, so that the example is one program; as three programs they
//! would be the same.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{ClaimPolicy, LinkRow, LinkState, Network, NodeBuilder};
use blastema_examples::free_addresses;
use std::net::SocketAddr;
use std::time::Duration;

/// For nodes to find each other, and names their holders.
const PATIENCE: Duration = Duration::from_secs(30);

/// Asks who draws the map.
#[derive(Debug, Request)]
#[contract(name = "map/author", reply = String)]
struct Author;

/// Draws the map.
struct Cartographer(&'static str);

impl Component for Cartographer {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Author>();
    }
}

impl Handle<Author> for Cartographer {
    async fn handle(&mut self, _: Author, _: &mut Context<Self>) -> String {
        self.0.to_owned()
    }
}

/// A node that sends its address to the group, and makes a link to each node that does the same.
fn node(name: &str, own: SocketAddr, group: &str, peers: &[(&str, SocketAddr)]) -> NodeBuilder {
    let mut network = Network::udp("ethernet", own).discover_anybody(group);
    for (peer, address) in peers {
        network = network.peer(peer, &address.to_string());
    }
    Node::builder(name).network(network)
}

/// The component claims `map` while it is at work, or stands by for it.
fn cartographer(on: &'static str) -> ChildSpec<Cartographer> {
    ChildSpec::new("cartographer", move || Cartographer(on)).claim("map", ClaimPolicy::Standby)
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [a, b, c, group] = free_addresses()?;
    let group = format!("239.255.77.11:{}", group.port());
    let first = node("module1", a, &group, &[("module2", b), ("asker", c)]);
    let first = first.child(cartographer("module1")).start().await?;
    let asker = node("asker", c, &group, &[("module1", a)]).start().await?;
    let mut watch = asker.watch_name("map")?;
    println!("map is at {}", tokio::time::timeout(PATIENCE, watch.held()).await?);

    let second = node("module2", b, &group, &[("module1", a)]);
    let second = second.child(cartographer("module2")).start().await?;
    // Once they have received each other's beacons, they have a link of their own.
    tokio::time::timeout(PATIENCE, linked(&asker, "module2")).await?;
    let map: Sender<Author> = asker.sender("*:map")?;
    assert_eq!(map.ask(Author).await?, "module1"); // module2 stands by

    // The node that holds the name, and that the others were told of, ends without a word.
    drop(first);
    println!("map is at {}", tokio::time::timeout(PATIENCE, watch.held()).await?);
    assert_eq!(map.ask(Author).await?, "module2"); // the same sender

    second.shutdown().await;
    asker.shutdown().await;
    Ok(())
}

/// Waits for a link to a neighbour that is not described.
async fn linked(node: &Node, neighbour: &str) {
    let up = |link: &LinkRow| {
        let found = link.neighbour.as_ref().is_some_and(|found| found.node.as_str() == neighbour);
        found && link.state == LinkState::Up
    };
    while !node.links().await.iter().any(up) {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
