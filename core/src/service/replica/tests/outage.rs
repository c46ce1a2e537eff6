//! Services without a primary.

use super::*;

impl Robot {
    fn outage(&self, member: usize) -> Option<&str> {
        self.faults.get(&(member, FaultKind::ServiceUnavailable)).map(String::as_str)
    }

    /// Returns the members that declare that the service is unavailable.
    fn without_primary(&self) -> Vec<usize> {
        (0..self.size).filter(|member| self.outage(*member).is_some()).collect()
    }
}

#[test]
fn neither_a_start_nor_a_takeover_is_an_outage() {
    for kind in [StandbyKind::Cold, StandbyKind::Warm, StandbyKind::Hot] {
        for seed in 0..10 {
            let mut robot = Robot::new(seed, 5, kind, OnPartition::Stop);
            for _ in 0..5 {
                for _ in 0..100 {
                    robot.advance_ms(3);
                    assert_eq!(robot.without_primary(), [0; 0], "{kind:?}, seed {seed}");
                }
                let [primary] = robot.primaries()[..] else { panic!("{:?}", robot.primaries()) };
                robot.kill(primary);
                robot.advance_ms(150);
                robot.start(primary);
            }
        }
    }
}

#[test]
fn a_service_without_a_majority_is_declared_after_a_second_with_the_missing_nodes() {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.poll_directories(500);
    robot.kill(0);
    robot.kill(2);
    robot.poll_directories(500);
    assert_eq!(robot.without_primary(), [0; 0], "a standby may take over yet");

    robot.poll_directories(1000);

    assert_eq!(robot.without_primary(), [1]);
    let detail = robot.outage(1).unwrap();
    assert!(detail.contains("no majority: it needs 2 of its 3 nodes, and has 1;"), "{detail}");
    assert!(detail.contains("not reachable: module0, module2 (start them, repair"), "{detail}");

    robot.start(2);
    robot.advance_ms(100);
    assert_eq!(robot.primaries().len(), 1);
    assert_eq!(robot.without_primary(), [0; 0], "it ends by itself");
}

#[test]
fn the_detail_of_an_outage_is_updated_when_its_cause_changes() {
    let mut robot = Robot::new(3, 5, StandbyKind::Warm, OnPartition::Stop);
    robot.poll_directories(500);
    (1..4).for_each(|member| robot.kill(member));
    robot.poll_directories(2000);
    assert!(robot.outage(0).unwrap().contains("not reachable: module1, module2, module3 ("));

    robot.start(2);
    robot.rest(0, true);
    robot.rest(4, true);
    robot.start(3);
    robot.rest(2, true);
    robot.rest(3, true);
    robot.poll_directories(3000);

    let detail = robot.outage(0).unwrap();
    assert!(
        !detail.contains("majority") && detail.contains("its component here accepts no jobs"),
        "{detail}"
    );
    assert_eq!(robot.without_primary(), [0, 4], "those that have just started have five seconds");
    robot.poll_directories(3000);
    assert_eq!(robot.without_primary(), [0, 2, 3, 4]);
}

#[test]
fn a_node_alone_at_the_start_is_given_five_seconds() {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    (1..3).for_each(|member| robot.kill(member));
    robot.poll_directories(4500);
    assert_eq!(robot.without_primary(), [0; 0], "the others may be about to start");

    robot.poll_directories(1000);

    assert_eq!(robot.without_primary(), [0]);
}

#[test]
fn only_a_member_that_is_cut_off_declares_the_outage() {
    let mut robot = Robot::new(3, 3, StandbyKind::Hot, OnPartition::Stop);
    robot.poll_directories(500);
    robot.sides = vec![1, 0, 0];
    robot.poll_directories(2000);
    assert_eq!(robot.without_primary(), [0]);
    assert!(robot.outage(0).unwrap().contains("not reachable: module1, module2"));

    robot.sides = vec![0; 3];
    robot.poll_directories(500);
    assert_eq!(robot.without_primary(), [0; 0]);
}

#[test]
fn an_outage_by_different_configurations_names_the_nodes() {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.poll_directories(500);
    assert_eq!(robot.primaries(), [0]);
    robot.reconfigure(0, |config| config.heartbeat_interval = HEARTBEAT * 2);
    robot.meet();
    robot.poll_directories(3000);

    assert_eq!(robot.without_primary(), [1, 2], "the first has just started");
    let detail = robot.outage(2).unwrap();
    assert!(
        detail.contains("another configuration of it: module0 (the fault contract"),
        "{detail}"
    );
    robot.poll_directories(3000);
    let detail = robot.outage(0).unwrap();
    assert!(detail.contains("configuration of it: module1, module2 ("), "{detail}");
}

#[test]
fn a_service_that_waits_for_others_or_for_its_state_declares_so() {
    let mut robot = Robot::new(2, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.served_ms = Some(u64::MAX / 2_000_000);
    (0..3).for_each(|member| robot.start(member));
    robot.poll_directories(5500);
    assert_eq!(robot.without_primary(), [0, 1, 2]);
    let detail = robot.outage(0).unwrap();
    assert!(detail.contains("waits for the services that it depends on"), "{detail}");

    // A longer heartbeat interval, so that twenty leases are longer than a takeover may take.
    let mut robot = Robot::new(6, 3, StandbyKind::Hot, OnPartition::Stop);
    for member in 0..3 {
        robot.reconfigure(member, |config| config.heartbeat_interval = HEARTBEAT * 10);
    }
    robot.poll_directories(1000);
    robot.ask_some(3);
    robot.poll_directories(500);
    robot.stop_for(&[0, 1, 2], Duration::from_millis(1));
    (0..3).for_each(|member| robot.lose(member));
    robot.poll_directories(4500);
    let detail = robot.outage(0).unwrap();
    assert!(detail.contains("lacks the state, and waits 6.0 s"), "{detail}");
    robot.poll_directories(4000);
    assert_eq!(robot.without_primary(), [0; 0], "it starts without the state");
}

#[test]
fn a_candidate_without_votes_declares_what_may_prevent_them() {
    let mut robot = Robot::new(6, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.poll_directories(500);
    // The other members are in the directory, and their processes are stopped.
    robot.stopped = vec![false, true, true];
    robot.poll_directories(2000);

    let detail = robot.outage(0).expect("it is declared");
    assert!(
        detail.contains("have not elected a primary yet (their components may be at rest"),
        "{detail}"
    );
}

#[test]
fn a_long_outage_wakes_the_replica_no_more_often_than_it_must() {
    let mut robot = Robot::elected(6, 1, StandbyKind::Warm);
    robot.rest(0, true);
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let (mut now, mut wakes) = (own.now, 0);
    let end = now + Duration::from_secs(60);
    while now < end {
        own.handle_timeout(now);
        let due = own.poll_timeout().unwrap();
        assert!(due > now, "it would spin");
        (now, wakes) = (due, wakes + 1);
    }
    // Once per second for the fault, and once for each time that it may stand for election again.
    assert!(wakes < 170, "{wakes}");
}
