//! Each medium that leaves the process carries sealed links.

use super::{PATIENCE, ask, end, node};
use blastema::{Network, Node};
use blastema_ptys::{Adapters, Cable};
use blastema_tests::{RobotKeys, free_addresses};
use std::path::Path;

/// Two nodes on these networks find each other, and ask each other.
async fn carries(folder: &Path, networks: [Network; 2], cipher: &str, requests: u32) -> [Node; 2] {
    let keys = RobotKeys::new(folder, &["left", "right"], 1);
    let [left, right] = networks;
    let left = node(&keys, "left", left).start().await.expect("it starts");
    let right = node(&keys, "right", right).start().await.expect("it starts");
    assert!(left.connected("right", PATIENCE).await, "{:?}", left.links().await);
    assert!(right.connected("left", PATIENCE).await, "{:?}", right.links().await);
    for number in 1..=requests {
        assert_eq!(ask(&left, "right").await, number);
        assert_eq!(ask(&right, "left").await, number);
    }
    for node in [&left, &right] {
        let network = &node.networks()[0];
        assert!(network.sealed && !network.insecure, "{network:?}");
        let links = node.links().await;
        let seal = links[0].seal.expect("it is sealed");
        assert!(seal.cipher.contains(cipher), "{seal:?}");
        let shown = node.snapshot().await;
        for part in [r#""sealed":true"#, &format!(r#""seal":"{}""#, seal.cipher)] {
            assert!(shown.contains(part), "{part} is missing in {shown}");
        }
    }
    [left, right]
}

#[test]
fn udp_tcp_and_unix_sockets_carry_sealed_links() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        for scheme in ["udp", "tcp"] {
            let folder = tempfile::tempdir().expect("a folder");
            let at = free_addresses(2);
            let network = |own: usize, peer: &str| {
                let endpoint = format!("{scheme}://{}", at[own]);
                Network::new("lan", &endpoint).peer(peer, &at[1 - own].to_string())
            };
            end(carries(folder.path(), [network(0, "right"), network(1, "left")], "GCM", 20).await)
                .await;
        }
        let folder = tempfile::tempdir().expect("a folder");
        let socket = |name: &str| folder.path().join(name).display().to_string();
        let network = |own: &str, peer: &str| {
            Network::new("local", &format!("unix://{}", socket(own))).peer(peer, &socket(peer))
        };
        let networks = [network("left", "right"), network("right", "left")];
        end(carries(folder.path(), networks, "GCM", 20).await).await;
    });
}

#[test]
fn a_serial_line_carries_sealed_links_and_a_can_bus_authenticated_ones() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let cable = Cable::new();
        let network = |port: &Path, peer: &str| {
            let endpoint = format!("serial://{}?baud=921600", port.display());
            Network::new("line", &endpoint).peer(peer, "")
        };
        let networks = [network(&cable.left(), "right"), network(&cable.right(), "left")];
        end(carries(folder.path(), networks, "GCM", 20).await).await;

        let folder = tempfile::tempdir().expect("a folder");
        let adapters = Adapters::new();
        [1, 2].into_iter().for_each(|number| adapters.plug(number));
        let network = |own: u8, peer: &str| {
            let port = adapters.port(own);
            let endpoint = format!("slcan://{}?bitrate=1000000&address={own}", port.display());
            Network::new("bus", &endpoint).peer(peer, &(3 - own).to_string())
        };
        end(carries(folder.path(), [network(1, "right"), network(2, "left")], "SHA", 20).await)
            .await;
    });
}

#[test]
fn the_slowest_serial_line_carries_sealed_links_with_the_frames_that_it_chooses() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let cable = Cable::slow(960);
        let network = |port: &Path, peer: &str| {
            let endpoint = format!("serial://{}?baud=9600", port.display());
            Network::new("line", &endpoint).peer(peer, "")
        };
        let networks = [network(&cable.left(), "right"), network(&cable.right(), "left")];
        end(carries(folder.path(), networks, "GCM", 3).await).await;
    });
}
