//! Two nodes of one name.

use super::network::{MS, Net, Who};
use super::*;

const A: Who = ("a", 1);
const LATER: Who = ("a", 2);
const B: Who = ("b", 1);
const C: Who = ("c", 1);
const D: Who = ("d", 1);

#[test]
fn a_second_node_of_a_name_is_kept_out_and_told_while_no_other_node_notices() {
    let mut net = Net::new(&[(A, B), (B, C), (C, D)]);
    net.plug(C, LATER);
    net.run(15_000);

    let mut outputs = net.outputs();
    outputs.retain(|output| [" taken", " keeps", "(\"b"].iter().any(|part| output.contains(part)));
    assert_eq!(
        outputs,
        ["(\"c\", 1) keeps a#2 out for #1", "(\"a\", 2) taken by #1, first: false"]
    );
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(1); 3]);

    net.kill(A);
    net.run(50);
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(2); 3], "its turn has come");
}

/// Two links of a node lead to two incarnations of another, on two networks; the second is cheaper.
fn with_a_second_on_another_network((first, second): (u64, u64)) -> Router {
    let mut router = router();
    for (link, incarnation, cost) in [(FIRST, first, 9), (SECOND, second, 1)] {
        router.handle_link(link, incarnation_up(incarnation, cost), at(1000));
        outputs(&mut router, 1010);
    }
    assert_eq!(sent_to_a(&mut router), Some(FIRST), "the second waits");
    router
}

fn incarnation_up(incarnation: u64, cost: u16) -> LinkStatus {
    let neighbour = Neighbour { node: named("a"), incarnation: Incarnation(incarnation) };
    LinkStatus { neighbour, health: LinkHealth::Up, cost, mtu: 1400 }
}

fn sent_to_a(router: &mut Router) -> Option<LinkId> {
    router.handle_segment(id("a"), PacketPriority::Data, "segment".into());
    over(router.poll_output())
}

#[test]
fn a_second_node_on_another_network_takes_nothing_from_the_first_that_answers() {
    for incarnations in [(1, 2), (2, 1)] {
        let mut router = with_a_second_on_another_network(incarnations);
        let (first, second) = incarnations;
        let ids = vec![router.own.id];
        router.handle_routing(FIRST, RoutingMessage::Have { range: None, ids }.encode(), at(1100));
        outputs(&mut router, 2000);
        assert_eq!(sent_to_a(&mut router), Some(FIRST));

        let announce = RoutingMessage::Announce(vec![advertisement("a", 1, &[("own", 1)])]);
        router.handle_routing(SECOND, announce.encode(), at(2010));
        let (node, incarnation, by) = (named("a"), Incarnation(second), Incarnation(first));
        let taken = RoutingMessage::Taken { by }.encode();
        let reported = outputs(&mut router, 2020);
        assert!(reported.contains(&RouterOutput::Routing { link: SECOND, bytes: taken }));
        assert!(
            reported.contains(&RouterOutput::KeptOut { node, incarnation, by }),
            "{reported:?}"
        );

        let down = LinkStatus { health: LinkHealth::Down, ..incarnation_up(first, 9) };
        router.handle_link(FIRST, down, at(2030));
        (2030..2060).for_each(|now| drop(outputs(&mut router, now)));
        assert_eq!(sent_to_a(&mut router), Some(SECOND), "the first has ended");
        assert_eq!(router.route(id("a")).unwrap().incarnation, incarnation);
    }
}

#[test]
fn a_second_node_on_another_network_has_the_name_of_one_that_answers_no_challenge() {
    for incarnations in [(1, 2), (2, 1)] {
        let mut router = with_a_second_on_another_network(incarnations);
        // What it has confirmed before says nothing.
        let before = AdvertisementId { sequence: router.own.id.sequence - 1, ..router.own.id };
        let have = RoutingMessage::Have { range: None, ids: vec![before] };
        router.handle_routing(FIRST, have.encode(), at(1100));
        outputs(&mut router, 1990);
        assert_eq!(sent_to_a(&mut router), Some(FIRST));

        (2000..2060).for_each(|now| drop(outputs(&mut router, now)));

        assert_eq!(sent_to_a(&mut router), Some(SECOND));
        assert_eq!(router.route(id("a")).unwrap().incarnation, Incarnation(incarnations.1));
        let down = LinkStatus { health: LinkHealth::Down, ..incarnation_up(incarnations.0, 9) };
        router.handle_link(FIRST, down, at(2070));
        (2070..2080).for_each(|now| drop(outputs(&mut router, now)));
        assert_eq!(sent_to_a(&mut router), Some(SECOND));
    }
}

#[test]
fn a_node_that_begins_anew_has_its_name_at_once() {
    // With one cable, and with two that notice it one after the other.
    let mut net = Net::new(&[(A, B), (A, C), (B, C), (C, D)]);
    net.kill(A);
    net.run(10);
    net.outputs();
    net.plug(B, LATER);
    net.plug(C, LATER);
    net.run(10);
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(2); 3]);
    assert!(net.outputs().iter().all(|outputs| !outputs.contains("taken")));

    let next = ("a", 3);
    net.routers.remove(&LATER);
    net.unplug(LATER, B);
    net.run(1);
    net.plug(B, next);
    net.run(25);
    net.unplug(LATER, C);
    net.plug(C, next);
    net.run(10);
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(3); 3]);
    assert!(net.outputs().iter().all(|outputs| !outputs.contains("taken")), "it had ended");
}

#[test]
fn a_node_whose_number_fell_has_its_name_within_a_second_although_a_greater_one_was_kept_out_before()
 {
    let (fifth, greater, third) = (("a", 5), ("a", 20), ("a", 3));
    let mut net = Net::new(&[(fifth, B), (fifth, C), (B, C), (C, D)]);
    net.plug(D, greater);
    net.run(1_500);
    net.kill(greater);
    net.run(50);

    net.kill(fifth);
    net.plug(third, B);
    net.plug(third, C);
    net.run(1_200);

    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(3); 3]);
}

#[test]
fn an_incarnation_that_ended_keeps_the_next_one_out_until_its_neighbour_knows() {
    let mut net = Net::new(&[(A, B), (B, C)]);
    // Its link to B is not known to be dead.
    net.routers.remove(&A);
    net.plug(C, LATER);
    net.run(100);
    assert_eq!(net.reached(C, "a"), Some(1));
    net.unplug(A, B);
    net.run(50);
    assert_eq!([B, C].map(|by| net.reached(by, "a")), [Some(2); 2]);
    assert!(net.outputs().iter().all(|outputs| !outputs.contains("taken")));
}

#[test]
fn where_two_halves_meet_that_have_each_a_node_of_a_name_the_older_stays_everywhere() {
    let mut net = Net::new(&[(A, B), (C, LATER), (C, D)]);
    assert_eq!(net.reached(D, "a"), Some(2));
    net.plug(B, C);
    net.run(3_000);

    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(1); 3]);
    let mut outputs = net.outputs();
    outputs.retain(|outputs| outputs.contains("taken") || outputs.starts_with("(\"b\""));
    outputs.sort();
    let both = ["(\"a\", 1) taken by #2, first: true", "(\"a\", 2) taken by #1, first: false"];
    assert_eq!(outputs[..2], both);
    assert!(outputs[2..].iter().all(|outputs| !outputs.contains("reaches a")), "{outputs:?}");
}

#[test]
fn that_a_name_is_taken_is_over_a_minute_after_the_second_node_has_gone_and_not_before() {
    let mut net = Net::new(&[(A, B), (B, C)]);
    net.plug(C, LATER);
    net.run(75_000);
    assert!(!net.outputs().iter().any(|outputs| outputs.contains("rid")), "{:?}", net.outputs());

    net.kill(LATER);
    net.run(75_000);
    let mut outputs = net.outputs();
    outputs.retain(|outputs| outputs.contains("rid"));
    assert_eq!(outputs, ["(\"c\", 1) is rid of NameTaken"]);
    net.plug(C, LATER);
    net.run(3_000);
    let again = "(\"c\", 1) keeps a#2 out for #1";
    let outputs = net.outputs();
    assert!(outputs.iter().any(|outputs| outputs == again), "{outputs:?}");

    // The older one ends instead.
    net.kill(A);
    net.run(75_000);
    let mut outputs = net.outputs();
    outputs.retain(|outputs| outputs.contains("rid"));
    outputs.sort();
    assert_eq!(outputs, ["(\"a\", 2) is rid of NameTaken", "(\"c\", 1) is rid of NameTaken"]);
}

#[test]
fn a_neighbour_that_says_all_the_time_that_the_name_is_taken_makes_one_fault() {
    let mut net = Net::new(&[(A, B)]);
    let link = net.number(A, "b");
    let router = net.routers.get_mut(&A).unwrap();
    let mut outputs = Vec::new();
    for n in 0..10_000 {
        let taken = RoutingMessage::Taken { by: Incarnation(9) };
        router.handle_routing(link, taken.encode(), net.now + MS * n);
        outputs.extend(std::iter::from_fn(|| router.poll_output()));
    }
    let incarnation = Incarnation(9);
    assert_eq!(outputs, [RouterOutput::NameTaken { incarnation, first: false }]);
    assert!(router.route(id("b")).is_some());
}
