//! Paths that carry one way only, queue for a second, or end at a node that is stopped for a while.

use crate::net_simulation::ROBOT;
use crate::net_simulation::world::{CALM, MS, STORM, World, for_seeds, long};
use blastema_core::TrafficClass;
use blastema_core::net::link::LinkState;
use std::time::Duration;

/// Eight megabits a second, with a queue of a second.
const SLOW: (u64, u64) = (1_000_000, 1_000_000);

impl World {
    /// The state of a wire at both ends.
    fn both_ends(&self, wire: usize) -> [LinkState; 2] {
        self.wires[wire].ends.map(|(node, link)| {
            let (_, _, link) = &self.nodes[node].as_ref().unwrap().links[link];
            link.state()
        })
    }

    /// Messages in both directions, one each millisecond.
    fn talk(&mut self, millis: u32) {
        for _ in 0..millis {
            assert!(self.send(0, 1, 100) && self.send(1, 0, 100));
            self.run(MS);
        }
    }

    fn stop(&mut self, node: usize, span: Duration) {
        self.stopped[node] = self.now + span;
    }

    /// All wires carry, and no node is stopped: time to be whole again.
    fn heal(&mut self) {
        for wire in &mut self.wires {
            (wire.cut, wire.mute, wire.rate) = (false, [false; 2], None);
        }
        // A node that stays dead has ten seconds to tell what had arrived, and another one may be
        // stopped for three.
        self.run(Duration::from_secs(16));
    }
}

#[test]
fn a_wire_that_carries_one_way_only_is_down_at_both_ends_and_costs_nothing() {
    for_seeds(300..310, |seed| {
        let mut world = World::new(seed, 2, &[(0, 1), (0, 1)], CALM);
        world.run(500 * MS);
        for side in [0, 1] {
            world.wires[0].mute[side] = true;
            world.talk(1000);
            assert!(!world.both_ends(0).contains(&LinkState::Up), "{:?}", world.both_ends(0));
            assert_eq!(world.both_ends(1), [LinkState::Up; 2]);

            world.wires[0].mute[side] = false;
            world.talk(3000);
            assert_eq!(world.both_ends(0), [LinkState::Up; 2]);
        }
        world.run(1000 * MS);

        assert_eq!(world.delivered.len() as u64, world.count_sent());
        assert!(world.returned.is_empty());
    });
}

#[test]
fn nodes_that_only_one_way_joins_are_not_reachable_and_get_their_messages_back() {
    for_seeds(310..320, |seed| {
        let mut world = World::new(seed, 3, &[(0, 1), (0, 2)], CALM);
        world.run(500 * MS);

        world.wires[0].mute[1] = true;
        for _ in 0..100 {
            world.send(0, 1, 100);
            world.send(2, 1, 100);
            world.send(1, 2, 100);
            world.run(10 * MS);
        }
        world.run(Duration::from_secs(12));
        let reachable =
            |world: &World, node: usize| world.nodes[node].as_ref().unwrap().reachable.len();
        assert_eq!([0, 1, 2].map(|node| reachable(&world, node)), [1, 0, 1]);
        assert!(!world.returned.is_empty());

        world.heal();
        assert_eq!([0, 1, 2].map(|node| reachable(&world, node)), [2; 3]);
        world.check_complete();
    });
}

#[test]
fn nodes_that_were_stopped_together_condemn_nobody_when_they_go_on() {
    for_seeds(320..340, |seed| {
        let mut world = World::new(seed, 3, &ROBOT, CALM);
        world.run(1000 * MS);
        let before = world.downs;
        for _ in 0..10 {
            let span = Duration::from_millis(50 + world.random.below(5_000));
            for node in 0..3 {
                // Not at the same moment: what was sent in between waits in sockets.
                let late = Duration::from_millis(world.random.below(20));
                world.stop(node, span + late);
                world.send(node, (node + 1) % 3, 100);
            }
            world.run(span + 500 * MS);
        }
        world.run(1000 * MS);

        assert_eq!(world.downs, before, "no link was ever bad");
        assert_eq!(world.delivered.len() as u64, world.count_sent());
        assert!(world.returned.is_empty());
    });
}

#[test]
fn a_slow_path_with_a_deep_queue_keeps_its_link_and_its_control_beside_images_both_ways() {
    if !long() {
        return;
    }
    const IMAGE: usize = 300_000;
    for_seeds(340..344, |seed| {
        let mut world = World::new(seed, 2, &[(0, 1)], CALM);
        world.run(500 * MS);
        let (downs, bytes) = (world.downs, world.bytes);
        world.wires[0].rate = Some(SLOW);

        let (mut images, mut longest) = (0, Duration::ZERO);
        for n in 0..200 {
            if n % 4 == 0 {
                // A third more than the path bears.
                for (from, to) in [(0, 1), (1, 0)] {
                    images += u64::from(world.send_on(TrafficClass::Bulk, from, to, IMAGE));
                }
            }
            let (began, delivered) = (world.now, world.delivered_on(TrafficClass::Control));
            assert!(world.send_on(TrafficClass::Control, 0, 1, 32));
            while world.delivered_on(TrafficClass::Control) == delivered {
                world.run(MS);
                assert!(world.now - began < Duration::from_secs(2), "a command is lost");
            }
            longest = longest.max(world.now - began);
            world.run_until(began + 56 * MS);
        }
        world.run(Duration::from_secs(20));

        assert_eq!(world.downs, downs, "no link was ever bad");
        assert_eq!(world.delivered.len() as u64, world.count_sent());
        assert!(world.returned.is_empty());
        // Commands are to keep a lease of 200 ms.
        assert!(longest < 150 * MS, "the longest took {longest:?}");
        let sent = world.bytes - bytes;
        let payload = images * IMAGE as u64;
        assert!(sent * 10 <= payload * 11, "{sent} bytes for {payload}");
    });
}

#[test]
fn whatever_paths_do_no_message_is_doubled_or_vanishes() {
    let wires = [(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (0, 1)];
    for_seeds(400..412, |seed| {
        let mut world = World::new(seed, 4, &wires, STORM);
        for _ in 0..400 {
            let wire = world.random.below(6) as usize;
            let node = world.random.below(4) as usize;
            match world.random.below(40) {
                0 | 1 => {
                    let side = world.random.below(2) as usize;
                    world.wires[wire].mute[side] ^= true;
                }
                2 => {
                    let span = Duration::from_millis(world.random.below(3_000));
                    world.stop(node, span);
                }
                3 => {
                    let slow = world.random.chance(0.5).then_some((50_000, 50_000));
                    world.wires[wire].rate = slow;
                }
                4 => world.kill(node),
                5..=8 if world.nodes[node].is_none() => world.start(node),
                _ => {
                    let to = (node + 1 + world.random.below(3) as usize) % 4;
                    let length = world.random.below(3000) as usize;
                    world.send(node, to, length);
                }
            }
            let pause = Duration::from_millis(world.random.below(20));
            world.run(pause);
        }
        world.heal();
        world.check_complete();
    });
}
