//! Incarnations whose numbers fall, words of incarnations that are over, and bits that were changed
//! on their way.

use crate::net_simulation::ROBOT;
use crate::net_simulation::world::{CALM, Frames, MS, STORM, Weather, World, for_seeds, long};
use blastema_core::net::link::LinkState;
use blastema_core::{Incarnation, Instant};
use bytes::Bytes;
use std::time::Duration;

/// Every node reaches every other in its present incarnation, and has a session with that.
fn is_whole(world: &World) -> bool {
    world.nodes.iter().flatten().all(|node| {
        let others = world.nodes.iter().flatten().filter(|other| other.name != node.name);
        others.clone().count() == node.reachable.len()
            && others.clone().all(|other| {
                let session = &node.sessions[&blastema_core::net::NodeId::of(&other.name)];
                session.peer() == Some(Incarnation(other.incarnation))
            })
    })
}

fn healed_within(world: &mut World, bound: Duration) -> Duration {
    let began = world.now;
    while !is_whole(world) {
        world.run(5 * MS);
        assert!(world.now - began <= bound, "not whole again after {:?}", world.now - began);
    }
    world.now - began
}

/// All frames that are under way within a time.
fn watch(world: &mut World, span: Duration) -> Frames {
    let mut seen = Frames::new();
    let end = world.now + span;
    while world.now < end {
        world.run(MS / 10);
        seen.extend(world.frames.iter().map(|(key, frame)| (*key, frame.clone())));
    }
    seen
}

/// They arrive again, one each millisecond.
fn replay(world: &mut World, frames: Frames) -> Instant {
    let mut at = world.now;
    for (n, (_, frame)) in frames.into_iter().enumerate() {
        at = world.now + MS * n as u32;
        world.frames.insert((at, u64::MAX - n as u64), frame);
    }
    at
}

fn restarts_with_smaller_numbers(weather: Weather, bound: Duration) {
    for_seeds(200..210, |seed| {
        let mut world = World::new(seed, 3, &ROBOT, weather);
        world.kill(0);
        world.kill(1);
        world.kill(2);
        world.incarnations = vec![1_000, 2_000, 3_000];
        (0..3).for_each(|node| world.start(node));
        world.run(1000 * MS);
        for round in 0..4 {
            let victim = world.random.below(3) as usize;
            for to in (0..3).filter(|to| *to != victim) {
                world.send(victim, to, 100);
            }
            world.kill(victim);
            let dead_for = [0, 30, 200, 1500][round];
            world.run(Duration::from_millis(dead_for));
            // Below all that it ever had, and a day later above all of them again.
            world.incarnations[victim] = if round < 3 { 500 - 100 * round as u64 } else { 10_000 };
            world.start(victim);
            healed_within(&mut world, bound);
            world.run(1000 * MS);
        }
        world.run(Duration::from_secs(3));
        world.check_complete();
    });
}

#[test]
fn a_node_that_begins_anew_with_a_smaller_number_is_back_within_a_second() {
    restarts_with_smaller_numbers(CALM, Duration::from_secs(1));
}

#[test]
fn a_node_that_begins_anew_with_a_smaller_number_is_back_within_seconds_in_a_storm() {
    if !long() {
        return;
    }
    restarts_with_smaller_numbers(STORM, Duration::from_secs(5));
}

#[test]
fn what_an_incarnation_that_is_over_has_said_changes_nothing_whichever_number_is_greater() {
    for (old, new) in [(999, 9), (9, 999)] {
        for_seeds(220..225, |seed| {
            let mut world = World::new(seed, 3, &ROBOT, CALM);
            world.kill(1);
            world.incarnations[1] = old;
            world.start(1);
            world.run(1000 * MS);
            world.send(1, 2, 100);
            let sent = watch(&mut world, 300 * MS);
            world.kill(1);
            world.incarnations[1] = new;
            world.start(1);
            healed_within(&mut world, Duration::from_secs(1));
            world.run(2000 * MS);
            let delivered = world.delivered.len();

            let end = replay(&mut world, sent);
            while world.now < end {
                world.run(5 * MS);
                assert!(is_whole(&world), "{:?}", world.now);
            }

            assert_eq!(world.delivered.len(), delivered);
            assert!(world.send(1, 2, 10) && world.send(2, 1, 10));
            world.run(100 * MS);
            assert_eq!(world.delivered.len(), delivered + 2);
        });
    }
}

/// A network that talks, and all that was on its wires for ten seconds.
fn recorded(seed: u64) -> (World, Vec<(usize, usize, Bytes)>) {
    let mut world = World::new(seed, 3, &ROBOT, CALM);
    world.run(1000 * MS);
    for _ in 0..500 {
        world.send(0, 1, 100);
        world.send(2, 1, 100);
        world.run(20 * MS);
    }
    let before = world.now;
    // Each frame is on its way for a tenth of a millisecond at least.
    let sent = watch(&mut world, Duration::from_secs(10)).into_values().collect();
    assert!(world.now > before && is_whole(&world));
    (world, sent)
}

/// Runs for a millisecond, in which some of these arrive again: in turn, or any.
fn repeat(world: &mut World, sent: &[(usize, usize, Bytes)], in_turn: bool) {
    for _ in 0..3 {
        world.count += 1;
        let one = match in_turn {
            true => world.count % sent.len() as u64,
            false => world.random.below(sent.len() as u64),
        };
        let key = (world.now, (1 << 60) + world.count);
        world.frames.insert(key, sent[one as usize].clone());
    }
    world.run(MS);
}

#[test]
fn what_was_said_before_takes_no_link_down() {
    for_seeds(260..262, |seed| {
        for in_turn in [true, false] {
            let (mut world, sent) = recorded(seed);
            for _ in 0..2_000 {
                repeat(&mut world, &sent, in_turn);
                assert!(is_whole(&world), "{:?}", world.now);
                let mut links = world.nodes.iter().flatten().flat_map(|node| &node.links);
                assert!(links.all(|(_, _, link)| link.state() == LinkState::Up));
            }
        }
    });
}

#[test]
fn changed_bits_in_every_kind_of_frame_are_survived_and_forgotten() {
    for_seeds(240..250, |seed| {
        let mut world = World::new(seed, 3, &ROBOT, CALM);
        world.run(1000 * MS);
        world.flips = 0.05;
        for round in 0..10 {
            for n in 0..60 {
                world.send(n % 3, (n + 1) % 3, 200);
                world.run(10 * MS);
            }
            // What nodes say to each other when they meet is struck, too.
            if round % 3 == 2 {
                world.kill(1);
                world.run(300 * MS);
                world.start(1);
            }
        }

        world.flips = 0.0;
        // Each node floods its links again every ten seconds.
        healed_within(&mut world, Duration::from_secs(15));
        world.run(3000 * MS);
        assert!(is_whole(&world));
        let before = world.delivered.len();
        assert!(world.send(0, 1, 10) && world.send(1, 2, 10) && world.send(2, 0, 10));
        world.run(200 * MS);
        assert_eq!(world.delivered.len(), before + 3);
    });
}
