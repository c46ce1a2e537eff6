//! A node that starts while it is waited for, and one that may be away.

use crate::scenarios::puppet::{Deed, Pull, Strings, ask};
use blastema::prelude::*;
use blastema::{MemoryMedium, Network, NodeBuilder};
use blastema_testkit::TestNode;
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

fn node(
    medium: &MemoryMedium,
    [own, peer]: [&str; 2],
    child: ChildSpec<impl Component>,
) -> NodeBuilder {
    let network = Network::memory("ethernet", medium, own).with_faults(7).peer(peer, peer);
    Node::builder(own).network(network).child(child)
}

#[blastema_testkit::test]
async fn a_node_is_connected_when_its_start_is_over_and_its_objects_answer() {
    let (medium, strings) = (MemoryMedium::default(), Strings::default());
    let base = node(&medium, ["base", "laptop"], strings.spec("planner"));
    let base = TestNode::start(base).await;
    let laptop = || node(&medium, ["laptop", "base"], strings.spec("pad"));
    let pull = || strings.pull("pad", "on_activated", Pull::Wait(SECOND));
    for _ in 0..3 {
        pull();
        let (laptop, connected) = tokio::join!(TestNode::start(laptop()), async {
            let connected = base.connected("laptop", 20 * SECOND).await;
            for _ in 0..20 {
                assert_eq!(ask(&base, "laptop:pad", Deed::Nothing).await.unwrap(), 1);
            }
            connected
        });
        assert!(connected);
        laptop.shutdown().await;
        base.advance(SECOND).await;
        assert!(!base.connected("laptop", SECOND).await);
    }
}
