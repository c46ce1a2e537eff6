//! Copies of one segment: which links they are given to.

use super::*;
use crate::GatherBuffer;

fn copies(router: &mut Router, destination: &str, segment: &GatherBuffer) -> Vec<LinkId> {
    router.handle_copies(id(destination), PacketPriority::Data, segment);
    let outputs = std::iter::from_fn(|| router.poll_output());
    let packets = outputs.map(|output| match output {
        RouterOutput::Packet { link, packet } => {
            let packet = Packet::decode(packet.into_bytes()).unwrap();
            assert_eq!(packet.payload, Payload::Segment(segment.clone()));
            link
        }
        other => panic!("{other:?}"),
    });
    packets.collect()
}

#[test]
fn a_copy_goes_over_every_direct_link_and_over_the_alternate() {
    const THIRD: LinkId = LinkId(2);
    let mut router = between_two();
    let segment = "segment".into();

    assert_eq!(copies(&mut router, "far", &segment), [FIRST, SECOND], "the next hop and the other");
    assert_eq!(
        copies(&mut router, "left", &segment),
        [FIRST, SECOND],
        "a detour over right and far"
    );
    router.handle_link(THIRD, up("left", 9), at(1020));
    outputs(&mut router, 1030);

    assert_eq!(copies(&mut router, "left", &segment), [FIRST, SECOND, THIRD]);
    router.handle_copies(id("absent"), PacketPriority::Data, &segment);
    assert!(matches!(router.poll_output(), Some(RouterOutput::Undelivered { .. })));
}

#[test]
fn a_link_that_is_too_small_for_a_copy_is_left_out() {
    const THIRD: LinkId = LinkId(2);
    let mut router = between_two();
    router.handle_link(THIRD, LinkStatus { mtu: MTU_MIN, ..up("left", 9) }, at(1020));
    outputs(&mut router, 1030);

    assert_eq!(copies(&mut router, "left", &"small".into()), [FIRST, SECOND, THIRD]);
    let large = Bytes::from_static(&[7; 200]).into();
    assert_eq!(copies(&mut router, "left", &large), [FIRST, SECOND]);
}
