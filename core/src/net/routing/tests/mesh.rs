//! Nodes that are all linked to each other.

use super::network::{Load, Net, Who};
use super::*;

const A: Who = ("a", 1);
const B: Who = ("b", 1);
const C: Who = ("c", 1);

fn newest(net: &Net, by: Who, origin: &str) -> AdvertisementId {
    net.routers[&by].database.advertisement(id(origin)).unwrap().id
}

/// A node's router has something new to say of a link.
fn change(net: &mut Net, own: Who, far: &'static str) {
    let (link, now) = (net.number(own, far), net.now);
    net.routers.get_mut(&own).unwrap().handle_link(link, up(far, 11), now);
    net.settle(own);
}

#[test]
fn in_a_full_mesh_a_change_is_announced_by_its_origin_alone() {
    let nodes: [Who; 6] = [A, B, C, ("d", 1), ("e", 1), ("f", 1)];
    let pairs = (0..6).flat_map(|one| (0..one).map(move |other| (nodes[one], nodes[other])));
    let mut net = Net::new(&pairs.collect::<Vec<_>>());
    net.run(500);
    change(&mut net, A, "b");

    let mut announced_by = Vec::new();
    for _ in 0..100 {
        let announces = net.wire.iter().filter_map(|(from, _, _, load)| match load {
            Load::Routing(bytes) => match RoutingMessage::decode(bytes.clone()) {
                Ok(RoutingMessage::Announce(_)) => Some(from.0),
                _ => None,
            },
            Load::Packet(_) => None,
        });
        announced_by.extend(announces);
        net.run(1);
    }

    assert_eq!(announced_by, ["a"; 5]);
    let known = newest(&net, A, "a");
    assert!(nodes.iter().all(|node| newest(&net, *node, "a") == known));
}

#[test]
fn what_an_origin_could_not_deliver_before_it_failed_is_found_by_comparing() {
    let mut net = Net::new(&[(A, B), (B, C), (A, C)]);
    net.run(500);
    // The cable carries nothing more, which no router knows yet.
    net.cables.retain(|cable| *cable != (A, C));
    change(&mut net, A, "b");
    net.run(5);
    let news = newest(&net, B, "a");
    assert!(newest(&net, C, "a") < news, "only its origin tells it");

    net.routers.remove(&A);
    net.run(1_100);

    assert_eq!(newest(&net, C, "a"), news);
}

#[test]
fn once_the_link_to_its_origin_is_down_news_is_passed_on_at_once() {
    let mut net = Net::new(&[(A, B), (B, C), (A, C)]);
    net.run(500);
    net.cables.retain(|cable| *cable != (A, C));
    change(&mut net, A, "b");
    net.run(5);

    net.unplug(A, C);
    net.run(3);

    assert_eq!(newest(&net, C, "a"), newest(&net, A, "a"));
}

#[test]
fn a_node_whose_links_change_all_the_time_announces_the_newest_at_a_bounded_pace() {
    let mut router = between_two();
    let mut told = Vec::new();
    for now in 1_100..1_200 {
        router.handle_link(FIRST, up("left", now as u16), at(now));
        let own = announced(&outputs(&mut router, now), SECOND);
        told.extend(own.into_iter().filter(|told| told.node == named("own")));
    }
    told.extend(announced(&outputs(&mut router, 1_210), SECOND));

    let mut ids: Vec<_> = told.iter().map(|told| told.id).collect();
    ids.dedup();
    // At once, and after each 10 ms, with two links.
    assert_eq!(ids.len(), 11, "{ids:?}");
    let last = told.iter().rfind(|told| told.node == named("own")).unwrap();
    assert!(last.edges.iter().any(|edge| edge.cost == 1_199), "{last:?}");
}

#[test]
fn late_confirmations_of_older_news_are_not_answered_while_the_newest_is_on_its_way() {
    let mut router = between_two();
    let before = router.database.own.id;
    outputs(&mut router, 1_090);
    router.handle_link(FIRST, up("left", 7), at(1_100));
    outputs(&mut router, 1_100);
    let mut confirm = |now| {
        let have = RoutingMessage::Have { range: None, ids: vec![before] };
        router.handle_routing(SECOND, have.encode(), at(now));
        let outputs: Vec<_> = std::iter::from_fn(|| router.poll_output()).collect();
        announced(&outputs, SECOND).len()
    };

    assert_eq!((1_101..1_111).map(&mut confirm).sum::<usize>(), 0);
    assert_eq!(confirm(2_000), 1, "it may be lost");
}
