//! What a node's picture shows of its networks, and of its traffic with other nodes.
//!
//! ```text
//!        lan
//!   base ═════ arm ───── head
//!        wire
//! ```

use super::{Count, PATIENCE, ask, end, node, until};
use blastema::prelude::*;
use blastema::{Network, NodeBuilder};
use blastema_tests::{RobotKeys, free_addresses, listens};
use serde_json::{Value, json};
use std::fs;
use std::path::Path;

#[derive(Clone, Debug, Event)]
#[contract(name = "sealed/pose")]
struct Pose(u32);

/// Describes base and arm on two networks, and the head behind the arm.
fn robot(folder: &Path) -> [NodeBuilder; 3] {
    let keys = RobotKeys::new(folder, &["base", "arm", "head"], 1);
    let at = free_addresses(6);
    let network = |name: &str, own: usize, peer: &str, of: usize| {
        Network::new(name, &format!("udp://{}", at[own])).peer(peer, &at[of].to_string())
    };
    [
        node(&keys, "base", network("lan", 0, "arm", 1)).network(network("wire", 2, "arm", 3)),
        node(&keys, "arm", network("lan", 1, "base", 0))
            .network(network("wire", 3, "base", 2))
            .network(network("neck", 4, "head", 5)),
        node(&keys, "head", network("neck", 5, "arm", 4)),
    ]
}

async fn start(builders: [NodeBuilder; 3]) -> [Node; 3] {
    let [base, arm, head] = builders;
    let base = base.start().await.expect("it starts");
    let arm = arm.start().await.expect("it starts");
    let head = head.start().await.expect("it starts");
    for (node, other) in [(&base, "arm"), (&base, "head"), (&arm, "head"), (&head, "base")] {
        assert!(node.connected(other, PATIENCE).await, "{:?}", node.links().await);
    }
    [base, arm, head]
}

async fn picture(node: &Node) -> Value {
    serde_json::from_str(&node.snapshot().await).expect("a JSON document")
}

/// The first row of a part of the picture with this value.
async fn row(node: &Node, part: &str, key: &str, value: &str) -> Value {
    let picture = picture(node).await;
    let mut rows = picture[part].as_array().into_iter().flatten();
    rows.find(|row| row[key] == value).cloned().unwrap_or_default()
}

#[test]
fn a_route_names_the_link_that_it_takes_and_the_one_that_it_falls_back_on() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let nodes = start(robot(folder.path())).await;
        let base = &nodes[0];

        let has_both = async || {
            let route = row(base, "routes", "node", "head").await;
            route["network"].is_string() && route["alternate_network"].is_string()
        };
        until(has_both, "the picture has a route to the head, and another").await;

        let route = row(base, "routes", "node", "head").await;
        let mut networks = [&route["network"], &route["alternate_network"]];
        networks.sort_by_key(|network| network.to_string());
        assert_eq!(networks, ["lan", "wire"], "{route}");
        for (network, link) in [("network", "link"), ("alternate_network", "alternate_link")] {
            let network = route[network].as_str().expect("a name");
            let taken = row(base, "links", "network", network).await;
            assert_eq!((&route[link], &taken["neighbour"]), (&taken["link"], &json!("arm")));
        }
        assert_eq!(route["relays"], 1, "the arm passes it on: {route}");
        end(nodes).await;
    });
}

#[test]
fn a_link_shows_the_frames_and_bytes_that_it_has_carried_each_way() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let nodes = start(robot(folder.path())).await;
        let [_, arm, head] = &nodes;
        let before = row(arm, "links", "network", "neck").await;
        for number in 1..=20 {
            assert_eq!(ask(arm, "head").await, number);
        }

        let sender = row(arm, "links", "network", "neck").await;
        let receiver = row(head, "links", "network", "neck").await;

        let figure = |row: &Value, key: &str| {
            row[key].as_u64().unwrap_or_else(|| panic!("{key} is missing in {row}"))
        };
        let sent = figure(&sender, "frames_sent") - figure(&before, "frames_sent");
        let received = figure(&sender, "frames_received") - figure(&before, "frames_received");
        assert!(sent >= 20 && received >= 20, "{before} {sender}");
        // Each request has gone over it, whose frame has the seal's 16 bytes at least.
        let bytes = figure(&sender, "bytes_sent") - figure(&before, "bytes_sent");
        assert!(bytes > 16 * sent, "{before} {sender}");
        assert!(figure(&receiver, "frames_received") >= 20, "{receiver}");
        assert!(figure(&receiver, "bytes_received") > 16 * 20, "{receiver}");
        assert_eq!(figure(&sender, "frames_dropped"), 0, "{sender}");
        assert!(sender["round_trip_ms"].is_number(), "{sender}");
        // Hellos alone are some bytes each second.
        let is_measured = async || {
            let link = row(arm, "links", "network", "neck").await;
            let session = row(arm, "sessions", "node", "head").await;
            let both = |row: &Value| {
                [figure(row, "bytes_sent_per_s"), figure(row, "bytes_received_per_s")]
            };
            assert!(both(&session).iter().all(|rate| *rate < 1_000_000), "{session}");
            both(&link).iter().all(|rate| (100..1_000_000).contains(rate))
        };
        until(is_measured, "rates of a link").await;
        let medium = row(arm, "media", "network", "neck").await;
        // All links of a network share its medium, which also carries what belongs to none.
        assert!(figure(&medium, "frames_sent") >= figure(&sender, "frames_sent"), "{medium}");
        assert_eq!(figure(&medium, "queued"), 0, "{medium}");
        assert!(medium["frames_dropped"].is_u64() && medium["oldest_ms"] == 0.0, "{medium}");
        end(nodes).await;
    });
}

#[test]
fn the_roster_that_a_node_uses_is_shown_with_its_serial_number() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let nodes = start(robot(folder.path())).await;
        let head = &nodes[2];
        let shown = row(head, "roster", "robot", "ranger").await;
        assert_eq!((&shown["serial"], &shown["nodes"]), (&json!(1), &json!(3)), "{shown}");

        let text = RobotKeys::roster(&["base", "arm", "head", "gripper"], 1, 7);
        let new = folder.path().join("copied");
        fs::write(&new, text).expect("a folder");
        fs::rename(&new, folder.path().join("ranger.roster")).expect("a folder");

        let is_newer = async || {
            let shown = row(head, "roster", "robot", "ranger").await;
            shown["serial"] == 7 && shown["nodes"] == 4
        };
        until(is_newer, "the picture has the newer roster").await;
        end(nodes).await;
    });
}

#[test]
fn messages_that_were_not_delivered_are_shown_with_the_reason_and_how_many() {
    let _turn = blastema_doubles::turn();
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let nodes = start(robot(folder.path())).await;
        let base = &nodes[0];
        let absent = base.sender::<Count>("arm:absent").expect("a name");
        for _ in 0..3 {
            absent.tell(Count).expect("the arm can be reached");
        }

        let is_counted = async || {
            let letters = row(base, "dead_letters", "object", "absent").await;
            letters["count"] == 3
        };
        until(is_counted, "the picture has three dead letters").await;
        let letters = row(base, "dead_letters", "object", "absent").await;
        assert_eq!(letters["reason"], "receiver unknown", "{letters}");
        assert_eq!(
            (&letters["node"], &letters["contract"]),
            (&json!("arm"), &json!("sealed/count"))
        );
        end(nodes).await;
    });
}

#[test]
fn a_topic_names_the_nodes_that_publish_on_it_and_those_that_listen() {
    let Some(_turn) = blastema_doubles::turn_if_long() else { return };
    blastema::run(async {
        let folder = tempfile::tempdir().expect("a folder");
        let [base, arm, head] = robot(folder.path());
        let ear = || listens("ear", "sealed/pose", (), |_, _: Pose, _| {});
        let [base, head] = [base, head].map(|node| node.child(ear()));
        let nodes = start([base, arm, head]).await;
        let [base, arm, head] = &nodes;
        let poses = arm.publisher::<Pose>("sealed/pose").expect("a topic");
        assert!(arm.connected("base", PATIENCE).await && arm.connected("head", PATIENCE).await);

        let here = row(arm, "topics", "topic", "sealed/pose").await;
        assert_eq!(here["listening_nodes"], json!(["base", "head"]), "{here}");
        assert_eq!(here["publishing_nodes"], json!([]), "{here}");
        // Before the first event.
        for other in [base, head] {
            let is_heard = async || {
                let there = row(other, "topics", "topic", "sealed/pose").await;
                there["publishing_nodes"] == json!(["arm"])
            };
            until(is_heard, "the picture of a listener names the arm").await;
        }
        assert_eq!(
            row(base, "topics", "topic", "sealed/pose").await["listening_nodes"],
            json!(["head"])
        );

        let is_gone = async || {
            let there = row(base, "topics", "topic", "sealed/pose").await;
            there["publishing_nodes"] == json!([])
        };
        drop(poses);
        until(is_gone, "a publisher that is dropped is gone").await;
        let _poses = arm.publisher::<Pose>("sealed/pose").expect("a topic");
        until(async || !is_gone().await, "another one is seen").await;
        arm.shutdown().await;
        until(is_gone, "a node that has left publishes no more").await;
        end(nodes).await;
    });
}
