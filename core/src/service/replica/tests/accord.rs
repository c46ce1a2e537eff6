//! Members that were told different things.

use super::*;

const SECOND: u64 = 1000;

impl Robot {
    /// Members of whom each was told these nodes; all see each other.
    fn told(lists: &[&[usize]]) -> Self {
        let mut robot = Robot::new(1, lists.len(), StandbyKind::Warm, OnPartition::Stop);
        for (member, list) in lists.iter().enumerate() {
            robot.tell(member, |config| config.members = list.iter().copied().map(node).collect());
        }
        robot
    }

    /// This member begins anew, and was told something else.
    fn tell(&mut self, member: usize, change: impl FnOnce(&mut ReplicaConfig)) {
        let mut config = self.config(member);
        change(&mut config);
        self.told.insert(member, config);
        self.kill(member);
        self.disputes.remove(&member);
        self.start(member);
    }

    /// What the one was told is told to the other, and its answer.
    pub(super) fn compare(&mut self, member: usize, with: usize) {
        if self.sides[member] != self.sides[with] {
            return;
        }
        for (from, to) in [(member, with), (with, member)] {
            let Some(terms) = self.members[from].as_ref().map(|from| from.replica.terms()) else {
                return;
            };
            if let Some(to) = self.members[to].as_mut() {
                to.replica.handle_terms(&node(from), &terms, self.now);
            }
        }
        self.settle(with);
    }

    /// Everybody looks around, as bodies do twice a second.
    fn look_around(&mut self, millis: u64) {
        for _ in 0..millis / 500 {
            self.advance_ms(500);
            for member in 0..self.size {
                let seen = |other: &usize| {
                    *other != member
                        && self.members[*other].is_some()
                        && self.sides[*other] == self.sides[member]
                };
                let found: Vec<_> = (0..self.size).filter(seen).map(node).collect();
                let now = self.now;
                if let Some(own) = self.members[member].as_mut() {
                    own.replica.handle_carriers(&found, now);
                    self.settle(member);
                }
            }
        }
    }

    fn disputing(&self) -> Vec<usize> {
        self.disputes.keys().copied().collect()
    }
}

#[test]
fn where_lists_of_members_differ_nobody_serves_and_each_says_why() {
    let cases: [&[&[usize]]; 4] = [
        &[&[0], &[0, 1, 2], &[0, 1, 2]],
        &[&[0], &[1]],
        &[&[0, 1], &[0, 1, 2], &[0, 1, 2]],
        &[&[0, 1, 2], &[1, 0, 2], &[0, 1, 2]],
    ];
    for lists in cases {
        let mut robot = Robot::told(lists);
        robot.look_around(2 * SECOND);

        assert!(robot.primaries().is_empty(), "{lists:?}: {:?}", robot.primaries());
        assert_eq!(robot.disputing(), (0..lists.len()).collect::<Vec<_>>(), "{lists:?}");
        let asked = robot.ask();
        robot.look_around(SECOND);
        assert_eq!(robot.callers[asked].answer, None);
    }
}

#[test]
fn whatever_else_differs_nobody_serves_either() {
    type Change = fn(&mut ReplicaConfig);
    let changes: [(&str, Change); 3] = [
        ("standbys", |config| config.kind = StandbyKind::Hot),
        ("majority", |config| config.on_partition = OnPartition::Continue),
        ("hello", |config| config.hello_interval = HELLO * 3),
    ];
    for (what, change) in changes {
        let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.advance_ms(200);
        robot.tell(1, change);
        robot.look_around(2 * SECOND);

        assert!(robot.primaries().is_empty(), "{what}");
        assert!(robot.disputes.len() == 3, "{what}: {:?}", robot.disputes);
        assert!(robot.disputes.values().all(|text| text.contains(what)), "{:?}", robot.disputes);
    }
}

#[test]
fn members_that_list_each_other_find_out_before_they_vote() {
    for first in 0..3 {
        let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.tell(first, |config| config.hello_interval = HELLO / 10);
        // Nobody has looked around yet.
        robot.advance_ms(500);
        assert_eq!(robot.overlaps, 0, "{first}");
        assert!(robot.disputes.len() >= 2, "{first}: {:?}", robot.disputes);
    }
}

#[test]
fn once_the_wrong_one_was_told_better_the_service_goes_on_with_what_it_knew() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
    let before = robot.ask();
    robot.advance_ms(50);
    assert_eq!(robot.callers[before].answer, Some(1));
    robot.tell(0, |config| config.members = vec![node(0)]);
    robot.look_around(2 * SECOND);
    assert!(robot.primaries().is_empty() && robot.disputes.len() == 3);

    robot.tell(0, |_| {});
    robot.look_around(SECOND);

    assert_eq!(robot.disputing(), [0; 0], "{:?}", robot.disputes);
    assert_eq!(robot.primaries().len(), 1);
    let after = robot.ask();
    robot.advance_ms(200);
    assert_eq!(robot.callers[after].answer, Some(2), "what was answered is kept");
}

#[test]
fn a_dispute_outlives_that_the_other_is_out_of_sight_but_not_that_it_has_left() {
    let mut robot = Robot::told(&[&[0], &[0, 1, 2], &[0, 1, 2]]);
    robot.look_around(2 * SECOND);
    robot.sides[0] = 1;
    robot.look_around(5 * SECOND);
    assert!(robot.primaries().is_empty(), "it may serve where it is");
    assert_eq!(robot.disputing(), [0, 1, 2]);

    robot.kill(0);
    let now = robot.now;
    for member in [1, 2] {
        robot.members[member].as_mut().unwrap().replica.handle_left(&node(0), now);
        robot.settle(member);
    }
    robot.advance_ms(300);
    assert_eq!(robot.disputing(), [0], "the record of one that has gone");
    assert_eq!(robot.primaries().len(), 1, "two of three");
}

#[test]
fn a_body_that_begins_anew_still_knows_of_the_dispute() {
    let mut robot = Robot::told(&[&[0], &[1]]);
    robot.look_around(SECOND);
    robot.disputes.clear();
    let (now, own) = (robot.now, robot.members[0].as_mut().unwrap());
    own.replica = own.replica.begun_anew(now);
    robot.settle(0);
    robot.advance_ms(500);
    assert_eq!(robot.disputing(), [0]);
    assert!(robot.primaries().is_empty());
}

#[test]
fn one_more_that_differs_is_more_of_the_same_and_one_less_is_told_anew() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let other = Replica::new(
        ReplicaConfig { members: vec![node(1)], ..robot.config(1) },
        Bytes::new(),
        robot.now,
    );
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let (same, terms) = (own.terms(), other.terms());
    let mut hear = |from: usize, terms: &[u8]| -> Vec<String> {
        own.handle_terms(&node(from), terms, Instant::from_millis(1));
        let outputs = std::iter::from_fn(|| own.poll_output());
        let told = outputs.filter_map(|output| match output {
            ReplicaOutput::Disputed { detail } => {
                let named = |n: &usize| detail.contains(&format!("on module{n}:"));
                Some(format!("disputed {:?}", (0..3).filter(named).collect::<Vec<_>>()))
            }
            ReplicaOutput::Agreed => Some("agreed".to_owned()),
            _ => None,
        });
        told.collect()
    };

    assert_eq!(hear(1, &terms), ["disputed [1]"]);
    assert_eq!(hear(1, &terms), [""; 0]);
    assert_eq!(hear(2, &terms), ["disputed [1, 2]"]);
    assert_eq!(hear(1, &same), ["agreed", "disputed [2]"]);
    assert_eq!(hear(2, &same), ["agreed"]);
}

#[test]
fn those_who_agree_are_asked_once_and_the_others_again_and_again() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let mut asked = |found: &[usize], millis: u64| {
        let found: Vec<_> = found.iter().copied().map(node).collect();
        own.handle_carriers(&found, Instant::from_millis(millis));
        let outputs = std::iter::from_fn(|| own.poll_output());
        let asked = outputs.filter_map(|output| match output {
            ReplicaOutput::Compare { with } => Some(index(&with)),
            _ => None,
        });
        let asked: Vec<_> = asked.collect();
        // The first one says the same each time.
        let terms = own.terms();
        if found.contains(&node(1)) {
            own.handle_terms(&node(1), &terms, Instant::from_millis(millis));
        }
        asked
    };
    assert_eq!(asked(&[0, 1, 2], 1000), [1, 2]);
    assert_eq!(asked(&[1, 2], 1499), [0; 0]);
    assert_eq!(asked(&[1, 2], 1500), [2]);
    assert_eq!(asked(&[2], 2000), [1, 2], "one has gone");
    assert_eq!(asked(&[2], 2400), [0; 0]);
    assert_eq!(asked(&[1, 2], 2500), [1, 2], "and is back, in whichever life");
    assert_eq!(asked(&[1, 2, 4], 3000), [2, 4], "members or not");
    own.handle_terms(&node(2), b"nonsense", Instant::from_millis(3100));
    assert_eq!(own.refused(), 1);
}

#[test]
fn a_member_that_does_not_carry_the_service_is_told_and_keeps_nobody_from_serving() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let say = |robot: &mut Robot, of: usize| {
        let now = robot.now;
        robot.members[0].as_mut().unwrap().replica.handle_no_terms(&node(of), now);
        robot.settle(0);
        robot.disputes.get(&0).cloned()
    };
    assert_eq!(say(&mut robot, 2), None, "it may just begin");
    let told = say(&mut robot, 2).expect("it does not");
    assert!(told.contains("listed, but without this service: module2; give it there"), "{told}");
    for _ in 0..3 {
        assert_eq!(say(&mut robot, 7), Some(told.clone()), "who is not listed need not");
    }

    robot.advance_ms(200);
    assert_eq!(robot.primaries().len(), 1);
    let terms = robot.members[2].as_ref().unwrap().replica.terms();
    let now = robot.now;
    robot.members[0].as_mut().unwrap().replica.handle_terms(&node(2), &terms, now);
    robot.settle(0);
    assert_eq!(robot.disputing(), [0; 0]);
}

#[test]
fn however_many_say_however_much_a_caller_is_told_in_one_small_message_and_of_members_first() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let long = |n: usize| NodeName::new(&format!("a{n:-<30}")).unwrap();
    let config = ReplicaConfig { members: (0..900).map(long).collect(), ..robot.config(1) };
    let terms = Replica::new(config, Bytes::new(), robot.now).terms();
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let now = Instant::from_millis(1);
    for stranger in 0..2000 {
        own.handle_terms(&long(stranger), &terms, now);
    }
    let refused = own.refused();
    assert!(refused > 900, "not all are kept: {refused}");

    own.handle_terms(&node(2), &terms, now);

    let told = own.dispute().unwrap();
    assert!(told.len() < 10_000, "{} bytes", told.len());
    let first = told.find(&format!("on {}:", node(2)));
    assert!(first.is_some() && first < told.find("on a"), "{told}");
    assert!(told.contains("; and ") && told.ends_with(" more"), "{told}");
    assert_eq!(own.refused(), refused, "there is room for members");
}
