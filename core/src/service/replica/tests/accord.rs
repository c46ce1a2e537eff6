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
    pub(super) fn tell(&mut self, member: usize, change: impl FnOnce(&mut ReplicaConfig)) {
        let mut config = self.config(member);
        change(&mut config);
        self.told.insert(member, config);
        self.kill(member);
        self.disputes.remove(&member);
        self.start(member);
    }

    /// What the one was told is told to the other, and its answer.
    pub(super) fn compare(&mut self, member: usize, with: usize) {
        if self.sides.get(with) != Some(&self.sides[member]) {
            return;
        }
        for (from, to) in [(member, with), (with, member)] {
            let Some(terms) = self.members[from].as_ref().map(|from| from.replica.terms()) else {
                return;
            };
            let Some(Some(to)) = self.members.get_mut(to) else { return };
            let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + to.drift));
            match from == member {
                true => to.replica.handle_asked(&node(from), &terms, now),
                false => to.replica.handle_terms(&node(from), &terms, now),
            }
        }
        self.settle(with);
    }

    /// Everybody looks around, as bodies do twice a second.
    pub(super) fn look_around(&mut self, millis: u64) {
        for _ in 0..(millis / 500).max(1) {
            self.advance_ms(millis.min(500));
            for member in 0..self.size {
                let seen = |other: &usize| {
                    *other != member
                        && self.members[*other].is_some()
                        && self.sides[*other] == self.sides[member]
                };
                let found: Vec<_> = (0..self.size).filter(seen).map(node).collect();
                if let Some(own) = self.members[member].as_mut() {
                    let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + own.drift));
                    own.replica.handle_reached(&found);
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
fn where_lists_of_members_differ_one_serves_of_those_who_agree_if_any_may_and_each_says_why() {
    let cases: [(&[&[usize]], &[usize]); 6] = [
        (&[&[0], &[0, 1, 2], &[0, 1, 2]], &[1, 2]),
        (&[&[0, 1], &[0, 1, 2], &[0, 1, 2]], &[1, 2]),
        (&[&[0, 1, 2], &[1, 0, 2], &[0, 1, 2]], &[0, 2]),
        // One of them, always the same.
        (&[&[0], &[1]], &[0, 1]),
        // Of neither list there is a majority.
        (&[&[0, 1], &[1, 0]], &[]),
        (&[&[0, 1, 2], &[1, 2, 0], &[2, 0, 1]], &[]),
    ];
    for (lists, who) in cases {
        let mut robot = Robot::told(lists);
        robot.look_around(SECOND);
        robot.overlaps = 0;
        robot.look_around(SECOND);

        let primaries = robot.primaries();
        assert_eq!(primaries.len(), who.len().min(1), "{lists:?}: {primaries:?}");
        assert!(primaries.iter().all(|primary| who.contains(primary)), "{lists:?}: {primaries:?}");
        assert_eq!(robot.overlaps, 0, "{lists:?}");
        assert_eq!(robot.disputing(), (0..lists.len()).collect::<Vec<_>>(), "{lists:?}");
        for (member, told) in &robot.disputes {
            // One that may serve says so, as far as it can know.
            let hopeless = told.contains("is not served by these terms");
            assert!(hopeless || who.contains(member), "{lists:?}: {told}");
        }
        let asked = robot.ask();
        robot.advance_ms(100);
        assert_eq!(robot.callers[asked].answer.is_some(), !who.is_empty(), "{lists:?}");
    }
}

#[test]
fn whatever_else_one_was_told_otherwise_the_others_go_on_but_for_another_hello() {
    type Change = fn(&mut ReplicaConfig);
    let changes: [(&str, Change, usize); 4] = [
        ("standbys", |config| config.kind = StandbyKind::Hot, 1),
        ("majority", |config| config.on_partition = OnPartition::Continue, 1),
        ("hello", |config| config.hello_interval = HELLO * 3, 0),
        ("hello", |config| config.hello_interval = HELLO / 2, 0),
    ];
    for (what, change, serving) in changes {
        let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.advance_ms(200);
        robot.tell(1, change);
        robot.look_around(SECOND);
        robot.overlaps = 0;
        robot.look_around(SECOND);

        let primaries = robot.primaries();
        assert_eq!(primaries.len(), serving, "{what}: {primaries:?}");
        assert!(!primaries.contains(&1) && robot.overlaps == 0, "{what}: {primaries:?}");
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
    robot.ask();
    robot.advance_ms(50);
    robot.tell(0, |config| config.members = vec![node(0)]);
    robot.look_around(2 * SECOND);
    assert!(matches!(robot.primaries()[..], [1 | 2]) && robot.disputes.len() == 3);
    robot.ask();
    robot.advance_ms(50);

    robot.tell(0, |_| {});
    robot.look_around(SECOND);

    assert_eq!(robot.disputing(), [0; 0], "{:?}", robot.disputes);
    assert_eq!(robot.primaries().len(), 1);
    robot.ask();
    robot.advance_ms(200);
    assert_eq!(robot.answers(), [Some(1), Some(2), Some(3)], "what was answered is kept");
}

#[test]
fn a_node_that_was_told_otherwise_and_died_or_is_cut_off_keeps_nobody_from_serving() {
    let wrong: [&[usize]; 4] = [&[0], &[2, 1, 0], &[0, 1], &[0, 1, 2, 3]];
    for (wrong, dies) in wrong.iter().flat_map(|wrong| [(wrong, true), (wrong, false)]) {
        let mut robot = Robot::told(&[wrong, &[0, 1, 2], &[0, 1, 2]]);
        robot.look_around(SECOND);
        if dies {
            robot.kill(0);
        } else {
            robot.sides[0] = 1;
        }
        robot.overlaps = 0;
        // Long after any promise.
        robot.look_around(SECOND);

        assert!(matches!(robot.primaries()[..], [1 | 2]), "{wrong:?}: {:?}", robot.primaries());
        assert_eq!(robot.overlaps, 0, "{wrong:?}");
        robot.ask_some(1);
        assert_eq!(robot.answers(), [Some(1)], "{wrong:?}");
        // And whoever follows may, too.
        let first = robot.primaries()[0];
        let now = robot.clock(robot.members[first].as_ref().unwrap().drift);
        robot.members[first].as_mut().unwrap().replica.handle_component_gone(now);
        robot.settle(first);
        robot.advance_ms(200);
        assert_eq!(robot.primaries(), [3 - first], "{wrong:?}");
    }
}

#[test]
fn one_that_died_before_it_was_told_what_others_were_is_waited_for_where_it_may_serve_by_itself() {
    let mut robot = Robot::told(&[&[0], &[0, 1, 2], &[0, 1, 2]]);
    robot.advance_ms(100);
    let terms = robot.members[0].as_ref().unwrap().replica.terms();
    for member in [1, 2] {
        let now = robot.clock(robot.members[member].as_ref().unwrap().drift);
        let own = &mut robot.members[member].as_mut().unwrap().replica;
        own.handle_asked(&node(0), &terms, now);
        while own.poll_output().is_some() {}
    }
    robot.kill(0);
    robot.look_around(3 * SECOND);
    assert_eq!(robot.primaries(), [], "it never heard of them");

    for member in [1, 2] {
        let now = robot.clock(robot.members[member].as_ref().unwrap().drift);
        robot.members[member].as_mut().unwrap().replica.handle_left(&node(0), now);
        robot.settle(member);
    }
    robot.advance_ms(300);
    assert_eq!(robot.primaries().len(), 1);
}

#[test]
fn of_a_wrong_node_that_is_gone_for_a_minute_nothing_is_told_where_it_hinders_nobody() {
    let wrong: [&[usize]; 4] = [&[0], &[2, 1, 0], &[0, 1], &[0, 1, 2, 3]];
    for wrong in wrong {
        let mut robot = Robot::told(&[wrong, &[0, 1, 2], &[0, 1, 2]]);
        robot.look_around(SECOND);
        robot.kill(0);
        robot.disputes.remove(&0);
        // By clocks that run up to a twentieth faster.
        robot.look_around(55 * SECOND);
        assert_eq!(robot.disputing(), [1, 2], "{wrong:?}: it may come back");

        robot.look_around(6 * SECOND);

        assert_eq!(robot.disputing(), [0; 0], "{wrong:?}: {:?}", robot.disputes);
        assert_eq!(robot.primaries().len(), 1, "{wrong:?}");
        for member in [1, 2] {
            let own = &robot.members[member].as_ref().unwrap().replica;
            assert_eq!(own.accord.reckons_with(own.now).len(), 1, "{wrong:?}: it is not forgotten");
        }
        // It was alive, and says the same again.
        robot.start(0);
        robot.look_around(SECOND);
        robot.overlaps = 0;
        robot.look_around(SECOND);
        assert_eq!(robot.disputing(), [0, 1, 2], "{wrong:?}");
        assert_eq!(robot.overlaps, 0, "{wrong:?}");
    }
}

#[test]
fn wrong_nodes_that_are_gone_are_told_of_as_long_as_too_few_are_left_to_serve() {
    let mut robot = Robot::told(&[&[0, 1, 2], &[1, 2], &[1, 2]]);
    robot.look_around(SECOND);
    for wrong in [1, 2] {
        robot.kill(wrong);
        robot.disputes.remove(&wrong);
    }

    robot.look_around(150 * SECOND);

    assert_eq!(robot.disputing(), [0], "it is fenced, and says why");
    assert_eq!(robot.primaries().len(), 0);
}

#[test]
fn a_wrong_node_that_is_gone_is_told_of_as_long_as_it_might_serve_where_it_is() {
    // Another hello; and one that was met, and never answered.
    let mut robot = Robot::told(&[&[0, 1, 2], &[0, 1, 2], &[0, 1, 2]]);
    robot.tell(0, |config| config.hello_interval = HELLO * 2);
    robot.look_around(SECOND);
    let mut unanswered = Robot::told(&[&[0], &[0, 1, 2], &[0, 1, 2]]);
    let terms = unanswered.members[0].as_ref().unwrap().replica.terms();
    for member in [1, 2] {
        let own = &mut unanswered.members[member].as_mut().unwrap().replica;
        own.handle_asked(&node(0), &terms, own.now);
        while let Some(output) = own.poll_output() {
            if let ReplicaOutput::Disputed { detail } = output {
                unanswered.disputes.insert(member, detail);
            }
        }
    }
    for mut robot in [robot, unanswered] {
        robot.kill(0);
        robot.disputes.remove(&0);

        robot.look_around(150 * SECOND);

        assert_eq!(robot.disputing(), [1, 2], "{:?}", robot.told[&0]);
        assert_eq!(robot.primaries(), [], "{:?}", robot.told[&0]);
        // Whoever has its name now, and was told right, has the last word.
        robot.told.clear();
        robot.start(0);
        robot.look_around(SECOND);
        assert_eq!((robot.disputing(), robot.primaries().len()), (vec![], 1));
    }
}

#[test]
fn whoever_votes_tells_a_claimant_of_terms_that_it_has_not_heard_of() {
    let mut robot = Robot::told(&[&[0, 1, 2], &[0, 1, 2], &[0, 1, 2]]);
    robot.look_around(SECOND);
    let first = robot.primaries()[0];
    let others: Vec<_> = (0..3).filter(|member| *member != first).collect();
    let wrong = ReplicaConfig { members: vec![node(3), node(4)], ..robot.config(3) };
    let wrong = Replica::new(ReplicaConfig { own: node(3), ..wrong }, Bytes::new(), robot.now);
    // They alone have met somebody who has died since.
    for member in &others {
        let now = robot.clock(robot.members[*member].as_ref().unwrap().drift);
        let own = &mut robot.members[*member].as_mut().unwrap().replica;
        own.handle_terms(&node(3), &wrong.terms(), now);
    }

    robot.advance_ms(200);

    let replica = &robot.members[first].as_ref().unwrap().replica;
    assert_eq!(replica.accord.reckons_with(replica.now).len(), 1, "it was told");
    assert!(
        others.contains(&robot.primaries()[0]),
        "who has told it itself knows that it keeps back"
    );
}

#[test]
fn a_body_that_begins_anew_still_knows_of_the_dispute() {
    let mut robot = Robot::told(&[&[0], &[1]]);
    robot.look_around(SECOND);
    robot.disputes.clear();
    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    own.replica = own.replica.begun_anew(now);
    robot.settle(0);
    assert_eq!(robot.disputing(), [0]);
    robot.overlaps = 0;
    robot.advance_ms(500);
    assert_eq!(robot.overlaps, 0);
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
    // Some more than are kept.
    for stranger in 0..1100 {
        own.handle_terms(&long(stranger), &terms, now);
    }
    let refused = own.refused();
    assert!(refused > 50, "not all are kept: {refused}");

    own.handle_terms(&node(2), &terms, now);

    let told = own.dispute().unwrap();
    assert!(told.len() < 10_000, "{} bytes", told.len());
    let first = told.find(&format!("on {}:", node(2)));
    assert!(first.is_some() && first < told.find("on a"), "{told}");
    assert!(told.contains("; and ") && told.ends_with(" more"), "{told}");
    assert_eq!(own.refused(), refused, "there is room for members");
}
