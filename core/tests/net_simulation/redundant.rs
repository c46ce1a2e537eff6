//! What goes every way at once: a single fault is not noticed by whoever listens.

use crate::world::{CALM, MS, World, for_seeds, name};
use blastema_core::net::link::LinkState;
use blastema_core::net::segment::Stream;
use blastema_core::net::session::SessionCounters;
use blastema_core::net::{NodeId, Session};
use std::time::Duration;

const INTERVAL: Duration = Duration::from_millis(10);

impl World {
    fn all_up(&self) -> bool {
        let mut links = self.nodes.iter().flatten().flat_map(|node| &node.links);
        links.all(|(_, _, link)| link.state() == LinkState::Up)
    }

    fn session(&self, node: usize, peer: usize) -> &Session {
        &self.nodes[node].as_ref().unwrap().sessions[&NodeId::of(&name(peer))]
    }

    fn publish(&mut self) {
        assert!(self.send_on(Stream::Redundant, 0, 1, 32));
        // Other traffic, which has one way only, and waits when that fails.
        self.send(0, 1, 100);
        self.run(INTERVAL);
    }
}

/// Publishes `count` messages from node 0 to node 1 while single links fail, one after the other, each
/// `settling` messages after the repair of the last at the earliest. Answers how many failed.
fn single_faults(world: &mut World, count: usize, every: usize, settling: usize) -> usize {
    world.run(1000 * MS);
    assert!(world.all_up());
    let (mut faults, mut mended) = (0, 0);
    let mut cut = None;
    for n in 0..count {
        world.publish();
        match cut {
            Some((wire, until)) if until <= n => {
                let wire: usize = wire;
                world.wires[wire].cut = false;
                (cut, mended) = (None, n);
            }
            // A single fault: all links are well when the next one fails.
            None if n % every == 0 && n >= mended + settling && world.all_up() => {
                let wire = world.random.below(world.wires.len() as u64) as usize;
                world.wires[wire].cut = true;
                cut = Some((wire, n + 1 + world.random.below(40) as usize));
                faults += 1;
            }
            _ => {}
        }
    }
    world.wires.iter_mut().for_each(|wire| wire.cut = false);
    world.run(3000 * MS);
    faults
}

/// Also with `cargo test --release -p blastema-core --test net_simulation`, which sends a million.
#[test]
fn single_faults_cost_nothing_and_no_gap_is_longer_than_two_intervals() {
    let (count, seeds) = if cfg!(debug_assertions) { (10_000, 0..2) } else { (1_000_000, 0..1) };
    for_seeds(seeds, |seed| {
        let mut world = World::new(seed, 2, &[(0, 1), (0, 1)], CALM);

        let faults = single_faults(&mut world, count, 50, 0);

        assert!(faults * 1000 >= count, "{faults} faults");
        assert_eq!(world.delivered.len() as u64, world.count_sent(), "nothing is lost or doubled");
        assert!(world.returned.is_empty());
        assert!(world.gap <= 2 * INTERVAL, "{:?}", world.gap);
        let SessionCounters { replicas, alone, missed, .. } = world.session(1, 0).counters();
        assert_eq!(missed, 0);
        assert!(replicas > count as u64 / 10, "{replicas} copies");
        assert!(alone > faults as u64, "a way that failed is counted");
    });
}

#[test]
fn copies_take_ways_over_other_nodes_and_none_comes_back() {
    for_seeds(0..3, |seed| {
        // A ring: one way is direct, the other leads through two nodes.
        let ring = [(0, 1), (1, 2), (2, 3), (3, 0)];
        let mut world = World::new(seed, 4, &ring, CALM);

        // A relay passes a copy on by its routes, and a link that has failed is dear for five seconds:
        // until then a relay may know of no way but the one that the copy came by.
        let faults = single_faults(&mut world, 8000, 100, 600);

        assert!(faults >= 5, "{faults} faults");
        assert_eq!(world.delivered.len() as u64, world.count_sent());
        assert!(world.gap <= 2 * INTERVAL, "{:?}", world.gap);
        for node in world.nodes.iter().flatten() {
            assert_eq!(node.router.refusals().unexpected, 0, "nothing went in a circle");
        }
    });
}

#[test]
fn what_no_way_brings_is_repeated_all_the_same() {
    let mut world = World::new(7, 2, &[(0, 1), (0, 1)], CALM);
    world.run(1000 * MS);
    world.wires.iter_mut().for_each(|wire| wire.cut = true);
    for _ in 0..10 {
        world.publish();
    }

    world.wires.iter_mut().for_each(|wire| wire.cut = false);
    world.run(2000 * MS);

    assert_eq!(world.delivered.len() as u64, world.count_sent());
    assert!(world.returned.is_empty());
}
