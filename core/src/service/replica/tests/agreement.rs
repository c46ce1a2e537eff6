//! Members with different configurations.

use super::*;
use crate::service::ServiceState;

const SECOND: u64 = 1000;

impl Robot {
    /// Returns members with these lists, which all reach each other.
    fn configured(lists: &[&[usize]]) -> Self {
        let mut robot = Robot::new(1, lists.len(), StandbyKind::Warm, OnPartition::Stop);
        for (member, list) in lists.iter().enumerate() {
            robot.reconfigure(member, |config| {
                config.members = list.iter().copied().map(node).collect()
            });
        }
        robot
    }

    /// Returns members of which the first one and the others meet after a second.
    fn apart(lists: &[&[usize]]) -> Self {
        let mut robot = Robot::configured(lists);
        robot.sides[0] = 1;
        robot.poll_directories(SECOND);
        robot.advance_ms(200);
        robot.sides[0] = 0;
        robot
    }

    /// Restarts this member with another configuration.
    pub(super) fn reconfigure(&mut self, member: usize, change: impl FnOnce(&mut ReplicaConfig)) {
        let mut config = self.config(member);
        change(&mut config);
        self.configurations.insert(member, config);
        self.kill(member);
        self.faults.remove(&(member, FaultKind::ContractMismatch));
        self.start(member);
    }

    /// Exchanges the configurations of two members: a question and its answer.
    pub(super) fn compare(&mut self, member: usize, with: usize) {
        if self.sides.get(with) != Some(&self.sides[member]) {
            return;
        }
        for (from, to) in [(member, with), (with, member)] {
            let Some(configuration) =
                self.members[from].as_ref().map(|from| from.replica.configuration())
            else {
                return;
            };
            let Some(Some(to)) = self.members.get_mut(to) else { return };
            let now = clock(self.now, to.drift);
            to.replica.handle_configuration(&node(from), &configuration, now);
        }
        self.drain(with);
    }

    /// Gives every member its view of the directory twice a second, as its actor does.
    pub(super) fn poll_directories(&mut self, millis: u64) {
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
                    let now = clock(self.now, own.drift);
                    own.replica.handle_carriers(&found, |_| true, now);
                    self.drain(member);
                }
            }
        }
    }

    /// Lets all members compare their configurations now.
    pub(super) fn meet(&mut self) {
        for (member, with) in (0..self.size).flat_map(|one| (0..one).map(move |other| (one, other)))
        {
            self.compare(member, with);
            self.drain(member);
        }
    }

    fn mismatch(&self, member: usize) -> Option<&str> {
        self.faults.get(&(member, FaultKind::ContractMismatch)).map(String::as_str)
    }

    fn mismatching(&self) -> Vec<usize> {
        (0..self.size).filter(|member| self.mismatch(*member).is_some()).collect()
    }
}

#[test]
fn nodes_that_meet_before_one_of_them_serves_do_not_begin_and_each_names_the_difference() {
    let cases: [&[&[usize]]; 5] = [
        &[&[0], &[1]],
        &[&[0, 1], &[1, 0]],
        &[&[0], &[0, 1, 2], &[0, 1, 2]],
        &[&[0, 1, 2], &[1, 0, 2], &[0, 1, 2]],
        &[&[0, 1, 2], &[1, 2, 0], &[2, 0, 1]],
    ];
    for lists in cases {
        let mut robot = Robot::configured(lists);
        robot.meet();
        let asked = robot.ask();
        for _ in 0..200 {
            robot.advance_ms(10);
            assert_eq!(robot.primaries(), [], "{lists:?}");
        }
        robot.poll_directories(SECOND);

        assert_eq!(robot.primaries(), [], "{lists:?}");
        assert_eq!(robot.callers[asked].answer, None, "{lists:?}");
        assert_eq!(robot.mismatching(), (0..lists.len()).collect::<Vec<_>>(), "{lists:?}");
        for member in 0..lists.len() {
            let detail = robot.mismatch(member).unwrap();
            assert!(detail.contains("its nodes are") && detail.contains("write the same list"));
        }

        for member in 0..lists.len() {
            robot.reconfigure(member, |_| {});
        }
        robot.poll_directories(SECOND);
        assert_eq!((robot.primaries().len(), robot.mismatching()), (1, vec![]), "{lists:?}");
        assert_eq!(robot.callers[asked].answer, Some(1), "{lists:?}");
    }
}

#[test]
fn whatever_differs_on_a_node_that_starts_the_primary_goes_on_and_no_further_node_begins() {
    type Change = fn(&mut ReplicaConfig);
    let changes: [(&str, Change); 6] = [
        ("its nodes are", |config| config.members = vec![node(2)]),
        ("its nodes are", |config| config.members = (0..5).map(node).collect()),
        ("standbys", |config| config.kind = StandbyKind::Hot),
        ("majority", |config| config.on_partition = OnPartition::Continue),
        ("heartbeat", |config| config.heartbeat_interval = HEARTBEAT * 3),
        ("heartbeat", |config| config.heartbeat_interval = HEARTBEAT / 2),
    ];
    for (what, change) in changes {
        let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.poll_directories(500);
        robot.ask_some(2);
        let epochs = robot.epochs.clone();
        robot.reconfigure(2, change);
        // At its first poll no other node is connected.
        let own = robot.members[2].as_mut().unwrap();
        own.replica.handle_carriers(&[], |_| true, robot.now);
        for _ in 0..49 {
            robot.advance_ms(10);
            assert_eq!(robot.primaries(), [0], "{what}");
        }
        for _ in 0..30 {
            robot.poll_directories(100);
            assert_eq!(robot.primaries(), [0], "{what}");
        }
        robot.ask_some(2);

        assert_eq!(robot.epochs, epochs, "{what}: the primary is not disturbed");
        assert_eq!(robot.mismatching(), [0, 1, 2], "{what}");
        assert!((0..3).all(|member| robot.mismatch(member).unwrap().contains(what)), "{what}");
        let view = robot.members[2].as_ref().unwrap().replica.view();
        assert_eq!((view.state, view.primary), (ServiceState::Fenced, None), "{what}");

        robot.kill(0);
        robot.poll_directories(2 * SECOND);
        assert_eq!(robot.primaries(), [], "{what}");
        robot.reconfigure(2, |_| {});
        robot.poll_directories(SECOND);
        robot.ask_some(1);
        let expected: Vec<_> = (1..=5).map(Some).collect();
        assert_eq!(robot.answers(), expected, "{what}: nothing is lost");
        assert_eq!(robot.overlaps, 0, "{what}");
    }
}

#[test]
fn of_two_primaries_that_meet_the_one_with_the_longer_list_goes_on() {
    let cases: [(&[&[usize]], &[usize]); 3] = [
        (&[&[0], &[0, 1, 2], &[0, 1, 2]], &[1, 2]),
        (&[&[0], &[1, 2], &[1, 2]], &[1, 2]),
        // Always the same one.
        (&[&[0], &[1]], &[0, 1]),
    ];
    for (lists, who) in cases {
        let mut robot = Robot::apart(lists);
        assert_eq!(robot.primaries().len(), 2, "{lists:?}: they have not met");
        robot.meet();
        robot.overlaps = 0;
        robot.poll_directories(3 * SECOND);

        let primaries = robot.primaries();
        assert_eq!(primaries.len(), 1, "{lists:?}: {primaries:?}");
        assert!(primaries.iter().all(|primary| who.contains(primary)), "{lists:?}: {primaries:?}");
        assert_eq!(robot.overlaps, 0, "{lists:?}");
        assert_eq!(robot.mismatching(), (0..lists.len()).collect::<Vec<_>>(), "{lists:?}");
        robot.ask_some(1);
        assert_eq!(robot.answers(), [Some(1)], "{lists:?}");
    }
}

#[test]
fn the_primary_that_resigns_hands_the_service_to_no_standby_that_has_not_met_the_other_one() {
    let (short, long): (&[usize], &[usize]) = (&[0, 1, 2], &[3, 4, 5, 6]);
    let mut robot = Robot::configured(&[short, short, short, long, long, long, long]);
    robot.advance_ms(200);
    assert_eq!(robot.primaries(), [0, 3]);
    robot.compare(0, 3);
    robot.drain(0);
    robot.overlaps = 0;
    // Less than a lease later the standbys meet it as well.
    robot.advance_ms(10);
    robot.meet();
    robot.poll_directories(SECOND);

    assert_eq!((robot.primaries(), robot.overlaps), (vec![3], 0));
}

#[test]
fn a_primary_that_leads_asks_again_the_one_that_took_it_for_a_standby() {
    let mut robot = Robot::apart(&[&[0], &[0, 1, 2], &[0, 1, 2]]);
    let [0, leader] = robot.primaries()[..] else { panic!("{:?}", robot.primaries()) };
    // Its answer came to a question that was sent before the leader served.
    let theirs = robot.members[0].as_ref().unwrap().replica.configuration();
    let now = robot.clock(robot.members[leader].as_ref().unwrap().drift);
    let own = &mut robot.members[leader].as_mut().unwrap().replica;
    own.handle_carriers(&[node(0)], |_| true, now);
    own.handle_configuration(&node(0), &theirs, now);
    while own.poll_output().is_some() {}
    assert_eq!(robot.primaries().len(), 2);

    let own = &mut robot.members[leader].as_mut().unwrap().replica;
    own.handle_carriers(&[node(0)], |_| true, now + Duration::from_millis(500));
    robot.drain(leader);

    assert_eq!(robot.primaries(), [leader]);
}

#[test]
fn a_node_with_another_configuration_counts_out_of_sight_until_it_agrees_or_has_left() {
    for (dies, leaves) in [(true, true), (true, false), (false, true), (false, false)] {
        let mut robot = Robot::configured(&[&[2, 1, 0], &[0, 1, 2], &[0, 1, 2]]);
        robot.meet();
        robot.poll_directories(SECOND);
        if dies {
            robot.kill(0);
        } else {
            robot.sides[0] = 1;
        }
        robot.poll_directories(100 * SECOND);
        assert_eq!(robot.primaries(), [], "it may be alive");
        assert!(robot.mismatch(1).is_some() && robot.mismatch(2).is_some());

        robot.sides[0] = 0;
        if leaves {
            robot.kill(0);
            robot.faults.remove(&(0, FaultKind::ContractMismatch));
            for member in [1, 2] {
                robot.members[member].as_mut().unwrap().replica.handle_left(&node(0));
                robot.drain(member);
            }
        } else {
            robot.reconfigure(0, |_| {});
        }
        robot.poll_directories(SECOND);
        assert_eq!(robot.primaries().len(), 1, "dies: {dies}, leaves: {leaves}");
        assert_eq!(robot.mismatching(), [0; 0], "dies: {dies}, leaves: {leaves}");
    }
}

#[test]
fn members_that_list_each_other_find_out_before_they_vote() {
    for first in 0..3 {
        let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.reconfigure(first, |config| config.heartbeat_interval = HEARTBEAT / 10);
        // No member has polled the directory yet.
        robot.advance_ms(500);
        assert_eq!(robot.overlaps, 0, "{first}");
        assert!(robot.mismatching().len() >= 2, "{first}: {:?}", robot.mismatching());
    }
}

#[test]
fn once_the_wrong_node_is_corrected_the_service_goes_on_with_its_state() {
    let mut robot = Robot::elected(1, 3, StandbyKind::Warm);
    robot.ask();
    robot.advance_ms(50);
    robot.reconfigure(0, |config| config.members = vec![node(0)]);
    robot.poll_directories(2 * SECOND);
    assert!(matches!(robot.primaries()[..], [1 | 2]) && robot.mismatching().len() == 3);
    robot.ask();
    robot.advance_ms(50);

    robot.reconfigure(0, |_| {});
    robot.poll_directories(SECOND);

    assert_eq!(robot.mismatching(), [0; 0], "{:?}", robot.mismatching());
    assert_eq!(robot.primaries().len(), 1);
    robot.ask();
    robot.advance_ms(200);
    assert_eq!(robot.answers(), [Some(1), Some(2), Some(3)], "what was answered is kept");
}

#[test]
fn a_restarted_actor_still_knows_of_the_mismatch() {
    let mut robot = Robot::configured(&[&[0], &[1]]);
    robot.poll_directories(SECOND);
    robot.faults.clear();
    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    own.replica = own.replica.restarted(Bytes::new(), now);
    robot.drain(0);
    assert_eq!(robot.mismatching(), [0]);
    robot.overlaps = 0;
    robot.advance_ms(500);
    assert_eq!(robot.overlaps, 0);
}

#[test]
fn a_further_mismatch_changes_the_detail_and_one_that_is_over_clears_the_fault() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let other = Replica::new(
        ReplicaConfig { members: vec![node(1)], ..robot.config(1) },
        Bytes::new(),
        robot.now,
    );
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let (same, configuration) = (own.configuration(), other.configuration());
    let mut receive = |from: usize, configuration: &[u8]| -> Vec<String> {
        own.handle_configuration(&node(from), configuration, Instant::from_millis(1));
        let outputs = std::iter::from_fn(|| own.poll_output());
        let reports = outputs.filter_map(|output| match output {
            ReplicaOutput::Fault { detail, .. } => {
                let named = |n: &usize| detail.contains(&format!("on module{n}:"));
                Some(format!("mismatch {:?}", (0..3).filter(named).collect::<Vec<_>>()))
            }
            ReplicaOutput::FaultCleared { .. } => Some("agreed".to_owned()),
            _ => None,
        });
        reports.collect()
    };

    assert_eq!(receive(1, &configuration), ["mismatch [1]"]);
    assert_eq!(receive(1, &configuration), [""; 0]);
    assert_eq!(receive(2, &configuration), ["mismatch [1, 2]"]);
    assert_eq!(receive(1, &same), ["mismatch [2]"]);
    assert_eq!(receive(2, &same), ["agreed"]);
}

#[test]
fn nodes_that_agree_are_asked_once_and_the_others_again_and_again() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let mut asked = |found: &[usize], millis: u64| {
        let found: Vec<_> = found.iter().copied().map(node).collect();
        own.handle_carriers(&found, |_| true, Instant::from_millis(millis));
        let outputs = std::iter::from_fn(|| own.poll_output());
        let asked = outputs.filter_map(|output| match output {
            ReplicaOutput::Compare { with } => Some(index(&with)),
            _ => None,
        });
        let asked: Vec<_> = asked.collect();
        // The first one has the same configuration each time.
        let configuration = own.configuration();
        if found.contains(&node(1)) {
            own.handle_configuration(&node(1), &configuration, Instant::from_millis(millis));
        }
        asked
    };
    assert_eq!(asked(&[0, 1, 2], 1000), [1, 2]);
    assert_eq!(asked(&[1, 2], 1499), [0; 0]);
    assert_eq!(asked(&[1, 2], 1500), [2]);
    assert_eq!(asked(&[2], 2000), [1, 2], "one has gone");
    assert_eq!(asked(&[2], 2400), [0; 0]);
    assert_eq!(asked(&[1, 2], 2500), [1, 2], "and is back, perhaps restarted");
    assert_eq!(asked(&[1, 2, 4], 3000), [2, 4], "members or not");
    own.handle_configuration(&node(2), b"nonsense", Instant::from_millis(3100));
    assert_eq!(own.refused(), 1);
}

#[test]
fn a_member_that_does_not_carry_the_service_is_named_and_prevents_no_election() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let report = |robot: &mut Robot, of: usize| {
        robot.members[0].as_mut().unwrap().replica.handle_no_service(&node(of));
        robot.drain(0);
        robot.mismatch(0).map(str::to_owned)
    };
    assert_eq!(report(&mut robot, 2), None, "it may be starting");
    let detail = report(&mut robot, 2).expect("it does not");
    assert!(
        detail.contains("listed, but without this service: module2; add the service there"),
        "{detail}"
    );
    for _ in 0..3 {
        assert_eq!(
            report(&mut robot, 7),
            Some(detail.clone()),
            "a node that is not listed need not"
        );
    }

    robot.advance_ms(200);
    assert_eq!(robot.primaries().len(), 1);
    let configuration = robot.members[2].as_ref().unwrap().replica.configuration();
    let now = robot.now;
    robot.members[0].as_mut().unwrap().replica.handle_configuration(&node(2), &configuration, now);
    robot.drain(0);
    assert_eq!(robot.mismatching(), [0; 0]);
}

#[test]
fn however_many_configurations_differ_a_caller_receives_one_small_message_with_members_first() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let long = |n: usize| NodeName::new(&format!("a{n:-<30}")).unwrap();
    let config = ReplicaConfig { members: (0..7).map(long).collect(), ..robot.config(1) };
    let configuration = Replica::new(config, Bytes::new(), robot.now).configuration();
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let now = Instant::from_millis(1);
    // Some more than are kept.
    for stranger in 0..300 {
        own.handle_configuration(&long(stranger), &configuration, now);
    }
    let refused = own.refused();
    assert!(refused > 40, "not all are kept: {refused}");

    own.handle_configuration(&node(2), &configuration, now);

    let detail = own.mismatch().unwrap();
    assert!(detail.len() < 10_000, "{} bytes", detail.len());
    let first = detail.find(&format!("on {}:", node(2)));
    assert!(first.is_some() && first < detail.find("on a"), "{detail}");
    assert_eq!(own.refused(), refused, "there is capacity for members");
}
