//! A condition over an operator whose process is killed and started again.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, ConditionState, Connected, Hold, Link, LostCommunicationPolicy, Network, Rung,
};
use blastema_tests::{Notes, PATIENCE, Process, addresses, free_addresses, moves, role, until};
use std::net::SocketAddr;
use std::time::Duration;

const NODES: [&str; 2] = ["rover", "operator"];

#[derive(Clone, Debug, PartialEq, Request)]
#[contract(name = "wheels/drive", reply = ())]
enum Drive {
    Safe,
    Forward,
    Stop,
}

fn network(addresses: &[SocketAddr], own: usize) -> Network {
    let other = 1 - own;
    let link = Link::new(NODES[other], addresses[other]).hello_every(Duration::from_millis(100));
    Network::udp("ethernet", addresses[own]).link(link)
}

#[test]
fn a_process_plays_its_role() {
    let Some(role) = role() else { return };
    assert_eq!(role, "operator");
    blastema::run(async {
        let network = network(&addresses(), 1);
        let node = Node::builder("operator").network(network).start().await.unwrap();
        let _beats = node.heartbeat("operator/beat", Duration::from_millis(50)).unwrap();
        let wheels = node.commander::<Drive>("rover:wheels", "console").unwrap();
        loop {
            if wheels.claim_within(PATIENCE).await.is_ok() {
                while wheels.command(Drive::Forward).await.is_ok() {
                    blastema::sleep(Duration::from_millis(50)).await;
                }
            }
            blastema::sleep(Duration::from_millis(50)).await;
        }
    });
}

#[test]
fn a_killed_operator_is_lost_the_robot_stops_by_itself_and_is_commanded_again_by_the_next() {
    let _turn = blastema_doubles::turn();
    let addresses = free_addresses(2);
    let start = || Process::start(module_path!(), "operator", &addresses);
    blastema::run(async {
        let seen = Notes::<Drive>::default();
        let safe = ActuatorSpec::new(Drive::Safe, Hold).lease(Duration::from_secs(2));
        // It remembers each other command.
        let wheels = moves("wheels", safe, seen.clone(), |seen, drive, _| {
            if seen.lock().last() != Some(&drive) {
                seen.note(drive);
            }
        });
        let beat = || {
            let topic = Connected::heartbeat("operator/beat").timeout(Duration::from_secs(3));
            Connected::all([topic, Connected::session("operator").timeout(PATIENCE)])
        };
        let policy = LostCommunicationPolicy::new("operator", beat())
            .commander("operator")
            .after(Duration::from_millis(100), Rung::command("stop", "wheels", Drive::Stop))
            .until_stable_for(Duration::from_millis(500));
        let node = Node::builder("rover")
            .network(network(&addresses, 0))
            .child(wheels)
            .lost_communication(policy)
            .start()
            .await
            .unwrap();
        let condition = node.condition("operator", beat()).unwrap();
        let drives = async |wanted: Drive| {
            let drives = async || seen.lock().last() == Some(&wanted);
            until(drives, &format!("{wanted:?}")).await;
        };
        for _ in 0..2 {
            let mut operator = start();
            drives(Drive::Forward).await;
            tokio::time::timeout(PATIENCE, condition.acceptable()).await.expect("it is heard");

            operator.kill();
            tokio::time::timeout(PATIENCE, condition.lost()).await.expect("it is silent");
            drives(Drive::Stop).await;
            // The safe command is the same, and comes first.
            let stands = async || node.lost_communication()[0].rung.as_deref() == Some("stop");
            until(stands, "the rung stands").await;
        }
        let mut lost = node.faults().await.entries;
        lost.retain(|entry| entry.fault.kind == FaultKind::ConnectionLost);
        assert_eq!(lost.len(), 2);
        assert_eq!(condition.state(), ConditionState::Lost);
        let _operator = start();
        drives(Drive::Forward).await;
        node.shutdown().await;
    });
}
