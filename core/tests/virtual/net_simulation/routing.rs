//! Which way traffic takes while links swing and routers lie.

use crate::net_simulation::world::{CALM, MS, World, for_seeds, name};
use blastema_core::Incarnation;
use blastema_core::net::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, RoutingMessage,
};
use blastema_core::net::{LinkId, NodeId};

#[test]
fn a_cable_whose_quality_swings_moves_traffic_once_and_not_with_every_swing() {
    for_seeds(40..43, |seed| {
        let mut world = World::new(seed, 2, &[(0, 1), (0, 1)], CALM);
        world.run(1000 * MS);
        let before = world.path_changes;
        for second in 0..60 {
            // Three bad seconds, three good ones, and so on: each is seen in the loss.
            world.wires[0].loss = if second / 3 % 2 == 0 { 0.15 } else { 0.0 };
            for _ in 0..20 {
                world.send(0, 1, 100);
                world.run(50 * MS);
            }
        }
        world.wires[0].loss = 0.0;
        world.run(1000 * MS);

        // Both ends count. A late hello moves it for a moment; the swings themselves, once in five
        // seconds each way at most.
        let changes = world.path_changes - before;
        assert!(changes <= 2 * 60, "{changes} changes in a minute");
        assert_eq!(world.delivered.len() as u64, world.count_sent());
    });
}

/// Node 1 makes an advertisement in another's name: incarnation, sequence number, links.
fn lie(origin: usize, incarnation: u64, sequence: u64, to: &[usize]) -> Advertisement {
    let node = name(origin);
    let (origin, incarnation) = (NodeId::of(&node), Incarnation(incarnation));
    let edge = |to: &usize| Edge { to: NodeId::of(&name(*to)), incarnation: 1, cost: 1, mtu: 9000 };
    let edges = to.iter().map(edge).collect();
    let advertisement_id = AdvertisementId { origin, sequence };
    let signature = Some([sequence as u8; 64]);
    Advertisement { id: advertisement_id, incarnation, node, edges, signature }
}

/// The way from 0 to 2 is over 3, and there is traffic on it. Node 1 is next to 0 alone, has a key,
/// and tells it the n-th of its lies every 20 ms.
fn under_lies(seed: u64, lies: impl Fn(u64) -> Vec<Advertisement>) {
    let mut world = World::with_keys(seed, 4, &[(0, 1), (0, 3), (3, 2)]);
    world.run(1000 * MS);
    let before = world.path_changes;
    for n in 0..200 {
        let bytes = RoutingMessage::Announce(lies(n)).encode();
        let now = world.now;
        world.nodes[0].as_mut().unwrap().router.handle_routing(LinkId(0), bytes, now);
        world.settle(0);
        world.send(0, 2, 50);
        world.send(2, 0, 50);
        world.run(20 * MS);
    }
    world.run(1000 * MS);
    assert!(world.returned.is_empty());
    assert_eq!(world.path_changes, before, "nothing was believed for a moment");
    assert_eq!(world.delivered.len() as u64, world.count_sent());
    let router = |node: usize| &world.nodes[node].as_ref().unwrap().router;
    assert_eq!(router(0).route(NodeId::of(&name(2))).unwrap().next, LinkId(1));
    assert!(router(0).refusals().forged >= 200, "{}", router(0).refusals());
    // What was refused is not passed on.
    assert_eq!((router(2).refusals().forged, router(3).refusals().forged), (0, 0));
    for (own, peer) in [(0, 2), (2, 0), (0, 3), (3, 2)] {
        let route = router(own).route(NodeId::of(&name(peer))).unwrap();
        assert_eq!(route.incarnation, Incarnation(1));
    }
}

#[test]
fn announcements_in_the_names_of_others_are_not_believed() {
    // That 2 is next to the liar, that 3 has no links at all, and that 0 has none.
    let first = AdvertisementId::first_sequence(Incarnation(1));
    for_seeds(50..53, |seed| {
        under_lies(seed, |n| {
            let number = first + 1000 + n;
            vec![lie(2, 1, number, &[1]), lie(3, 1, number, &[]), lie(0, 1, number, &[])]
        });
    });
}

#[test]
fn the_highest_number_and_incarnations_that_a_node_never_had_are_not_believed_either() {
    for_seeds(70..73, |seed| {
        under_lies(seed, |n| {
            let incarnation = if n % 3 == 0 { u64::MAX } else { 2 + n };
            vec![lie(2, incarnation, u64::MAX - n, &[3]), lie(3, incarnation, u64::MAX, &[0])]
        });
    });
}

/// Without keys a node outdoes what is said in its name, so that a changed bit does no lasting harm.
#[test]
fn without_keys_what_is_said_in_a_nodes_name_is_outdone() {
    let first = AdvertisementId::first_sequence(Incarnation(1));
    for_seeds([110, 112, 114], |seed| {
        let mut world = World::new(seed, 4, &[(0, 1), (0, 3), (3, 2)], CALM);
        world.run(1000 * MS);
        for n in 0..200 {
            let lies = [lie(2, 1, first + 1000 + n, &[1]), lie(3, 1, first + 1000 + n, &[])];
            let lies = lies.map(|lie| Advertisement { signature: None, ..lie });
            let bytes = RoutingMessage::Announce(lies.to_vec()).encode();
            let now = world.now;
            world.nodes[0].as_mut().unwrap().router.handle_routing(LinkId(0), bytes, now);
            world.settle(0);
            world.send(0, 2, 50);
            world.run(20 * MS);
        }
        world.run(1000 * MS);
        assert!(world.returned.is_empty());
        assert_eq!(world.delivered.len() as u64, world.count_sent());
    });
}
