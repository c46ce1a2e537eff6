//! Routers with keys, and a relay between them that is hostile.

use super::network::{Load, Net, Who, roster, seed};
use super::*;
use crate::net::seal::is_seal_frame;

const A: Who = ("a", 1);
const B: Who = ("b", 1);
const C: Who = ("c", 1);
const SECRET: &[u8] = b"forward, at one metre per second";

/// The way from A to C leads over B.
fn in_a_row() -> Net {
    let mut net = Net::with_roster(&[(A, B), (B, C)], Some(roster(&["a", "b", "c"])));
    net.run(1_000);
    assert_eq!([A, C].map(|who| net.routers[&who].route(id("b")).is_some()), [true; 2]);
    assert_eq!(net.reached(A, "c"), Some(1));
    net
}

/// The packet that B sends C next.
fn from_b_to_c(net: &mut Net) -> (LinkId, Bytes) {
    loop {
        let is_it = |(from, to, _, load): &(Who, Who, LinkId, Load)| {
            (*from, to.0) == (B, "c") && matches!(load, Load::Packet(_))
        };
        match net.wire.iter().position(is_it).map(|place| net.wire.remove(place)) {
            Some((.., link, Load::Packet(packet))) => return (link, packet),
            _ => net.run(1),
        }
    }
}

fn taken(net: &mut Net) -> Vec<(Who, NodeId, Bytes)> {
    std::mem::take(&mut net.segments)
}

#[test]
fn what_goes_over_a_relay_is_sealed_for_its_destination_and_to_a_neighbour_it_is_not() {
    let mut net = in_a_row();

    net.send(A, "c", SECRET);
    let (link, packet) = from_b_to_c(&mut net);

    assert!(!packet.windows(SECRET.len()).any(|part| part == SECRET));
    assert!(net.segments.is_empty());
    net.arrive(C, link, Load::Packet(packet));
    assert_eq!(taken(&mut net), [(C, id("a"), Bytes::from_static(SECRET))]);

    net.send(B, "c", SECRET);
    let (_, packet) = from_b_to_c(&mut net);
    assert!(packet.ends_with(SECRET), "the link seals it");
}

#[test]
fn a_relay_cannot_change_repeat_or_invent_a_segment() {
    let mut net = in_a_row();
    net.send(A, "c", SECRET);
    let (link, packet) = from_b_to_c(&mut net);
    let head = packet.len() - SECRET.len() - 24;

    for at in head..packet.len() {
        let mut changed = packet.to_vec();
        changed[at] ^= 1;
        net.arrive(C, link, Load::Packet(changed.into()));
    }
    let plain = Packet { source: id("a"), ..packet_to("c", 3) };
    net.arrive(C, link, Load::Packet(plain.encode()));
    assert_eq!(taken(&mut net), []);
    assert_eq!(net.routers[&C].refusals().forged, 1, "without a seal");

    for _ in 0..100 {
        net.arrive(C, link, Load::Packet(packet.clone()));
    }
    assert_eq!(taken(&mut net), [(C, id("a"), Bytes::from_static(SECRET))]);

    // Under another source's name a seal is still the sealer's.
    net.send(A, "c", SECRET);
    let (link, packet) = from_b_to_c(&mut net);
    let mut renamed = Packet::decode(packet).unwrap();
    (renamed.source, renamed.passed) = (id("d"), Vec::new());
    net.arrive(C, link, Load::Packet(renamed.encode()));
    assert_eq!(taken(&mut net), [(C, id("a"), Bytes::from_static(SECRET))]);
}

#[test]
fn an_advertisement_that_its_origin_has_not_signed_changes_nothing() {
    let mut net = in_a_row();
    let link = net.number(C, "b");
    let signed_by = |signer: &str, mut lie: Advertisement| {
        let part = lie.signed_part();
        let message = [b"blastema advertisement 1\0ranger\0", &part[..]].concat();
        lie.signature = Some(seed(signer).advertisement_signer().sign(&message));
        lie
    };
    let newest = |who: &str, n: u64| {
        let mut lie = advertisement(who, n, &[("b", 1), ("c", 1)]);
        lie.id.sequence = u64::MAX - n;
        lie
    };
    let told = net.routers[&C].database.advertisement(id("a")).cloned();
    let own = net.routers[&C].database.own.clone();

    for n in 1..4 {
        for lie in [
            newest("a", n),
            signed_by("b", newest("a", n)),
            signed_by("b", newest("c", n)),
            newest("c", n),
            signed_by("d", newest("d", n)),
        ] {
            let announce = RoutingMessage::Announce(vec![lie]).encode();
            net.arrive(C, link, Load::Routing(announce));
        }
    }
    net.run(500);

    assert_eq!(net.routers[&C].database.advertisement(id("a")).cloned(), told);
    assert_eq!(net.routers[&C].database.own, own, "nothing was to be outdone");
    assert!(net.routers[&C].route(id("d")).is_none());
    assert_eq!(net.routers[&C].refusals().forged, 12);
    assert_eq!(net.reached(C, "a"), Some(1));
    net.send(A, "c", SECRET);
    net.run(5);
    assert_eq!(taken(&mut net).len(), 1);
}

#[test]
fn a_flood_of_signatures_costs_no_more_than_its_bound_and_the_truth_is_heard_after_it() {
    let mut net = in_a_row();
    let link = net.number(C, "b");
    for n in 0..10_000 {
        let mut lie = advertisement("a", 1, &[("b", 1)]);
        (lie.id.sequence, lie.signature) = (u64::MAX - n, Some([3; 64]));
        net.arrive(C, link, Load::Routing(RoutingMessage::Announce(vec![lie]).encode()));
    }
    assert_eq!(net.routers[&C].refusals().forged, 256);

    let before = net.routers[&C].database.advertisement(id("a")).unwrap().id;
    net.run(12_000);
    assert!(
        net.routers[&C].database.advertisement(id("a")).unwrap().id > before,
        "it is refreshed"
    );
}

#[test]
fn a_node_that_is_taken_off_the_roster_is_forgotten_and_not_heard() {
    let mut net = in_a_row();
    let shorter = roster(&["b", "c"]);
    let now = net.now;
    for who in [B, C] {
        net.routers.get_mut(&who).unwrap().handle_roster(&shorter, now);
    }
    net.run(1_000);
    assert!(net.routers[&C].route(id("a")).is_none());
    net.send(A, "c", SECRET);
    net.run(100);
    assert_eq!(taken(&mut net), []);

    let now = net.now;
    for who in [B, C] {
        net.routers.get_mut(&who).unwrap().handle_roster(&roster(&["a", "b", "c"]), now);
    }
    // Neighbours compare what they know every second.
    net.run(4_000);
    assert_eq!(net.reached(C, "a"), Some(1));
    net.send(A, "c", SECRET);
    net.run(5);
    assert_eq!(taken(&mut net).len(), 1);
}

#[test]
fn keys_for_a_detour_are_there_before_it_is_needed() {
    let mut net = Net::with_roster(&[(A, B), (B, C), (A, C)], Some(roster(&["a", "b", "c"])));
    net.run(1_000);
    net.send(A, "c", SECRET);
    net.run(2);
    assert_eq!(taken(&mut net).len(), 1);

    net.unplug(A, C);
    net.send(A, "c", SECRET);
    let (link, packet) = from_b_to_c(&mut net);
    assert!(!packet.windows(SECRET.len()).any(|part| part == SECRET));
    net.arrive(C, link, Load::Packet(packet));
    assert_eq!(taken(&mut net).len(), 1);
}

#[test]
fn of_two_that_differ_in_their_signature_alone_everybody_takes_the_same() {
    let one = Advertisement { signature: Some([1; 64]), ..advertisement("a", 1, &[("b", 1)]) };
    let other = Advertisement { signature: Some([9; 64]), ..one.clone() };
    assert!(one.rank() < other.rank());
}

#[test]
fn a_replayed_advertisement_keeps_a_restarted_node_out_for_no_longer_than_a_challenge() {
    let mut net = Net::with_roster(&[(A, B), (B, C)], Some(roster(&["a", "b", "c"])));
    net.run(1_000);
    let old = net.routers[&B].database.advertisement(id("a")).cloned().unwrap();
    net.kill(A);
    // C claims to be next to the earlier incarnation, and repeats what that has said.
    let link = net.number(B, "c");
    let mut claim = net.routers.remove(&C).unwrap().database.own;
    claim.id.sequence += 1_000;
    claim.edges.push(Edge { to: id("a"), incarnation: 1, cost: 1, mtu: 1_400 });
    let message = [b"blastema advertisement 1\0ranger\0", &claim.signed_part()[..]].concat();
    claim.signature = Some(seed("c").advertisement_signer().sign(&message));
    let mut replayed = old;
    replayed.edges.push(Edge { to: id("c"), incarnation: 1, cost: 1, mtu: 1_400 });
    replayed.id.sequence += 1_000;
    let message = [b"blastema advertisement 1\0ranger\0", &replayed.signed_part()[..]].concat();
    replayed.signature = Some(seed("a").advertisement_signer().sign(&message));
    let bytes = RoutingMessage::Announce(vec![claim, replayed]).encode();
    net.arrive(B, link, Load::Routing(bytes));
    net.run(50);
    assert_eq!(net.reached(B, "a"), Some(1), "B believes it");

    net.plug(B, ("a", 2));
    net.run(1_100);
    assert_eq!(net.reached(B, "a"), Some(2), "no answer has come to the challenge");
}

#[test]
fn a_restarted_destination_agrees_on_new_keys_and_opens_nothing_of_before() {
    let mut net = in_a_row();
    net.send(A, "c", SECRET);
    let (link, old) = from_b_to_c(&mut net);
    net.arrive(C, link, Load::Packet(old.clone()));
    taken(&mut net);

    net.kill(C);
    net.run(300);
    let next = ("c", 2);
    net.plug(B, next);
    net.run(1_500);
    assert_eq!(net.reached(A, "c"), Some(2));
    net.arrive(next, link, Load::Packet(old));
    assert_eq!(taken(&mut net), []);
    net.send(A, "c", SECRET);
    net.run(5);
    assert_eq!(taken(&mut net), [(next, id("a"), Bytes::from_static(SECRET))]);
}

#[test]
fn no_segment_begins_as_a_frame_of_a_seal_does() {
    // What the session writes first: the kind, and flags that only these kinds have.
    for first in (0..=255_u8).filter(|first| is_seal_frame(&[*first])) {
        let segment = [&[first][..], &[1; 60]].concat();
        let understood = crate::net::wire::segment::Segment::decode(segment.into());
        assert!(understood.is_err(), "{first:#x} {understood:?}");
    }
}

#[test]
fn of_two_computers_with_one_key_the_older_keeps_the_name_and_the_other_is_told() {
    const D: Who = ("d", 1);
    let cables = [(A, B), (B, C), (C, D)];
    let mut net = Net::with_roster(&cables, Some(roster(&["a", "b", "c", "d"])));
    net.run(1_000);
    net.plug(C, ("a", 2));
    net.run(30_000);

    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(1); 3]);
    let told = "(\"a\", 2) stops for #1";
    assert!(net.outputs().iter().any(|output| output == told));
}
