//! Processes that are all linked to each other, more of them than the computer has processors.

use blastema::prelude::*;
use blastema::{Link, LinkState, Network, NodeBuilder, NodeState};
use blastema_tests::{Process, addresses, answers, free_addresses, role, until};
use std::net::SocketAddr;
use std::time::Duration;
use tokio::sync::watch;

/// For everything that takes time on a busy computer.
const PATIENCE: Duration = Duration::from_secs(300);
/// With eleven links each, hellos are sent less often than by default.
const NODES: usize = 12;

/// Says how many links of the node are up now that it has been connected with all others, and how
/// many other nodes it ever took for lost.
#[derive(Clone, Debug, Request)]
#[contract(name = "mesh/standing", reply = (u32, u32))]
struct Standing;

async fn member(addresses: &[SocketAddr], own: usize, builder: NodeBuilder) -> Node {
    let mut network = Network::udp("ethernet", addresses[own]);
    let others = (0..NODES).filter(|number| *number != own);
    let others: Vec<_> = others.map(|number| (format!("module{number}"), number)).collect();
    for (name, number) in &others {
        // One that has not come yet is waited for.
        let link = Link::new(name, addresses[*number]).expected_within(Duration::MAX);
        network = network.link(link);
    }
    let node = builder.network(network).start().await.unwrap();
    for (name, _) in &others {
        assert!(node.connected(name, PATIENCE).await, "{name} is not met");
    }
    node
}

async fn standing(node: &Node) -> (u32, u32) {
    let up = node.links().await.iter().filter(|link| link.state == LinkState::Up).count();
    let faults = node.faults().await.entries;
    let lost = faults.iter().filter(|entry| entry.fault.kind == FaultKind::NodeLost).count();
    (up as u32, lost as u32)
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    let own: usize = role.parse().expect("a number");
    blastema::run(async {
        let (report, reported) = watch::channel((0, 0));
        let witness = answers::<Standing>("witness", reported);
        let builder = Node::builder(&format!("module{own}")).child(witness);
        let node = member(&addresses(), own, builder).await;
        loop {
            report.send_replace(standing(&node).await);
            blastema::sleep(Duration::from_millis(100)).await;
        }
    });
}

#[test]
fn a_dozen_processes_are_all_connected_and_none_takes_another_for_lost() {
    let _turn = blastema_doubles::turn();
    let addresses = free_addresses(NODES);
    let start = |own: usize| Process::start(module_path!(), &own.to_string(), &addresses);
    let _processes: Vec<_> = (1..NODES).map(start).collect();
    blastema::run(async {
        let node = member(&addresses, 0, Node::builder("module0")).await;
        let all = NODES as u32 - 1;
        // One after the other: the last is asked after all have met all for a while.
        for number in 1..NODES {
            let witness = node.sender::<Standing>(&format!("module{number}:witness")).unwrap();
            let met = async || {
                // A component of a node in safe state answers nothing.
                let (up, lost) = witness.ask_within(Standing, PATIENCE).await.expect("a reply");
                assert_eq!(lost, 0, "module{number} took a node for lost");
                up == all
            };
            until(met, "all links come up").await;
        }

        let (_, lost) = standing(&node).await;
        assert_eq!(lost, 0, "module0 took a node for lost");
        assert!(!matches!(node.state(), NodeState::InSafeState { .. }));
        node.shutdown().await;
    });
}
