//! Which way traffic takes while links swing and routers lie.

use crate::world::{CALM, MS, World, for_seeds, name};
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

/// Node 1 sends an advertisement in another's name: incarnation, sequence number, links.
fn lie(origin: usize, (incarnation, sequence): (u64, u32), to: &[usize]) -> Advertisement {
    let node = name(origin);
    let (origin, incarnation) = (NodeId::of(&node), Incarnation(incarnation));
    let edge = |to: &usize| Edge { to: NodeId::of(&name(*to)), incarnation: 1, cost: 1, mtu: 9000 };
    let edges = to.iter().map(edge).collect();
    let advertisement_id = AdvertisementId { origin, incarnation, sequence };
    Advertisement { id: advertisement_id, node, edges, withdrawn: false }
}

/// The way from 0 to 2 is over 3, and there is traffic on it. Node 1 is next to 0 alone, and tells
/// it the n-th of its lies every 20 ms.
fn under_lies(seed: u64, lies: impl Fn(u32) -> Vec<Advertisement>) -> World {
    let mut world = World::new(seed, 4, &[(0, 1), (0, 3), (3, 2)], CALM);
    world.run(1000 * MS);
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
    assert_eq!(world.delivered.len() as u64, world.count_sent());
    let node = world.nodes[0].as_ref().unwrap();
    assert_eq!(node.router.route(NodeId::of(&name(2))).unwrap().next, LinkId(1));
    world
}

fn named_as_forged(world: &World, node: usize) -> bool {
    let router = &world.nodes[node].as_ref().unwrap().router;
    world.liars.iter().any(|(victim, _)| *victim == name(node)) && router.refusals().forged >= 3
}

#[test]
fn announcements_that_lie_draw_no_traffic_and_are_outdone() {
    for_seeds(50..55, |seed| {
        let world = under_lies(seed, |n| {
            // In the name of others: that 2 is next to the liar, and that 3 has no links at all.
            let number = (1, 1000 + n);
            vec![lie(1, number, &[0, 2, 3]), lie(2, number, &[1]), lie(3, number, &[])]
        });
        assert!(named_as_forged(&world, 2) && named_as_forged(&world, 3));
    });
}

#[test]
fn a_lie_with_the_highest_number_that_there_is_is_withdrawn_by_who_it_is_about() {
    for_seeds(110..116, |seed| {
        let world = under_lies(seed, |n| {
            // Each time the same number, or the one before it.
            let number = (1, u32::MAX - n % 2);
            vec![lie(2, number, &[1]), lie(3, number, &[])]
        });
        let router = |node: usize| &world.nodes[node].as_ref().unwrap().router;
        assert!(router(2).refusals().forged > 0 && router(3).refusals().forged > 0);
    });
}

#[test]
fn an_incarnation_that_a_node_never_had_ends_no_session_with_it() {
    for_seeds(70..76, |seed| {
        let world = under_lies(seed, |n| {
            let incarnation = if n % 3 == 0 { u64::MAX } else { 2 + u64::from(n) };
            vec![lie(2, (incarnation, u32::MAX - n), &[3]), lie(3, (incarnation, 1 + n), &[0, 2])]
        });
        for (own, peer) in [(0, 2), (2, 0), (0, 3), (3, 2)] {
            let node = world.nodes[own].as_ref().unwrap();
            let route = node.router.route(NodeId::of(&name(peer))).unwrap();
            assert_eq!(route.incarnation, Incarnation(1));
        }
    });
}

#[test]
fn what_is_withdrawn_in_others_names_is_said_again() {
    for_seeds(150..156, |seed| {
        let world = under_lies(seed, |n| {
            let withdrawn =
                |origin, number| Advertisement { withdrawn: true, ..lie(origin, number, &[]) };
            // Of what is held at that time, or of what never was.
            let number = if n % 5 > 0 { (1, 1 + n % 60) } else { (u64::MAX, 1 + n) };
            vec![withdrawn(2, number), withdrawn(3, number)]
        });
        let router = |node: usize| &world.nodes[node].as_ref().unwrap().router;
        assert!(router(2).refusals().forged > 0 && router(3).refusals().forged > 0);
    });
}
