//! Whole networks over bad wires: what the sessions promise holds.

mod carrier;
mod incarnations;
mod paths;
mod redundant;
mod routing;
mod world;

use std::hash::Hasher;
use std::time::Duration;
use world::{CALM, MS, STORM, World, for_seeds, long};

/// The robot of the demonstration: module0 in the middle, and a second path everywhere.
const ROBOT: [(usize, usize); 4] = [(0, 1), (0, 2), (0, 1), (1, 2)];

#[test]
fn three_nodes_find_each_other_and_talk_over_two_hops() {
    let mut world = World::new(1, 3, &[(0, 1), (0, 2)], CALM);
    world.run(200 * MS);

    for n in 0..100 {
        assert!(world.send(1, 2, n));
        assert!(world.send(2, 1, n));
        world.run(MS);
    }
    world.run(100 * MS);

    assert_eq!(world.delivered.len(), 200);
    assert!(world.returned.is_empty());
    world.check_complete();
}

#[test]
fn nothing_is_lost_doubled_or_reordered_in_a_storm_while_cables_are_cut_one_after_the_other() {
    for_seeds(0..20, |seed| {
        let mut world = World::new(seed, 3, &ROBOT, STORM);
        world.run(1000 * MS);
        for round in 0..6 {
            let cut = world.random.below(4) as usize;
            world.wires[cut].cut = true;
            for _ in 0..100 {
                let from = world.random.below(3) as usize;
                let to = (from + 1 + world.random.below(2) as usize) % 3;
                let length = if world.random.chance(0.05) { 20_000 } else { 50 };
                world.send(from, to, length);
                world.run(5 * MS);
            }
            world.wires[cut].cut = false;
            world.run(Duration::from_millis(500 + round * 100));
        }
        world.run(Duration::from_secs(5));

        assert!(world.count_sent() > 500, "{}", world.count_sent());
        // A storm may make every link of a node flap at once; a session rides that out.
        assert_eq!(world.delivered.len() as u64, world.count_sent());
        assert!(world.returned.is_empty());
    });
}

#[test]
fn a_cut_cable_costs_one_look_up_when_there_is_another() {
    let mut world = World::new(3, 2, &[(0, 1), (0, 1)], CALM);
    world.run(500 * MS);

    world.wires[0].cut = true;
    let cut = world.now;
    world.send(0, 1, 10);
    while world.delivered.is_empty() {
        world.run(MS);
    }

    // A hello every 20 ms: suspect two intervals after the last one, then at once the other way.
    assert!(world.now - cut <= 50 * MS, "{:?}", world.now - cut);
    assert!(world.returned.is_empty());
}

#[test]
fn a_partition_gives_messages_back_and_a_merge_lets_them_through_again() {
    let mut world = World::new(4, 4, &[(0, 1), (1, 2), (2, 3)], CALM);
    world.run(1000 * MS);
    assert_eq!(world.nodes[0].as_ref().unwrap().reachable.len(), 3);

    world.wires[1].cut = true;
    world.send(0, 3, 10);
    // Until then the peer may tell that it had arrived.
    world.run(Duration::from_secs(12));
    assert_eq!(world.returned.len(), 1);
    assert_eq!(world.nodes[0].as_ref().unwrap().reachable.len(), 1);
    assert!(!world.send(0, 3, 10), "no path leads there");

    world.wires[1].cut = false;
    world.run(Duration::from_secs(1));
    assert!(world.send(0, 3, 10));
    world.run(100 * MS);
    assert_eq!(world.delivered.len(), 1);
}

#[test]
fn a_short_outage_of_every_path_loses_nothing() {
    let mut world = World::new(5, 2, &[(0, 1)], CALM);
    world.run(500 * MS);

    world.wires[0].cut = true;
    for _ in 0..50 {
        assert!(world.send(0, 1, 100));
        world.run(10 * MS);
    }
    world.wires[0].cut = false;
    world.run(Duration::from_secs(1));

    assert_eq!(world.delivered.len(), 50);
    assert!(world.returned.is_empty());
}

#[test]
fn a_node_that_dies_and_incarnations_again_is_a_new_one_to_everybody() {
    for_seeds(0..20, |seed| {
        let mut world = World::new(seed, 3, &ROBOT, STORM);
        world.run(1000 * MS);
        for _ in 0..5 {
            let victim = world.random.below(3) as usize;
            for _ in 0..30 {
                let from = world.random.below(3) as usize;
                let to = (from + 1 + world.random.below(2) as usize) % 3;
                world.send(from, to, 100);
                world.run(3 * MS);
            }
            world.kill(victim);
            let dead_for = Duration::from_millis(world.random.below(1000));
            world.run(dead_for);
            world.start(victim);
            world.run(1000 * MS);
        }
        world.run(Duration::from_secs(5));
        world.check_complete();
        for node in world.nodes.iter().flatten() {
            assert_eq!(node.reachable.len(), 2, "{}", node.name);
            assert!(node.sessions.values().all(|session| session.peer().is_some()));
        }
    });
}

#[test]
fn whatever_happens_no_message_is_doubled_or_vanishes() {
    let wires = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (0, 1)];
    for_seeds(100..115, |seed| {
        let mut world = World::new(seed, 4, &wires, STORM);
        for _ in 0..400 {
            match world.random.below(40) {
                0 => {
                    let node = world.random.below(4) as usize;
                    world.kill(node);
                }
                1..=3 => {
                    let node = world.random.below(4) as usize;
                    if world.nodes[node].is_none() {
                        world.start(node);
                    }
                }
                4 | 5 => {
                    let wire = world.random.below(6) as usize;
                    world.wires[wire].cut = !world.wires[wire].cut;
                }
                _ => {
                    let from = world.random.below(4) as usize;
                    let to = (from + 1 + world.random.below(3) as usize) % 4;
                    let length = world.random.below(3000) as usize;
                    world.send(from, to, length);
                }
            }
            let pause = Duration::from_millis(world.random.below(20));
            world.run(pause);
        }
        world.wires.iter_mut().for_each(|wire| wire.cut = false);
        // A node that stays dead has ten seconds to tell what had arrived.
        world.run(Duration::from_secs(12));
        world.check_complete();
    });
}

#[test]
fn one_seed_gives_one_run_bit_for_bit() {
    let trace = |seed| {
        let mut world = World::new(seed, 3, &ROBOT, STORM);
        for n in 0..200 {
            world.send(n % 3, (n + 1) % 3, 100);
            world.run(10 * MS);
            world.wires[0].cut = n % 50 > 25;
        }
        (world.trace.finish(), world.count)
    };
    assert_eq!(trace(7), trace(7));
    assert_ne!(trace(7), trace(8));
}

#[test]
fn many_nodes_know_each_other_within_a_second() {
    let count = if long() { 50 } else { 20 };
    let wires: Vec<_> =
        (0..count).flat_map(|n| [(n, (n + 1) % count), (n, (n + 7) % count)]).collect();
    let mut world = World::new(9, count, &wires, CALM);

    world.run(Duration::from_secs(1));

    assert!(world.nodes.iter().flatten().all(|node| node.reachable.len() == count - 1));
}

#[test]
fn a_large_message_arrives_whole_over_a_path_that_becomes_smaller() {
    let mut world = World::new(10, 2, &[(0, 1), (0, 1)], CALM);
    world.wires[1].mtu = 700;
    world.run(500 * MS);

    world.send(0, 1, 1_000_000);
    world.run(5 * MS);
    world.wires[0].cut = true;
    world.run(Duration::from_secs(3));

    assert_eq!(world.delivered.len(), 1);
}
