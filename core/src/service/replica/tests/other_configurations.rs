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

#[test]
fn while_a_list_is_changed_node_by_node_nothing_that_was_answered_is_forgotten() {
    let grown: [&[usize]; 2] = [&[0, 1, 2], &[0, 1, 2, 3]];
    let moved: [&[usize]; 2] = [&[0, 1, 2], &[1, 2, 3]];
    let shrunk: [&[usize]; 2] = [&[0, 1, 2, 3], &[0, 1, 2]];
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        for ([before, after], order) in [
            (grown, &[3, 2, 1, 0][..]),
            (grown, &[3, 0, 1, 2]),
            (moved, &[3, 2, 1]),
            (shrunk, &[2, 1, 0]),
        ] {
            let mut robot = Robot::new(3, 4, kind, OnPartition::Stop);
            let those = |list: &[usize]| list.iter().copied().map(node).collect::<Vec<_>>();
            for member in 0..4 {
                robot.reconfigure(member, |config| config.members = those(before));
                if !before.contains(&member) {
                    robot.kill(member);
                }
            }
            robot.advance_ms(200);
            robot.ask_some(3);
            for member in order {
                robot.reconfigure(*member, |config| config.members = those(after));
                robot.poll_directories(1000);
                robot.ask_some(2);
                robot.advance_ms(100);
                let answers = robot.answers();
                let expected: Vec<_> = (1..=answers.len() as u64).map(Some).collect();
                assert_eq!(answers, expected, "{kind:?} {after:?}: {member} restarts");
            }
            assert_eq!(robot.overlaps, 0, "{kind:?} {after:?}");
            assert_eq!(robot.losses, 0, "{kind:?} {after:?}");
        }
    }
}

#[test]
fn where_so_many_nodes_change_their_list_at_once_that_the_state_is_lost_they_wait_and_declare_it() {
    let (before, after) = ([0, 1, 2], [0, 1, 2, 3, 4]);
    let those = |list: &[usize]| list.iter().copied().map(node).collect::<Vec<_>>();
    let mut robot = Robot::new(3, 5, StandbyKind::Warm, OnPartition::Stop);
    for member in 0..5 {
        robot.reconfigure(member, |config| config.members = those(&before));
        if !before.contains(&member) {
            robot.kill(member);
        }
    }
    robot.advance_ms(200);
    robot.ask_some(3);
    for member in [1, 3, 4] {
        robot.reconfigure(member, |config| config.members = those(&after));
    }
    let answered = Position { epoch: 1, number: 3 };
    robot.poll_directories(500);
    assert!(
        robot.primaries().is_empty(),
        "a node that has the state is waited for: {:?}",
        robot.primaries()
    );
    assert_eq!(robot.losses, 0);
    assert_eq!(robot.members[3].as_ref().unwrap().replica.answered, answered);

    robot.poll_directories(1500);

    assert_eq!((robot.primaries().len(), robot.overlaps), (1, 0));
    let asked = robot.ask();
    robot.advance_ms(50);
    assert_eq!(robot.callers[asked].answer, Some(1), "all is forgotten");
    assert_eq!(robot.losses, 1, "and that is declared");
}

#[test]
fn however_many_nodes_change_their_list_at_once_no_answered_request_is_lost_without_a_fault() {
    let (mut forgotten, mut kept) = (0, 0);
    for seed in 0_u64..24 {
        let kind = if seed % 2 == 0 { StandbyKind::Warm } else { StandbyKind::Hot };
        let mut robot = Robot::new(seed, 5, kind, OnPartition::Stop);
        let mut chance = Random::new(seed ^ 0x5a);
        let those = |list: &[usize]| list.iter().copied().map(node).collect::<Vec<_>>();
        for member in 0..5 {
            robot.reconfigure(member, |config| config.members = those(&[0, 1, 2]));
            if member > 2 {
                robot.kill(member);
            }
        }
        robot.advance_ms(200);
        robot.ask_some(3);
        let after = if chance.chance(0.5) { vec![0, 1, 2, 3, 4] } else { vec![1, 2, 3, 4] };
        // One or two of the three restart first, the primary or not, and the others later.
        let mut order = vec![0, 1, 2];
        order.rotate_left((chance.unit() * 3.0) as usize);
        let last = order.split_off(1 + usize::from(chance.chance(0.5)));
        let news: &[&[usize]] = if chance.chance(0.5) { &[&[3, 4], &[]] } else { &[&[], &[3, 4]] };
        for (some, news) in [(vec![], news[0]), (order, news[1]), (last, &[])] {
            for member in news.iter().copied().chain(some) {
                robot.reconfigure(member, |config| config.members = those(&after));
            }
            for _ in 0..3 {
                robot.poll_directories(1000);
                robot.ask_some(1);
            }
        }
        assert_eq!(robot.overlaps, 0, "seed {seed}");
        let answers: Vec<_> = robot.answers().into_iter().flatten().collect();
        let back = answers.windows(2).filter(|two| two[1] <= two[0]).count() as u64;
        assert!(back <= robot.losses, "seed {seed}: {answers:?}, declared {} times", robot.losses);
        forgotten += back;
        kept += u64::from(back == 0);
    }
    assert!(forgotten > 3 && kept > 3, "both were tried: {forgotten}, {kept}");
}

#[test]
fn beside_a_node_with_a_shorter_list_the_nodes_that_agree_take_over_from_a_primary_that_died() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::new(5, 4, kind, OnPartition::Stop);
        let those = |list: &[usize]| list.iter().copied().map(node).collect::<Vec<_>>();
        for member in 0..4 {
            robot.reconfigure(member, |config| config.members = those(&[0, 1, 2]));
        }
        robot.kill(3);
        robot.advance_ms(200);
        robot.ask_some(5);
        robot.reconfigure(3, |config| config.members = those(&[0, 3]));
        robot.poll_directories(1000);
        robot.ask_some(1);
        robot.advance_ms(100);
        let [primary] = robot.primaries()[..] else { panic!("{:?}", robot.primaries()) };

        robot.kill(primary);
        robot.poll_directories(500);
        robot.ask_some(1);
        robot.advance_ms(200);

        let expected: Vec<_> = (1..=7).map(Some).collect();
        assert_eq!(
            robot.answers(),
            expected,
            "{kind:?} without {primary}: {:?}",
            robot.configurations
        );
    }
}
