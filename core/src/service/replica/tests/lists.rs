//! Random lists: of the nodes that have met, at most one is primary.

use super::*;

/// Returns some of so many nodes.
fn list(chance: &mut Random, size: usize) -> Vec<NodeName> {
    let mut all: Vec<_> = (0..size).filter(|_| chance.chance(0.6)).collect();
    if chance.chance(0.2) {
        all.reverse();
    }
    all.into_iter().map(node).collect()
}

#[test]
fn however_lists_differ_and_whichever_nodes_are_cut_off_or_die_there_are_never_two_primaries() {
    let mut served = 0;
    for seed in 0_u64..24 {
        let size = 3 + (seed % 4) as usize;
        let mut robot = Robot::new(seed, size, StandbyKind::Warm, OnPartition::Stop);
        let mut chance = Random::new(seed ^ 0x71);
        for _ in 0..2 {
            let lists: Vec<_> = (0..3).map(|_| list(&mut chance, size)).collect();
            // At most one of them has another rule.
            let divides = chance.chance(0.2).then(|| (chance.unit() * size as f64) as usize);
            for member in 0..size {
                let mut those = lists.iter().filter(|list| list.contains(&node(member)));
                let which = those.clone().count().min(1 + (chance.unit() * 2.0) as usize);
                let members = those.nth(which.saturating_sub(1)).cloned();
                robot.reconfigure(member, |config| {
                    config.members = members.unwrap_or_else(|| vec![node(member)]);
                    if divides == Some(member) {
                        config.on_partition = OnPartition::Continue;
                    }
                });
            }
            // All meet.
            robot.sides = vec![0; size];
            robot.poll_directories(500);
            robot.advance_ms(200);
            robot.overlaps = 0;
            for _ in 0..4 {
                served += robot.primaries().len();
                let member = (chance.unit() * size as f64) as usize;
                match chance.unit() {
                    case if case < 0.2 => robot.kill(member),
                    case if case < 0.8 => robot.sides[member] ^= 1,
                    _ => robot.sides = vec![0; size],
                }
                robot.advance_ms(150);
                robot.poll_directories(0);
            }
            assert_eq!(robot.overlaps, 0, "seed {seed}: {:?}", robot.configurations);
        }
    }
    assert!(served > 40, "there is a primary now and then: {served}");
}
