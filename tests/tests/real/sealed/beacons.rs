//! Nodes with keys that find each other by beacons, and beacons that no node of the robot has made.

use super::{PATIENCE, ask, end, node};
use blastema::prelude::*;
use blastema::{FaultKind, Network};
use blastema_tests::{RobotKeys, free_addresses};
use std::net::{SocketAddr, UdpSocket};
use std::path::Path;
use std::time::Duration;

const NODES: [&str; 3] = ["base", "arm", "head"];

async fn start(folder: &Path, own: &str, at: SocketAddr, group: SocketAddr) -> Node {
    let network = Network::new("lan", &format!("udp://{at}"));
    let network = network.discover_all(&group.to_string());
    node(&RobotKeys::there(folder), own, network).start().await.expect("it starts")
}

fn group(last: u8, port: u16) -> SocketAddr {
    SocketAddr::from(([239, 255, 77, last], port))
}

#[test]
fn nodes_with_keys_find_each_other_by_beacons_also_with_rosters_of_two_serial_numbers() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folders = [(); 2].map(|()| tempfile::tempdir().expect("a folder"));
        RobotKeys::new(folders[0].path(), &NODES, 1);
        RobotKeys::new(folders[1].path(), &NODES, 1);
        let newer = RobotKeys::roster(&["arm", "base"], 1, 2);
        let file = folders[1].path().join("ranger.roster");
        std::fs::write(file, newer).expect("a folder");
        let at = free_addresses(3);
        let group = group(21, at[2].port());

        let base = start(folders[0].path(), "base", at[0], group).await;
        let arm = start(folders[1].path(), "arm", at[1], group).await;

        assert!(base.connected("arm", PATIENCE).await, "{:?}", base.links().await);
        assert_eq!(ask(&base, "arm").await, 1);
        assert!(base.links().await.iter().all(|link| link.seal.is_some()));
        end([base, arm]).await;
    });
}

#[test]
fn a_beacon_that_no_node_of_the_robot_has_made_is_not_tried() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        RobotKeys::new(folder.path(), &NODES, 1);
        let at = free_addresses(2);
        let group = group(22, at[1].port());
        let base = start(folder.path(), "base", at[0], group).await;

        // It names the arm, at its own address.
        let liar = UdpSocket::bind("127.0.0.1:0").expect("a free port");
        liar.set_nonblocking(true).expect("it is a socket");
        let port = liar.local_addr().expect("it is bound").port().to_be_bytes();
        let plain = [b"BLB\x01", &port[..], b"arm"].concat();
        let serial = 1_u64.to_be_bytes();
        let forged = [b"BLB\x02", &port[..], &serial, &[0, 3], b"arm", &[7; 16]].concat();
        let lies = async {
            loop {
                for beacon in [&plain, &forged] {
                    // A buffer that is full now is empty a little later.
                    let _ = liar.send_to(beacon, group);
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
        };
        let mut faults = base.fault_events();
        let is_found = async {
            while let Some(event) = faults.next().await {
                if event.fault.location.to_string().starts_with("base:net/links/") {
                    return event.fault;
                }
            }
            panic!("the node has ended");
        };
        let fault = tokio::select! {
            () = lies => unreachable!("it never ends"),
            found = tokio::time::timeout(PATIENCE, is_found) => found.expect("many are refused"),
        };

        assert_eq!(fault.kind, FaultKind::CheckFailed);
        assert!(fault.detail.contains("by beacons"), "{}", fault.detail);
        let mut buffer = [0; 2_000];
        assert!(liar.recv(&mut buffer).is_err(), "nothing was sent there");
        assert_eq!(base.links().await, []);
        base.shutdown().await;
    });
}
