//! What the policy of the robot lets the left end do at the right one.

use super::*;
use crate::net::trust::access::AccessPolicy;
use crate::net::trust::crypto::Seed;
use crate::net::trust::policy::Role;
use crate::net::trust::roster::{NodeRoster, RosterNode};

/// The rights at the right end, by these lines; the left end has this role.
fn policy(left: Role, lines: &[&str]) -> AccessPolicy {
    let nodes = [("left", left), ("right", Role::Node), ("other", Role::Node)];
    let listed = nodes.iter().zip(1..).map(|((name, role), seed)| RosterNode {
        name: node(name),
        keys: Seed::new([seed; 32]).public_keys(),
        role: *role,
    });
    let roster = NodeRoster::new(node("ranger"), listed).expect("different nodes");
    let lines: String = lines.iter().map(|line| format!("{line}\n")).collect();
    let lines = format!("policy\n{lines}end");
    let roster = NodeRoster::parse(&roster.to_text().replace("end", &lines)).expect("lines");
    AccessPolicy::new(node("right"), &roster)
}

fn guarded(left: Role, lines: &[&str]) -> Pair {
    let mut pair = Pair::new();
    pair.ends[1].handle_access(policy(left, lines));
    for end in 0..2 {
        pair.begin(end);
    }
    pair.run();
    pair
}

fn is_forbidden(output: &PeerProtocolOutput) -> bool {
    let why = match output {
        PeerProtocolOutput::Resolve { result: Err(why), .. } => why,
        PeerProtocolOutput::Lost { why, .. } => why,
        PeerProtocolOutput::SubscriptionForbidden { why } => why,
        _ => return false,
    };
    matches!(why, DeliveryError::Forbidden { .. })
}

/// The verbs that the right end has refused since the last look. Nothing else came out of it.
fn refused(pair: &mut Pair) -> Vec<String> {
    let outputs = pair.take(1).into_iter();
    let verbs = outputs.map(|output| match output {
        PeerProtocolOutput::AccessDenied { denied } => {
            assert_eq!(denied.peer, node("left"));
            denied.verb.to_string()
        }
        other => panic!("{other:?}"),
    });
    verbs.collect()
}

#[test]
fn a_peer_that_may_neither_ask_nor_tell_is_not_bound() {
    let mut pair = guarded(Role::Node, &["only other may ask tell on right/arm"]);
    pair.call(count(), Some(7));
    assert_eq!(refused(&mut pair), ["ask"]);
    let resolved = pair.take(0);
    assert!(matches!(&resolved[..], [output] if is_forbidden(output)), "{resolved:?}");

    let mut pair = guarded(Role::Node, &["only other may recover on right"]);
    pair.call(ContractIdentity { name: "blastema/recover", ..count() }, Some(7));
    assert_eq!(refused(&mut pair), ["recover"]);
    let resolved = pair.take(0);
    assert!(matches!(&resolved[..], [output] if is_forbidden(output)), "{resolved:?}");

    let mut pair = guarded(Role::Guest, &[]);
    pair.call(count(), None);
    assert_eq!(refused(&mut pair), ["ask"]);
    let lost = pair.take(0);
    assert!(matches!(&lost[..], [output] if is_forbidden(output)), "{lost:?}");
}

#[test]
fn a_peer_that_may_only_tell_is_refused_what_it_asks_and_the_reverse() {
    let mut pair = guarded(Role::Node, &["only other may ask on right/*"]);
    pair.call(count(), None);
    pair.agree();
    assert!(matches!(&pair.take(1)[..], [PeerProtocolOutput::Serve { call: None, .. }]));
    pair.call(count(), Some(7));
    assert_eq!(refused(&mut pair), ["ask"]);
    assert!(matches!(&pair.take(0)[..], [output] if is_forbidden(output)));

    let mut pair = guarded(Role::Node, &["only other may tell on ** by count"]);
    pair.call(count(), Some(7));
    pair.agree();
    assert!(matches!(&pair.take(1)[..], [PeerProtocolOutput::Serve { call: Some(_), .. }]));
    pair.call(count(), None);
    assert_eq!(refused(&mut pair), ["tell"]);
    let lost = pair.take(0);
    assert!(matches!(&lost[..], [output] if is_forbidden(output)), "{lost:?}");
}

#[test]
fn a_message_on_its_way_when_another_policy_closes_its_binding_is_lost_to_its_sender_by_name() {
    let mut pair = guarded(Role::Node, &[]);
    pair.call(count(), None);
    pair.agree();
    pair.take(1);
    let (left, right) = (pair.ids[0], pair.ids[1]);
    pair.ends[1].handle_access(policy(Role::Node, &["only other may ask tell on right/arm"]));
    let tell =
        PeerMessage::Tell { binding: 1, timestamp_us: 0, id: None, payload: payload().into() };
    pair.ends[1].handle_message(left, tell.encode().into_bytes(), at(0));
    pair.run();

    assert_eq!(refused(&mut pair), ["tell"]);
    let lost = pair.take(0);
    let [PeerProtocolOutput::Lost { peer, to, why }] = &lost[..] else { panic!("{lost:?}") };
    assert_eq!((*peer, to), (right, &MessageTarget::Object(arm(), "count")));
    assert!(matches!(why, DeliveryError::Forbidden { .. }), "{why}");
}

#[test]
fn a_peer_says_only_of_what_was_sent_to_it_that_it_was_refused() {
    let mut pair = guarded(Role::Node, &[]);
    pair.call(count(), None);
    pair.agree();
    pair.take(1);
    let why = DeliveryError::Stopped;
    for binding in [1, 7] {
        let refused = PeerMessage::TellRefused { binding, why: why.clone() };
        pair.ends[0].handle_message(pair.ids[1], refused.encode().into_bytes(), at(0));
    }
    pair.run();
    assert_eq!((pair.take(0).len(), pair.ends[0].refusals().unexpected), (1, 1));
}

#[test]
fn a_peer_that_may_not_listen_is_told_and_gets_no_event() {
    let mut pair = guarded(Role::Node, &["only other may listen on news"]);
    pair.ends[0].handle_interest(topic(), vec![count()]);
    pair.run();
    assert_eq!(refused(&mut pair), ["listen"]);
    assert!(matches!(&pair.take(0)[..], [output] if is_forbidden(output)));
}

#[test]
fn a_peer_that_may_not_publish_is_not_told_who_listens_and_its_events_are_dropped() {
    let mut pair = guarded(Role::Node, &["only other may publish on news"]);
    pair.ends[1].handle_interest(topic(), vec![count()]);
    pair.run();
    assert_eq!(pair.take(0), [], "it is not told");
    // It guesses the number.
    let event = PeerMessage::Event { subscription: 1, timestamp_us: 0, payload: payload().into() };
    let (left, event) = (pair.ids[0], event.encode().into_bytes());
    pair.ends[1].handle_message(left, event, at(0));
    pair.run();
    assert_eq!(refused(&mut pair), ["publish"]);
}

#[test]
fn another_policy_counts_at_once_for_bindings_and_the_session_goes_on() {
    let mut pair = guarded(Role::Node, &[]);
    pair.call(count(), Some(7));
    let epoch = pair.agree();
    pair.take(1);
    let left = pair.ids[0];
    let on_its_way = PeerMessage::Request {
        binding: 1,
        call: 2,
        timestamp: 0,
        within: 0,
        id: None,
        payload: payload().into(),
    };
    pair.ends[1].handle_full(left, 1);
    pair.run();
    let object = arm();
    assert_eq!(pair.take(0), [PeerProtocolOutput::ObjectFull { peer: pair.ids[1], object }]);

    let elsewhere = "only other may ask on right/leg";
    pair.ends[1].handle_access(policy(Role::Node, &[elsewhere]));
    pair.run();
    assert_eq!((pair.take(0), pair.take(1)), (vec![], vec![]));

    let here = "only other may ask tell on right/arm";
    pair.ends[1].handle_access(policy(Role::Node, &[elsewhere, here]));
    pair.run();
    let object = arm();
    let ready = PeerProtocolOutput::ObjectReady { peer: pair.ids[1], object };
    assert_eq!(pair.take(0), [ready], "nothing waits for what it may not do");
    assert_eq!(pair.take(1), [], "the peer has tried nothing yet");
    // What comes through the old binding is refused, and so is a new one.
    pair.ends[1].handle_message(left, on_its_way.encode().into_bytes(), at(0));
    pair.run();
    assert_eq!(refused(&mut pair), ["ask"]);
    pair.call(count(), Some(8));
    assert_eq!(refused(&mut pair), ["ask"]);
    assert!(matches!(&pair.take(0)[..], [output] if is_forbidden(output)));
    // What was served before is answered.
    pair.ends[1].handle_answer(left, epoch, 1, Ok(payload().into()), at(0));
    pair.run();
    let answered = PeerProtocolOutput::Resolve { reply_as: 7, result: Ok(payload()) };
    assert_eq!(pair.take(0), [answered]);

    pair.ends[1].handle_access(policy(Role::Node, &[]));
    pair.call(count(), Some(9));
    pair.agree();
    assert!(matches!(&pair.take(1)[..], [PeerProtocolOutput::Serve { call: Some(_), .. }]));
}

#[test]
fn another_policy_counts_at_once_for_who_listens() {
    let mut pair = guarded(Role::Node, &[]);
    pair.ends[0].handle_interest(topic(), vec![count()]);
    pair.run();
    let listens = |output: &PeerProtocolOutput| {
        matches!(output, PeerProtocolOutput::Subscribe { subscription: 1, .. })
    };
    assert!(matches!(&pair.take(1)[..], [output] if listens(output)));

    for _ in 0..2 {
        pair.ends[1].handle_access(policy(Role::Node, &["only other may listen on news"]));
        pair.run();
    }
    let ended = PeerProtocolOutput::Unsubscribe { peer: pair.ids[0], subscription: 1 };
    assert_eq!(pair.take(1), [ended]);
    assert!(matches!(&pair.take(0)[..], [output] if is_forbidden(output)));
    assert!(pair.ends[0].is_refused_a_subscription());

    for _ in 0..2 {
        pair.ends[1].handle_access(policy(Role::Node, &[]));
        pair.run();
    }
    assert!(matches!(&pair.take(1)[..], [output] if listens(output)));
    assert_eq!(pair.take(0), []);
    assert!(!pair.ends[0].is_refused_a_subscription());
}

#[test]
fn another_policy_counts_at_once_for_who_publishes() {
    let mut pair = guarded(Role::Node, &[]);
    pair.ends[1].handle_interest(topic(), vec![count()]);
    pair.run();
    assert!(matches!(&pair.take(0)[..], [PeerProtocolOutput::Subscribe { .. }]));
    pair.ends[1].handle_access(policy(Role::Node, &["only other may publish on news"]));
    pair.run();
    assert!(matches!(&pair.take(0)[..], [PeerProtocolOutput::Unsubscribe { .. }]));
    // It is not told twice that no object listens.
    pair.ends[1].handle_interest(topic(), vec![]);
    pair.ends[1].handle_interest(topic(), vec![count()]);
    pair.run();
    assert_eq!(pair.take(0), []);
    pair.ends[1].handle_access(policy(Role::Node, &[]));
    pair.run();
    assert!(matches!(&pair.take(0)[..], [PeerProtocolOutput::Subscribe { .. }]));
}

#[test]
fn a_number_in_use_stands_for_what_it_stood_for_first() {
    let mut pair = guarded(Role::Node, &["only other may ask tell on right/arm"]);
    let left = pair.ids[0];
    let identity = count().full().encode();
    for object in ["leg", "arm", "leg"] {
        let object = ObjectName::new(object).expect("a name");
        let bind = PeerMessage::Bind { binding: 5, object, identity: identity.clone() };
        pair.ends[1].handle_message(left, bind.encode().into_bytes(), at(0));
    }
    pair.run();
    let bound = pair.take(1);
    assert!(matches!(&bound[..], [PeerProtocolOutput::Bind { .. }]), "{bound:?}");

    for topic in ["news", "weather"] {
        let (topic, identities) = (topic.to_owned(), vec![identity.clone()]);
        let subscribe = PeerMessage::Subscribe { subscription: 5, topic, identities };
        pair.ends[1].handle_message(left, subscribe.encode().into_bytes(), at(0));
    }
    let subscribed = pair.ends[1].poll_output();
    let Some(PeerProtocolOutput::Subscribe { topic, .. }) = subscribed else {
        panic!("{subscribed:?}");
    };
    assert_eq!((topic.topic.as_str(), pair.ends[1].poll_output()), ("news", None));
    assert_eq!(pair.ends[1].refusals().unexpected, 3);
}

#[test]
fn a_subscription_has_one_contract_in_several_versions() {
    let mut pair = guarded(Role::Node, &["only other may listen on news by count"]);
    let (first, second) = (ContractIdentity { name: "other", ..count() }, count());
    let identities = [first, second].map(|identity| identity.full().encode());
    let topic = "news".to_owned();
    let subscribe =
        PeerMessage::Subscribe { subscription: 1, topic, identities: identities.into() };
    pair.ends[1].handle_message(pair.ids[0], subscribe.encode().into_bytes(), at(0));
    pair.run();
    assert_eq!(pair.take(1), []);
}

#[test]
fn a_peer_is_believed_once_that_it_refuses_a_subscription_and_only_one_that_there_is() {
    let mut pair = guarded(Role::Node, &[]);
    pair.ends[1].handle_interest(topic(), vec![count()]);
    pair.run();
    let why = DeliveryError::Forbidden {
        node: "right".into(),
        verb: "listen".into(),
        object: "news".into(),
        serial: 1,
    };
    for subscription in [7, 1, 1] {
        let refused = PeerMessage::SubscribeRefused { subscription, why: why.clone() };
        pair.ends[1].handle_message(pair.ids[0], refused.encode().into_bytes(), at(0));
    }
    pair.run();
    assert!(matches!(&pair.take(1)[..], [output] if is_forbidden(output)));
    assert!(pair.ends[1].is_refused_a_subscription());
    // Who ends a subscription is not refused it any more.
    pair.ends[1].handle_interest(topic(), vec![]);
    pair.run();
    assert_eq!(pair.take(1), []);
    assert!(!pair.ends[1].is_refused_a_subscription());

    // Nor is one on whose topic the peer may not publish any more: it is not listened to there.
    pair.ends[1].handle_interest(topic(), vec![count()]);
    pair.run();
    let told = pair.take(0).pop();
    let Some(PeerProtocolOutput::Subscribe { subscription, .. }) = told else {
        panic!("{told:?}");
    };
    let refused = PeerMessage::SubscribeRefused { subscription, why };
    pair.ends[1].handle_message(pair.ids[0], refused.encode().into_bytes(), at(0));
    pair.run();
    assert!(matches!(&pair.take(1)[..], [output] if is_forbidden(output)));
    assert!(pair.ends[1].is_refused_a_subscription());
    pair.ends[1].handle_access(policy(Role::Node, &["only other may publish on news"]));
    pair.run();
    assert_eq!(pair.take(1), []);
    assert!(!pair.ends[1].is_refused_a_subscription());
}

#[test]
fn what_a_node_says_to_its_own_components_no_peer_says() {
    let mut pair = guarded(Role::Operator, &[]);
    pair.call(ContractIdentity { name: "blastema/drive-component", ..count() }, Some(7));
    assert_eq!(refused(&mut pair), ["tell"]);
}

#[test]
fn the_component_of_a_service_is_no_way_around_the_rights_at_the_service() {
    let mut pair = guarded(Role::Node, &["only other may ask on map"]);
    for (object, is_open) in [("map/replica", false), ("map/other", true)] {
        let call = Call {
            node: node("right"),
            object: ObjectName::new(object).expect("a name"),
            contract: count(),
            id: None,
            sent: at(0),
            until: None,
            payload: payload().into(),
            reply_as: None,
            credit: None,
        };
        pair.ends[0].handle_call(call);
        pair.run();
        let bound = pair.take(1);
        let is_bound = matches!(&bound[..], [PeerProtocolOutput::Bind { .. }]);
        assert_eq!(is_bound, is_open, "{object}: {bound:?}");
    }
}

#[test]
fn what_a_peer_has_asked_for_stays_bounded_however_it_asks() {
    let mut pair = guarded(Role::Node, &[]);
    let left = pair.ids[0];
    let identity = count().full().encode();
    for number in 0..2 * BINDINGS_MAX as u32 {
        // What is refused by the object, and ended subscriptions that never were, make no room.
        let bind = PeerMessage::Bind { binding: number, object: arm(), identity: identity.clone() };
        pair.ends[1].handle_message(left, bind.encode().into_bytes(), at(0));
        let gone = PeerMessage::Unsubscribe { subscription: number };
        pair.ends[1].handle_message(left, gone.encode().into_bytes(), at(0));
        while let Some(output) = pair.ends[1].poll_output() {
            if let PeerProtocolOutput::Bind { peer, epoch, binding, .. } = output {
                let unknown = DeliveryError::Unknown { name: "arm".into() };
                let refused = (number % 2 == 0).then_some((unknown, None));
                let answer = refused.map_or(Ok(()), Err);
                pair.ends[1].handle_bound(peer, epoch, binding, answer);
            }
        }
    }
    let session = pair.ends[1].peers.open(left).expect("it is open");
    assert_eq!(session.bound.len() + session.subscriptions.len(), BINDINGS_MAX);
}

#[test]
fn only_operators_and_nodes_that_a_line_names_operate_a_node() {
    let order = || ContractIdentity { name: "blastema/order-isolation", ..count() };
    let check = |role: Role, lines: &[&str], may: bool| {
        let mut pair = guarded(role, lines);
        pair.call(order(), Some(7));
        if may {
            let bound = pair.take(1);
            assert!(matches!(&bound[..], [PeerProtocolOutput::Bind { .. }]), "{bound:?}");
        } else {
            assert_eq!(refused(&mut pair), ["operate"]);
            assert!(matches!(&pair.take(0)[..], [output] if is_forbidden(output)));
        }
    };

    check(Role::Operator, &[], true);
    for role in [Role::Node, Role::Guest] {
        check(role, &[], false);
    }
    check(Role::Node, &["only left may operate on right"], true);
    check(Role::Operator, &["only other may operate on right"], false);
    check(Role::Operator, &["only other may operate on other"], true);
    check(Role::Operator, &["only other may operate on right by blastema/key-status"], true);
}
