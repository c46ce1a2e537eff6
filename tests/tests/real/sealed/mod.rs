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
use blastema_tests::RobotKeys;
use std::time::Duration;

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(120);

/// Counts: the answer is how often it was asked.
#[derive(Clone, Debug, Request)]
#[contract(name = "sealed/count", reply = u32)]
struct Count;

struct Counter(u32);

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Count>();
    }
}

impl Handle<Count> for Counter {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u32 {
        self.0 += 1;
        self.0
    }
}

/// The node `own` with a counter of the name `<own>-counter`.
fn node(keys: &RobotKeys, own: &str, network: Network) -> NodeBuilder {
    let counter = ChildSpec::new(&format!("{own}-counter"), || Counter(0));
    Node::builder(own).work_threads(1).keys(keys.of(own)).network(network).child(counter)
}

async fn until(mut holds: impl AsyncFnMut() -> bool, what: &str) {
    let held = async {
        while !holds().await {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    assert!(tokio::time::timeout(PATIENCE, held).await.is_ok(), "{what}");
}

async fn is_up(node: &Node) -> bool {
    node.links().await.iter().any(|link| link.state == LinkState::Up)
}

/// Asks the other node's counter, and returns its answer.
async fn ask(node: &Node, of: &str) -> u32 {
    let name = format!("{of}:{of}-counter");
    let counter = node.sender::<Count>(&name).expect("a name");
    counter.ask_within(Count, PATIENCE).await.expect("it answers")
}
