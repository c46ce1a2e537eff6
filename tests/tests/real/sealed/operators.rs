//! What operators ask and order: over a session of their own, from an address that no node
//! describes.
//!
//! ```text
//!   laptop ┄┄┄ base ───── arm
//! ```

use super::{PATIENCE, ask, end, node, until};
use blastema::core::net::trust::policy::Role;
use blastema::prelude::*;
use blastema::{LinkState, Network, OrderError};
use blastema_tests::{RobotKeys, free_addresses};
use std::fs;
use std::net::SocketAddr;
use tempfile::TempDir;

const NODES: [&str; 3] = ["base", "arm", "laptop"];

struct Robot {
    folders: [TempDir; 3],
    at: Vec<SocketAddr>,
}

impl Robot {
    fn new(laptop: Role, policy: &[&str]) -> Self {
        let folders = NODES.map(|_| tempfile::tempdir().expect("a folder"));
        for folder in &folders {
            RobotKeys::new(folder.path(), &NODES, 1);
        }
        let robot = Robot { folders, at: free_addresses(2) };
        (0..3).for_each(|own| robot.put(own, laptop, policy, 1));
        robot
    }

    /// Puts a roster beside the key of one.
    fn put(&self, own: usize, laptop: Role, policy: &[&str], serial: u64) {
        let nodes = [("base", Role::Node), ("arm", Role::Node), ("laptop", laptop)];
        let text = RobotKeys::roster_with(&nodes, policy, 1, serial);
        let folder = self.folders[own].path();
        fs::write(folder.join("copied"), text).expect("a folder");
        fs::rename(folder.join("copied"), folder.join("ranger.roster")).expect("a folder");
    }

    async fn start(&self, own: usize) -> Node {
        let network = match own {
            2 => Network::new("lan", "udp://127.0.0.1:0").peer("base", &self.at[0].to_string()),
            _ => Network::new("lan", &format!("udp://{}", self.at[own]))
                .peer(NODES[1 - own], &self.at[1 - own].to_string()),
        };
        let keys = RobotKeys::there(self.folders[own].path());
        node(&keys, NODES[own], network).start().await.expect("it starts")
    }
}

#[test]
fn an_operator_that_no_node_describes_connects_and_reads_the_state_of_all_keys() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new(Role::Operator, &[]);
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        for round in 1..=2 {
            let laptop = robot.start(2).await;
            assert!(laptop.connected("base", PATIENCE).await, "round {round}");
            assert!(laptop.connected("arm", PATIENCE).await);
            assert_eq!(ask(&laptop, "arm").await, round);

            for (own, node) in [("base", &base), ("arm", &arm)] {
                let status = laptop.key_status_of(own, PATIENCE).await.expect("it may");
                assert_eq!(status.serial, 1);
                assert_eq!(status.fingerprint.len(), "9f:3c:00:00:00:00:00:00".len());
                let lan = &status.networks[..];
                assert!(matches!(lan, [lan] if lan.network == "lan" && lan.sealed), "{lan:?}");
                assert!(node.refusals().is_empty());
            }
            laptop.shutdown().await;
        }

        // It has left, and is missed by none.
        let is_forgotten = async || base.links().await.len() == 1;
        until(is_forgotten, "the link to the operator is forgotten").await;
        for node in [&base, &arm] {
            let faults = node.faults().await.entries;
            assert!(faults.iter().all(|entry| !entry.stands()), "{faults:?}");
        }
        end([base, arm]).await;
    });
}

#[test]
fn an_operator_isolates_a_node_and_admits_it_and_the_fault_says_who() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let robot = Robot::new(Role::Operator, &[]);
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        let laptop = robot.start(2).await;
        assert!(base.connected("arm", PATIENCE).await && laptop.connected("base", PATIENCE).await);

        let ordered = laptop.order_isolation("base", "arm", "it smokes", PATIENCE).await;
        assert_eq!(ordered, Ok(()));
        let is_told = async || {
            let faults = base.faults().await.entries;
            let of_arm = |detail: &str| detail.contains("by order of laptop: it smokes");
            faults.iter().any(|entry| entry.stands() && of_arm(&entry.fault.detail))
        };
        until(is_told, "the fault names the operator and the reason").await;

        let ordered = laptop.order_admission("base", "arm", "", PATIENCE).await;
        assert_eq!(ordered, Ok(()));
        assert!(base.connected("arm", PATIENCE).await);
        assert_eq!(ask(&base, "arm").await, 1);
        let is_calm = async || !base.faults().await.entries.iter().any(|entry| entry.stands());
        until(is_calm, "no fault stands").await;

        let oneself = laptop.order_isolation("base", "base", "", PATIENCE).await;
        assert!(matches!(&oneself, Err(OrderError::Refused(why)) if why.contains("itself")));
        let unknown = laptop.order_isolation("base", "leg", "", PATIENCE).await;
        assert!(matches!(&unknown, Err(OrderError::Refused(why)) if why.contains("leg")));
        end([base, arm, laptop]).await;
    });
}

#[test]
fn a_node_without_the_right_orders_nothing_and_is_in_the_audit_log() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let robot = Robot::new(Role::Operator, &[]);
        let (base, arm) = (robot.start(0).await, robot.start(1).await);
        assert!(base.connected("arm", PATIENCE).await);

        let ordered = arm.order_isolation("base", "laptop", "", PATIENCE).await;
        let refused = |ordered: &Result<(), OrderError>| {
            matches!(ordered, Err(OrderError::Delivery(DeliveryError::Forbidden { .. })))
        };
        assert!(refused(&ordered), "{ordered:?}");
        let read = arm.key_status_of("base", PATIENCE).await;
        assert!(matches!(read, Err(DeliveryError::Forbidden { .. })), "{read:?}");
        let refusals = base.refusals();
        let [first, second] = &refusals[..] else { panic!("{refusals:?}") };
        for (refusal, contract) in
            [(first, "blastema/key-status"), (second, "blastema/order-isolation")]
        {
            assert_eq!(refusal.node.as_str(), "arm");
            assert_eq!((refusal.verb, refusal.object.as_str()), ("operate", "base"));
            assert_eq!(refusal.contract, contract);
        }

        // A line gives the right to a node, and takes it from operators that it does not name.
        let line = ["only arm may operate on base"];
        robot.put(0, Role::Operator, &line, 2);
        let may = async || arm.key_status_of("base", PATIENCE).await.is_ok();
        until(may, "the line gives it").await;
        let laptop = robot.start(2).await;
        assert!(laptop.connected("base", PATIENCE).await);
        let ordered = laptop.order_isolation("base", "arm", "", PATIENCE).await;
        assert!(refused(&ordered), "{ordered:?}");
        end([base, arm, laptop]).await;
    });
}

#[test]
fn a_node_that_is_no_operator_does_not_connect_by_itself() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let robot = Robot::new(Role::Node, &[]);
        let (base, laptop) = (robot.start(0).await, robot.start(2).await);

        let is_refused = async || {
            let links = laptop.links().await;
            links.iter().all(|link| link.state != LinkState::Up)
        };
        assert!(!laptop.connected("base", std::time::Duration::from_secs(2)).await);
        assert!(is_refused().await);
        assert_eq!(base.links().await.len(), 1);
        end([base, laptop]).await;
    });
}
