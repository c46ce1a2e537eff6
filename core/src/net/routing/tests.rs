//! A router among neighbours that the test speaks for.

mod copies;
mod mesh;
mod names;
mod network;
mod restarts;
mod sealed;

use super::*;
use crate::net::link::Neighbour;
use crate::net::wire::advertisement::Edge;
use crate::net::wire::packet::{Packet, PacketPriority, Payload, UndeliveredReason};
use crate::testing::{at, node as named};

const FIRST: LinkId = LinkId(0);
const SECOND: LinkId = LinkId(1);

fn id(name: &str) -> NodeId {
    NodeId::of(&named(name))
}

/// The test sends in place of the neighbours.
fn router() -> Router {
    Router::new(RouterConfig::new(named("own"), Incarnation(1)), at(1000))
}

fn up(neighbour: &str, cost: u16) -> LinkStatus {
    let neighbour = Neighbour { node: named(neighbour), incarnation: Incarnation(1) };
    LinkStatus { neighbour, health: LinkHealth::Up, cost, mtu: 1400 }
}

/// The n-th of the first incarnation.
fn advertisement(node: &str, n: u64, edges: &[(&str, u16)]) -> Advertisement {
    let sequence = AdvertisementId::first_sequence(Incarnation(1)) + n;
    let (incarnation, mtu) = (1, 1400);
    let edge = |&(to, cost): &(&str, u16)| Edge { to: id(to), incarnation, cost, mtu };
    Advertisement {
        id: AdvertisementId { origin: id(node), sequence },
        incarnation: Incarnation(1),
        node: named(node),
        edges: edges.iter().map(edge).collect(),
        signature: None,
    }
}

/// The same, as a later incarnation says it first.
fn of_incarnation(incarnation: u64, mut advertisement: Advertisement) -> Advertisement {
    advertisement.incarnation = Incarnation(incarnation);
    advertisement.id.sequence = AdvertisementId::first_sequence(Incarnation(incarnation)) + 1;
    advertisement
}

/// The same, of a node that is linked to that incarnation of another.
fn linked_to(incarnation: u8, to: &str, mut linked: Advertisement) -> Advertisement {
    for edge in linked.edges.iter_mut().filter(|edge| edge.to == id(to)) {
        edge.incarnation = incarnation;
    }
    linked
}

fn tell(router: &mut Router, link: LinkId, reported: Advertisement, now: u64) {
    router.handle_routing(link, RoutingMessage::Announce(vec![reported]).encode(), at(now));
}

fn outputs(router: &mut Router, now: u64) -> Vec<RouterOutput> {
    router.handle_timeout(at(now));
    std::iter::from_fn(|| router.poll_output()).collect()
}

fn without_routing(outputs: Vec<RouterOutput>) -> Vec<RouterOutput> {
    outputs.into_iter().filter(|o| !matches!(o, RouterOutput::Routing { .. })).collect()
}

fn announced(outputs: &[RouterOutput], link: LinkId) -> Vec<Advertisement> {
    let bytes = outputs.iter().filter_map(|output| match output {
        RouterOutput::Routing { link: on, bytes } if *on == link => Some(bytes.clone()),
        _ => None,
    });
    bytes
        .filter_map(|bytes| match RoutingMessage::decode(bytes) {
            Ok(RoutingMessage::Announce(reported)) => Some(reported),
            _ => None,
        })
        .flatten()
        .collect()
}

/// Two ways to `far`, over `left` and over `right`; `left` is cheaper.
fn between_two() -> Router {
    let mut router = router();
    router.handle_link(FIRST, up("left", 1), at(1000));
    router.handle_link(SECOND, up("right", 5), at(1000));
    tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1), ("far", 1)]), 1000);
    tell(&mut router, SECOND, advertisement("right", 1, &[("own", 5), ("far", 1)]), 1000);
    tell(&mut router, FIRST, advertisement("far", 1, &[("left", 1), ("right", 1)]), 1000);
    let reached = without_routing(outputs(&mut router, 1010));
    assert_eq!(reached.len(), 3, "{reached:?}");
    router
}

fn packet_to(destination: &str, hops: u8) -> Packet {
    let payload = Payload::Segment(Bytes::from_static(b"segment").into());
    let (destination, source) = (id(destination), id("source"));
    Packet { class: PacketPriority::Data, hops, destination, source, passed: Vec::new(), payload }
}

fn over(output: Option<RouterOutput>) -> Option<LinkId> {
    match output {
        Some(RouterOutput::Packet { link, .. }) => Some(link),
        _ => None,
    }
}

#[test]
fn the_alternate_is_known_ahead_and_taken_without_any_computation() {
    let mut router = between_two();
    let route = router.route(id("far")).unwrap();
    assert_eq!((route.next, route.alternate, route.cost), (FIRST, Some(SECOND), 2));
    let segment = || Bytes::from_static(b"segment");
    router.handle_segment(id("far"), PacketPriority::Data, segment().into());
    assert_eq!(over(router.poll_output()), Some(FIRST));

    let suspect = LinkStatus { health: LinkHealth::Suspect, ..up("left", 1) };
    router.handle_link(FIRST, suspect, at(1020));

    let changed = RouterOutput::PathChanged { node: id("far"), mtu: 1376 };
    let reported: Vec<_> = std::iter::from_fn(|| router.poll_output()).collect();
    assert!(reported.contains(&changed), "{reported:?}");
    router.handle_segment(id("far"), PacketPriority::Data, segment().into());
    assert_eq!(over(router.poll_output()), Some(SECOND));
}

#[test]
fn of_two_ways_that_are_not_well_the_better_one_is_taken() {
    let mut router = between_two();
    let mut chosen = |left, right| {
        router.handle_link(FIRST, LinkStatus { health: left, ..up("left", 1) }, at(1020));
        router.handle_link(SECOND, LinkStatus { health: right, ..up("right", 5) }, at(1020));
        router.route(id("far")).unwrap().chosen
    };

    assert_eq!(chosen(LinkHealth::Suspect, LinkHealth::Proving), Some(SECOND));
    assert_eq!(chosen(LinkHealth::Proving, LinkHealth::Suspect), Some(FIRST));
    assert_eq!(chosen(LinkHealth::Proving, LinkHealth::Up), Some(SECOND));
    assert_eq!(chosen(LinkHealth::Suspect, LinkHealth::Suspect), Some(FIRST));
}

#[test]
fn a_way_that_would_lead_back_is_no_alternate() {
    let mut router = router();
    router.handle_link(FIRST, up("left", 1), at(1000));
    router.handle_link(SECOND, up("right", 1), at(1000));
    // What `right` sends to `left` it sends through us.
    tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1)]), 1000);
    tell(&mut router, SECOND, advertisement("right", 1, &[("own", 1)]), 1000);
    outputs(&mut router, 1010);

    assert_eq!(router.route(id("left")).unwrap().alternate, None);
}

#[test]
fn an_edge_counts_only_if_both_ends_announce_it() {
    let mut router = router();
    router.handle_link(FIRST, up("left", 1), at(1000));
    tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1), ("far", 1)]), 1000);
    tell(&mut router, FIRST, advertisement("far", 1, &[]), 1000);
    outputs(&mut router, 1010);
    assert!(router.route(id("far")).is_none());

    tell(&mut router, FIRST, advertisement("far", 2, &[("left", 1)]), 1020);
    let reported = without_routing(outputs(&mut router, 1030));

    assert!(
        matches!(&reported[..], [RouterOutput::Reachable { node, .. }] if *node == named("far"))
    );
}

#[test]
fn who_boasts_of_a_cheap_link_draws_no_traffic_unless_its_other_end_says_so_too() {
    let mut router = between_two();
    // By `left`, `far` costs 1 and 50, whatever `left` says: `right` is nearer with 5 and 1.
    tell(&mut router, FIRST, advertisement("left", 2, &[("own", 1), ("far", 1)]), 1020);
    tell(&mut router, FIRST, advertisement("far", 2, &[("left", 50), ("right", 1)]), 1020);
    outputs(&mut router, 1030);
    let route = router.route(id("far")).unwrap();
    assert_eq!((route.next, route.cost), (SECOND, 6));

    // That it has links to others, none of them confirms.
    let boast = [("own", 1), ("far", 1), ("right", 1), ("nowhere", 1)];
    tell(&mut router, FIRST, advertisement("left", 3, &boast), 1040);
    outputs(&mut router, 1050);
    assert_eq!(router.route(id("right")).unwrap().next, SECOND);
    assert!(router.route(id("nowhere")).is_none());
}

#[test]
fn a_link_that_is_said_to_carry_next_to_nothing_is_no_way() {
    let mut router = between_two();
    let mut narrow = advertisement("far", 2, &[("left", 1), ("right", 1)]);
    narrow.edges[0].mtu = 1;

    tell(&mut router, FIRST, narrow, 1020);
    outputs(&mut router, 1030);

    let route = router.route(id("far")).unwrap();
    assert_eq!((route.next, route.mtu), (SECOND, 1400));
}

#[test]
fn what_somebody_says_in_our_name_is_outdone() {
    let mut router = between_two();

    tell(&mut router, FIRST, advertisement("own", 700, &[("nowhere", 1)]), 1020);

    let reported = announced(&outputs(&mut router, 1020), SECOND);
    let own = reported.iter().find(|reported| reported.id.origin == id("own")).unwrap();
    let newer = advertisement("own", 701, &[]).id;
    assert_eq!((own.id, own.edges.len()), (newer, 2));
}

#[test]
fn a_way_that_became_dearer_further_on_is_told_so_that_what_was_lost_there_is_repeated() {
    let mut router = between_two();
    router.handle_link(SECOND, LinkStatus { health: LinkHealth::Down, ..up("right", 5) }, at(1020));
    without_routing(outputs(&mut router, 1020));

    tell(&mut router, FIRST, advertisement("left", 2, &[("own", 1), ("far", 9)]), 1040);

    let changed = RouterOutput::PathChanged { node: id("far"), mtu: 1376 };
    assert!(outputs(&mut router, 1050).contains(&changed));
}

#[test]
fn a_packet_is_passed_on_with_one_hop_less_and_never_back() {
    let mut router = between_two();

    router.handle_packet(SECOND, packet_to("far", 3).encode(), at(1020));
    let Some(RouterOutput::Packet { link: FIRST, packet }) = router.poll_output() else {
        panic!("it goes on over the cheaper way");
    };
    assert_eq!(Packet::decode(packet.into_bytes()).unwrap().hops, 2);

    router.handle_packet(FIRST, packet_to("far", 3).encode(), at(1020));
    assert_eq!(over(router.poll_output()), Some(SECOND), "never back to where it came from");
}

#[test]
fn a_packet_goes_to_nobody_who_has_had_it_and_over_no_node_twice() {
    let mut router = between_two();
    let passed = |by: &[&str]| {
        let passed = by.iter().map(|relay| id(relay)).collect();
        Packet { passed, source: id("other"), ..packet_to("far", 3) }.encode()
    };

    // Left is nearer, but its own next hop sends the packet back to this node.
    router.handle_packet(SECOND, passed(&["left", "third"]), at(1020));
    assert_eq!(over(router.poll_output()), None, "both ways have had it");

    router.handle_packet(FIRST, passed(&["third"]), at(1020));
    let Some(RouterOutput::Packet { link: SECOND, packet }) = router.poll_output() else {
        panic!("it goes on");
    };
    let packet = Packet::decode(packet.into_bytes()).unwrap();
    assert_eq!(packet.passed, [id("third"), id("own")]);

    router.handle_packet(SECOND, passed(&["own", "third"]), at(1020));
    assert_eq!(over(router.poll_output()), None, "it was here before");
}

#[test]
fn what_cannot_be_delivered_comes_back_with_the_reason() {
    let mut router = between_two();
    // The source is the node called right.
    let from_right = |destination, hops| {
        let packet = Packet { source: id("right"), ..packet_to(destination, hops) };
        packet.encode()
    };
    let check = |router: &mut Router, expected| {
        let Some(RouterOutput::Packet { packet, .. }) = router.poll_output() else {
            panic!("nothing came back");
        };
        let Ok(Packet { destination, payload: Payload::Return { reason, .. }, .. }) =
            Packet::decode(packet.into_bytes())
        else {
            panic!("it is no return");
        };
        assert_eq!((destination, reason), (id("right"), expected));
    };

    router.handle_packet(SECOND, from_right("nowhere", 5), at(1020));
    check(&mut router, UndeliveredReason::NoRoute);
    router.handle_packet(SECOND, from_right("far", 0), at(1020));
    check(&mut router, UndeliveredReason::TooManyHops);
    router.handle_segment(id("nowhere"), PacketPriority::Data, Bytes::new().into());
    let (destination, reason) = (id("nowhere"), UndeliveredReason::NoRoute);
    let undelivered = RouterOutput::Undelivered { destination, reason };
    assert_eq!(router.poll_output(), Some(undelivered));
    router.handle_segment(id("far"), PacketPriority::Data, Bytes::from(vec![0; 1400]).into());
    let (destination, reason) = (id("far"), UndeliveredReason::TooLarge);
    let undelivered = RouterOutput::Undelivered { destination, reason };
    assert_eq!(router.poll_output(), Some(undelivered));
    // A return that cannot be delivered is not returned again.
    let payload = Payload::Return { destination: id("far"), reason: UndeliveredReason::NoRoute };
    let returned = Packet { payload, ..packet_to("nowhere", 3) };
    router.handle_packet(SECOND, returned.encode(), at(1020));
    assert_eq!(router.poll_output(), None);
}

#[test]
fn news_is_passed_on_at_once_and_repeated_until_confirmed() {
    let mut router = between_two();
    let news = advertisement("far", 2, &[("left", 1)]);

    tell(&mut router, FIRST, news.clone(), 1020);
    assert_eq!(announced(&outputs(&mut router, 1020), SECOND), vec![news.clone()]);
    let again = outputs(&mut router, 1065);
    assert!(announced(&again, SECOND).contains(&news));

    let ids = vec![news.id];
    let confirm = RoutingMessage::Have { range: None, ids };
    router.handle_routing(SECOND, confirm.encode(), at(1070));
    let later = outputs(&mut router, 1200);
    assert!(!announced(&later, SECOND).contains(&news));
}

#[test]
fn old_news_is_answered_with_newer_news() {
    let mut router = between_two();
    tell(&mut router, FIRST, advertisement("far", 5, &[("left", 1)]), 1020);
    outputs(&mut router, 1030);

    tell(&mut router, SECOND, advertisement("far", 4, &[]), 1040);

    let answer = announced(&outputs(&mut router, 1040), SECOND);
    let far = answer.iter().find(|reported| reported.id.origin == id("far")).unwrap();
    assert_eq!(far.id, advertisement("far", 5, &[]).id);
    assert!(router.refusals().stale >= 1);
}

#[test]
fn what_a_neighbour_lacks_is_seen_in_its_list_and_sent() {
    let mut router = between_two();
    outputs(&mut router, 1030);

    let range = Some((NodeId(0), NodeId(u32::MAX)));
    let nothing = RoutingMessage::Have { range, ids: vec![] };
    router.handle_routing(SECOND, nothing.encode(), at(1031));

    let sent = announced(&outputs(&mut router, 1031), SECOND);
    let mut origins: Vec<_> = sent.iter().map(|reported| reported.node.as_str()).collect();
    origins.sort();
    assert_eq!(origins, ["far", "left", "own", "right"]);
}

#[test]
fn a_node_that_nobody_repeats_is_forgotten() {
    let mut router = between_two();
    for now in (2000..60_000).step_by(1000) {
        let sequence = now;
        let left = advertisement("left", sequence, &[("own", 1), ("far", 1)]);
        let right = advertisement("right", sequence, &[("own", 5), ("far", 1)]);
        tell(&mut router, FIRST, left, now);
        tell(&mut router, SECOND, right, now);
        outputs(&mut router, now);
    }
    assert!(router.route(id("far")).is_none());
    assert!(router.route(id("left")).is_some());
}

#[test]
fn over_a_narrow_medium_news_is_repeated_ten_times_as_rarely() {
    let reported_after = |mtu, within: u64| {
        let mut router = router();
        router.handle_link(FIRST, LinkStatus { mtu, ..up("left", 1) }, at(1000));
        let count = |now| announced(&outputs(&mut router, now), FIRST).len();
        let counts: Vec<_> = (1000..1000 + within).map(count).collect();
        let times = counts.iter().enumerate().filter(|(_, count)| **count > 0);
        times.map(|(after, count)| (after, *count)).collect::<Vec<_>>()
    };

    let fast = [0, 40, 120, 280, 600, 920].map(|after| (after, 1));
    assert_eq!(reported_after(1400, 999), fast);
    let narrow = fast.map(|(after, count)| (10 * after, count));
    assert_eq!(reported_after(MTU_MIN, 9_990), narrow);
}

#[test]
fn a_link_that_cannot_carry_an_advertisement_is_not_used() {
    let mut router = router();
    let narrow = LinkStatus { mtu: MTU_MIN - 1, ..up("left", 1) };

    router.handle_link(FIRST, narrow, at(1000));

    assert_eq!(outputs(&mut router, 1010), []);
}

#[test]
fn nothing_goes_to_an_isolated_node_comes_from_it_or_leads_over_it_until_it_is_admitted() {
    let mut router = between_two();
    let segment = || Bytes::from_static(b"segment");
    let packet = |source: &str, to: &str| Packet { source: id(source), ..packet_to(to, 3) };

    router.handle_isolation(&named("left"), true, at(1020));
    let reported = outputs(&mut router, 1030);

    let own = |link| announced(&reported, link).into_iter().find(|own| own.node == named("own"));
    let told = own(SECOND).expect("the others are told");
    assert_eq!(told.edges.iter().map(|edge| edge.to).collect::<Vec<_>>(), [id("right")]);
    assert_eq!(own(FIRST), None);
    let (node, incarnation) = (named("left"), Incarnation(1));
    assert!(reported.contains(&RouterOutput::Lost { node, incarnation }));
    // The ways go around it.
    assert_eq!(router.route(id("far")).unwrap().next, SECOND);
    router.handle_segment(id("left"), PacketPriority::Data, segment().into());
    assert!(matches!(router.poll_output(), Some(RouterOutput::Undelivered { .. })));
    // Whatever comes by its link is refused, and what it has sent by others' links too.
    let refused = router.refusals().isolated;
    router.handle_packet(FIRST, packet("left", "far").encode(), at(1040));
    router.handle_packet(FIRST, packet("third", "own").encode(), at(1040));
    router.handle_packet(SECOND, packet("left", "own").encode(), at(1040));
    tell(&mut router, FIRST, advertisement("left", 9, &[("own", 1), ("far", 1)]), 1040);
    assert_eq!(router.refusals().isolated - refused, 4);
    assert_eq!(without_routing(outputs(&mut router, 1045)), []);
    // That its link is still well, or comes back, changes nothing.
    router.handle_link(FIRST, LinkStatus { health: LinkHealth::Down, ..up("left", 1) }, at(1050));
    router.handle_link(FIRST, up("left", 1), at(1060));
    assert_eq!(without_routing(outputs(&mut router, 1070)), []);

    router.handle_isolation(&named("left"), false, at(1080));

    let reported = outputs(&mut router, 1090);
    let back = |output: &RouterOutput| matches!(output, RouterOutput::Reachable { node, .. } if *node == named("left"));
    assert!(reported.iter().any(back), "{reported:?}");
    assert_eq!(router.route(id("far")).unwrap().next, FIRST);
}

#[test]
fn no_way_leads_over_a_far_node_that_is_isolated() {
    let mut router = router();
    router.handle_link(FIRST, up("left", 1), at(1000));
    tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1), ("middle", 1)]), 1000);
    tell(&mut router, FIRST, advertisement("middle", 1, &[("left", 1), ("far", 1)]), 1000);
    tell(&mut router, FIRST, advertisement("far", 1, &[("middle", 1)]), 1000);
    outputs(&mut router, 1010);
    assert!(router.route(id("far")).is_some());

    router.handle_isolation(&named("middle"), true, at(1020));
    outputs(&mut router, 1030);
    assert!(router.route(id("far")).is_none() && router.route(id("middle")).is_none());

    router.handle_isolation(&named("middle"), false, at(1040));
    outputs(&mut router, 1050);
    assert!(router.route(id("far")).is_some());
}

#[test]
fn of_two_announcements_with_one_number_everybody_takes_the_same() {
    let (one, other) = ([("left", 1), ("right", 1)], [("left", 1), ("right", 9)]);
    for (first, second) in [(one, other), (other, one)] {
        let mut router = between_two();
        tell(&mut router, FIRST, advertisement("far", 2, &first), 1020);
        outputs(&mut router, 1030);
        tell(&mut router, SECOND, advertisement("far", 2, &second), 1040);
        outputs(&mut router, 1050);
        let known =
            router.database.advertisement(id("far")).unwrap().edges.iter().map(|edge| edge.cost);
        assert_eq!(known.max(), Some(9));
    }
}
