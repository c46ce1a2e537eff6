//! One end of a cable loses its carrier, and a switch stands between: the other end finds it by
//! hellos.

use crate::net_simulation::world::{CALM, MS, STORM, World, for_seeds, long, name};
use blastema_core::net::link::LinkState;
use blastema_core::net::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, RoutingMessage,
};
use blastema_core::net::{LinkId, NodeId};
use blastema_core::{Incarnation, Instant};
use std::time::Duration;

impl World {
    /// The cable between a node and the switch that this wire passes.
    fn pull(&mut self, wire: usize, node: usize) {
        self.wires[wire].cut = true;
        let now = self.now;
        let links = &mut self.nodes[node].as_mut().unwrap().links;
        for (_, _, link) in links.iter_mut().filter(|link| link.0 == wire) {
            link.handle_no_carrier("the interface has lost its carrier", now);
        }
        self.settle(node);
    }

    fn state(&self, wire: usize, node: usize) -> LinkState {
        let links = &self.nodes[node].as_ref().unwrap().links;
        links.iter().find(|link| link.0 == wire).unwrap().2.state()
    }

    /// Sends from node 1 to node 0 every millisecond from the pull of wire 0 at node 0 on, and
    /// answers the longest time that any message takes.
    fn slowest_around_the_pull(&mut self) -> Duration {
        self.run(2000 * MS);
        assert_eq!(self.state(0, 1), LinkState::Up);
        self.pull(0, 0);
        let pulled = self.now;
        let mut slowest = Duration::ZERO;
        let mut sent: Vec<Instant> = Vec::new();
        while self.now < pulled + 300 * MS {
            if self.now < pulled + 200 * MS {
                assert!(self.send(1, 0, 50));
                sent.push(self.now);
            }
            let before = self.delivered.len();
            self.run(MS);
            for at in &sent[before..self.delivered.len()] {
                slowest = slowest.max(self.now - *at);
            }
        }
        assert_eq!(self.delivered.len(), sent.len(), "nothing is lost or doubled");
        assert!(self.returned.is_empty());
        assert_eq!(self.state(0, 1), LinkState::Down);
        slowest
    }
}

/// With hellos every 20 ms, a link is suspect after 40.
#[test]
fn the_other_end_takes_another_way_as_soon_as_a_hello_is_late() {
    let check = |nodes, wires: &[(usize, usize)], within| {
        for_seeds(0..10, |seed| {
            let mut world = World::new(seed, nodes, wires, CALM);

            let slowest = world.slowest_around_the_pull();

            assert!(slowest <= within, "{slowest:?} over {wires:?}");
        });
    };
    // Another cable between the two; over one node; over one of two cables to it.
    check(2, &[(0, 1), (0, 1)], 44 * MS);
    check(3, &[(0, 1), (0, 2), (2, 1)], 45 * MS);
    check(3, &[(0, 1), (0, 2), (0, 2), (2, 1)], 45 * MS);
    // No alternate is known beforehand: the routes are computed again.
    check(5, &[(0, 1), (0, 2), (2, 3), (3, 4), (4, 1)], 85 * MS);
}

#[test]
fn the_last_way_is_kept_until_hellos_judge_it() {
    let mut world = World::new(1, 2, &[(0, 1)], CALM);
    world.run(1000 * MS);

    world.pull(0, 0);
    world.run(10 * MS);

    assert_eq!(world.state(0, 1), LinkState::Up, "no hello is late");
    world.run(100 * MS);
    assert_eq!(world.state(0, 1), LinkState::Down);
}

#[test]
fn links_come_up_again_however_often_nodes_die() {
    let wires = [(0, 1), (0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)];
    for_seeds(0..10, |seed| {
        let mut world = World::new(seed, 4, &wires, CALM);
        for _ in 0..10 {
            let pause = Duration::from_millis(world.random.below(300));
            world.run(pause);
            let node = world.random.below(4) as usize;
            world.kill(node);
            let pause = Duration::from_millis(world.random.below(300));
            world.run(pause);
            world.start(node);
        }
        world.run(Duration::from_secs(3));

        let mut links = world.nodes.iter().flatten().flat_map(|node| &node.links);
        assert!(links.all(|(_, _, link)| link.state() == LinkState::Up));
    });
}

#[test]
fn what_is_pulled_and_plugged_in_a_storm_comes_back_every_time() {
    if !long() {
        return;
    }
    for_seeds(20..26, |seed| {
        let mut world = World::new(seed, 3, &[(0, 1), (0, 1), (0, 2), (2, 1)], STORM);
        world.run(1000 * MS);
        for _ in 0..20 {
            let wire = world.random.below(2) as usize;
            world.pull(wire, 0);
            for _ in 0..20 {
                world.send(0, 1, 50);
                world.send(1, 0, 50);
                world.run(10 * MS);
            }
            world.wires[wire].cut = false;
            world.run(Duration::from_millis(500));
        }
        world.weather = CALM;
        world.run(Duration::from_secs(15));

        assert_eq!(world.delivered.len() as u64, world.count_sent());
        assert!(world.returned.is_empty());
        let mut links = world.nodes.iter().flatten().flat_map(|node| &node.links);
        assert!(links.all(|(_, _, link)| link.state() == LinkState::Up));
    });
}

/// Node 2 tells node 1 in the name of node 0, every 5 ms, that node 0 has no links, and once that
/// it has.
#[test]
fn a_node_that_lies_about_a_link_of_others_diverts_nothing_and_takes_nothing_down() {
    for_seeds([30, 31, 32, 34], |seed| {
        let mut world = World::new(seed, 3, &[(0, 1), (0, 2), (2, 1)], CALM);
        world.run(2000 * MS);
        let first = AdvertisementId::first_sequence(Incarnation(1));
        for n in 0..800 {
            let node = name(0);
            let (origin, incarnation) = (NodeId::of(&node), Incarnation(1));
            let with = [1, 2].map(|to| Edge {
                to: NodeId::of(&name(to)),
                incarnation: 1,
                cost: 1,
                mtu: 9000,
            });
            let edges = if n % 4 == 0 { with.to_vec() } else { Vec::new() };
            let id = AdvertisementId { origin, sequence: first + 1000 + 2 * n };
            let lie = Advertisement { id, incarnation, node, edges, signature: None };
            let now = world.now;
            let victim = world.nodes[1].as_mut().unwrap();
            victim.router.handle_routing(
                LinkId(1),
                RoutingMessage::Announce(vec![lie]).encode(),
                now,
            );
            world.settle(1);
            assert!(world.send(0, 1, 50) && world.send(1, 0, 50));
            world.run(5 * MS);
            assert_eq!(world.state(0, 1), LinkState::Up);
        }
        world.run(1000 * MS);

        assert!(world.returned.is_empty());
        assert_eq!(world.delivered.len() as u64, world.count_sent());
    });
}
