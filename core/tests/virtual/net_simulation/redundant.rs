//! Messages sent over several paths at once: a single fault is not noticed by the receiver.

use crate::net_simulation::world::{CALM, MS, World, for_seeds, long, name};
use blastema_core::TrafficClass;
use blastema_core::net::link::LinkState;
use blastema_core::net::session::SessionCounters;
use blastema_core::net::{NodeId, Session};
use blastema_core::random::Random;
use std::cell::Cell;
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
        assert!(self.send_on(TrafficClass::Redundant, 0, 1, 32));
        // Other traffic, which has one way only, and waits when that fails.
        self.send(0, 1, 100);
    }
}

/// What has failed.
#[derive(Clone, Copy)]
enum Failed {
    Wire(usize),
    Node(usize),
}

impl World {
    fn repair(&mut self, failed: Failed) {
        match failed {
            Failed::Wire(wire) => self.wires[wire].cut = false,
            Failed::Node(node) => self.start(node),
        }
    }
}

/// Publishes `count` messages from node 0 to node 1 while single links fail, or nodes between the
/// two, one after the other. Answers how many failed.
fn single_faults(world: &mut World, count: usize, every: usize) -> usize {
    world.run(1000 * MS);
    assert!(world.all_up());
    let (mut faults, mut well) = (0, 0);
    let mut failed = None;
    for n in 0..count {
        world.publish();
        // Within the interval, at any time.
        let within = Duration::from_nanos(world.random.below(INTERVAL.as_nanos() as u64));
        world.run(within);
        well = if world.all_up() { well + 1 } else { 0 };
        match failed {
            Some((what, until)) if until <= n => {
                world.repair(what);
                failed = None;
            }
            // A single fault: all links are well when the next one comes, and the routers have had
            // a moment to tell each other so.
            None if n % every == 0 && well > 1 => {
                let nodes = world.nodes.len() as u64;
                let what = if nodes > 2 && world.random.chance(0.3) {
                    Failed::Node(2 + world.random.below(nodes - 2) as usize)
                } else {
                    Failed::Wire(world.random.below(world.wires.len() as u64) as usize)
                };
                match what {
                    Failed::Wire(wire) => world.wires[wire].cut = true,
                    Failed::Node(node) => world.kill(node),
                }
                failed = Some((what, n + 1 + world.random.below(40) as usize));
                faults += 1;
            }
            _ => {}
        }
        world.run(INTERVAL - within);
    }
    if let Some((what, _)) = failed {
        world.repair(what);
    }
    world.run(3000 * MS);
    faults
}

/// Node 0 and 1, and some others, on a ring in any order, with some more cables across: no single
/// cable or node parts them.
fn any_network(seed: u64) -> World {
    let mut random = Random::new(seed);
    let nodes = 3 + random.below(5) as usize;
    let mut ring: Vec<usize> = (0..nodes).collect();
    for place in (1..nodes).rev() {
        ring.swap(place, random.below(place as u64 + 1) as usize);
    }
    let mut wires: Vec<_> = (0..nodes).map(|n| (ring[n], ring[(n + 1) % nodes])).collect();
    for _ in 0..random.below(nodes as u64) {
        let (a, b) = (random.below(nodes as u64) as usize, random.below(nodes as u64) as usize);
        if a != b {
            wires.push((a, b));
        }
    }
    World::new(seed, nodes, &wires, CALM)
}

/// Also with `cargo test --release -p blastema-core --test virtual net_simulation`, which sends a million.
#[test]
fn single_faults_cost_nothing_and_no_gap_is_longer_than_two_intervals() {
    if !long() {
        return;
    }
    let (count, seeds) = if cfg!(debug_assertions) { (10_000, 0..2) } else { (1_000_000, 0..1) };
    for_seeds(seeds, |seed| {
        let mut world = World::new(seed, 2, &[(0, 1), (0, 1)], CALM);

        let faults = single_faults(&mut world, count, 50);

        assert!(faults * 1000 >= count, "{faults} faults");
        assert_eq!(world.delivered.len() as u64, world.count_sent(), "nothing is lost or doubled");
        assert!(world.returned.is_empty());
        assert!(world.gap <= 2 * INTERVAL, "{:?}", world.gap);
        let SessionCounters { replicas, .. } = world.session(1, 0).counters();
        assert!(replicas > count as u64 / 10, "{replicas} copies");
    });
}

#[test]
fn in_any_network_no_single_fault_at_any_time_loses_or_doubles_a_copy() {
    let seeds = match (long(), cfg!(debug_assertions)) {
        (false, _) => 0..4,
        (true, true) => 0..8,
        (true, false) => 0..40,
    };
    let faults = Cell::new(0);
    for_seeds(seeds, |seed| {
        let mut world = any_network(seed);

        let more = single_faults(&mut world, 2000, 10);

        faults.set(faults.get() + more);
        assert_eq!(world.delivered.len() as u64, world.count_sent(), "nothing is lost or doubled");
        assert!(world.returned.is_empty());
    });
    assert!(faults.get() > 100, "{} faults", faults.get());
}

#[test]
fn what_no_way_brings_is_repeated_all_the_same() {
    let mut world = World::new(7, 2, &[(0, 1), (0, 1)], CALM);
    world.run(1000 * MS);
    world.wires.iter_mut().for_each(|wire| wire.cut = true);
    for _ in 0..10 {
        world.publish();
        world.run(INTERVAL);
    }

    world.wires.iter_mut().for_each(|wire| wire.cut = false);
    world.run(2000 * MS);

    assert_eq!(world.delivered.len() as u64, world.count_sent());
    assert!(world.returned.is_empty());
}
