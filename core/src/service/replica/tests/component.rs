//! Components that end, stop and resume while their nodes run.

use super::*;

impl Robot {
    /// Restarts the component. The new incarnation does the current job.
    pub(super) fn lose(&mut self, member: usize) {
        let now = self.clock(self.members[member].as_ref().unwrap().drift);
        let own = self.members[member].as_mut().unwrap();
        own.sum = 0;
        own.replica.handle_component_died(now);
        self.drain(member);
    }

    /// Stops or resumes the component.
    pub(super) fn rest(&mut self, member: usize, rests: bool) {
        let now = self.clock(self.members[member].as_ref().unwrap().drift);
        let own = self.members[member].as_mut().unwrap();
        if rests {
            own.replica.handle_component_stopped(now);
        } else if own.replica.component.health == Health::Inactive {
            own.sum = 0;
            own.replica.handle_component_resumed(now);
        }
        self.drain(member);
    }

    /// Stops these processes for so long.
    pub(super) fn stop_for(&mut self, members: &[usize], span: Duration) {
        members.iter().for_each(|member| self.stopped[*member] = true);
        self.advance(span);
        members.iter().for_each(|member| self.stopped[*member] = false);
        for (from, to, message) in std::mem::take(&mut self.stalled) {
            self.carry(from, to, message);
        }
    }

    pub(super) fn role(&self, member: usize) -> Role {
        self.members[member].as_ref().unwrap().replica.role()
    }

    pub(super) fn ask_some(&mut self, number: usize) {
        for _ in 0..number {
            self.ask();
            self.advance_ms(5);
        }
    }

    pub(super) fn assert_nothing_is_lost(&self, what: &str) {
        let answers: Vec<u64> =
            self.callers.iter().map(|caller| caller.answer.expect("it was answered")).collect();
        let different: BTreeSet<_> = answers.iter().collect();
        assert_eq!(different.len(), answers.len(), "{what}: {answers:?}");
        assert_eq!(answers.iter().max(), Some(&(answers.len() as u64)), "{what}: {answers:?}");
        assert_eq!(self.overlaps, 0, "{what}");
    }
}

#[test]
fn a_hot_primary_whose_component_died_leaves_the_service_to_a_standby_at_once() {
    let mut robot = Robot::elected(9, 3, StandbyKind::Hot);
    robot.ask_some(3);

    robot.lose(0);
    let caller = robot.ask();
    robot.advance_ms(200);

    assert_ne!(robot.primaries(), [0]);
    assert_eq!(robot.answers()[3], Some(4));
    assert_eq!(robot.members[0].as_ref().unwrap().sum, 4, "it is in step again");
    let lease = HEARTBEAT * 3;
    assert!(
        robot.waited(caller) < lease,
        "no caller waits for a lease: {:?}",
        robot.waited(caller)
    );
}

#[test]
fn a_member_without_the_state_is_not_elected_while_those_who_have_it_stand_still() {
    for moment in 0..40 {
        let mut robot = Robot::elected(moment, 3, StandbyKind::Hot);
        robot.ask_some(3);
        robot.ask();
        robot.advance(Duration::from_micros(200 * moment));
        robot.lose(0);

        // The stops are shorter or longer than their promises.
        robot.stop_for(&[1, 2], Duration::from_millis(moment * 5));
        robot.advance_ms(200);
        robot.ask_some(2);
        robot.advance_ms(50);

        robot.assert_nothing_is_lost(&format!("moment {moment}"));
    }
}

#[test]
fn a_member_whose_component_dies_while_it_stands_for_election_is_not_elected() {
    for rests in [false, true] {
        for moment in 0..60 {
            let mut robot = Robot::elected(moment, 3, StandbyKind::Hot);
            robot.ask_some(3);
            robot.kill(0);
            robot.advance(Duration::from_micros(25_000 + 300 * moment));
            match rests {
                true => robot.rest(1, true),
                false => robot.lose(1),
            }
            robot.ask_some(2);
            robot.advance_ms(300);

            robot.assert_nothing_is_lost(&format!("rests: {rests}, moment {moment}"));
            assert_eq!(robot.losses, 0);
        }
    }
}

#[test]
fn a_member_without_the_state_helps_to_elect_the_last_one_that_has_it() {
    for standby in [1, 2] {
        let mut robot = Robot::elected(4, 3, StandbyKind::Hot);
        robot.ask_some(4);
        robot.kill(standby);
        robot.advance_ms(50);
        robot.ask_some(2);

        robot.lose(0);
        robot.ask_some(2);
        robot.advance_ms(200);

        robot.assert_nothing_is_lost(&format!("without {standby}"));
        assert_eq!(robot.primaries(), [3 - standby]);
    }
}

#[test]
fn whichever_component_dies_while_it_works_nothing_is_answered_twice_or_forgotten() {
    for seed in 0_u64..12 {
        let kind = if seed.is_multiple_of(2) { StandbyKind::Warm } else { StandbyKind::Hot };
        let mut robot = Robot::new(seed, 3, kind, OnPartition::Stop);
        let mut chance = Random::new(seed ^ 0xdead);
        robot.advance_ms(100);
        for _ in 0..25 {
            for _ in 0..3 {
                robot.ask();
                robot.advance(Duration::from_micros((chance.unit() * 3000.0) as u64));
            }
            let member = match robot.primaries()[..] {
                [primary] if chance.chance(0.7) => primary,
                _ => (chance.unit() * 3.0) as usize,
            };
            if chance.chance(0.2) {
                robot.rest(member, true);
                robot.advance_ms((chance.unit() * 100.0) as u64);
                robot.rest(member, false);
            } else {
                robot.lose(member);
            }
            if chance.chance(0.3) {
                let others: Vec<_> = (0..3).filter(|other| *other != member).collect();
                robot.stop_for(&others, Duration::from_millis((chance.unit() * 90.0) as u64));
            }
            robot.advance_ms(250);
        }
        robot.advance_ms(500);
        robot.assert_nothing_is_lost(&format!("{kind:?}, seed {seed}"));
    }
}

#[test]
fn where_no_member_has_the_state_the_service_starts_again_after_a_while() {
    let mut robot = Robot::elected(6, 3, StandbyKind::Hot);
    robot.ask_some(3);
    robot.stop_for(&[0, 1, 2], Duration::from_millis(1));
    (0..3).for_each(|member| robot.lose(member));

    robot.advance_ms(500);
    assert_eq!(robot.primaries(), [], "a member might have the state");
    robot.advance_ms(500);
    assert_eq!(robot.primaries().len(), 1);
    robot.ask();
    robot.advance_ms(20);
    assert_eq!(robot.answers()[3], Some(1));
}

#[test]
fn the_only_member_goes_on_by_itself() {
    let mut robot = Robot::elected(6, 1, StandbyKind::Hot);
    robot.ask_some(2);
    robot.lose(0);
    robot.ask_some(1);
    assert_eq!(robot.answers()[2], Some(1));

    robot.rest(0, true);
    robot.advance_ms(100);
    assert_eq!(robot.primaries(), []);
    robot.rest(0, false);
    robot.advance_ms(100);
    robot.ask_some(1);
    assert_eq!(robot.answers()[3], Some(1));
}

#[test]
fn a_primary_whose_component_rests_resigns_at_once_and_is_no_candidate_until_it_is_back() {
    for kind in [StandbyKind::Cold, StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::elected(8, 3, kind);
        robot.ask_some(3);
        robot.rest(0, true);
        assert_eq!(robot.primaries(), [], "{kind:?}: at once");
        robot.advance_ms(15);
        let follower = robot.primaries();
        assert!(matches!(follower[..], [1 | 2]), "{kind:?}: {follower:?}");
        robot.ask_some(2);
        let fresh = kind == StandbyKind::Cold;
        assert_eq!(robot.answers()[4], Some(if fresh { 2 } else { 5 }), "{kind:?}");
        let behind = Role::Standby { primary: Some(node(follower[0])), in_step: false };
        assert_eq!(robot.role(0), behind, "{kind:?}");

        // The stopped member still votes; the last one with a component serves.
        robot.kill(follower[0]);
        robot.advance_ms(100);
        assert_eq!(robot.primaries(), [3 - follower[0]], "{kind:?}");
        robot.ask_some(1);
        assert_eq!(robot.answers()[5], Some(if fresh { 1 } else { 6 }), "{kind:?}");
        robot.start(follower[0]);
        robot.advance_ms(200);
        robot.rest(3 - follower[0], true);
        robot.advance_ms(200);
        assert_eq!(robot.primaries(), follower, "{kind:?}: not the one at rest");

        robot.rest(0, false);
        robot.advance_ms(200);
        robot.kill(follower[0]);
        robot.advance_ms(100);
        assert_eq!(robot.primaries(), [0], "{kind:?}: it is back");
    }
}

#[test]
fn a_resignation_of_an_earlier_epoch_or_of_a_standby_releases_no_promise() {
    let mut robot = Robot::elected(8, 3, StandbyKind::Warm);
    let past = Message::Resigned { epoch: 0 };
    let other = Message::Resigned { epoch: 1 };
    for (from, message) in [(0, past), (1, other)] {
        let now = robot.clock(robot.members[2].as_ref().unwrap().drift);
        let own = robot.members[2].as_mut().unwrap();
        own.replica.handle_message(&node(from), &codec::encode_unbounded(&message), now);
        assert_eq!(
            robot.role(2),
            Role::Standby { primary: Some(node(0)), in_step: true },
            "{message:?}"
        );
    }
    robot.advance_ms(100);
    assert_eq!(robot.primaries(), [0]);
}

#[test]
fn a_warm_service_goes_on_where_it_was_however_long_all_of_its_members_rested() {
    for members in [1, 3] {
        let mut robot = Robot::elected(4, members, StandbyKind::Warm);
        robot.ask_some(3);

        (0..members).for_each(|member| robot.rest(member, true));
        robot.advance(Duration::from_secs(60));
        (0..members).for_each(|member| robot.rest(member, false));
        robot.advance(Duration::from_secs(2));
        robot.ask();
        robot.advance_ms(500);

        assert_eq!(robot.answers().last(), Some(&Some(4)), "{members} members");
    }
}

#[test]
fn the_only_member_of_a_warm_service_loads_the_last_state_into_its_restarted_component() {
    let mut robot = Robot::elected(4, 1, StandbyKind::Warm);
    robot.ask_some(3);

    robot.lose(0);
    robot.ask_some(1);
    robot.advance_ms(500);

    robot.assert_nothing_is_lost("after the restart");
}
