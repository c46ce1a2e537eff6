//! Copies of one segment: which ways they are given, and who passes them on.

use super::*;

const THIRD: LinkId = LinkId(2);

fn copy_to(destination: &str, hops: u8, copy: u8, relays: &[&str]) -> Packet {
    let relays = relays.iter().map(|relay| id(relay)).collect();
    let payload = Payload::Copy { copy, relays, segment: Bytes::from_static(b"segment").into() };
    Packet { payload, ..packet_to(destination, hops) }
}

fn sent(router: &mut Router) -> Vec<(LinkId, Packet)> {
    let outputs = std::iter::from_fn(|| router.poll_output());
    let packets = outputs.map(|output| match output {
        RouterOutput::Packet { link, packet } => {
            (link, Packet::decode(packet.into_bytes()).unwrap())
        }
        other => panic!("{other:?}"),
    });
    packets.collect()
}

fn come(router: &mut Router, packet: &Packet) -> Vec<(LinkId, Packet)> {
    router.handle_packet(FIRST, packet.encode(), at(1020));
    sent(router)
}

fn copies_to(router: &mut Router, destination: &str) -> Vec<(LinkId, Payload)> {
    router.handle_copies(id(destination), PacketPriority::Data, &"segment".into());
    sent(router).into_iter().map(|(link, packet)| (link, packet.payload)).collect()
}

#[test]
fn each_copy_has_its_way_written_in_it() {
    let mut router = between_two();
    // Behind `far` is one more, and `left` has no link to it.
    let beside = advertisement("right", 2, &[("own", 5), ("far", 1), ("beyond", 1)]);
    tell(&mut router, SECOND, beside, 1020);
    let far = advertisement("far", 2, &[("left", 1), ("right", 1), ("beyond", 1)]);
    tell(&mut router, FIRST, far, 1020);
    tell(&mut router, FIRST, advertisement("beyond", 1, &[("far", 1), ("right", 1)]), 1020);
    outputs(&mut router, 1030);

    let copies = copies_to(&mut router, "beyond");

    let copy = |copy, relays| Payload::Copy {
        copy,
        relays,
        segment: Bytes::from_static(b"segment").into(),
    };
    assert_eq!(copies, [(FIRST, copy(0, vec![id("far")])), (SECOND, copy(1, vec![]))]);
    // To a neighbour, the direct one needs no words.
    let copies = copies_to(&mut router, "right");
    assert_eq!(copies[0], (FIRST, copy(0, vec![id("far")])));
    assert_eq!(copies[1], (SECOND, Payload::Segment(Bytes::from_static(b"segment").into())));
}

#[test]
fn where_there_is_one_way_only_routes_are_followed() {
    let mut router = between_two();
    tell(&mut router, FIRST, advertisement("far", 2, &[("left", 1)]), 1020);
    outputs(&mut router, 1030);

    let copies = copies_to(&mut router, "far");

    assert_eq!(copies, [(FIRST, Payload::Segment(Bytes::from_static(b"segment").into()))]);
    router.handle_copies(id("absent"), PacketPriority::Data, &Bytes::new().into());
    assert!(matches!(router.poll_output(), Some(RouterOutput::Undelivered { .. })));
}

#[test]
fn a_copy_is_passed_on_by_its_own_way_and_by_no_other() {
    let mut router = between_two();

    // Over `right`, although `left` is cheaper.
    let passed = come(&mut router, &copy_to("far", 9, 1, &["right"]));
    assert_eq!(passed, [(SECOND, copy_to("far", 8, 1, &[]))]);
    let passed = come(&mut router, &copy_to("right", 9, 1, &[]));
    assert_eq!(passed, [(SECOND, copy_to("right", 8, 1, &[]))]);

    // The next is no neighbour, or never was; another way is known.
    for gone in [copy_to("far", 9, 0, &[]), copy_to("far", 9, 0, &["absent", "right"])] {
        assert_eq!(come(&mut router, &gone), []);
    }
    assert_eq!(router.refusals().astray, 2);
    assert_eq!(router.refusals().total(), 2);
}

#[test]
fn a_copy_that_was_here_or_is_not_at_its_end_is_refused() {
    let mut router = between_two();

    assert_eq!(come(&mut router, &copy_to("far", 9, 0, &["right", "own"])), []);
    assert_eq!(come(&mut router, &copy_to("own", 9, 0, &["right"])), []);
    assert_eq!(router.refusals().malformed, 2);
    assert_eq!(come(&mut router, &copy_to("right", 0, 0, &[])), []);
    assert_eq!(router.refusals().astray, 1);
    // One that goes in a circle elsewhere; and one of our own that comes back.
    assert_eq!(come(&mut router, &copy_to("far", 9, 0, &["right", "left", "right"])), []);
    assert_eq!(router.refusals().malformed, 3);
    let own = Packet { source: id("own"), ..copy_to("far", 9, 0, &["right"]) };
    assert_eq!(come(&mut router, &own), []);
    assert_eq!(router.refusals().unexpected, 1);

    router.handle_packet(FIRST, copy_to("own", 0, 1, &[]).encode(), at(1020));
    let arrived = router.poll_output();
    assert!(
        matches!(arrived, Some(RouterOutput::Segment { source, .. }) if source == id("source"))
    );
}

#[test]
fn copies_that_must_pass_the_same_two_nodes_take_different_cables_between_them() {
    let mut router = router();
    let narrow = LinkStatus { mtu: MTU_MIN, ..up("right", 1) };
    for (link, status) in [(FIRST, up("left", 1)), (SECOND, up("right", 9)), (THIRD, narrow)] {
        router.handle_link(link, status, at(1000));
    }
    outputs(&mut router, 1010);
    let mut links = |health, segment: &'static [u8]| {
        router.handle_link(SECOND, LinkStatus { health, ..up("right", 9) }, at(1020));
        while router.poll_output().is_some() {}
        let segment = Bytes::from_static(segment);
        [0, 1].map(|copy| {
            let payload =
                Payload::Copy { copy, relays: vec![id("right")], segment: segment.clone().into() };
            let packet = Packet { payload, ..packet_to("far", 9) };
            come(&mut router, &packet).first().map(|(link, _)| *link)
        })
    };

    assert_eq!(links(LinkHealth::Up, b"small"), [Some(SECOND), Some(THIRD)]);
    assert_eq!(links(LinkHealth::Suspect, b"small"), [Some(THIRD); 2]);
    assert_eq!(links(LinkHealth::Up, &[0; MTU_MIN]), [Some(SECOND); 2]);
    assert_eq!(links(LinkHealth::Down, &[0; MTU_MIN]), [None; 2]);
}

#[test]
fn a_way_that_is_too_small_or_longer_than_a_packet_may_go_is_left_out() {
    let mut router = between_two();
    let segment = Bytes::from_static(&[7; 1200]);
    let mut narrow = advertisement("far", 2, &[("left", 1), ("right", 1)]);
    narrow.edges[1].mtu = 1000;
    tell(&mut router, FIRST, narrow, 1020);
    outputs(&mut router, 1030);
    assert_eq!(copies_to(&mut router, "far").len(), 2);

    router.handle_copies(id("far"), PacketPriority::Data, &segment.clone().into());

    let packet = Payload::Segment(segment.clone().into());
    assert_eq!(sent(&mut router).into_iter().map(|(_, p)| p.payload).collect::<Vec<_>>(), [packet]);
    router.config.hops = 0;
    assert_eq!(copies_to(&mut router, "far").len(), 1);
}
