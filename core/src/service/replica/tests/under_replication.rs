//! Primaries whose state no other member holds.

use super::*;

impl Robot {
    fn fault(&self, member: usize, kind: FaultKind) -> Option<&str> {
        self.faults.get(&(member, kind)).map(String::as_str)
    }

    /// Returns the members that have such a fault.
    fn with(&self, kind: &FaultKind) -> Vec<usize> {
        self.faults.keys().filter(|(_, known)| known == kind).map(|(member, _)| *member).collect()
    }
}

#[test]
fn a_hot_service_whose_standbys_all_rest_goes_on_and_declares_that_a_failure_loses_its_state() {
    let mut robot = Robot::elected(4, 3, StandbyKind::Hot);
    robot.ask_some(3);
    assert_eq!(robot.with(&FaultKind::Unreplicated), []);

    robot.rest(1, true);
    robot.advance_ms(200);
    assert_eq!(robot.with(&FaultKind::Unreplicated), [], "one standby is left");
    robot.rest(2, true);
    robot.advance_ms(100);

    let detail = robot.fault(0, FaultKind::Unreplicated).expect("it is declared");
    assert!(detail.contains("no standby holds its state"), "{detail}");
    assert!(detail.contains("module1, module2") && detail.contains("bring"), "{detail}");
    assert_eq!(robot.with(&FaultKind::Unreplicated), [0]);
    let asked = robot.ask();
    robot.advance_ms(20);
    assert_eq!(robot.callers[asked].answer, Some(4), "it goes on");

    robot.rest(1, false);
    robot.advance_ms(100);
    assert_eq!(robot.with(&FaultKind::Unreplicated), [], "over, by itself");
    robot.kill(0);
    robot.advance_ms(200);
    robot.ask_some(1);
    robot.assert_nothing_is_lost("the standby that came back has it");
    assert_eq!(robot.with(&FaultKind::StateLost), []);
}

#[test]
fn a_service_that_starts_again_as_no_member_holds_its_state_declares_so() {
    for returns in [[1, 2], [2, 0], [0, 1]] {
        let mut robot = Robot::elected(4, 3, StandbyKind::Hot);
        (1..3).for_each(|member| robot.rest(member, true));
        robot.advance_ms(100);
        robot.ask_some(3);
        assert_eq!(robot.answers(), [Some(1), Some(2), Some(3)]);
        robot.kill(0);
        robot.advance_ms(50);
        for member in returns {
            match member {
                0 => robot.start(0),
                _ => robot.rest(member, false),
            }
        }
        robot.advance(Duration::from_secs(2));

        let primary = robot.primaries();
        assert_eq!(primary.len(), 1, "{returns:?}");
        assert_eq!(robot.with(&FaultKind::StateLost), primary, "{returns:?}");
        let detail = robot.fault(primary[0], FaultKind::StateLost).unwrap();
        assert!(
            detail.contains("starts again with the state") && detail.contains("was lost"),
            "{detail}"
        );
        let asked = robot.ask();
        robot.advance_ms(50);
        assert_eq!(robot.callers[asked].answer, Some(1));

        // The next primary has the same state: nothing more is lost.
        robot.kill(primary[0]);
        robot.faults.clear();
        robot.start(primary[0]);
        robot.advance(Duration::from_secs(3));
        assert_eq!(robot.with(&FaultKind::StateLost), [], "{returns:?}");
    }
}

#[test]
fn the_fault_of_a_lost_state_stands_while_the_primary_that_started_without_it_serves() {
    let mut robot = Robot::elected(6, 3, StandbyKind::Hot);
    robot.ask_some(3);
    robot.stop_for(&[0, 1, 2], Duration::from_millis(1));
    (0..3).for_each(|member| robot.lose(member));
    robot.advance(Duration::from_secs(2));
    let primary = robot.primaries();
    assert_eq!(robot.with(&FaultKind::StateLost), primary);

    robot.rest(primary[0], true);
    robot.advance_ms(200);

    assert_eq!(robot.primaries().len(), 1);
    assert_eq!(robot.with(&FaultKind::StateLost), []);
}

#[test]
fn the_only_member_whose_hot_component_died_declares_that_its_state_is_lost() {
    let mut robot = Robot::elected(6, 1, StandbyKind::Hot);
    robot.lose(0);
    assert_eq!(robot.with(&FaultKind::StateLost), [], "there was none");
    robot.ask_some(2);

    robot.lose(0);

    assert_eq!(robot.with(&FaultKind::StateLost), [0]);
    assert_eq!(robot.with(&FaultKind::Unreplicated), [], "no other member was to hold it");
}

#[test]
fn a_primary_that_is_cut_off_from_all_standbys_and_goes_on_declares_that_it_holds_the_state_alone()
{
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::new(5, 2, kind, OnPartition::Continue);
        robot.advance_ms(200);
        let primary = robot.primaries()[0];
        robot.sides = vec![0, 1];
        robot.advance_ms(500);
        assert_eq!(robot.with(&FaultKind::Unreplicated), [], "it may be the start");
        robot.advance_ms(300);
        let detail =
            robot.fault(primary, FaultKind::Unreplicated).expect("it is declared").to_owned();
        assert!(detail.contains(&format!("not reachable: module{}", 1 - primary)), "{detail}");

        robot.sides = vec![0, 0];
        robot.advance_ms(500);
        assert_eq!(robot.with(&FaultKind::Unreplicated), [], "{kind:?}");
    }
}

#[test]
fn replies_wait_for_a_standby_that_comes_into_step_but_not_for_one_that_never_does() {
    let mut robot = Robot::elected(4, 2, StandbyKind::Warm);
    robot.ask_some(2);
    // Snapshots to it are lost.
    robot.withheld = Some(1);
    robot.kill(1);
    robot.start(1);
    robot.advance_ms(50);

    let asked = robot.ask();
    robot.advance_ms(300);
    assert_eq!(robot.callers[asked].answer, None, "it may come into step yet");
    assert_eq!(robot.with(&FaultKind::Unreplicated), []);
    robot.advance_ms(500);
    assert_eq!(robot.callers[asked].answer, Some(3), "twenty leases are enough");
    let detail = robot.fault(0, FaultKind::Unreplicated).expect("it is declared");
    assert!(detail.contains("not in step: module1"), "{detail}");

    robot.withheld = None;
    robot.advance_ms(200);
    assert_eq!(robot.with(&FaultKind::Unreplicated), []);
}

#[test]
fn a_standby_whose_component_cannot_take_the_state_over_holds_nothing() {
    let mut robot = Robot::elected(4, 2, StandbyKind::Hot);
    robot.ask_some(2);
    let standby = 1 - robot.primaries()[0];
    robot.unloadable = Some(standby);
    robot.lose(standby);
    robot.advance_ms(50);

    let asked = robot.ask();
    robot.advance_ms(100);
    assert_eq!(robot.callers[asked].answer, None, "it may take it over yet");
    robot.advance(Duration::from_secs(1));
    assert_eq!(robot.callers[asked].answer, Some(3));
    let detail =
        robot.fault(1 - standby, FaultKind::Unreplicated).expect("it is declared").to_owned();
    assert!(detail.contains(&format!("not in step: module{standby}")), "{detail}");

    robot.unloadable = None;
    robot.advance_ms(200);
    assert_eq!(robot.with(&FaultKind::Unreplicated), []);
    assert_eq!(robot.members[standby].as_ref().unwrap().sum, 3);
}

#[test]
fn a_standby_at_rest_is_sent_no_state_that_it_cannot_keep() {
    let mut robot = Robot::elected(4, 3, StandbyKind::Hot);
    robot.rest(2, true);
    robot.advance_ms(100);
    let before = robot.snapshots;

    robot.advance_ms(500);
    robot.ask_some(3);

    assert_eq!(robot.snapshots, before);
    assert_eq!(robot.answers(), [Some(1), Some(2), Some(3)]);
}

#[test]
fn whatever_rests_dies_and_returns_an_answered_request_is_kept_or_its_loss_is_declared() {
    let mut regressions = 0;
    for seed in 0_u64..12 {
        let mut robot = Robot::new(seed, 3, StandbyKind::Hot, OnPartition::Stop);
        let mut chance = Random::new(seed ^ 0xe0);
        robot.advance_ms(100);
        let (mut greatest, mut told) = (0, 0);
        for _ in 0..15 {
            let first = robot.callers.len();
            let member = (chance.unit() * 3.0) as usize;
            let alive = robot.members[member].is_some();
            match chance.unit() {
                case if case < 0.4 && alive => robot.rest(member, true),
                case if case < 0.6 && alive => robot.rest(member, false),
                // All other members know the last answered position.
                _ if robot.members.iter().all(Option::is_some) && !robot.primaries().is_empty() => {
                    robot.kill(member);
                }
                _ => (0..3).for_each(|member| {
                    if robot.members[member].is_none() {
                        robot.start(member);
                    }
                }),
            }
            robot.advance_ms((chance.unit() * 900.0) as u64);
            robot.ask_some(3);
            robot.advance_ms((chance.unit() * 900.0) as u64);

            let answers = robot.callers[first..].iter().filter_map(|caller| caller.answer);
            let (least, most) = answers
                .fold((u64::MAX, 0), |(least, most), answer| (least.min(answer), most.max(answer)));
            if least <= greatest {
                assert!(robot.losses > told, "seed {seed}: {least} after {greatest}, silently");
                regressions += 1;
                (greatest, told) = (0, robot.losses);
            }
            greatest = greatest.max(most);
        }
        assert_eq!(robot.overlaps, 0, "seed {seed}");
    }
    assert!(regressions > 2, "the test has to see some: {regressions}");
}
