//! Which keys a node starts with.

use super::{PATIENCE, ask, end, node, until};
use blastema::prelude::*;
use blastema::{FaultKind, KeysPermissions, Link, LinkState, Network, NodeBuilder, StartError};
use blastema_tests::{RobotKeys, free_addresses};
use std::env;
use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

const NODES: [&str; 2] = ["left", "right"];

fn udp() -> Network {
    Network::new("lan", "udp://127.0.0.1:0").peer("right", "127.0.0.1:9")
}

async fn refused(keys: &RobotKeys, network: Network) -> String {
    match node(keys, "left", network).start().await {
        Err(StartError::Keys(text) | StartError::Network(text)) => text,
        other => panic!("{other:?}"),
    }
}

fn set_mode(file: &Path, mode: u32) {
    fs::set_permissions(file, Permissions::from_mode(mode)).expect("it is ours");
}

#[test]
fn keys_that_cannot_be_used_are_refused_with_what_to_do() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let (path, in_text) = (folder.path(), folder.path().display().to_string());
        let keys = RobotKeys::new(path, &NODES, 1);
        let roster = path.join("ranger.roster");
        let good = fs::read(&roster).unwrap();
        let own = fs::read(keys.of("left")).unwrap();
        let check = async |network: Network, words: &[&str]| {
            let text = refused(&keys, network).await;
            assert!(words.iter().all(|word| text.contains(word)), "{text}");
        };

        set_mode(&keys.of("left"), 0o644);
        check(udp(), &["left.key can be read by others (mode 0644): chmod 600", &in_text]).await;
        set_mode(&keys.of("left"), 0o600);
        fs::copy(keys.of("right"), keys.of("left")).unwrap();
        check(udp(), &["is the key of right, and this node is called left: copy left.key"]).await;
        fs::write(keys.of("left"), "blastema node key 1\n").unwrap();
        check(udp(), &["left.key: line"]).await;
        fs::write(keys.of("left"), &own).unwrap();

        fs::remove_file(&roster).unwrap();
        check(udp(), &["ranger.roster cannot be read", "copy ranger.roster beside"]).await;
        // Signed by another, as by an attacker who may write it.
        let other = tempfile::tempdir().expect("a folder");
        RobotKeys::new(other.path(), &NODES, 2);
        fs::copy(other.path().join("ranger.roster"), &roster).unwrap();
        check(udp(), &["ranger.roster", "sign"]).await;
        let revoked = tempfile::tempdir().expect("a folder");
        RobotKeys::new(revoked.path(), &["base", "right"], 1);
        fs::copy(revoked.path().join("ranger.roster"), &roster).unwrap();
        check(udp(), &["left is not in roster 1 of ranger", "copy the newest roster"]).await;
        fs::write(&roster, &good).unwrap();
        set_mode(&roster, 0o664);
        check(udp(), &["ranger.roster can be changed by others (mode 0664): chmod go-w"]).await;
        set_mode(&roster, 0o644);

        check(udp().insecure(), &["network lan is insecure and the node has keys"]).await;
        let unknown = Network::new("lan", "udp://127.0.0.1:0").peer("gripper", "127.0.0.1:9");
        check(unknown, &["gripper", "is not in roster 1 of ranger", "keys add gripper"]).await;
        let small = Network::new("line", "serial:///dev/ttyS99?mtu=96").peer("right", "");
        check(small, &["network line", "96 bytes", "mtu=120"]).await;
        let twice = udp().link(Link::to("right", "127.0.0.1:10").named("second"));
        check(twice, &["two links of network lan lead to right"]).await;

        let node = node(&keys, "left", udp()).start().await.expect("nothing is wrong any more");
        node.shutdown().await;
    });
}

/// As in a container that has mounted them.
#[test]
fn keys_with_unchecked_permissions_and_the_robots_secret_beside_them_are_a_standing_fault() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let stands = async |builder: NodeBuilder, words: &str| {
            let node = builder.start().await.expect("it starts");
            let is_told = async || {
                let mut faults = node.faults().await.entries.into_iter().map(|entry| entry.fault);
                faults
                    .any(|fault| fault.kind == FaultKind::Insecure && fault.detail.contains(words))
            };
            until(is_told, words).await;
            node.shutdown().await;
        };

        set_mode(&keys.of("left"), 0o644);
        set_mode(folder.path(), 0o777);
        let unchecked = node(&keys, "left", udp()).keys_permissions(KeysPermissions::Unchecked);
        stands(unchecked, "permissions are unchecked").await;

        set_mode(&keys.of("left"), 0o600);
        set_mode(folder.path(), 0o700);
        fs::write(folder.path().join("ranger.robot"), "a secret").expect("a folder");
        stands(node(&keys, "left", udp()), "signs the roster, and lies on a node").await;
    });
}

#[test]
fn the_same_network_is_refused_without_keys_and_starts_with_them() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let open = || Network::new("lan", "udp://0.0.0.0:0").peer("right", "127.0.0.1:9");

        let without = Node::builder("left").network(open()).start().await;

        let Err(StartError::Insecure { .. }) = &without else { panic!("{without:?}") };
        let text = without.unwrap_err().to_string();
        assert!(text.contains("blastema keys new") && text.contains(".insecure()"), "{text}");
        let with = node(&keys, "left", open()).start().await.expect("it has keys");
        assert!(with.networks()[0].sealed && !with.networks()[0].insecure);
        with.shutdown().await;
    });
}

/// An impostor at the neighbour's address, which is a node of another robot.
#[test]
fn a_node_with_other_keys_gets_no_link_and_no_word() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let (folder, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        let others = RobotKeys::new(other.path(), &NODES, 2);
        for scheme in ["udp", "tcp"] {
            let at = free_addresses(2);
            let network = |own: usize, peer: &str| {
                let endpoint = format!("{scheme}://{}", at[own]);
                let link = Link::to(peer, &at[1 - own].to_string());
                Network::new("lan", &endpoint).link(link.expected_within(Duration::from_secs(1)))
            };
            let left = node(&keys, "left", network(0, "right")).start().await.unwrap();
            let impostor = node(&others, "right", network(1, "left")).start().await.unwrap();
            for node in [&left, &impostor] {
                let never_heard = async || {
                    let mut entries = node.faults().await.entries.into_iter();
                    let cause = "frames came that no node of this robot has sealed";
                    entries.any(|entry| entry.fault.detail.contains(cause))
                };
                until(never_heard, "the neighbour does not come").await;
                let link = &node.links().await[0];
                assert_eq!(link.state, LinkState::Connecting, "{scheme}: {link:?}");
                assert!(link.seal.is_none() && link.neighbour.is_none(), "{link:?}");
                assert_eq!(node.sessions().await.len(), 0);
            }
            impostor.shutdown().await;
            // The true one, at the same address, is taken at once.
            let right = node(&keys, "right", network(1, "left")).start().await.unwrap();
            assert!(left.connected("right", PATIENCE).await, "{scheme}: {:?}", left.links().await);
            assert_eq!(ask(&left, "right").await, 1);
            end([left, right]).await;
        }
    });
}

#[test]
fn both_ends_are_told_of_the_key_that_one_of_them_lacks() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().unwrap();
        let keys = RobotKeys::new(folder.path(), &NODES, 1);
        for scheme in ["udp", "tcp"] {
            let at = free_addresses(2);
            let network = |own: usize, peer: &str| {
                let endpoint = format!("{scheme}://{}", at[own]);
                let link = Link::to(peer, &at[1 - own].to_string());
                Network::new("lan", &endpoint).link(link.expected_within(Duration::from_secs(1)))
            };
            let left = node(&keys, "left", network(0, "right")).start().await.unwrap();
            let right = Node::builder("right").work_threads(1).network(network(1, "left"));
            let right = right.start().await.unwrap();

            for (node, cause) in [
                (&left, "perhaps right has no key, or an old one"),
                (&right, "perhaps left has a key, and this node has none"),
            ] {
                let is_told = async || {
                    let mut entries = node.faults().await.entries.into_iter();
                    entries.any(|entry| entry.fault.detail.contains(cause))
                };
                until(is_told, cause).await;
            }
            end([left, right]).await;
        }
    });
}

#[test]
fn a_relative_path_is_shown_from_the_root_on_and_the_variable_that_names_a_file_is_named() {
    let _turn = blastema_doubles::turn();
    const OF_VARIABLE: &str = "/no/such.key";
    let start = |file: Option<&str>| {
        let builder = Node::builder("left").network(udp());
        let builder = file.into_iter().fold(builder, NodeBuilder::keys);
        let started = blastema::run(async { builder.start().await.map(|_| ()) });
        started.expect_err("there is no such file").to_string()
    };
    if env::var_os("BLASTEMA_KEYS").is_some() {
        let text = start(None);
        assert!(text.starts_with("BLASTEMA_KEYS: /no/such.key cannot be read"), "{text}");
        return;
    }

    let text = start(Some("such.key"));
    let here = env::current_dir().expect("it is there").join("such.key");
    assert!(text.starts_with(&format!("{} cannot be read", here.display())), "{text}");

    // The variable of this process is also that of the tests beside this one.
    let name = "sealed::start::a_relative_path_is_shown_from_the_root_on_and_the_variable_that_names_a_file_is_named";
    let mut again = Command::new(env::current_exe().expect("it runs"));
    let status = again.args(["--exact", name]).env("BLASTEMA_KEYS", OF_VARIABLE).status();
    assert!(status.expect("it is started").success());
}
