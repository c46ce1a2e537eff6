//! Members with different configurations.

use super::*;

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

    /// Restarts this member with another configuration.
    pub(super) fn reconfigure(&mut self, member: usize, change: impl FnOnce(&mut ReplicaConfig)) {
        let mut config = self.config(member);
        change(&mut config);
        self.configurations.insert(member, config);
        self.kill(member);
        self.mismatches.remove(&member);
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
            let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + to.drift));
            match from == member {
                true => to.replica.handle_comparison_request(&node(from), &configuration, now),
                false => to.replica.handle_configuration(&node(from), &configuration, now),
            }
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
                    let now = Instant::from_nanos(self.now.as_nanos() / 1000 * (1000 + own.drift));
                    own.replica.handle_reachable(&found);
                    own.replica.handle_carriers(&found, now);
                    self.drain(member);
                }
            }
        }
    }

    fn mismatching(&self) -> Vec<usize> {
        self.mismatches.keys().copied().collect()
    }
}

#[test]
fn where_lists_differ_at_most_one_of_the_nodes_that_agree_serves_and_each_declares_why() {
    let cases: [(&[&[usize]], &[usize]); 6] = [
        (&[&[0], &[0, 1, 2], &[0, 1, 2]], &[1, 2]),
        (&[&[0, 1], &[0, 1, 2], &[0, 1, 2]], &[1, 2]),
        (&[&[0, 1, 2], &[1, 0, 2], &[0, 1, 2]], &[0, 2]),
        // One of them serves, always the same one.
        (&[&[0], &[1]], &[0, 1]),
        // Neither list has a majority.
        (&[&[0, 1], &[1, 0]], &[]),
        (&[&[0, 1, 2], &[1, 2, 0], &[2, 0, 1]], &[]),
    ];
    for (lists, who) in cases {
        let mut robot = Robot::configured(lists);
        robot.poll_directories(SECOND);
        robot.overlaps = 0;
        robot.poll_directories(SECOND);

        let primaries = robot.primaries();
        assert_eq!(primaries.len(), who.len().min(1), "{lists:?}: {primaries:?}");
        assert!(primaries.iter().all(|primary| who.contains(primary)), "{lists:?}: {primaries:?}");
        assert_eq!(robot.overlaps, 0, "{lists:?}");
        assert_eq!(robot.mismatching(), (0..lists.len()).collect::<Vec<_>>(), "{lists:?}");
        for (member, detail) in &robot.mismatches {
            // A node that may serve declares so, as far as it can know.
            let fenced = detail.contains("no node with this configuration serves");
            assert!(fenced || who.contains(member), "{lists:?}: {detail}");
        }
        let asked = robot.ask();
        robot.advance_ms(100);
        assert_eq!(robot.callers[asked].answer.is_some(), !who.is_empty(), "{lists:?}");
    }
}

#[test]
fn whatever_else_differs_on_one_node_the_others_go_on_but_for_the_heartbeat_interval() {
    type Change = fn(&mut ReplicaConfig);
    let changes: [(&str, Change, usize); 4] = [
        ("standbys", |config| config.kind = StandbyKind::Hot, 1),
        ("majority", |config| config.on_partition = OnPartition::Continue, 1),
        ("heartbeat", |config| config.heartbeat_interval = HEARTBEAT * 3, 0),
        ("heartbeat", |config| config.heartbeat_interval = HEARTBEAT / 2, 0),
    ];
    for (what, change, serving) in changes {
        let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
        robot.advance_ms(200);
        robot.reconfigure(1, change);
        robot.poll_directories(SECOND);
        robot.overlaps = 0;
        robot.poll_directories(SECOND);

        let primaries = robot.primaries();
        assert_eq!(primaries.len(), serving, "{what}: {primaries:?}");
        assert!(!primaries.contains(&1) && robot.overlaps == 0, "{what}: {primaries:?}");
        assert!(robot.mismatches.len() == 3, "{what}: {:?}", robot.mismatches);
        assert!(
            robot.mismatches.values().all(|text| text.contains(what)),
            "{:?}",
            robot.mismatches
        );
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
        assert!(robot.mismatches.len() >= 2, "{first}: {:?}", robot.mismatches);
    }
}

#[test]
fn once_the_wrong_node_is_corrected_the_service_goes_on_with_its_state() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    robot.advance_ms(100);
    robot.ask();
    robot.advance_ms(50);
    robot.reconfigure(0, |config| config.members = vec![node(0)]);
    robot.poll_directories(2 * SECOND);
    assert!(matches!(robot.primaries()[..], [1 | 2]) && robot.mismatches.len() == 3);
    robot.ask();
    robot.advance_ms(50);

    robot.reconfigure(0, |_| {});
    robot.poll_directories(SECOND);

    assert_eq!(robot.mismatching(), [0; 0], "{:?}", robot.mismatches);
    assert_eq!(robot.primaries().len(), 1);
    robot.ask();
    robot.advance_ms(200);
    assert_eq!(robot.answers(), [Some(1), Some(2), Some(3)], "what was answered is kept");
}

#[test]
fn a_node_with_another_configuration_that_died_or_is_cut_off_prevents_no_election() {
    let wrong: [&[usize]; 4] = [&[0], &[2, 1, 0], &[0, 1], &[0, 1, 2, 3]];
    for (wrong, dies) in wrong.iter().flat_map(|wrong| [(wrong, true), (wrong, false)]) {
        let mut robot = Robot::configured(&[wrong, &[0, 1, 2], &[0, 1, 2]]);
        robot.poll_directories(SECOND);
        if dies {
            robot.kill(0);
        } else {
            robot.sides[0] = 1;
        }
        robot.overlaps = 0;
        // Long after any promise.
        robot.poll_directories(SECOND);

        assert!(matches!(robot.primaries()[..], [1 | 2]), "{wrong:?}: {:?}", robot.primaries());
        assert_eq!(robot.overlaps, 0, "{wrong:?}");
        robot.ask_some(1);
        assert_eq!(robot.answers(), [Some(1)], "{wrong:?}");
        // The next primary may serve, too.
        let first = robot.primaries()[0];
        let now = robot.clock(robot.members[first].as_ref().unwrap().drift);
        robot.members[first].as_mut().unwrap().replica.handle_component_stopped(now);
        robot.drain(first);
        robot.advance_ms(200);
        assert_eq!(robot.primaries(), [3 - first], "{wrong:?}");
    }
}

#[test]
fn a_node_that_died_before_it_was_bound_prevents_an_election_where_it_may_serve_by_itself() {
    let mut robot = Robot::configured(&[&[0], &[0, 1, 2], &[0, 1, 2]]);
    robot.advance_ms(100);
    let configuration = robot.members[0].as_ref().unwrap().replica.configuration();
    for member in [1, 2] {
        let now = robot.clock(robot.members[member].as_ref().unwrap().drift);
        let own = &mut robot.members[member].as_mut().unwrap().replica;
        own.handle_comparison_request(&node(0), &configuration, now);
        while own.poll_output().is_some() {}
    }
    robot.kill(0);
    robot.poll_directories(3 * SECOND);
    assert_eq!(robot.primaries(), [], "it never received their configuration");

    for member in [1, 2] {
        let now = robot.clock(robot.members[member].as_ref().unwrap().drift);
        robot.members[member].as_mut().unwrap().replica.handle_left(&node(0), now);
        robot.drain(member);
    }
    robot.advance_ms(300);
    assert_eq!(robot.primaries().len(), 1);
}

#[test]
fn the_fault_of_a_wrong_node_that_is_gone_for_a_minute_ends_if_it_is_harmless() {
    let wrong: [&[usize]; 4] = [&[0], &[2, 1, 0], &[0, 1], &[0, 1, 2, 3]];
    for wrong in wrong {
        let mut robot = Robot::configured(&[wrong, &[0, 1, 2], &[0, 1, 2]]);
        robot.poll_directories(SECOND);
        robot.kill(0);
        robot.mismatches.remove(&0);
        // By clocks that run up to a twentieth faster.
        robot.poll_directories(55 * SECOND);
        assert_eq!(robot.mismatching(), [1, 2], "{wrong:?}: it may come back");

        robot.poll_directories(6 * SECOND);

        assert_eq!(robot.mismatching(), [0; 0], "{wrong:?}: {:?}", robot.mismatches);
        assert_eq!(robot.primaries().len(), 1, "{wrong:?}");
        for member in [1, 2] {
            let own = &robot.members[member].as_ref().unwrap().replica;
            assert_eq!(
                own.agreement.relevant_fingerprints(own.now).len(),
                1,
                "{wrong:?}: it is not forgotten"
            );
        }
        // The node was alive, and has the same configuration.
        robot.start(0);
        robot.poll_directories(SECOND);
        robot.overlaps = 0;
        robot.poll_directories(SECOND);
        assert_eq!(robot.mismatching(), [0, 1, 2], "{wrong:?}");
        assert_eq!(robot.overlaps, 0, "{wrong:?}");
    }
}

#[test]
fn the_fault_of_wrong_nodes_that_are_gone_stands_while_too_few_are_left_to_serve() {
    let mut robot = Robot::configured(&[&[0, 1, 2], &[1, 2], &[1, 2]]);
    robot.poll_directories(SECOND);
    for wrong in [1, 2] {
        robot.kill(wrong);
        robot.mismatches.remove(&wrong);
    }

    robot.poll_directories(150 * SECOND);

    assert_eq!(robot.mismatching(), [0], "it is fenced, and declares why");
    assert_eq!(robot.primaries().len(), 0);
}

#[test]
fn the_fault_of_a_wrong_node_that_is_gone_stands_while_it_might_serve_where_it_is() {
    // Another heartbeat interval; and a node that asked and never answered.
    let mut robot = Robot::configured(&[&[0, 1, 2], &[0, 1, 2], &[0, 1, 2]]);
    robot.reconfigure(0, |config| config.heartbeat_interval = HEARTBEAT * 2);
    robot.poll_directories(SECOND);
    let mut unanswered = Robot::configured(&[&[0], &[0, 1, 2], &[0, 1, 2]]);
    let configuration = unanswered.members[0].as_ref().unwrap().replica.configuration();
    for member in [1, 2] {
        let own = &mut unanswered.members[member].as_mut().unwrap().replica;
        own.handle_comparison_request(&node(0), &configuration, own.now);
        while let Some(output) = own.poll_output() {
            if let ReplicaOutput::ConfigMismatch { detail } = output {
                unanswered.mismatches.insert(member, detail);
            }
        }
    }
    for mut robot in [robot, unanswered] {
        robot.kill(0);
        robot.mismatches.remove(&0);

        robot.poll_directories(150 * SECOND);

        assert_eq!(robot.mismatching(), [1, 2], "{:?}", robot.configurations[&0]);
        assert_eq!(robot.primaries(), [], "{:?}", robot.configurations[&0]);
        // A new node of its name with the right configuration ends the mismatch.
        robot.configurations.clear();
        robot.start(0);
        robot.poll_directories(SECOND);
        assert_eq!((robot.mismatching(), robot.primaries().len()), (vec![], 1));
    }
}

#[test]
fn a_voter_sends_a_candidate_the_configurations_that_it_lacks() {
    let mut robot = Robot::configured(&[&[0, 1, 2], &[0, 1, 2], &[0, 1, 2]]);
    robot.poll_directories(SECOND);
    let first = robot.primaries()[0];
    let others: Vec<_> = (0..3).filter(|member| *member != first).collect();
    let wrong = ReplicaConfig { members: vec![node(3), node(4)], ..robot.config(3) };
    let wrong = Replica::new(ReplicaConfig { own: node(3), ..wrong }, Bytes::new(), robot.now);
    // They alone have met a node that has ended since.
    for member in &others {
        let now = robot.clock(robot.members[*member].as_ref().unwrap().drift);
        let own = &mut robot.members[*member].as_mut().unwrap().replica;
        own.handle_configuration(&node(3), &wrong.configuration(), now);
    }

    robot.advance_ms(200);

    let replica = &robot.members[first].as_ref().unwrap().replica;
    assert_eq!(
        replica.agreement.relevant_fingerprints(replica.now).len(),
        1,
        "it received the configuration"
    );
    assert!(others.contains(&robot.primaries()[0]), "the voters know that the other node defers");
}

#[test]
fn a_restarted_actor_still_knows_of_the_mismatch() {
    let mut robot = Robot::configured(&[&[0], &[1]]);
    robot.poll_directories(SECOND);
    robot.mismatches.clear();
    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    own.replica = own.replica.restarted(now);
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
            ReplicaOutput::ConfigMismatch { detail } => {
                let named = |n: &usize| detail.contains(&format!("on module{n}:"));
                Some(format!("mismatch {:?}", (0..3).filter(named).collect::<Vec<_>>()))
            }
            ReplicaOutput::MismatchCleared => Some("agreed".to_owned()),
            _ => None,
        });
        reports.collect()
    };

    assert_eq!(receive(1, &configuration), ["mismatch [1]"]);
    assert_eq!(receive(1, &configuration), [""; 0]);
    assert_eq!(receive(2, &configuration), ["mismatch [1, 2]"]);
    assert_eq!(receive(1, &same), ["agreed", "mismatch [2]"]);
    assert_eq!(receive(2, &same), ["agreed"]);
}

#[test]
fn nodes_that_agree_are_asked_once_and_the_others_again_and_again() {
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
        let now = robot.now;
        robot.members[0].as_mut().unwrap().replica.handle_no_service(&node(of), now);
        robot.drain(0);
        robot.mismatches.get(&0).cloned()
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
    let config = ReplicaConfig { members: (0..900).map(long).collect(), ..robot.config(1) };
    let configuration = Replica::new(config, Bytes::new(), robot.now).configuration();
    let own = &mut robot.members[0].as_mut().unwrap().replica;
    let now = Instant::from_millis(1);
    // Some more than are kept.
    for stranger in 0..1100 {
        own.handle_configuration(&long(stranger), &configuration, now);
    }
    let refused = own.refused();
    assert!(refused > 50, "not all are kept: {refused}");

    own.handle_configuration(&node(2), &configuration, now);

    let detail = own.mismatch().unwrap();
    assert!(detail.len() < 10_000, "{} bytes", detail.len());
    let first = detail.find(&format!("on {}:", node(2)));
    assert!(first.is_some() && first < detail.find("on a"), "{detail}");
    assert!(detail.contains("; and ") && detail.ends_with(" more"), "{detail}");
    assert_eq!(own.refused(), refused, "there is capacity for members");
}
