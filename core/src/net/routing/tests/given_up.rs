//! A neighbour that says by another way that it has given a link up.

use super::*;

fn given_up(router: &mut Router, now: u64) -> Vec<LinkId> {
    let reported = outputs(router, now).into_iter();
    reported
        .filter_map(|reported| match reported {
            RouterOutput::GivenUp { link } => Some(link),
            _ => None,
        })
        .collect()
}

fn say(router: &mut Router, link: LinkId, sent: &RoutingMessage) {
    router.handle_routing(link, sent.encode(), at(1020));
}

#[test]
fn a_neighbour_that_announces_its_links_without_us_has_given_up_ours() {
    let mut router = between_two();

    tell(&mut router, SECOND, advertisement("left", 2, &[("far", 1)]), 1020);

    assert_eq!(given_up(&mut router, 1020), [FIRST]);
    // Once: what it does not announce any more it need not withdraw.
    tell(&mut router, SECOND, advertisement("left", 3, &[("far", 1)]), 1030);
    assert_eq!(given_up(&mut router, 1030), []);
    tell(&mut router, SECOND, advertisement("left", 4, &[("own", 1), ("far", 1)]), 1040);
    tell(&mut router, SECOND, advertisement("left", 5, &[("far", 1)]), 1050);
    assert_eq!(given_up(&mut router, 1050), [FIRST]);
}

#[test]
fn what_is_not_announced_yet_was_not_given_up_and_neither_is_what_there_was_no_room_for() {
    let mut router = router();
    router.handle_link(FIRST, up("left", 1), at(1000));
    router.handle_link(SECOND, up("right", 1), at(1000));
    for sequence in 1..5 {
        tell(&mut router, FIRST, advertisement("left", sequence, &[("far", 1)]), 1000);
    }
    assert_eq!(given_up(&mut router, 1010), []);
    tell(&mut router, FIRST, advertisement("left", 5, &[("own", 1)]), 1020);

    // Others' links, old words, another incarnation, and a node with more links than it can tell
    // of.
    tell(&mut router, FIRST, advertisement("right", 1, &[("own", 1)]), 1030);
    tell(&mut router, FIRST, advertisement("left", 4, &[]), 1030);
    let many: Vec<_> = (0..64).map(|n| format!("n{n}")).collect();
    let many: Vec<_> = many.iter().map(|name| (name.as_str(), 1)).collect();
    tell(&mut router, SECOND, advertisement("left", 6, &many), 1030);
    tell(&mut router, SECOND, of_incarnation(2, advertisement("left", 1, &[])), 1030);

    assert_eq!(given_up(&mut router, 1040), []);
}

#[test]
fn of_several_links_to_one_neighbour_the_one_that_it_names_is_given_up() {
    let mut router = router();
    for (link, node) in [(FIRST, "left"), (SECOND, "left"), (LinkId(2), "right")] {
        router.handle_link(link, up(node, 1), at(1000));
    }
    let reported = outputs(&mut router, 1010);
    for link in [FIRST, SECOND] {
        let bytes = RoutingMessage::Numbered(link).encode();
        assert!(
            reported.contains(&RouterOutput::Routing { link, bytes }),
            "we say what we call it"
        );
    }

    say(&mut router, SECOND, &RoutingMessage::GaveUp(FIRST));
    assert_eq!(given_up(&mut router, 1020), [FIRST]);
    // Not by others, not of others' links, of none, or by the link itself.
    for (by, link) in [(LinkId(2), FIRST), (FIRST, LinkId(2)), (FIRST, LinkId(9)), (FIRST, FIRST)] {
        say(&mut router, by, &RoutingMessage::GaveUp(link));
    }
    assert_eq!(given_up(&mut router, 1020), []);
    assert_eq!(router.refusals().unexpected, 3);
}

#[test]
fn a_link_that_is_down_is_named_as_the_neighbour_calls_it() {
    let mut router = router();
    for (link, node) in [(FIRST, "left"), (SECOND, "left"), (LinkId(2), "right")] {
        router.handle_link(link, up(node, 1), at(1000));
    }
    say(&mut router, FIRST, &RoutingMessage::Numbered(LinkId(77)));
    outputs(&mut router, 1020);

    router.handle_link(FIRST, LinkStatus { health: LinkHealth::Down, ..up("left", 1) }, at(1030));

    let bytes = RoutingMessage::GaveUp(LinkId(77)).encode();
    let sent = outputs(&mut router, 1030).into_iter();
    let sent = sent.filter(
        |reported| matches!(reported, RouterOutput::Routing { bytes: b, .. } if *b == bytes),
    );
    assert_eq!(
        sent.collect::<Vec<_>>(),
        [RouterOutput::Routing { link: SECOND, bytes: bytes.clone() }]
    );
}
