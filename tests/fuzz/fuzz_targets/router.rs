//! Whatever its neighbours say at whatever times, a router neither panics nor remembers more than
//! it may, with keys and without.

#![no_main]

use blastema_core::net::routing::{LinkHealth, LinkStatus, RouterKeys};
use blastema_core::net::seal::SealerConfig;
use blastema_core::net::trust::crypto::Seed;
use blastema_core::net::trust::policy::Role;
use blastema_core::net::trust::roster::{NodeRoster, RosterNode};
use blastema_core::net::wire::packet::Packet;
use blastema_core::net::{LinkId, Neighbour, NodeId, Router, RouterConfig, RouterOutput};
use blastema_core::{Incarnation, Instant, Machine, NodeName};
use bytes::Bytes;
use libfuzzer_sys::fuzz_target;
use std::time::Duration;

/// Fewer than usual, so that the bound is reached.
const NODES_MAX: usize = 8;

fn name(text: &str) -> NodeName {
    NodeName::new(text).expect("a good name")
}

fn keys(now: Instant) -> RouterKeys {
    let nodes = ["m1", "m2", "m3"].into_iter().zip(1..);
    let listed = nodes.map(|(node, seed)| RosterNode {
        name: name(node),
        keys: Seed::new([seed; 32]).public_keys(),
        role: Role::Node,
    });
    let roster = NodeRoster::new(name("robot"), listed).expect("different names");
    let config = SealerConfig::new(NodeId::of(&name("m1")), Incarnation(7), "robot");
    RouterKeys::new(&Seed::new([1; 32]), &roster, config, [9; 32], now)
}

type Script = (bool, Vec<(u8, u16, bool, Vec<u8>)>);

fuzz_target!(|script: Script| {
    let (has_keys, script) = script;
    let mut now = Instant::from_millis(1);
    let config =
        RouterConfig { nodes_max: NODES_MAX, ..RouterConfig::new(name("m1"), Incarnation(7)) };
    let mut router = Router::new(config, now);
    if has_keys {
        router = router.with_keys(keys(now));
    }
    for (number, neighbour) in [(0, "m2"), (1, "m3")] {
        let neighbour = Neighbour { node: name(neighbour), incarnation: Incarnation(9) };
        let status = LinkStatus { neighbour, health: LinkHealth::Up, cost: 10, mtu: 1400 };
        router.handle_link(LinkId(number), status, now);
    }
    for (link, wait_ms, routing, bytes) in script {
        now = now + Duration::from_millis(wait_ms.into());
        router.handle_timeout(now);
        let link = LinkId((link % 3).into());
        let bytes = Bytes::from(bytes);
        if routing {
            router.handle_routing(link, bytes, now);
        } else {
            router.handle_packet(link, bytes, now);
        }
        let mut outputs = 0;
        while let Some(output) = router.poll_output() {
            outputs += 1;
            // At worst every known node changes, and every link is told of every node.
            assert!(outputs <= 8 * NODES_MAX, "too much to do: {output:?}");
            if let RouterOutput::Packet { packet, .. } = output {
                assert!(
                    Packet::decode(packet.into_bytes()).is_ok(),
                    "what no node may send is passed on"
                );
            }
        }
        assert!(router.routes().count() <= NODES_MAX);
        // A handshake goes on in a turn of its own.
        assert!(router.poll_timeout().is_some_and(|due| due > now || has_keys));
    }
});
