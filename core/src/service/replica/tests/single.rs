//! One replica, and what single nodes send to it.

use super::*;
use crate::service::configuration::ServiceConfiguration;
use crate::testing::at;

/// Returns the configuration of a node with this list.
fn listing(own: usize, members: &[usize]) -> ReplicaConfig {
    ReplicaConfig {
        own: node(own),
        members: members.iter().copied().map(node).collect(),
        kind: StandbyKind::Warm,
        on_partition: OnPartition::Stop,
        depends: false,
        heartbeat_interval: HEARTBEAT,
    }
}

fn started(config: ReplicaConfig) -> Replica {
    Replica::new(config, Bytes::new(), at(0))
}

/// Delivers a message of one replica to another.
fn deliver(replica: &mut Replica, from: &Replica, message: &Message, millis: u64) {
    let message = from.agreement.sign(codec::encode_unbounded(message));
    replica.handle_message(&from.config.own, &message, at(millis));
}

#[test]
fn a_configuration_with_an_excessive_heartbeat_interval_is_refused() {
    let config = ReplicaConfig { heartbeat_interval: Duration::MAX, ..listing(3, &[0, 3]) };
    let mut own = started(listing(0, &[0, 1, 2]));

    let answer = (ServiceConfiguration::of(&config).encode(), false);
    own.handle_configuration(&node(3), &codec::encode_unbounded(&answer), at(1));
    own.handle_timeout(at(100));

    assert_eq!(own.refused(), 1);
    assert!(!own.agreement.is_disputed());
}

#[test]
fn the_configuration_of_a_node_that_may_not_claim_the_service_does_not_count() {
    let mut own = started(listing(0, &[0]));
    let agrees = own.configuration();
    own.handle_configuration(&node(1), &agrees, at(1));
    let hostile = started(listing(2, &[2, 3, 4]));
    own.handle_configuration(&node(2), &hostile.configuration(), at(1));
    assert!(own.mismatch().is_some());

    let may_claim = |other: &NodeName| *other != node(2);
    own.handle_carriers(&[node(1)], may_claim, at(2));

    assert_eq!((own.mismatch(), own.agreement.is_disputed()), (None, false));
    let outputs = std::iter::from_fn(|| own.poll_output());
    let cleared = ReplicaOutput::FaultCleared { kind: FaultKind::ContractMismatch };
    assert_eq!(outputs.filter(|output| *output == cleared).count(), 1);
    assert!(own.agreement.known.contains_key(&node(1)), "the configurations of others count");
    own.handle_carriers(&[node(1)], may_claim, at(3));
    assert_eq!(own.poll_output(), None);
}

#[test]
fn an_epoch_beyond_all_measure_ends_no_replica() {
    let mut own = started(listing(0, &[0, 1, 2]));
    let second = started(listing(1, &[0, 1, 2]));
    deliver(&mut own, &second, &Message::Voted { epoch: u64::MAX }, 1);
    own.handle_timeout(at(34));
    assert_eq!(own.role(), Role::Standby { primary: None, in_step: false });
}

#[test]
fn a_promise_that_answers_no_heartbeat_extends_no_lease_beyond_its_receipt() {
    let mut own = started(listing(0, &[0, 1, 2]));
    let second = started(listing(1, &[0, 1, 2]));
    own.handle_timeout(at(34));
    let (position, answered) = (Position::default(), Position::default());
    deliver(&mut own, &second, &Message::Vote(Vote { epoch: 1, in_step: true, answered }), 35);
    for (sent, millis) in [(u64::MAX, 40), (0, 50)] {
        let status = StandbyStatus::InStep;
        let promise = LeasePromise { epoch: 1, sent: Some(sent), position, answered, status };
        deliver(&mut own, &second, &Message::LeasePromise(promise), millis);
    }

    own.handle_timeout(at(69));
    assert_eq!(own.role(), Role::Primary { epoch: 1 });
    own.handle_timeout(at(70));
    assert_eq!(own.role(), Role::Standby { primary: None, in_step: false });
}

#[test]
fn after_a_takeover_a_repeated_request_is_answered_once_a_majority_has_its_entry() {
    let members = [0, 1, 2, 3, 4];
    let mut own = started(listing(0, &members));
    let voters = [1, 2].map(|voter| started(listing(voter, &members)));
    // The primary before has sent this entry to no other member.
    let (id, position) = (MessageId { sender: 1, sequence: 7 }, Position { epoch: 0, number: 1 });
    own.log.position = position;
    own.log.table.note(Served { id, result: Ok(vec![9]) });
    own.handle_timeout(at(34));
    let (answered, status) = (Position::default(), StandbyStatus::InStep);
    for voter in &voters {
        deliver(&mut own, voter, &Message::Vote(Vote { epoch: 1, in_step: false, answered }), 35);
    }

    own.handle_request(request(5, id), at(36));

    let mut is_answered = vec![answers(&mut own)];
    for voter in &voters {
        let promise = LeasePromise { epoch: 1, sent: None, position, answered, status };
        deliver(&mut own, voter, &Message::LeasePromise(promise), 37);
        is_answered.push(answers(&mut own));
    }
    assert_eq!(is_answered, [false, false, true]);
}

/// Returns whether a caller is answered.
fn answers(replica: &mut Replica) -> bool {
    let mut outputs = std::iter::from_fn(|| replica.poll_output());
    outputs.any(|output| matches!(output, ReplicaOutput::Answer { .. }))
}

#[test]
fn a_replica_that_needs_no_vote_waits_for_answers_after_its_second_poll_but_not_for_ever() {
    let stop = listing(0, &[0]);
    let goes_on = ReplicaConfig { on_partition: OnPartition::Continue, ..listing(0, &[0, 1, 2]) };
    for config in [stop, goes_on] {
        let mut own = started(config);
        let serves = |own: &mut Replica, millis: u64| {
            (0..100).for_each(|more| own.handle_timeout(at(millis + more)));
            matches!(own.role(), Role::Primary { .. })
        };
        own.handle_carriers(&[], |_| true, at(0));
        assert!(!serves(&mut own, 400), "no node was connected at the first poll");
        own.handle_carriers(&[node(1)], |_| true, at(500));
        assert!(!serves(&mut own, 900), "its answer is missing");

        let mut answered = own.restarted(Bytes::new(), at(600));
        let configuration = answered.configuration();
        answered.handle_configuration(&node(1), &configuration, at(600));
        assert!(serves(&mut answered, 600));
        own.handle_carriers(&[node(1)], |_| true, at(1000));
        assert!(serves(&mut own, 1000), "it does not answer");
    }
}
