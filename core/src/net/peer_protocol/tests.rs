//! Two peer protocols, each the peer of the other.

use super::*;
use crate::contract::layout::{Described, Layout};
use crate::net::session::IDLE_TIMEOUT;
use crate::{CreditPool, Delivery, ObjectName};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

fn layout_of_number() -> &'static Layout {
    u64::layout()
}

fn layout_of_text() -> &'static Layout {
    String::layout()
}

fn contract(message: crate::contract::layout::LayoutOf) -> ContractIdentity {
    let reply = layout_of_number;
    let fingerprint = crate::contract::fingerprint(message, reply);
    ContractIdentity {
        name: "count",
        version: 1,
        delivery: Delivery::Reliable,
        bulk: false,
        idempotent: false,
        fingerprint,
        message,
        reply,
    }
}

fn count() -> ContractIdentity {
    contract(layout_of_number)
}

fn node(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn arm() -> ObjectName {
    ObjectName::new("arm").unwrap()
}

fn topic() -> TopicContract {
    TopicContract { topic: "news".into(), contract: "count".into() }
}

fn payload() -> Bytes {
    Bytes::from_static(b"payload")
}

fn at(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

/// The protocol of one of two nodes that have met.
fn end(name: &str) -> PeerProtocol {
    let mut end = PeerProtocol::new(node(name), Incarnation(1), IDLE_TIMEOUT);
    for peer in ["left", "right"].into_iter().filter(|peer| *peer != name) {
        end.meet(&node(peer), 0, at(0));
    }
    end
}

/// Two peer protocols; what one sends, the other receives.
struct Pair {
    ends: [PeerProtocol; 2],
    ids: [NodeId; 2],
    outputs: [Vec<PeerProtocolOutput>; 2],
    /// After how many outputs the other end had told all that it listens to.
    announced: [Option<usize>; 2],
    /// How many sessions have begun.
    sessions: u32,
    now: u64,
}

impl Pair {
    fn new() -> Self {
        let ids = [NodeId::of(&node("left")), NodeId::of(&node("right"))];
        let mut ends = [end("left"), end("right")];
        ends.iter_mut().for_each(|end| end.handle_started(at(0)));
        let outputs = Default::default();
        Pair { ends, ids, outputs, announced: [None; 2], sessions: 0, now: 0 }
    }

    /// A session begins at this end.
    fn begin(&mut self, end: usize) {
        self.sessions += 1;
        let peer = self.ids[1 - end];
        self.ends[end].handle_opened(peer, Incarnation(1), self.sessions, at(0));
    }

    fn open() -> Self {
        let mut pair = Pair::new();
        for end in 0..2 {
            pair.begin(end);
        }
        pair.run();
        pair
    }

    /// Carries out what can be carried out without the application.
    fn run(&mut self) {
        loop {
            let mut busy = false;
            for end in 0..2 {
                while let Some(output) = self.ends[end].poll_output() {
                    busy = true;
                    match output {
                        PeerProtocolOutput::Send { message, .. } => {
                            self.ends[1 - end].handle_message(
                                self.ids[end],
                                message.into_bytes(),
                                at(self.now),
                            );
                        }
                        PeerProtocolOutput::Announced { peer } => {
                            assert_eq!(peer, self.ids[1 - end]);
                            self.announced[end] = Some(self.outputs[end].len());
                        }
                        other => self.outputs[end].push(other),
                    }
                }
            }
            if !busy {
                return;
            }
        }
    }

    fn take(&mut self, end: usize) -> Vec<PeerProtocolOutput> {
        std::mem::take(&mut self.outputs[end])
    }

    fn call(&mut self, contract: ContractIdentity, reply_as: Option<u64>) {
        let (node, object) = (node("right"), arm());
        let call = Call {
            node,
            object,
            contract,
            id: None,
            sent: at(self.now),
            until: None,
            payload: payload().into(),
            reply_as,
            credit: None,
        };
        self.ends[0].handle_call(call);
        self.run();
    }

    /// The right end agrees to the binding that it was just asked for.
    fn agree(&mut self) -> SessionEpoch {
        let outputs = self.take(1);
        let [PeerProtocolOutput::Bind { peer, epoch, binding, identity, .. }] = &outputs[..] else {
            panic!("{outputs:?}");
        };
        assert_eq!(count().check(identity), Ok(()));
        self.ends[1].handle_bound(*peer, *epoch, *binding, Ok(()));
        self.run();
        *epoch
    }
}

#[test]
fn the_first_message_binds_and_all_are_served_in_order() {
    let mut pair = Pair::open();
    pair.call(count(), Some(10));
    pair.call(count(), None);
    assert!(pair.ends[0].is_waiting());

    let epoch = pair.agree();
    pair.call(count(), Some(11));

    let calls: Vec<_> = pair
        .take(1)
        .into_iter()
        .map(|output| match output {
            PeerProtocolOutput::Serve { call, .. } => call,
            other => panic!("{other:?}"),
        })
        .collect();
    assert_eq!(calls, [Some(1), None, Some(2)]);
    let left = pair.ids[0];
    pair.ends[1].handle_answer(left, epoch, 2, Ok(payload().into()), at(0));
    pair.ends[1].handle_answer(left, epoch, 1, Err(DeliveryError::Stopped), at(0));
    pair.run();
    let resolved = |reply_as, result| PeerProtocolOutput::Resolve { reply_as, result };
    assert_eq!(
        pair.take(0),
        [resolved(11, Ok(payload())), resolved(10, Err(DeliveryError::Stopped))]
    );
}

#[test]
fn a_contract_that_differs_is_shown_from_both_sides_and_asked_again_next_time() {
    let mut pair = Pair::open();
    pair.call(contract(layout_of_text), Some(10));
    let outputs = pair.take(1);
    let [PeerProtocolOutput::Bind { peer, epoch, binding, identity, .. }] = &outputs[..] else {
        panic!("{outputs:?}");
    };
    let theirs = count().check(identity).unwrap_err().to_string();
    let why = DeliveryError::ContractDiffers { difference: theirs.clone() };
    pair.ends[1].handle_bound(*peer, *epoch, *binding, Err((why, Some(count()))));
    pair.run();

    let outputs = pair.take(0);
    let [
        PeerProtocolOutput::Differs { difference, .. },
        PeerProtocolOutput::Resolve {
            reply_as: 10,
            result: Err(DeliveryError::ContractDiffers { .. }),
        },
    ] = &outputs[..]
    else {
        panic!("{outputs:?}");
    };
    assert_ne!(*difference, theirs, "here and there have changed places");
    pair.call(count(), Some(11));
    pair.agree();
    assert!(matches!(pair.take(1)[..], [PeerProtocolOutput::Serve { .. }]));
}

#[test]
fn everything_is_resolved_when_the_session_ends_and_late_answers_go_nowhere() {
    let mut pair = Pair::open();
    let right = pair.ids[1];
    pair.call(count(), Some(10));
    let epoch = pair.agree();
    pair.run();

    pair.ends[0].handle_ended(right, &DeliveryError::Stopped);
    pair.run();

    let unknown = DeliveryError::OutcomeUnknown { reason: DeliveryError::Stopped.to_string() };
    let resolved = PeerProtocolOutput::Resolve { reply_as: 10, result: Err(unknown) };
    let why = DeliveryError::Stopped;
    assert_eq!(pair.take(0), [resolved, PeerProtocolOutput::Forget { peer: right, why }]);

    let left = pair.ids[0];
    pair.ends[1].handle_ended(left, &DeliveryError::Stopped);
    for end in 0..2 {
        pair.begin(end);
    }
    pair.take(1);
    pair.ends[1].handle_answer(left, epoch, 1, Ok(payload().into()), at(0));
    pair.run();
    assert_eq!(pair.take(0), [], "the answer belongs to the session before");
}

#[test]
fn without_a_session_a_call_is_refused_with_the_reason() {
    let mut pair = Pair::new();
    pair.call(count(), Some(10));
    let why = DeliveryError::Unreachable { node: "right".into() };
    let resolved = |why| PeerProtocolOutput::Resolve { reply_as: 10, result: Err(why) };
    assert_eq!(pair.take(0), [resolved(why)]);

    let known = pair.ends[0].peers.get_mut(pair.ids[1]).unwrap();
    known.handle_reachable(Incarnation(1), 1000, at(0));
    pair.call(count(), Some(10));
    assert_eq!(pair.take(0), [resolved(DeliveryError::Restarting)]);
    pair.call(count(), None);
    let (peer, to) = (pair.ids[1], MessageTarget::Object(arm(), "count"));
    assert_eq!(
        pair.take(0),
        [PeerProtocolOutput::Lost { peer, to, why: DeliveryError::Restarting }]
    );
}

/// In which stream events go.
const EVENTS: Option<TrafficClass> = Some(TrafficClass::Event);

/// How many of its credits are held.
#[derive(Default)]
struct CountedPool(AtomicUsize);

impl CreditPool for CountedPool {
    fn give_back(&self, _: usize) {
        self.0.fetch_sub(1, Ordering::Relaxed);
    }
}

#[test]
fn a_message_holds_its_credit_while_it_waits_for_its_binding_and_on_to_the_session() {
    let mut pair = Pair::open();
    let pool = Arc::new(CountedPool::default());
    let held = || pool.0.load(Ordering::Relaxed);
    let call = |contract| {
        pool.0.fetch_add(1, Ordering::Relaxed);
        let credit = Some(Credit::new(pool.clone(), 8));
        let (node, object, payload) = (node("right"), arm(), payload().into());
        let (id, sent, until, reply_as) = (None, at(0), None, None);
        Call { node, object, contract, id, sent, until, payload, reply_as, credit }
    };
    for _ in 0..1000 {
        pair.ends[0].handle_call(call(count()));
    }
    pair.run();
    assert_eq!(held(), 1000, "they wait for their binding");
    let (peer, epoch, binding) = match &pair.take(1)[..] {
        [PeerProtocolOutput::Bind { peer, epoch, binding, .. }] => (*peer, *epoch, *binding),
        other => panic!("{other:?}"),
    };
    pair.ends[1].handle_bound(peer, epoch, binding, Ok(()));
    while let Some(output) = pair.ends[1].poll_output() {
        let PeerProtocolOutput::Send { message, .. } = output else { continue };
        pair.ends[0].handle_message(pair.ids[1], message.into_bytes(), at(0));
    }
    let sent: Vec<_> = std::iter::from_fn(|| pair.ends[0].poll_output()).collect();
    assert_eq!((sent.len(), held()), (1000, 1000), "the session gets the credit with them");
    drop(sent);
    assert_eq!(held(), 0);

    pair.call(contract(layout_of_text), None);
    pair.take(1);
    pair.ends[0].handle_call(call(contract(layout_of_text)));
    assert_eq!(held(), 1);
    pair.ends[0].handle_ended(pair.ids[1], &DeliveryError::Restarting);
    assert_eq!(held(), 0, "what does not go holds nothing");
}

#[test]
fn commands_and_their_replies_are_control() {
    let mut pair = Pair::open();
    pair.call(ContractIdentity { name: "blastema/command", ..count() }, Some(10));
    let (peer, epoch, binding) = match &pair.take(1)[..] {
        [PeerProtocolOutput::Bind { peer, epoch, binding, .. }] => (*peer, *epoch, *binding),
        other => panic!("{other:?}"),
    };
    pair.ends[1].handle_bound(peer, epoch, binding, Ok(()));
    pair.run();

    let (peer, call) = match &pair.take(1)[..] {
        [PeerProtocolOutput::Serve { peer, call: Some(call), .. }] => (*peer, *call),
        other => panic!("{other:?}"),
    };
    pair.ends[1].handle_answer(peer, epoch, call, Ok(payload().into()), at(0));
    let reply = pair.ends[1].poll_output();
    let Some(PeerProtocolOutput::Send { stream: TrafficClass::Control, .. }) = reply else {
        panic!("{reply:?}");
    };
}

#[test]
fn a_peer_that_starts_is_announced_when_its_start_is_over_and_in_every_later_session_at_once() {
    let mut pair = Pair::new();
    pair.ends[1] = end("right");
    let open = |pair: &mut Pair| {
        for end in 0..2 {
            pair.begin(end);
        }
        pair.run();
    };
    open(&mut pair);
    assert_eq!(pair.announced, [None, Some(0)]);

    pair.ends[1].handle_started(at(700));
    pair.run();
    assert_eq!(pair.announced, [Some(0), Some(0)]);

    pair.announced = [None; 2];
    pair.ends[1].handle_ended(pair.ids[0], &DeliveryError::Restarting);
    pair.run();
    pair.take(1);
    open(&mut pair);
    assert_eq!(pair.announced, [Some(0), Some(0)]);
}

#[test]
fn an_interest_is_told_now_and_to_every_later_session() {
    let mut pair = Pair::new();
    pair.ends[0].handle_interest(topic(), vec![count()]);
    for end in 0..2 {
        pair.begin(end);
    }
    pair.run();
    assert_eq!(pair.announced, [Some(0), Some(1)]);
    let outputs = pair.take(1);
    let [PeerProtocolOutput::Subscribe { peer, subscription, topic: wanted, .. }] = &outputs[..]
    else {
        panic!("{outputs:?}");
    };
    assert_eq!(*wanted, topic());

    pair.ends[1].handle_event(*peer, *subscription, EVENTS, payload().into(), at(0), None);
    pair.run();
    let event = PeerProtocolOutput::Event {
        peer: NodeId::of(&node("right")),
        topic: topic(),
        form: 0,
        age: Duration::ZERO,
        payload: payload(),
    };
    assert_eq!(pair.take(0), [event]);

    pair.ends[0].handle_interest(topic(), vec![count()]);
    pair.run();
    assert_eq!(pair.take(1), [], "the same interest is no second subscription");
    pair.ends[0].handle_interest(topic(), vec![]);
    pair.run();
    let (peer, subscription) = (*peer, *subscription);
    assert_eq!(pair.take(1), [PeerProtocolOutput::Unsubscribe { peer, subscription }]);
    pair.ends[1].handle_event(peer, subscription, EVENTS, payload().into(), at(0), None);
    pair.run();
    assert_eq!(pair.take(0), []);
    assert_eq!(pair.ends[0].refusals().stale, 1);
}

#[test]
fn a_returned_message_resolves_its_request() {
    let mut pair = Pair::open();
    pair.call(count(), None);
    pair.agree();
    pair.take(1);
    let call = |reply_as| Call {
        node: node("right"),
        object: arm(),
        contract: count(),
        id: None,
        sent: at(0),
        until: None,
        payload: payload().into(),
        reply_as,
        credit: None,
    };
    let full = DeliveryError::WayFull { node: "right".into(), class: TrafficClass::Request };
    let mut outputs = vec![];
    for reply_as in [Some(10), None] {
        pair.ends[0].handle_call(call(reply_as));
        let Some(PeerProtocolOutput::Send { peer, message, .. }) = pair.ends[0].poll_output()
        else {
            panic!("it is sent");
        };
        pair.ends[0].handle_returned(
            peer,
            message.into_bytes(),
            full.clone(),
            TransmitState::Nothing,
        );
        outputs.extend(pair.ends[0].poll_output());
    }

    let (peer, to) = (pair.ids[1], MessageTarget::Object(arm(), "count"));
    let resolved = PeerProtocolOutput::Resolve { reply_as: 10, result: Err(full.clone()) };
    let lost = PeerProtocolOutput::Lost { peer, to, why: full };
    assert_eq!(outputs, [resolved, lost]);
}

#[test]
fn a_peer_that_binds_without_end_is_refused_beyond_the_limit() {
    let mut pair = Pair::open();
    let identity = count().brief().encode();
    for binding in 0..BINDINGS_MAX as u32 + 3 {
        let bind = PeerMessage::Bind { binding, object: arm(), identity: identity.clone() };
        pair.ends[0].handle_message(pair.ids[1], bind.encode().into_bytes(), at(0));
    }
    assert_eq!(pair.ends[0].refusals().too_large, 3);
}

#[test]
fn a_roster_is_taken_once_each_time_that_it_was_asked_for() {
    let mut pair = Pair::open();
    let (peer, text) = (pair.ids[1], payload());
    let roster = PeerMessage::Roster { text: text.to_vec() }.encode().into_bytes();
    pair.ends[0].handle_message(peer, roster.clone(), at(0));
    pair.ends[0].handle_roster(1, Bytes::new());
    pair.ends[1].handle_roster(2, text.clone());
    pair.run();
    pair.ends[0].handle_message(peer, roster, at(0));
    pair.run();
    assert_eq!(pair.take(0), [PeerProtocolOutput::Roster { peer, text }]);
    assert_eq!(pair.ends[0].refusals().unexpected, 2);
}

#[test]
fn what_a_peer_says_of_itself_is_refused_or_shortened_where_it_is_too_long() {
    let mut pair = Pair::open();
    let peer = pair.ids[1];
    let mut says = |message: PeerMessage| {
        pair.ends[0].handle_message(peer, message.encode().into_bytes(), at(0));
        let outputs: Vec<_> = std::iter::from_fn(|| pair.ends[0].poll_output()).collect();
        (outputs, pair.ends[0].refusals().too_large)
    };
    let (identity, long) = (vec![0; 16 * 1024 + 1], "x".repeat(100_000));
    let refused =
        |outputs: &[PeerProtocolOutput]| matches!(outputs, [PeerProtocolOutput::Send { .. }]);
    let bind = PeerMessage::Bind { binding: 1, object: arm(), identity: identity.clone() };
    let (outputs, count) = says(bind);
    assert!(refused(&outputs) && count == 1);
    let (topic, identities) = ("news".to_owned(), vec![identity]);
    let (outputs, count) = says(PeerMessage::Subscribe { subscription: 1, topic, identities });
    assert!(refused(&outputs) && count == 2);
    assert_eq!(says(PeerMessage::Roster { text: vec![0; 128 * 1024 + 1] }), (vec![], 3));
    assert_eq!(says(PeerMessage::Directory { message: vec![0; 64 * 1024 + 1] }), (vec![], 4));

    let reason = Some("x".repeat(256));
    let (outputs, _) = says(PeerMessage::InSafeState { reason: long.clone() });
    assert_eq!(outputs, [PeerProtocolOutput::SafeState { peer, reason }]);
    let why = DeliveryError::Unknown { name: long };
    let (outputs, _) = says(PeerMessage::SubscribeRefused { subscription: 1, why });
    let [PeerProtocolOutput::Differs { difference, .. }] = &outputs[..] else {
        panic!("{outputs:?}");
    };
    assert!(difference.len() < 8 * 1024);
}

#[test]
fn what_waited_on_the_way_arrives_with_its_age() {
    let mut pair = Pair::open();
    pair.run();
    pair.call(count(), None);
    // The peer agrees 300 ms later.
    pair.now = 300;
    pair.take(1);
    let right = pair.ids[1];
    pair.ends[0].handle_message(
        right,
        PeerMessage::Bound { binding: 1 }.encode().into_bytes(),
        at(300),
    );
    pair.run();

    let outputs = pair.take(1);
    let [PeerProtocolOutput::Serve { age, .. }] = &outputs[..] else { panic!("{outputs:?}") };
    assert_eq!(*age, Duration::from_millis(300));
}

#[test]
fn an_object_without_room_is_told_of_once_however_many_bindings_lead_there() {
    let mut pair = Pair::open();
    let left = pair.ids[0];
    let right = pair.ids[1];
    let mut numbers = Vec::new();
    for contract in [count(), contract(layout_of_text)] {
        pair.call(contract, None);
        let outputs = pair.take(1);
        let [.., PeerProtocolOutput::Bind { epoch, binding, .. }] = &outputs[..] else {
            panic!("{outputs:?}")
        };
        pair.ends[1].handle_bound(left, *epoch, *binding, Ok(()));
        pair.run();
        numbers.push(*binding);
    }
    pair.take(0);
    let mut says = |binding: u32, word: fn(&mut PeerProtocol, NodeId, u32)| {
        word(&mut pair.ends[1], left, binding);
        pair.run();
        pair.take(0)
    };
    let (peer, object) = (right, arm());
    let full = PeerProtocolOutput::ObjectFull { peer, object: object.clone() };
    let backlog = PeerProtocolOutput::ObjectReady { peer, object };

    assert_eq!(says(numbers[0], PeerProtocol::handle_full), std::slice::from_ref(&full));
    assert_eq!(says(numbers[1], PeerProtocol::handle_full), []);
    assert_eq!(says(numbers[0], PeerProtocol::handle_capacity), []);
    assert_eq!(says(numbers[1], PeerProtocol::handle_capacity), [backlog]);
    assert_eq!(says(numbers[1], PeerProtocol::handle_full), [full]);

    // What makes no sense changes nothing, and is counted.
    assert_eq!(says(numbers[1], PeerProtocol::handle_full), []);
    assert_eq!(says(numbers[0], PeerProtocol::handle_capacity), []);
    assert_eq!(says(99, PeerProtocol::handle_full), []);
    assert_eq!(says(99, PeerProtocol::handle_capacity), []);
    assert_eq!(pair.ends[0].refusals().unexpected, 4);
}

#[test]
fn a_reply_that_no_session_carries_is_told_to_have_been_made() {
    let mut pair = Pair::open();
    pair.call(count(), Some(10));
    pair.agree();
    pair.take(1);
    let left = pair.ids[0];
    let reply = PeerMessage::Reply { call: 1, result: Ok(payload().into()) }.encode().into_bytes();

    let why = DeliveryError::TooLargeForSession { limit: 5 };
    pair.ends[1].handle_returned(left, reply, why, TransmitState::Nothing);
    pair.run();

    let result = Err(DeliveryError::ReplyTooLarge { limit: 5 });
    assert_eq!(pair.take(0), [PeerProtocolOutput::Resolve { reply_as: 10, result }]);
}

#[test]
fn a_reply_that_finds_no_capacity_is_told_as_lost_and_an_error_goes_as_it_is() {
    let class = TrafficClass::Request;
    let full = DeliveryError::WayFull { node: "left".into(), class };
    for reply in [Ok(payload().into()), Err(DeliveryError::Expired)] {
        let mut pair = Pair::open();
        pair.call(count(), Some(10));
        pair.agree();
        pair.take(1);
        let left = pair.ids[0];
        let refused = PeerMessage::Reply { call: 1, result: reply.clone() }.encode().into_bytes();

        pair.ends[1].handle_returned(left, refused, full.clone(), TransmitState::Nothing);
        pair.run();

        let outputs = pair.take(0);
        let [PeerProtocolOutput::Resolve { reply_as: 10, result: Err(why) }] = &outputs[..] else {
            panic!("{outputs:?}");
        };
        match reply {
            Ok(_) => assert!(matches!(why, DeliveryError::OutcomeUnknown { .. }), "{why}"),
            Err(error) => assert_eq!(*why, error),
        }
    }
}

mod access;

#[test]
fn however_many_nodes_were_met_a_further_one_has_a_session() {
    let mut protocol = PeerProtocol::new(node("base"), Incarnation(1), IDLE_TIMEOUT);
    for number in 0..2 * PEERS_MAX {
        let met = node(&format!("n{number}"));
        if let Some(gone) = protocol.expendable(&met) {
            protocol.forget(gone);
        }
        let id = protocol.meet(&met, 0, at(0));
        assert!(protocol.peers.get(id).is_some_and(|peer| peer.node == met));
    }
    assert_eq!(protocol.peers.ids().len(), PEERS_MAX);
}

#[test]
fn a_peer_whose_session_is_open_makes_way_for_no_other() {
    let mut protocol = PeerProtocol::new(node("base"), Incarnation(1), IDLE_TIMEOUT);
    for number in 0..PEERS_MAX {
        let id = protocol.meet(&node(&format!("n{number}")), 0, at(0));
        protocol.handle_opened(id, Incarnation(1), 1, at(0));
    }
    let (first, new) = (protocol.peers.ids()[0], node("new"));
    assert_eq!(protocol.expendable(&new), None);
    protocol.handle_ended(first, &DeliveryError::Stopped);
    assert_eq!(protocol.expendable(&new), Some(first));
}
