//! Bytes from outside: garbage, and messages that were true once and were changed on the way.
//! Nothing panics, everything is counted, and nothing grows without bound.

use blastema_core::net::OrderingKey;
use blastema_core::net::link::LinkConfig;
use blastema_core::net::peer_protocol::{PeerProtocolOutput, TopicContract};
use blastema_core::net::routing::{LinkHealth, LinkStatus};
use blastema_core::net::session::{IDLE_TIMEOUT, VERSION};
use blastema_core::net::trust::access::AccessPolicy;
use blastema_core::net::trust::crypto::Seed;
use blastema_core::net::trust::policy::Role;
use blastema_core::net::trust::roster::{NodeRoster, RosterNode};
use blastema_core::net::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, RoutingMessage,
};
use blastema_core::net::wire::frame::{Echo, Frame, Hello};
use blastema_core::net::wire::hello_state::HelloState;
use blastema_core::net::wire::message::PeerMessage;
use blastema_core::net::wire::packet::{Packet, Payload};
use blastema_core::net::wire::segment::{
    Ack, Data, Datagram, DelayTicks, Fragment, OpenSegment, Segment,
};
use blastema_core::net::{
    Link, LinkId, Neighbour, NodeId, PacketPriority, PeerProtocol, Router, RouterConfig, Session,
    SessionConfig, SessionOutput,
};
use blastema_core::{
    ContractIdentity, DeliveryError, Incarnation, Instant, Machine, NodeName, ObjectName,
    TrafficClass,
};
use blastema_macros::Event;
use bytes::Bytes;
use proptest::collection::vec;
use proptest::prelude::*;
use std::collections::BTreeSet;

/// What peers send and listen to.
#[derive(Clone, Event)]
#[contract(name = "note", crate = "crate::facade")]
struct Note(u8);

fn name(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn drain<M: Machine>(machine: &mut M) -> Vec<M::Output> {
    std::iter::from_fn(|| machine.poll_output()).collect()
}

/// Whole messages of every layer, as a peer might send them.
fn genuine() -> Vec<Bytes> {
    let hello = Hello {
        node: name("peer"),
        incarnation: Incarnation(1),
        sequence: 7,
        interval_us: 10_000,
        skipped: 0,
        state: HelloState::Ready,
        loss_permille: 3,
        echo: Some(Echo { incarnation: Incarnation(1), sequence: 1, held_us: 5 }),
    };
    let advertisement_id = AdvertisementId { origin: NodeId::of(&name("peer")), sequence: 2 };
    let edges = vec![Edge { to: NodeId::of(&name("own")), incarnation: 1, cost: 1, mtu: 1400 }];
    let announce = RoutingMessage::Announce(vec![Advertisement {
        id: advertisement_id,
        incarnation: Incarnation(1),
        node: name("peer"),
        edges,
        signature: Some([9; 64]),
    }]);
    let range = Some((NodeId(0), NodeId(u32::MAX)));
    let have = RoutingMessage::Have { range, ids: vec![advertisement_id] };
    let ack = Ack { next: 0, window: 100, arrived: DelayTicks::default(), ranges: vec![(2, 3)] };
    let payload = Bytes::from_static(b"\x05hello");
    let data = Data {
        tag: 1,
        stream: TrafficClass::Request,
        sequence: 0,
        first: true,
        last: true,
        again: false,
        piece: Some(Fragment { index: 0, count: 2 }),
        ack: Some(ack.clone()),
        payload: payload.clone().into(),
    };
    let open = OpenSegment {
        version: VERSION,
        tag: 9,
        echo: 0,
        incarnation: Incarnation(1),
        number: 1,
        before: None,
    };
    let segment = Segment::Data(data).encode();
    let packet = Packet {
        class: PacketPriority::Data,
        hops: 3,
        destination: NodeId::of(&name("own")),
        source: NodeId::of(&name("peer")),
        passed: vec![],
        payload: Payload::Segment(segment.clone().into()),
    };
    let passed = Packet { passed: vec![NodeId(3), NodeId(4)], ..packet.clone() };
    let names = PeerMessage::Announced { timestamp_us: 0 };
    let datagram = Datagram {
        tag: 1,
        channel: 1,
        sequence: 1,
        number: None,
        piece: None,
        payload: payload.clone().into(),
    };
    vec![
        Frame::Hello(hello).encode(),
        Frame::Data(packet.encode().into()).encode(),
        Frame::Routing(announce.encode()).encode(),
        announce.encode(),
        have.encode(),
        packet.encode(),
        passed.encode(),
        Frame::Data(passed.encode().into()).encode(),
        segment,
        Segment::Open(open).encode(),
        Segment::Datagram(datagram).encode(),
        Segment::Acknowledge {
            tag: 1,
            streams: [None, None, None, Some(ack), None, None],
            datagrams: None,
        }
        .encode(),
        Segment::Reset { tag: 1 }.encode(),
        PeerMessage::Request {
            binding: 1,
            call: 1,
            timestamp: 1,
            within: 9,
            id: None,
            payload: payload.clone().into(),
        }
        .encode()
        .into_bytes(),
        PeerMessage::Event { subscription: 1, timestamp_us: 5, payload: payload.into() }
            .encode()
            .into_bytes(),
        names.encode().into_bytes(),
    ]
}

/// What a peer sends to whom it asks, tells and listens to.
fn genuine_of_peer() -> Vec<Bytes> {
    let identity = ContractIdentity::of::<Note>().full().encode();
    let object = ObjectName::new("arm").unwrap();
    let payload = Bytes::from_static(b"\x05hello");
    let (topic, identities) = ("news".to_owned(), vec![identity.clone()]);
    let messages = [
        PeerMessage::Bind { binding: 1, object, identity: identity.clone() },
        PeerMessage::Tell {
            binding: 1,
            timestamp_us: 1,
            id: None,
            payload: payload.clone().into(),
        },
        PeerMessage::TellRefused { binding: 1, why: DeliveryError::Stopped },
        PeerMessage::Subscribe { subscription: 1, topic, identities },
        PeerMessage::SubscribeRefused { subscription: 1, why: DeliveryError::Stopped },
        PeerMessage::SubscribeAgain { subscription: 1 },
        PeerMessage::Unsubscribe { subscription: 1 },
        PeerMessage::Event { subscription: 1, timestamp_us: 1, payload: payload.into() },
    ];
    messages.into_iter().map(|message| message.encode().into_bytes()).collect()
}

/// The rights at `own`: `peer` may ask there, and listen to all but news; nothing else.
fn policy() -> AccessPolicy {
    let listed = ["own", "peer", "other"].into_iter().zip(1..).map(|(node, seed)| RosterNode {
        name: name(node),
        keys: Seed::new([seed; 32]).public_keys(),
        role: Role::Node,
    });
    let roster = NodeRoster::new(name("robot"), listed).unwrap();
    let lines =
        ["policy", "only other may tell publish on **", "only other may listen on news", "end"];
    let text = roster.to_text().replace("end", &lines.join("\n"));
    AccessPolicy::new(name("own"), &NodeRoster::parse(&text).unwrap())
}

/// Garbage, or something genuine with a few bytes changed and its end cut off or doubled.
fn hostile() -> impl Strategy<Value = Bytes> {
    changed_of([genuine(), genuine_of_peer()].concat())
}

fn changed_of(genuine: Vec<Bytes>) -> impl Strategy<Value = Bytes> {
    let changed = (0..genuine.len(), vec((any::<usize>(), any::<u8>()), 0..4), 0..4usize);
    let changed = changed.prop_map(move |(which, changes, end)| {
        let mut bytes = genuine[which].to_vec();
        for (at, byte) in changes {
            let at = at % bytes.len();
            bytes[at] = byte;
        }
        match end {
            0 => bytes.truncate(bytes.len() / 2),
            1 => bytes.extend_from_within(..),
            _ => {}
        }
        Bytes::from(bytes)
    });
    prop_oneof![vec(any::<u8>(), 0..200).prop_map(Bytes::from), changed]
}

fn news() -> TopicContract {
    TopicContract { topic: "news".to_owned(), contract: "note".to_owned() }
}

fn link() -> Link {
    let config = LinkConfig::new(name("own"), Incarnation(1));
    Link::new(config, Instant::from_millis(1000))
}

fn router() -> Router {
    let config = RouterConfig { nodes_max: 8, ..RouterConfig::new(name("own"), Incarnation(1)) };
    let mut router = Router::new(config, Instant::ORIGIN);
    let neighbour = Neighbour { node: name("peer"), incarnation: Incarnation(1) };
    let status = LinkStatus { neighbour, health: LinkHealth::Up, cost: 1, mtu: 1400 };
    router.handle_link(LinkId(0), status, Instant::ORIGIN);
    router
}

/// A protocol that has met a peer.
fn exchange() -> (PeerProtocol, NodeId) {
    let mut exchange = PeerProtocol::new(name("own"), Incarnation(1), IDLE_TIMEOUT);
    let peer = exchange.meet(&name("peer"), 0, Instant::ORIGIN);
    (exchange, peer)
}

/// A session that is open, and its own tag.
fn session() -> (Session, u32) {
    let config = SessionConfig {
        channels_max: 4,
        message_max: 1000,
        ..SessionConfig::new(name("own"), Incarnation(1), name("peer"))
    };
    let mut session = Session::new(config, Instant::ORIGIN);
    session.handle_path(1400, Instant::ORIGIN);
    let outputs = drain(&mut session);
    let [SessionOutput::Transmit { segment, .. }] = &outputs[..] else { panic!("{outputs:?}") };
    let Ok(Segment::Open(OpenSegment { tag, .. })) = Segment::decode(segment.clone().into_bytes())
    else {
        panic!("it says who it is first");
    };
    let answer = OpenSegment {
        version: VERSION,
        tag: 9,
        echo: tag,
        incarnation: Incarnation(1),
        number: 1,
        before: None,
    };
    session.handle_segment(Segment::Open(answer).encode(), Instant::ORIGIN);
    assert_eq!(session.peer(), Some(Incarnation(1)));
    (session, tag)
}

proptest! {
    #[test]
    fn no_bytes_panic_a_decoder_and_what_is_understood_comes_back_the_same(bytes in hostile()) {
        if let Ok(frame) = Frame::decode(bytes.clone()) {
            prop_assert_eq!(Frame::decode(frame.encode()), Ok(frame));
        }
        if let Ok(packet) = Packet::decode(bytes.clone()) {
            prop_assert_eq!(Packet::decode(packet.encode()), Ok(packet));
        }
        if let Ok(routing) = RoutingMessage::decode(bytes.clone()) {
            prop_assert_eq!(RoutingMessage::decode(routing.encode()), Ok(routing));
        }
        if let Ok(segment) = Segment::decode(bytes.clone()) {
            prop_assert_eq!(Segment::decode(segment.encode()), Ok(segment));
        }
        if let Ok(message) = PeerMessage::decode(bytes) {
            prop_assert_eq!(PeerMessage::decode(message.encode().into_bytes()), Ok(message));
        }
    }

    #[test]
    fn no_frames_panic_a_link(frames in vec(hostile(), 0..30)) {
        let mut link = link();
        for (n, frame) in frames.into_iter().enumerate() {
            let now = Instant::from_millis(1000 + n as u64);
            link.handle_frame(frame, now);
            link.handle_timeout(now);
            prop_assert!(drain(&mut link).len() <= 4);
        }
    }

    #[test]
    fn no_frames_panic_a_router_or_make_it_know_too_many(frames in vec(hostile(), 0..30)) {
        let mut router = router();
        for (n, frame) in frames.into_iter().enumerate() {
            let now = Instant::from_millis(n as u64);
            router.handle_routing(LinkId(0), frame.clone(), now);
            router.handle_packet(LinkId(0), frame, now);
            router.handle_timeout(now);
            drain(&mut router);
        }
        prop_assert!(router.routes().count() <= 9);
    }

    #[test]
    fn no_segments_panic_a_session(segments in vec(hostile(), 0..30), known in any::<bool>()) {
        let (mut session, tag) = session();
        for (n, segment) in segments.into_iter().enumerate() {
            let now = Instant::from_millis(n as u64);
            let mut segment = segment.to_vec();
            // As if an attacker, or an error, knew the session's tag.
            if known && segment.len() >= 5 {
                segment[1..5].copy_from_slice(&tag.to_be_bytes());
            }
            session.handle_segment(segment.into(), now);
            session.handle_timeout(now);
            for output in drain(&mut session) {
                if let SessionOutput::Message { message, .. } = output {
                    prop_assert!(message.len() <= 1000);
                }
            }
        }
    }

    #[test]
    fn no_messages_panic_an_exchange(messages in vec(hostile(), 0..30)) {
        let (mut exchange, peer) = exchange();
        exchange.handle_opened(peer, Incarnation(1), 1, Instant::ORIGIN);
        for message in messages {
            exchange.handle_message(peer, message, Instant::ORIGIN);
            while let Some(output) = exchange.poll_output() {
                let answers = matches!(output, PeerProtocolOutput::Resolve { .. });
                prop_assert!(!answers, "nothing was asked");
            }
        }
    }
}

proptest! {
    #[test]
    fn no_messages_get_around_the_policy(
        messages in vec(changed_of(genuine_of_peer()), 0..60),
        late in 0..3usize,
    ) {
        let (mut exchange, peer) = exchange();
        exchange.handle_interest(news(), vec![ContractIdentity::of::<Note>()]);
        exchange.handle_opened(peer, Incarnation(1), 1, Instant::ORIGIN);
        let mut bound = BTreeSet::new();
        for (n, message) in messages.into_iter().enumerate() {
            // At once, or while the session goes on.
            if n == late {
                exchange.handle_access(policy());
            }
            exchange.handle_message(peer, message, Instant::ORIGIN);
            while let Some(output) = exchange.poll_output() {
                match output {
                    PeerProtocolOutput::Bind { peer, epoch, binding, .. } => {
                        bound.insert(binding);
                        exchange.handle_bound(peer, epoch, binding, Ok(()));
                    }
                    output if n < late => drop(output),
                    PeerProtocolOutput::Serve { binding, call, .. } => {
                        let was_told = bound.contains(&binding) && call.is_none();
                        prop_assert!(!was_told, "it may not tell");
                    }
                    PeerProtocolOutput::Subscribe { topic, .. } => {
                        prop_assert!(topic.topic != "news", "it may not listen");
                    }
                    PeerProtocolOutput::Event { .. } => prop_assert!(false, "it may not publish"),
                    _ => {}
                }
            }
        }
    }
}

#[test]
fn a_flood_of_invented_nodes_is_refused_beyond_the_limit() {
    let mut router = router();
    for n in 0..1000 {
        let node = name(&format!("n{n}"));
        let advertisement_id = AdvertisementId { origin: NodeId::of(&node), sequence: 1 };
        let edges =
            vec![Edge { to: NodeId::of(&name("peer")), incarnation: 1, cost: 1, mtu: 1400 }];
        let announce = RoutingMessage::Announce(vec![Advertisement {
            id: advertisement_id,
            incarnation: Incarnation(1),
            node,
            edges,
            signature: None,
        }]);
        router.handle_routing(LinkId(0), announce.encode(), Instant::ORIGIN);
        router.handle_timeout(Instant::ORIGIN);
        drain(&mut router);
    }
    assert_eq!(router.refusals().too_large, 992);
    router.handle_timeout(Instant::from_millis(10));
    // None of them is used: no other node advertises a link to them.
    assert_eq!(router.routes().count(), 1);
}

#[test]
fn a_peer_that_never_finishes_a_message_costs_no_more_than_its_bound() {
    let (mut session, tag) = session();
    for n in 0..100_000u64 {
        let datagram = Datagram {
            tag,
            channel: 1,
            sequence: n + 1,
            number: None,
            piece: Some(Fragment { index: 0, count: 2 }),
            payload: Bytes::from_static(&[0; 100]).into(),
        };
        session.handle_segment(Segment::Datagram(datagram).encode(), Instant::ORIGIN);
    }
    assert!(session.counters().incomplete > 99_900, "{:?}", session.counters());
}

#[test]
fn an_acknowledgement_of_what_was_never_sent_is_refused_and_an_absurd_window_bounded() {
    let (mut session, tag) = session();
    let ack = Ack { next: 5, window: u32::MAX, arrived: DelayTicks::default(), ranges: vec![] };
    let lie = Segment::Acknowledge {
        tag,
        streams: [None, None, None, Some(ack), None, None],
        datagrams: None,
    };
    session.handle_segment(lie.encode(), Instant::ORIGIN);
    assert_eq!(session.refusals().malformed, 1);

    let ack = Ack { next: 0, window: u32::MAX, arrived: DelayTicks::default(), ranges: vec![] };
    let greedy = Segment::Acknowledge {
        tag,
        streams: [None, None, None, Some(ack), None, None],
        datagrams: None,
    };
    session.handle_segment(greedy.encode(), Instant::ORIGIN);
    for _ in 0..8000 {
        let (key, bytes) = (OrderingKey::default(), Bytes::from_static(&[0; 1000]));
        let stream = TrafficClass::Request;
        let _ = session.handle_send_along(stream, key, bytes, None, Instant::ORIGIN);
    }
    // No more than the congestion window is on its way.
    assert!(drain(&mut session).len() <= 64);
}

#[test]
fn a_message_longer_than_its_limit_ends_the_session_that_announces_it() {
    let (mut session, tag) = session();
    let data = Data {
        tag,
        stream: TrafficClass::Request,
        sequence: 0,
        first: true,
        last: false,
        again: false,
        piece: None,
        ack: None,
        payload: Bytes::from_static(b"\xff\xff\xff\x7f").into(),
    };
    session.handle_segment(Segment::Data(data).encode(), Instant::ORIGIN);
    assert_eq!(session.peer(), None);
    assert_eq!(session.refusals().too_large, 1);
}
