//! Services that nobody serves.

use super::*;

impl Robot {
    fn outage(&self, member: usize) -> Option<&str> {
        self.faults.get(&(member, FaultKind::ServiceUnavailable)).map(String::as_str)
    }

    /// Who says that nobody serves.
    fn missing_it(&self) -> Vec<usize> {
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
                    assert_eq!(robot.missing_it(), [0; 0], "{kind:?}, seed {seed}");
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
fn a_service_without_a_majority_is_told_after_a_second_with_who_is_missing_until_it_is_served() {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.look_around(500);
    robot.kill(0);
    robot.kill(2);
    robot.look_around(500);
    assert_eq!(robot.missing_it(), [0; 0], "somebody may follow yet");

    robot.look_around(1000);

    assert_eq!(robot.missing_it(), [1]);
    let told = robot.outage(1).unwrap();
    assert!(told.contains("no majority: it needs 2 of its 3 nodes, and has 1;"), "{told}");
    assert!(told.contains("not heard: module0, module2 (start them, or mend"), "{told}");

    robot.start(2);
    robot.advance_ms(100);
    assert_eq!(robot.primaries().len(), 1);
    assert_eq!(robot.missing_it(), [0; 0], "it ends by itself");
}

#[test]
fn what_keeps_a_service_from_being_served_is_told_anew_when_it_is_something_else() {
    let mut robot = Robot::new(3, 5, StandbyKind::Warm, OnPartition::Stop);
    robot.look_around(500);
    (1..4).for_each(|member| robot.kill(member));
    robot.look_around(2000);
    assert!(robot.outage(0).unwrap().contains("not heard: module1, module2, module3 ("));

    robot.start(2);
    robot.rest(0, true);
    robot.rest(4, true);
    robot.start(3);
    robot.rest(2, true);
    robot.rest(3, true);
    robot.look_around(3000);

    let told = robot.outage(0).unwrap();
    assert!(
        !told.contains("majority") && told.contains("its component here takes nothing"),
        "{told}"
    );
    assert_eq!(robot.missing_it(), [0, 4], "those that have just begun are given five seconds");
    robot.look_around(3000);
    assert_eq!(robot.missing_it(), [0, 2, 3, 4]);
}

#[test]
fn a_node_alone_at_the_start_is_given_five_seconds() {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    (1..3).for_each(|member| robot.kill(member));
    robot.look_around(4500);
    assert_eq!(robot.missing_it(), [0; 0], "the others may be about to start");

    robot.look_around(1000);

    assert_eq!(robot.missing_it(), [0]);
}

#[test]
fn whoever_is_cut_off_says_so_alone_and_those_who_are_served_do_not() {
    let mut robot = Robot::new(3, 3, StandbyKind::Hot, OnPartition::Stop);
    robot.look_around(500);
    robot.sides = vec![1, 0, 0];
    robot.look_around(2000);
    assert_eq!(robot.missing_it(), [0]);
    assert!(robot.outage(0).unwrap().contains("not heard: module1, module2"));

    robot.sides = vec![0; 3];
    robot.look_around(500);
    assert_eq!(robot.missing_it(), [0; 0]);
}

#[test]
fn nodes_that_were_told_different_things_say_of_whom() {
    let mut robot = Robot::new(3, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.look_around(500);
    robot.tell(1, |config| config.hello_interval = HELLO * 2);
    robot.look_around(3000);

    assert_eq!(robot.missing_it(), [0, 2], "the third has just begun");
    let told = robot.outage(2).unwrap();
    assert!(told.contains("otherwise were module1 (what to write says"), "{told}");
    robot.look_around(3000);
    let told = robot.outage(1).unwrap();
    assert!(told.contains("otherwise were module0, module2 ("), "{told}");
}

#[test]
fn a_service_that_waits_for_others_or_for_its_state_says_so() {
    let mut robot = Robot::new(2, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.served_ms = Some(u64::MAX / 2_000_000);
    (0..3).for_each(|member| robot.start(member));
    robot.look_around(5500);
    assert_eq!(robot.missing_it(), [0, 1, 2]);
    let told = robot.outage(0).unwrap();
    assert!(told.contains("waits for the services that it depends on"), "{told}");

    // Longer hellos, so that twenty leases are longer than what is given to a takeover.
    let mut robot = Robot::new(6, 3, StandbyKind::Hot, OnPartition::Stop);
    for member in 0..3 {
        robot.tell(member, |config| config.hello_interval = HELLO * 10);
    }
    robot.look_around(1000);
    robot.ask_some(3);
    robot.look_around(500);
    robot.stop_for(&[0, 1, 2], Duration::from_millis(1));
    (0..3).for_each(|member| robot.lose(member));
    robot.look_around(4500);
    let told = robot.outage(0).unwrap();
    assert!(told.contains("has not the state, and waits 6.0 s"), "{told}");
    robot.look_around(4000);
    assert_eq!(robot.missing_it(), [0; 0], "it begins anew");
}

#[test]
fn whoever_stands_for_election_in_vain_says_who_did_not_vote() {
    let mut robot = Robot::new(6, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.look_around(500);
    // They are seen, and get no time.
    robot.stopped = vec![false, true, true];
    robot.look_around(2000);

    let told = robot.outage(0).expect("it is told");
    assert!(told.contains("was not voted for by module1, module2 ("), "{told}");
}

#[test]
fn a_member_that_is_kept_out_here_is_said_to_be_so_and_not_to_be_unwilling() {
    let mut robot = Robot::new(6, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.look_around(500);
    robot.stopped = vec![false, true, true];
    robot.look_around(1000);
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    own.handle_sent(&node(1), true);
    robot.look_around(3000);

    let told = robot.outage(0).expect("it is told");
    assert!(told.contains("isolated here: module1 ("), "{told}");
    assert!(told.contains("was not voted for by module2 ("), "{told}");
}

#[test]
fn an_outage_that_lasts_wakes_nobody_more_often_than_it_must() {
    let mut robot = Robot::new(6, 1, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
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
    // Once for each second, and for each time that it looks whether it may stand for election
    // again.
    assert!(wakes < 170, "{wakes}");
}
