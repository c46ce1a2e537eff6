//! Elections while nodes start, end and are cut off, and the requests meanwhile.

use super::*;

#[test]
fn the_first_of_the_members_serves_and_all_others_know_it() {
    let mut robot = Robot::elected(1, 3, StandbyKind::Warm);
    assert_eq!(robot.primaries(), [0]);
    for member in 1..3 {
        let role = robot.members[member].as_ref().unwrap().replica.role();
        assert_eq!(role, Role::Standby { primary: Some(node(0)), in_step: true });
    }

    for sum in 1..=20 {
        let caller = robot.ask();
        robot.advance_ms(10);
        assert_eq!(robot.callers[caller].answer, Some(sum));
    }
}

#[test]
fn a_request_in_flight_completes_once_when_the_primary_is_killed() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        for moment in 0..60 {
            let mut robot = Robot::elected(moment, 3, kind);
            for _ in 0..5 {
                robot.ask();
                robot.advance_ms(5);
            }
            let caller = robot.ask();
            robot.advance(Duration::from_micros(100 * moment));
            robot.kill(0);
            robot.advance_ms(100);
            robot.ask();
            robot.advance_ms(20);

            let expected: Vec<_> = (1..=7).map(Some).collect();
            assert_eq!(robot.answers(), expected, "{kind:?}, killed {moment} tenths later");
            assert!(robot.waited(caller) < Duration::from_millis(50), "{:?}", robot.waited(caller));
            assert_eq!(robot.overlaps, 0);
        }
    }
}

#[test]
fn the_next_primary_answers_after_one_round_trip_if_the_others_have_its_state() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::elected(4, 3, kind);
        for _ in 0..5 {
            robot.ask();
            robot.advance_ms(5);
        }
        robot.kill(0);
        while robot.primaries().is_empty() {
            robot.advance(Duration::from_micros(100));
        }
        let caller = robot.ask();
        robot.advance_ms(20);

        // Two paths of at most 1.7 ms, and the component's 0.3 ms, twice for a state to be loaded.
        assert!(robot.waited(caller) <= Duration::from_millis(5), "{:?}", robot.waited(caller));
        let follower = robot.primaries()[0];
        let standby = robot.members[3 - follower].as_ref().unwrap().replica.role();
        assert_eq!(standby, Role::Standby { primary: Some(node(follower)), in_step: true });
    }
}

#[test]
fn no_standby_takes_over_before_the_services_that_it_depends_on() {
    let mut robot = Robot::new(2, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.served_ms = Some(robot.now.as_nanos() / 1_000_000 + 150);
    (0..3).for_each(|member| robot.start(member));
    robot.advance_ms(145);
    assert_eq!(robot.primaries(), []);
    robot.advance_ms(30);
    assert_eq!(robot.primaries().len(), 1, "as soon as they are there");

    // They are lost together with the primary, and come back later.
    let first = robot.primaries()[0];
    robot.served_ms = Some(robot.now.as_nanos() / 1_000_000 + 300);
    robot.kill(first);
    robot.advance_ms(295);
    assert_eq!(robot.primaries(), []);
    robot.advance_ms(30);
    assert_eq!(robot.primaries().len(), 1);
    assert_eq!(robot.overlaps, 0);
}

#[test]
fn the_return_of_a_node_does_not_take_the_service_back() {
    for kind in [StandbyKind::Cold, StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::elected(3, 3, kind);
        robot.ask();
        robot.advance_ms(10);
        robot.kill(0);
        robot.advance_ms(100);
        let follower = robot.primaries();
        robot.start(0);
        robot.advance_ms(500);

        assert_eq!(robot.primaries(), follower, "{kind:?}");
        robot.ask();
        robot.advance_ms(10);
        let second = if kind == StandbyKind::Cold { 1 } else { 2 };
        assert_eq!(robot.answers(), [Some(1), Some(second)]);

        // It is in step again: after the next failure, it or the third member serves.
        robot.kill(follower[0]);
        robot.advance_ms(100);
        robot.ask();
        robot.advance_ms(10);
        let third = if kind == StandbyKind::Cold { 1 } else { 3 };
        assert_eq!(robot.answers()[2], Some(third), "{kind:?}");
    }
}

#[test]
fn a_primary_without_a_majority_stops_before_the_next_one_serves() {
    for seed in 0..40 {
        let mut robot = Robot::new(seed, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.advance_ms(100 + seed);
        assert_eq!(robot.primaries(), [0]);
        robot.sides = vec![1, 0, 0];
        robot.advance_ms(100);
        let follower = robot.primaries();
        assert!(matches!(follower[..], [1 | 2]), "{seed}: {follower:?}");
        robot.sides = vec![0, 0, 0];
        robot.advance_ms(200);
        assert_eq!(robot.primaries(), follower, "seed {seed}");
        assert_eq!(robot.overlaps, 0, "seed {seed}");
    }
}

#[test]
fn in_two_halves_no_node_serves_or_one_of_each_as_configured() {
    let mut robot = Robot::new(5, 2, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(200);
    assert_eq!(robot.primaries(), [0]);
    robot.sides = vec![0, 1];
    robot.advance_ms(500);
    assert_eq!(robot.primaries(), []);
    robot.sides = vec![0, 0];
    robot.advance_ms(500);
    assert_eq!(robot.primaries().len(), 1);

    let mut robot = Robot::new(5, 2, StandbyKind::Warm, OnPartition::Continue);
    robot.advance_ms(200);
    let first = robot.primaries();
    assert_eq!(first.len(), 1);
    robot.sides = vec![0, 1];
    robot.advance_ms(500);
    assert_eq!(robot.primaries(), [0, 1]);
    robot.sides = vec![0, 0];
    robot.advance_ms(500);
    assert_eq!(robot.primaries(), [1 - first[0]], "the greater epoch stays");
}

#[test]
fn whatever_is_cut_killed_and_started_again_nothing_is_answered_twice_or_forgotten() {
    for seed in 0_u64..40 {
        let kind = if seed.is_multiple_of(2) { StandbyKind::Warm } else { StandbyKind::Hot };
        let mut robot = Robot::new(seed, 3, kind, OnPartition::Stop);
        let mut chance = Random::new(seed ^ 0xfeed);
        robot.advance_ms(100);
        for _ in 0..25 {
            for _ in 0..3 {
                robot.ask();
                robot.advance_ms((chance.unit() * 6.0) as u64);
            }
            // One failure at a time, and time to come into step again.
            let member = (chance.unit() * 3.0) as usize;
            if chance.chance(0.5) {
                robot.kill(member);
                robot.advance_ms(60 + (chance.unit() * 100.0) as u64);
                robot.start(member);
            } else {
                robot.sides[member] = 1;
                robot.advance_ms((chance.unit() * 120.0) as u64);
                robot.sides[member] = 0;
            }
            robot.advance_ms(250);
        }
        robot.advance_ms(500);

        let answers: Vec<u64> =
            robot.callers.iter().map(|caller| caller.answer.expect("it was answered")).collect();
        let different: BTreeSet<_> = answers.iter().collect();
        assert_eq!(different.len(), answers.len(), "seed {seed}: {answers:?}");
        assert_eq!(answers.iter().max(), Some(&(answers.len() as u64)), "seed {seed}: {answers:?}");
        assert_eq!(robot.overlaps, 0, "seed {seed}");
    }
}
