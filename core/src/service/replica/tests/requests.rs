//! Requests and messages one by one: refused, answered from the table, or too late.

use super::*;

#[test]
fn messages_of_strangers_and_undecodable_ones_are_refused() {
    let mut robot = Robot::new(1, 3, StandbyKind::Warm, OnPartition::Stop);
    let own = robot.members[0].as_mut().unwrap();
    own.replica.handle_message(&NodeName::new("stranger").unwrap(), b"\0\0", robot.now);
    own.replica.handle_message(&node(1), b"\xff\xff\xff", robot.now);
    own.replica.handle_message(&node(0), b"\0\0", robot.now);
    assert_eq!(own.replica.refused(), 3);
}

#[test]
fn a_request_that_comes_again_is_answered_from_the_table_and_too_many_are_refused() {
    let mut robot = Robot::elected(1, 1, StandbyKind::Warm);
    let first = robot.ask();
    robot.advance_ms(10);
    robot.callers[first].answered = None;
    robot.callers[first].answer = None;
    robot.advance_ms(10);
    assert_eq!(robot.callers[first].answer, Some(1), "it is not counted again");

    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    for n in 0..=QUEUE_MAX as u64 {
        let id = MessageId { sender: 2, sequence: n };
        own.replica.handle_request(request(n, id), now);
    }
    let last = std::iter::from_fn(|| own.replica.poll_output()).last();
    let outcome = ServiceOutcome::Refused(DeliveryError::Full);
    assert_eq!(last, Some(ReplicaOutput::Answer { caller: QUEUE_MAX as u64, outcome }));
}

#[test]
fn a_request_whose_deadline_passed_while_it_waited_is_not_begun() {
    let mut robot = Robot::elected(1, 1, StandbyKind::Warm);
    let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
    let own = robot.members[0].as_mut().unwrap();
    let id = |sequence| MessageId { sender: 2, sequence };
    let soon = Some(now + Duration::from_millis(5));
    own.replica.handle_request(request(0, id(0)), now);
    own.replica.handle_request(ServiceRequest { until: soon, ..request(1, id(1)) }, now);
    own.replica.handle_request(request(2, id(2)), now);
    while own.replica.poll_output().is_some() {}

    let later = now + Duration::from_millis(6);
    own.replica.handle_executed(Ok(Bytes::new()), None, later);

    let outputs: Vec<_> = std::iter::from_fn(|| own.replica.poll_output()).collect();
    let outcome = ServiceOutcome::Refused(DeliveryError::DeadlinePassed);
    assert!(outputs.contains(&ReplicaOutput::Answer { caller: 1, outcome }), "{outputs:?}");
    let begun = |output: &&ReplicaOutput| matches!(output, ReplicaOutput::Execute { .. });
    assert_eq!(outputs.iter().filter(begun).count(), 1, "the third, and not the second");
}

/// Returns the lengths of the entries that a warm primary sends after requests with these states,
/// and its other outputs.
fn entries_of(states: &[Vec<u8>]) -> (Vec<usize>, Vec<ReplicaOutput>) {
    let mut robot = Robot::elected(3, 3, StandbyKind::Warm);
    let (mut lengths, mut others) = (Vec::new(), Vec::new());
    for (sequence, state) in states.iter().enumerate() {
        let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
        let own = robot.members[0].as_mut().unwrap();
        let id = MessageId { sender: 9, sequence: sequence as u64 };
        robot.callers.clear();
        own.replica.handle_request(request(0, id), now);
        while own.replica.poll_output().is_some() {}
        own.replica.handle_executed(Ok(Bytes::new()), Some(Ok(state.clone().into())), now);
        let mut length = 0;
        while let Some(output) = own.replica.poll_output() {
            match output {
                ReplicaOutput::Send { message, .. } => length = length.max(message.len()),
                ReplicaOutput::Load { .. } => own.replica.handle_loaded(),
                ReplicaOutput::Answer { .. } => {}
                other => others.push(other),
            }
        }
        lengths.push(length);
    }
    (lengths, others)
}

#[test]
fn only_what_has_changed_of_a_state_is_shipped() {
    let first = vec![1; 100_000];
    let mut second = first.clone();
    second[7] = 2;

    let (lengths, _) = entries_of(&[first, second.clone(), second]);

    assert!(lengths[0] > 100_000, "{lengths:?}");
    assert!(lengths[1] < 100 && lengths[2] < 100, "{lengths:?}");
}

#[test]
fn a_request_that_makes_the_state_too_large_fails_and_is_undone_and_the_fault_is_declared_once() {
    let large = vec![1; STATE_MAX + 1];
    let (lengths, others) = entries_of(&[vec![1; 8], large.clone(), large, vec![1; 9]]);

    assert!(lengths.iter().all(|length| *length < 200), "{lengths:?}");
    let [ReplicaOutput::Fault { detail, .. }] = &others[..] else { panic!("{others:?}") };
    assert!(detail.contains("too large") || detail.contains("larger"), "{detail}");
}

#[test]
fn replies_are_kept_until_their_callers_have_them_and_no_longer() {
    for kind in [StandbyKind::Warm, StandbyKind::Hot] {
        let mut robot = Robot::elected(8, 3, kind);
        for _ in 0..50 {
            robot.ask();
            robot.advance_ms(4);
        }
        for member in robot.members.iter().flatten() {
            let kept = (0..50).filter(|sequence| {
                member
                    .replica
                    .log
                    .table
                    .find(MessageId { sender: 1, sequence: *sequence })
                    .is_some()
            });
            assert!(kept.count() <= 4, "{kind:?}");
        }
        // A delayed copy is not served again.
        let late = MessageId { sender: 1, sequence: 3 };
        let now = robot.clock(robot.members[0].as_ref().unwrap().drift);
        let own = robot.members[0].as_mut().unwrap();
        own.replica.handle_request(request(0, late), now);
        let outcome = ServiceOutcome::Refused(DeliveryError::Expired);
        assert_eq!(own.replica.poll_output(), Some(ReplicaOutput::Answer { caller: 0, outcome }));
    }
}
