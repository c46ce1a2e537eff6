//! One replica, and what those say to it who were told another list.

use super::*;
use crate::service::terms::Terms;

/// Somebody who was told these nodes.
fn listing(own: usize, members: &[usize]) -> ReplicaConfig {
    ReplicaConfig {
        own: node(own),
        members: members.iter().copied().map(node).collect(),
        kind: StandbyKind::Warm,
        on_partition: OnPartition::Stop,
        depends: false,
        hello_interval: HELLO,
    }
}

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn begun(config: ReplicaConfig) -> Replica {
    Replica::new(config, Bytes::new(), at(0))
}

/// This one hears what that one says.
fn hear(replica: &mut Replica, from: &Replica, message: &Message, millis: u64) {
    let message = from.accord.sign(codec::encode_unbounded(message));
    replica.handle_message(&from.config.own, &message, at(millis));
}

fn outputs(replica: &mut Replica) -> Vec<ReplicaOutput> {
    std::iter::from_fn(|| replica.poll_output()).collect()
}

/// What it has said to the others since it was last looked at.
fn said(replica: &mut Replica) -> Vec<Message> {
    let outputs = outputs(replica).into_iter();
    let said = outputs.filter_map(|output| match output {
        ReplicaOutput::Send { message, .. } => {
            codec::decode_bounded::<Message, MESSAGE_MAX>(&message[..message.len() - 8]).ok()
        }
        _ => None,
    });
    said.collect()
}

fn hello(epoch: u64, position: Position) -> Message {
    Message::Hello { epoch, number: 1, position, answered: Position::default(), heard: Vec::new() }
}

fn standing(said: &[Message]) -> Option<Standing> {
    said.iter().find_map(|message| match message {
        Message::Promise { standing, .. } => Some(*standing),
        _ => None,
    })
}

/// The third of three, and one of another list that it has heard of.
fn third_and_other() -> (Replica, Replica) {
    let (mut own, other) = (begun(listing(2, &[0, 1, 2])), begun(listing(3, &[2, 3])));
    own.handle_terms(&node(3), &other.terms(), at(1));
    outputs(&mut own);
    (own, other)
}

#[test]
fn terms_of_a_hello_beyond_all_measure_are_refused() {
    let config = ReplicaConfig { hello_interval: Duration::MAX, ..listing(3, &[0, 3]) };
    let mut own = begun(listing(0, &[0, 1, 2]));

    let told = (Terms::of(&config).encode(), Position::default());
    own.handle_terms(&node(3), &codec::encode_unbounded(&told), at(1));
    own.handle_timeout(at(100));

    assert_eq!(own.refused(), 1);
    assert!(own.accord.is_undisputed());
}

#[test]
fn whoever_resigns_by_another_list_frees_nobody_from_a_vote_of_our_own() {
    let (mut own, other) = third_and_other();
    let (first, second) = (begun(listing(0, &[0, 1, 2])), begun(listing(1, &[0, 1, 2])));
    let heard = own.accord.reckons_with(at(1));
    let claim =
        |epoch| Message::Claim { epoch, position: Position::default(), heard: heard.clone() };
    let votes = |said: Vec<Message>| {
        said.iter().filter(|message| matches!(message, Message::Vote { .. })).count()
    };

    hear(&mut own, &first, &claim(1), 34);
    assert_eq!(votes(said(&mut own)), 1);
    hear(&mut own, &other, &hello(2, Position::default()), 35);
    assert!(standing(&said(&mut own)).is_some(), "it learns");
    hear(&mut own, &other, &Message::Resigned { epoch: 2 }, 36);
    hear(&mut own, &second, &claim(3), 37);
    own.handle_timeout(at(66));
    assert_eq!(votes(said(&mut own)), 0, "the first one still counts the vote");

    own.handle_timeout(at(68));
    assert_eq!(votes(said(&mut own)), 1, "as long as it may");
}

#[test]
fn positions_and_epochs_of_another_list_bring_nobody_into_step() {
    let (mut own, other) = third_and_other();
    let first = begun(listing(0, &[0, 1, 2]));
    hear(&mut own, &other, &hello(1, Position::default()), 2);
    assert_eq!(standing(&said(&mut own)), Some(Standing::Behind), "by a snapshot alone");
    let position = Position { epoch: 1, number: 5 };
    let (state, table) = (vec![5], Table::default());
    hear(&mut own, &other, &Message::Snapshot { epoch: 1, position, state, table }, 3);
    hear(&mut own, &other, &hello(1, position), 4);
    assert_eq!(standing(&said(&mut own)), Some(Standing::InStep));

    // Of the same epoch, and with so many requests of its own.
    let heard = own.accord.reckons_with(at(4));
    let theirs = Message::Hello { epoch: 1, number: 1, position, answered: position, heard };
    hear(&mut own, &first, &theirs, 5);

    assert_eq!(standing(&said(&mut own)), Some(Standing::Behind));
}

/// The first of three serves.
fn serving() -> Replica {
    let mut own = begun(listing(0, &[0, 1, 2]));
    own.handle_timeout(at(34));
    let answered = Position::default();
    let second = begun(listing(1, &[0, 1, 2]));
    hear(&mut own, &second, &Message::Vote { epoch: 1, in_step: true, answered }, 35);
    own.handle_loaded();
    assert_eq!(own.role(), Role::Primary { epoch: 1 });
    outputs(&mut own);
    own
}

#[test]
fn a_primary_sends_everything_to_whoever_learns_whatever_position_it_says() {
    let mut own = serving();
    let other = begun(listing(3, &[0, 3]));
    own.handle_terms(&node(3), &other.terms(), at(36));
    outputs(&mut own);

    let (position, answered) = (Position::default(), Position::default());
    let standing = Standing::InStep;
    hear(
        &mut own,
        &other,
        &Message::Promise { epoch: 1, number: 1, position, answered, standing },
        37,
    );

    assert!(outputs(&mut own).contains(&ReplicaOutput::Save));
}

#[test]
fn beyond_the_most_terms_that_are_told_apart_a_replica_says_that_it_has_to_be_started_anew() {
    let full = |detail: &str| detail.contains("more than 64 different terms");
    let mut own = begun(listing(0, &[0, 1, 2]));
    for other in 3..68 {
        let terms = begun(listing(other, &[other])).terms();
        assert!(!own.dispute().is_some_and(full), "{other}");
        own.handle_terms(&node(other), &terms, at(1));
    }
    assert!(own.dispute().is_some_and(full), "{:?}", own.dispute());
    // All of them are told better, and it has forgotten of whom it does not know.
    for other in 3..68 {
        let terms = own.terms();
        own.handle_terms(&node(other), &terms, at(2));
    }
    assert!(own.dispute().is_some_and(full), "{:?}", own.dispute());
    let last = outputs(&mut own).into_iter().filter_map(|output| match output {
        ReplicaOutput::Disputed { detail } => Some(detail),
        _ => None,
    });
    let last = last.last().expect("it is told");
    assert!(full(&last) && last.contains("start this node anew"), "{last}");
}

#[test]
fn beyond_the_most_terms_that_were_told_on_it_says_so_too() {
    let mut own = begun(listing(0, &[0, 1, 2]));
    let first = begun(listing(1, &[0, 1, 2]));
    for other in 3..68 {
        let terms = Terms::of(&listing(other, &[other])).encode();
        hear(&mut own, &first, &Message::Rival { terms }, 1);
    }
    assert!(own.dispute().is_some_and(|told| told.contains("start this node anew")));
}

#[test]
fn beyond_the_most_others_of_whom_it_is_remembered_what_they_say_it_says_so_too() {
    let mut own = begun(listing(0, &[0, 1, 2]));
    let terms = begun(listing(3, &[0, 3])).terms();
    for other in 3..1028 {
        own.handle_terms(&node(other), &terms, at(1));
    }
    assert!(own.dispute().is_some_and(|told| told.contains("start this node anew")));
}

#[test]
fn what_a_node_was_told_that_may_claim_the_service_no_more_does_not_count() {
    let mut own = begun(listing(0, &[0]));
    let agrees = own.terms();
    own.handle_terms(&node(1), &agrees, at(1));
    let hostile = begun(listing(2, &[2, 3, 4]));
    own.handle_terms(&node(2), &hostile.terms(), at(1));
    assert!(own.dispute().is_some());
    outputs(&mut own);

    own.handle_claimants(|other| *other != node(2), at(2));

    assert_eq!((own.dispute(), own.accord.reckons_with(at(2)).len()), (None, 0));
    assert_eq!(outputs(&mut own), [ReplicaOutput::Agreed]);
    assert!(own.accord.known.contains_key(&node(1)), "what others were told counts");
    own.handle_claimants(|other| *other != node(2), at(3));
    assert_eq!(outputs(&mut own), []);
}

#[test]
fn terms_that_somebody_out_of_sight_still_has_are_not_forgotten() {
    let divided = |config| ReplicaConfig { on_partition: OnPartition::Continue, ..config };
    let mut own = begun(divided(listing(0, &[0, 1])));
    let other = begun(divided(listing(2, &[1, 2])));
    own.handle_terms(&node(2), &other.terms(), at(1));
    own.handle_carriers(&[node(2)], at(2));
    assert_eq!(own.accord.reckons_with(at(2)).len(), 1);
    own.handle_carriers(&[], at(3));
    assert_eq!(own.accord.reckons_with(at(3)).len(), 0);
    // Somebody else says something meanwhile.
    let agrees = own.terms();
    own.handle_terms(&node(1), &agrees, at(4));

    own.handle_carriers(&[node(1), node(2)], at(5));

    assert_eq!(own.accord.reckons_with(at(5)).len(), 1, "they concern each other again");
}

#[test]
fn whoever_comes_back_into_sight_is_bound_only_when_it_has_answered_again() {
    let mut own = begun(listing(0, &[0, 1, 2]));
    let other = begun(listing(3, &[3]));
    let bound = |own: &Replica| own.accord.known[&node(3)].bound.is_some();
    own.handle_carriers(&[node(3)], at(1));
    own.handle_terms(&node(3), &other.terms(), at(2));
    own.handle_carriers(&[node(3)], at(502));
    assert!(bound(&own), "it was there all the time");
    own.handle_carriers(&[], at(1002));
    assert!(bound(&own), "where it is, it keeps back");
    outputs(&mut own);

    own.handle_carriers(&[node(3)], at(1502));

    assert!(!bound(&own), "it may be in another life");
    assert!(outputs(&mut own).contains(&ReplicaOutput::Compare { with: node(3) }));
    own.handle_terms(&node(3), &other.terms(), at(1503));
    assert!(bound(&own));

    // It says so itself before it is seen.
    own.handle_carriers(&[], at(2002));
    own.handle_asked(&node(3), &other.terms(), at(2010));
    assert!(!bound(&own));
    own.handle_terms(&node(3), &other.terms(), at(2011));
    own.handle_carriers(&[node(3)], at(2502));
    assert_eq!(own.accord.known[&node(3)].bound, Some(at(2011)));
}

#[test]
fn a_primary_that_meets_those_who_knew_of_more_by_another_list_says_what_is_lost() {
    let lost = |own: &mut Replica| {
        let lost = outputs(own).into_iter().find_map(|output| match output {
            ReplicaOutput::Fault { kind: FaultKind::StateLost, detail } => Some(detail),
            _ => None,
        });
        lost.is_some_and(|detail| detail.contains("after 7 requests"))
    };
    // Of an epoch that is ours, before ours, and after it.
    for epoch in [0, 1, 2] {
        let (mut own, mut other) = (serving(), begun(listing(3, &[0, 3])));
        own.handle_terms(&node(3), &other.terms(), at(36));
        assert!(!lost(&mut own), "nobody was answered");
        other.answered = Position { epoch, number: 7 };
        own.handle_terms(&node(3), &other.terms(), at(37));
        assert!(lost(&mut own), "{epoch}");
        own.handle_terms(&node(3), &other.terms(), at(38));
        assert!(!lost(&mut own), "said once");

        let (mut own, answered) = (serving(), other.answered);
        own.handle_terms(&node(3), &begun(listing(3, &[0, 3])).terms(), at(36));
        let (position, standing) = (Position::default(), Standing::Behind);
        let promise = Message::Promise { epoch: 1, number: 1, position, answered, standing };
        hear(&mut own, &other, &promise, 37);
        assert!(lost(&mut own), "who learns says so, too: {epoch}");
    }
}

#[test]
fn an_epoch_beyond_all_measure_ends_no_replica() {
    let mut own = begun(listing(0, &[0, 1, 2]));
    let second = begun(listing(1, &[0, 1, 2]));
    hear(&mut own, &second, &Message::Voted { epoch: u64::MAX }, 1);
    own.handle_timeout(at(34));
    assert_eq!(own.role(), Role::Standby { primary: None, in_step: false });
}
