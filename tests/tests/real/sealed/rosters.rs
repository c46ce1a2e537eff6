//! A changed roster that is put beside one node's key, and how it reaches the others: each node has
//! a folder of its own.
//!
//! ```text
//!   base ───── arm ───── head
//! ```

use super::{PATIENCE, ask, end, node, until};
use blastema::prelude::*;
use blastema::{Fault, LinkState, Network};
use blastema_tests::{RobotKeys, free_addresses};
use std::fs;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

const NODES: [&str; 3] = ["base", "arm", "head"];
/// Who has a cable to whom, by places in [`NODES`].
const PEERS: [&[usize]; 3] = [&[1], &[0, 2], &[1]];

struct Robot {
    folders: [TempDir; 3],
    at: Vec<SocketAddr>,
}

impl Robot {
    fn new() -> Self {
        let folders = NODES.map(|_| tempfile::tempdir().expect("a folder"));
        for folder in &folders {
            RobotKeys::new(folder.path(), &NODES, 1);
        }
        Robot { folders, at: free_addresses(3) }
    }

    async fn start(&self, own: usize) -> Node {
        let keys = RobotKeys::there(self.folders[own].path());
        let network = Network::new("lan", &format!("udp://{}", self.at[own]));
        let network = PEERS[own]
            .iter()
            .fold(network, |network, peer| network.peer(NODES[*peer], &self.at[*peer].to_string()));
        node(&keys, NODES[own], network).start().await.expect("it starts")
    }

    fn file(&self, own: usize) -> PathBuf {
        self.folders[own].path().join("ranger.roster")
    }

    /// Puts a roster of these nodes beside the key of one.
    fn put(&self, own: usize, nodes: &[&str], serial: u64) -> String {
        let text = RobotKeys::roster(nodes, 1, serial);
        let new = self.folders[own].path().join("copied");
        fs::write(&new, &text).expect("a folder");
        fs::rename(&new, self.file(own)).expect("a folder");
        text
    }
}

async fn holds(file: &Path, text: &str) {
    let is_there = async || fs::read_to_string(file).is_ok_and(|there| there == text);
    until(is_there, &format!("{} is the newest", file.display())).await;
}

#[test]
fn a_roster_that_one_node_is_given_reaches_all_and_those_that_were_off() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new();
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        let head = robot.start(2).await;
        assert!(base.connected("head", PATIENCE).await);
        assert_eq!(ask(&base, "head").await, 1);

        let second = robot.put(0, &["base", "arm", "head", "gripper"], 2);
        holds(&robot.file(1), &second).await;
        holds(&robot.file(2), &second).await;
        // Sessions and keys of nodes that are listed as before are what they were.
        assert_eq!(ask(&base, "head").await, 2);

        head.shutdown().await;
        let third = robot.put(0, &NODES, 3);
        holds(&robot.file(1), &third).await;
        assert_eq!(fs::read_to_string(robot.file(2)).expect("it is there"), second);
        let head = robot.start(2).await;
        holds(&robot.file(2), &third).await;

        // An older one is refused by the node that it is put beside, and reaches no other.
        robot.put(2, &["base", "arm", "head", "gripper"], 2);
        assert!(base.connected("head", PATIENCE).await);
        assert_eq!(ask(&base, "head").await, 1);
        assert_eq!(fs::read_to_string(robot.file(1)).expect("it is there"), third);
        end([base, arm, head]).await;
    });
}

#[test]
fn a_node_that_is_revoked_at_one_end_loses_its_links_at_the_other() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let robot = Robot::new();
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        let head = robot.start(2).await;
        assert!(base.connected("head", PATIENCE).await && head.connected("base", PATIENCE).await);

        // The arm cannot keep it, and uses it.
        fs::remove_dir_all(robot.folders[1].path()).expect("it is ours");
        robot.put(0, &["base", "arm"], 2);

        let is_down = async || {
            let links = arm.links().await;
            links.iter().any(|link| link.state == LinkState::Down)
        };
        until(is_down, "the arm drops its link with the head").await;
        let is_lost = async || {
            let counter = base.sender::<super::Count>("head:head-counter").expect("a name");
            counter.ask(super::Count).await.is_err()
        };
        until(is_lost, "the base does not reach it").await;
        assert_eq!(ask(&base, "arm").await, 1);
        end([base, arm, head]).await;
    });
}

/// The kinds of the faults that stand on a node, of which nothing else is asked.
async fn standing(node: &Node) -> Vec<FaultKind> {
    let faults = node.faults().await.entries.into_iter();
    let standing = faults.filter(|entry| entry.stands());
    standing.map(|entry| entry.fault.kind).collect()
}

#[test]
fn a_node_that_is_revoked_while_it_runs_is_told_why_and_missed_by_none() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let robot = Robot::new();
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        let head = robot.start(2).await;
        assert!(base.connected("head", PATIENCE).await && head.connected("base", PATIENCE).await);

        robot.put(0, &["base", "arm"], 2);

        let is_told = async || {
            let faults = head.faults().await.entries;
            faults.iter().any(|entry| {
                let Fault { kind, detail, .. } = &entry.fault;
                *kind == FaultKind::CheckFailed && detail.contains("it was revoked")
            })
        };
        until(is_told, "the head hears that it was revoked").await;
        let is_missed = async || standing(&head).await.contains(&FaultKind::NodeLost);
        until(is_missed, "the head has lost the others").await;
        let is_down = async || {
            let links = arm.links().await;
            links.iter().any(|link| link.state == LinkState::Down)
        };
        until(is_down, "the arm drops its link with the head").await;
        let removed = async |node: &Node| {
            let rows = node.table().await;
            let row = rows.iter().find(|row| row.location.to_string() == "head");
            row.and_then(|row| row.note.clone()).is_some_and(|note| note.contains("does not list"))
        };
        until(async || removed(&base).await, "the base shows that it is listed no more").await;
        until(async || removed(&arm).await, "the arm shows that it is listed no more").await;
        for node in [&base, &arm] {
            assert_eq!(standing(node).await, [], "on {}", node.name());
        }

        // It was a mistake: the same process is at work again.
        robot.put(0, &NODES, 3);
        robot.put(2, &NODES, 3);
        assert!(base.connected("head", PATIENCE).await);
        assert_eq!(ask(&base, "head").await, 1);
        let is_calm = async || standing(&head).await.is_empty();
        until(is_calm, "no fault stands on the head").await;
        end([base, arm, head]).await;
    });
}
