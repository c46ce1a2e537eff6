//! Which way traffic takes while links swing and routers lie.

use crate::world::{CALM, MS, World, for_seeds, name};
use blastema_core::Incarnation;
use blastema_core::net::advertisement::{Advertisement, Edge, Routing, Stamp};
use blastema_core::net::{LinkNumber, NodeId};

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

#[test]
fn announcements_that_lie_draw_no_traffic_and_are_outdone() {
    for_seeds(50..55, |seed| {
        // The way from 0 to 2 is over 3. Node 1 is next to 0 alone, and claims otherwise.
        let mut world = World::new(seed, 4, &[(0, 1), (0, 3), (3, 2)], CALM);
        world.run(1000 * MS);
        let lie = |origin: usize, sequence: u32, to: &[usize]| {
            let node = name(origin);
            let (origin, incarnation) = (NodeId::of(&node), Incarnation(1));
            let edge = |to: &usize| Edge { to: NodeId::of(&name(*to)), cost: 1, mtu: 9000 };
            let edges = to.iter().map(edge).collect();
            Advertisement { stamp: Stamp { origin, incarnation, sequence }, node, edges }
        };
        for n in 0..200u32 {
            let told = [
                lie(1, 1000 + n, &[0, 2, 3]),
                // In the name of others: that 2 is next to the liar, and that 3 has no links at all.
                lie(2, 1000 + n, &[1]),
                lie(3, 1000 + n, &[]),
            ];
            let bytes = Routing::Announce(told.to_vec()).encode();
            let now = world.now;
            let node = world.nodes[0].as_mut().unwrap();
            node.router.handle_routing(LinkNumber(0), bytes, now);
            world.settle(0);
            world.send(0, 2, 50);
            world.run(20 * MS);
        }
        world.run(1000 * MS);

        assert!(world.returned.is_empty());
        assert_eq!(world.delivered.len() as u64, world.count_sent());
        let node = world.nodes[0].as_ref().unwrap();
        assert_eq!(node.router.route(NodeId::of(&name(2))).unwrap().next, LinkNumber(1));
    });
}
