//! One replica, and messages of nodes with another list.

use super::*;
use crate::service::configuration::ServiceConfiguration;

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

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn started(config: ReplicaConfig) -> Replica {
    Replica::new(config, Bytes::new(), at(0))
}

/// Delivers a message of one replica to another.
fn deliver(replica: &mut Replica, from: &Replica, message: &Message, millis: u64) {
    let message = from.agreement.sign(codec::encode_unbounded(message));
    replica.handle_message(&from.config.own, &message, at(millis));
}

fn outputs(replica: &mut Replica) -> Vec<ReplicaOutput> {
    std::iter::from_fn(|| replica.poll_output()).collect()
}

/// Returns the messages that the replica has sent since the last call.
fn sent_by(replica: &mut Replica) -> Vec<Message> {
    let outputs = outputs(replica).into_iter();
    let sent = outputs.filter_map(|output| match output {
        ReplicaOutput::Send { message, .. } => {
            codec::decode_bounded::<Message, MESSAGE_MAX>(&message[..message.len() - 8]).ok()
        }
        _ => None,
    });
    sent.collect()
}

fn heartbeat(epoch: u64, position: Position) -> Message {
    Message::Heartbeat(ReplicaHeartbeat {
        epoch,
        number: 1,
        position,
        answered: Position::default(),
        known_configurations: Vec::new(),
    })
}

fn status(sent: &[Message]) -> Option<StandbyStatus> {
    sent.iter().find_map(|message| match message {
        Message::LeasePromise(promise) => Some(promise.status),
        _ => None,
    })
}

/// Returns the third of three members, and a node with another list that it knows of.
fn third_and_other() -> (Replica, Replica) {
    let (mut own, other) = (started(listing(2, &[0, 1, 2])), started(listing(3, &[2, 3])));
    own.handle_configuration(&node(3), &other.configuration(), at(1));
    outputs(&mut own);
    (own, other)
}

#[test]
fn a_configuration_with_an_excessive_heartbeat_interval_is_refused() {
    let config = ReplicaConfig { heartbeat_interval: Duration::MAX, ..listing(3, &[0, 3]) };
    let mut own = started(listing(0, &[0, 1, 2]));

    let answer = (ServiceConfiguration::of(&config).encode(), Position::default());
    own.handle_configuration(&node(3), &codec::encode_unbounded(&answer), at(1));
    own.handle_timeout(at(100));

    assert_eq!(own.refused(), 1);
    assert!(own.agreement.is_unanimous());
}

#[test]
fn a_resignation_by_another_list_does_not_release_a_vote_of_the_own_list() {
    let (mut own, other) = third_and_other();
    let (first, second) = (started(listing(0, &[0, 1, 2])), started(listing(1, &[0, 1, 2])));
    let known = own.agreement.relevant_fingerprints(at(1));
    let request = |epoch| {
        Message::VoteRequest(VoteRequest {
            epoch,
            position: Position::default(),
            known_configurations: known.clone(),
        })
    };
    let votes = |sent: Vec<Message>| {
        sent.iter().filter(|message| matches!(message, Message::Vote(_))).count()
    };

    deliver(&mut own, &first, &request(1), 34);
    assert_eq!(votes(sent_by(&mut own)), 1);
    deliver(&mut own, &other, &heartbeat(2, Position::default()), 35);
    assert!(status(&sent_by(&mut own)).is_some(), "it learns");
    deliver(&mut own, &other, &Message::Resigned { epoch: 2 }, 36);
    deliver(&mut own, &second, &request(3), 37);
    own.handle_timeout(at(66));
    assert_eq!(votes(sent_by(&mut own)), 0, "the first one still counts the vote");

    own.handle_timeout(at(68));
    assert_eq!(votes(sent_by(&mut own)), 1, "as long as it may");
}

#[test]
fn positions_and_epochs_of_another_list_bring_no_replica_into_step() {
    let (mut own, other) = third_and_other();
    let first = started(listing(0, &[0, 1, 2]));
    deliver(&mut own, &other, &heartbeat(1, Position::default()), 2);
    assert_eq!(status(&sent_by(&mut own)), Some(StandbyStatus::Behind), "by a snapshot alone");
    let position = Position { epoch: 1, number: 5 };
    let (state, table) = (vec![5], Table::default());
    deliver(&mut own, &other, &Message::Snapshot(Snapshot { epoch: 1, position, state, table }), 3);
    deliver(&mut own, &other, &heartbeat(1, position), 4);
    assert_eq!(status(&sent_by(&mut own)), Some(StandbyStatus::InStep));

    // The same epoch and position, with requests of its own.
    let known_configurations = own.agreement.relevant_fingerprints(at(4));
    let theirs = ReplicaHeartbeat {
        epoch: 1,
        number: 1,
        position,
        answered: position,
        known_configurations,
    };
    deliver(&mut own, &first, &Message::Heartbeat(theirs), 5);

    assert_eq!(status(&sent_by(&mut own)), Some(StandbyStatus::Behind));
}

/// Returns the first of three members as primary.
fn serving() -> Replica {
    let mut own = started(listing(0, &[0, 1, 2]));
    own.handle_timeout(at(34));
    let answered = Position::default();
    let second = started(listing(1, &[0, 1, 2]));
    deliver(&mut own, &second, &Message::Vote(Vote { epoch: 1, in_step: true, answered }), 35);
    own.handle_loaded();
    assert_eq!(own.role(), Role::Primary { epoch: 1 });
    outputs(&mut own);
    own
}

#[test]
fn a_primary_sends_a_snapshot_to_a_learner_at_any_position() {
    let mut own = serving();
    let other = started(listing(3, &[0, 3]));
    own.handle_configuration(&node(3), &other.configuration(), at(36));
    outputs(&mut own);

    let (position, answered) = (Position::default(), Position::default());
    let status = StandbyStatus::InStep;
    deliver(
        &mut own,
        &other,
        &Message::LeasePromise(LeasePromise { epoch: 1, number: 1, position, answered, status }),
        37,
    );

    assert!(outputs(&mut own).contains(&ReplicaOutput::Save));
}

#[test]
fn with_too_many_configurations_a_replica_declares_that_it_has_to_be_restarted() {
    let full = |detail: &str| detail.contains("more than 64 different configurations");
    let mut own = started(listing(0, &[0, 1, 2]));
    for other in 3..68 {
        let configuration = started(listing(other, &[other])).configuration();
        assert!(!own.mismatch().is_some_and(full), "{other}");
        own.handle_configuration(&node(other), &configuration, at(1));
    }
    assert!(own.mismatch().is_some_and(full), "{:?}", own.mismatch());
    // All nodes agree now, but the replica has not kept the configurations of all of them.
    for other in 3..68 {
        let configuration = own.configuration();
        own.handle_configuration(&node(other), &configuration, at(2));
    }
    assert!(own.mismatch().is_some_and(full), "{:?}", own.mismatch());
    let last = outputs(&mut own).into_iter().filter_map(|output| match output {
        ReplicaOutput::ConfigMismatch { detail } => Some(detail),
        _ => None,
    });
    let last = last.last().expect("it is declared");
    assert!(full(&last) && last.contains("restart this node"), "{last}");
}

#[test]
fn with_too_many_reported_configurations_it_declares_so_too() {
    let mut own = started(listing(0, &[0, 1, 2]));
    let first = started(listing(1, &[0, 1, 2]));
    for other in 3..68 {
        let configuration = ServiceConfiguration::of(&listing(other, &[other])).encode();
        deliver(&mut own, &first, &Message::OtherConfiguration(configuration), 1);
    }
    assert!(own.mismatch().is_some_and(|detail| detail.contains("restart this node")));
}

#[test]
fn with_configurations_of_too_many_nodes_it_declares_so_too() {
    let mut own = started(listing(0, &[0, 1, 2]));
    let configuration = started(listing(3, &[0, 3])).configuration();
    for other in 3..1028 {
        own.handle_configuration(&node(other), &configuration, at(1));
    }
    assert!(own.mismatch().is_some_and(|detail| detail.contains("restart this node")));
}

#[test]
fn the_configuration_of_a_node_that_may_not_claim_the_service_does_not_count() {
    let mut own = started(listing(0, &[0]));
    let agrees = own.configuration();
    own.handle_configuration(&node(1), &agrees, at(1));
    let hostile = started(listing(2, &[2, 3, 4]));
    own.handle_configuration(&node(2), &hostile.configuration(), at(1));
    assert!(own.mismatch().is_some());
    outputs(&mut own);

    own.handle_claimants(|other| *other != node(2), at(2));

    assert_eq!((own.mismatch(), own.agreement.relevant_fingerprints(at(2)).len()), (None, 0));
    assert_eq!(outputs(&mut own), [ReplicaOutput::MismatchCleared]);
    assert!(own.agreement.known.contains_key(&node(1)), "the configurations of others count");
    own.handle_claimants(|other| *other != node(2), at(3));
    assert_eq!(outputs(&mut own), []);
}

#[test]
fn a_configuration_that_a_node_out_of_sight_has_is_kept() {
    let divided = |config| ReplicaConfig { on_partition: OnPartition::Continue, ..config };
    let mut own = started(divided(listing(0, &[0, 1])));
    let other = started(divided(listing(2, &[1, 2])));
    own.handle_configuration(&node(2), &other.configuration(), at(1));
    own.handle_carriers(&[node(2)], at(2));
    assert_eq!(own.agreement.relevant_fingerprints(at(2)).len(), 1);
    own.handle_carriers(&[], at(3));
    assert_eq!(own.agreement.relevant_fingerprints(at(3)).len(), 0);
    // Another node agrees meanwhile.
    let agrees = own.configuration();
    own.handle_configuration(&node(1), &agrees, at(4));

    own.handle_carriers(&[node(1), node(2)], at(5));

    assert_eq!(
        own.agreement.relevant_fingerprints(at(5)).len(),
        1,
        "they concern each other again"
    );
}

#[test]
fn a_node_that_comes_back_into_sight_is_bound_when_it_has_answered_again() {
    let mut own = started(listing(0, &[0, 1, 2]));
    let other = started(listing(3, &[3]));
    let bound = |own: &Replica| own.agreement.known[&node(3)].bound_since.is_some();
    own.handle_carriers(&[node(3)], at(1));
    own.handle_configuration(&node(3), &other.configuration(), at(2));
    own.handle_carriers(&[node(3)], at(502));
    assert!(bound(&own), "it was there all the time");
    own.handle_carriers(&[], at(1002));
    assert!(bound(&own), "it still defers");
    outputs(&mut own);

    own.handle_carriers(&[node(3)], at(1502));

    assert!(!bound(&own), "it may be a new process");
    assert!(outputs(&mut own).contains(&ReplicaOutput::Compare { with: node(3) }));
    own.handle_configuration(&node(3), &other.configuration(), at(1503));
    assert!(bound(&own));

    // The node asks before the directory shows it.
    own.handle_carriers(&[], at(2002));
    own.handle_comparison_request(&node(3), &other.configuration(), at(2010));
    assert!(!bound(&own));
    own.handle_configuration(&node(3), &other.configuration(), at(2011));
    own.handle_carriers(&[node(3)], at(2502));
    assert_eq!(own.agreement.known[&node(3)].bound_since, Some(at(2011)));
}

#[test]
fn a_primary_that_meets_nodes_with_a_newer_state_of_another_list_declares_what_is_lost() {
    let lost = |own: &mut Replica| {
        let lost = outputs(own).into_iter().find_map(|output| match output {
            ReplicaOutput::Fault { kind: FaultKind::StateLost, detail } => Some(detail),
            _ => None,
        });
        lost.is_some_and(|detail| detail.contains("after 7 answered requests"))
    };
    // In the epoch before the primary's, in the same one, and in the one after it.
    for epoch in [0, 1, 2] {
        let (mut own, mut other) = (serving(), started(listing(3, &[0, 3])));
        own.handle_configuration(&node(3), &other.configuration(), at(36));
        assert!(!lost(&mut own), "no reply was sent");
        other.answered = Position { epoch, number: 7 };
        own.handle_configuration(&node(3), &other.configuration(), at(37));
        assert!(lost(&mut own), "{epoch}");
        own.handle_configuration(&node(3), &other.configuration(), at(38));
        assert!(!lost(&mut own), "declared once");

        let (mut own, answered) = (serving(), other.answered);
        own.handle_configuration(&node(3), &started(listing(3, &[0, 3])).configuration(), at(36));
        let (position, status) = (Position::default(), StandbyStatus::Behind);
        let promise = LeasePromise { epoch: 1, number: 1, position, answered, status };
        let promise = Message::LeasePromise(promise);
        deliver(&mut own, &other, &promise, 37);
        assert!(lost(&mut own), "a learner reports it, too: {epoch}");
    }
}

#[test]
fn an_epoch_beyond_all_measure_ends_no_replica() {
    let mut own = started(listing(0, &[0, 1, 2]));
    let second = started(listing(1, &[0, 1, 2]));
    deliver(&mut own, &second, &Message::Voted { epoch: u64::MAX }, 1);
    own.handle_timeout(at(34));
    assert_eq!(own.role(), Role::Standby { primary: None, in_step: false });
}
