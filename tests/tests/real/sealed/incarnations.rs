//! Nodes that are restarted while their clock is set back: the file beside the key says which
//! incarnation was the last.

use super::{PATIENCE, ask, end, node};
use blastema::prelude::*;
use blastema::{Network, NodeName};
use blastema_tests::{RobotKeys, free_addresses};
use std::fs;
use std::net::SocketAddr;
use std::path::Path;

const NODES: [&str; 2] = ["left", "right"];
const DAY: u64 = 24 * 60 * 60 * 1000;

async fn start(folder: &Path, at: &[SocketAddr], own: usize) -> Node {
    let (name, other) = (NODES[own], NODES[1 - own]);
    let network = Network::new("lan", &format!("udp://{}", at[own]));
    let network = network.peer(other, &at[1 - own].to_string());
    node(&RobotKeys::there(folder), name, network).start().await.expect("it starts")
}

async fn incarnation(node: &Node) -> u64 {
    node.incarnation().0
}

/// Which incarnation of the other node this one has a session with.
async fn met(node: &Node, other: &str) -> Option<u64> {
    let other = NodeName::new(other).expect("a name");
    let rows = node.sessions().await;
    let row = rows.iter().find(|row| row.node == other);
    row.and_then(|row| row.status.incarnation).map(|incarnation| incarnation.0)
}

#[test]
fn a_node_that_is_restarted_with_its_clock_set_back_by_a_day_is_taken_by_its_peers_at_once() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        RobotKeys::new(folder.path(), &NODES, 1);
        let at = free_addresses(2);
        let (left, right) =
            (start(folder.path(), &at, 0).await, start(folder.path(), &at, 1).await);
        assert!(left.connected("right", PATIENCE).await);
        let first = incarnation(&right).await;
        right.shutdown().await;

        // As if the clock had been a day ahead until now.
        let file = folder.path().join("right.incarnation");
        let kept = fs::read_to_string(&file).expect("it was written at the start");
        assert!(kept.contains(&first.to_string()), "{kept}");
        let ahead = first + DAY;
        fs::write(&file, kept.replace(&first.to_string(), &ahead.to_string())).expect("it is ours");
        let right = start(folder.path(), &at, 1).await;

        assert_eq!(incarnation(&right).await, ahead + 1);
        assert!(left.connected("right", PATIENCE).await);
        assert_eq!(ask(&left, "right").await, 1);
        assert_eq!(met(&left, "right").await, Some(ahead + 1));
        let kept = fs::read_to_string(&file).expect("it is there");
        assert!(kept.contains(&(ahead + 1).to_string()), "{kept}");
        end([left, right]).await;
    });
}

#[test]
fn a_node_that_cannot_keep_its_incarnation_starts_all_the_same() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        RobotKeys::new(folder.path(), &NODES, 1);
        fs::create_dir(folder.path().join("left.incarnation")).expect("a folder");
        fs::write(folder.path().join("right.incarnation"), "nonsense").expect("a folder");
        let at = free_addresses(2);

        let (left, right) =
            (start(folder.path(), &at, 0).await, start(folder.path(), &at, 1).await);

        assert!(left.connected("right", PATIENCE).await);
        assert_eq!(ask(&left, "right").await, 1);
        end([left, right]).await;
    });
}

/// The right node is restarted with a number that lies a day back, as its file says.
async fn restarted_a_day_back(numbers: [usize; 2]) {
    let folder = tempfile::tempdir().expect("a folder");
    RobotKeys::new(folder.path(), &NODES, 1);
    let at = free_addresses(2);
    let [stays, restarts] = numbers;
    let stays = start(folder.path(), &at, stays).await;
    let name = NODES[restarts];
    // As if the clock had been a day ahead.
    let ahead = incarnation(&stays).await + DAY;
    let file = folder.path().join(format!("{name}.incarnation"));
    let text = format!("blastema incarnation 1\nnode {name}\nincarnation {ahead}\n");
    fs::write(&file, text).expect("a folder");
    let first = start(folder.path(), &at, restarts).await;
    assert!(stays.connected(name, PATIENCE).await);
    assert_eq!(met(&stays, name).await, Some(ahead + 1));
    first.shutdown().await;

    // The file is lost with it.
    fs::remove_file(&file).expect("it is ours");
    let second = start(folder.path(), &at, restarts).await;

    assert!(stays.connected(name, PATIENCE).await);
    assert_eq!(ask(&stays, name).await, 1);
    assert_eq!(ask(&second, NODES[numbers[0]]).await, 1);
    let lower = incarnation(&second).await;
    assert!(lower < ahead);
    assert_eq!(met(&stays, name).await, Some(lower));
    let kept = fs::read_to_string(&file).expect("it is there");
    assert!(kept.contains(&lower.to_string()), "{kept}");
    for node in [&stays, &second] {
        let faults = node.faults().await.entries;
        assert!(faults.iter().all(|entry| !entry.stands()), "{faults:?}");
    }
    end([stays, second]).await;
}

#[test]
fn a_node_whose_number_is_lost_starts_by_its_clock_and_is_taken_by_its_peer() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        restarted_a_day_back([0, 1]).await;
        restarted_a_day_back([1, 0]).await;
    });
}
