//! Nodes whose networks are sealed, over real sockets: that they find each other, what an attacker
//! between them can do, and which keys are refused. Judged by counts and order.

mod attacker;
mod beacons;
mod incarnations;
mod media;
mod operators;
mod policy;
mod processes;
mod relay;
mod rosters;
mod seen;
mod start;

use blastema::prelude::*;
use blastema::{LinkState, Network, NodeBuilder};
use blastema_tests::{PATIENCE, Part, RobotKeys, serves, until};

/// Counts: the answer is how often it was asked.
#[derive(Clone, Debug, Request)]
#[contract(name = "sealed/count", reply = u32)]
struct Count;

fn counter(of: &str) -> ChildSpec<Part<u32, Count>> {
    serves(&format!("{of}-counter"), 0, |count, _: Count, _| {
        *count += 1;
        *count
    })
}

/// The node `own` with a counter of the name `<own>-counter`.
fn node(keys: &RobotKeys, own: &str, network: Network) -> NodeBuilder {
    Node::builder(own).work_threads(1).keys(keys.of(own)).network(network).child(counter(own))
}

async fn is_up(node: &Node) -> bool {
    node.links().await.iter().any(|link| link.state == LinkState::Up)
}

/// Ends them in order, one after the other.
async fn end(nodes: impl IntoIterator<Item = Node>) {
    for node in nodes {
        node.shutdown().await;
    }
}

/// Asks the other node's counter, and returns its answer.
async fn ask(node: &Node, of: &str) -> u32 {
    let name = format!("{of}:{of}-counter");
    let counter = node.sender::<Count>(&name).expect("a name");
    counter.ask_within(Count, PATIENCE).await.expect("it answers")
}
