//! Two nodes of one name.

use super::network::{Net, Who};
use super::*;

const A: Who = ("a", 1);
const LATER: Who = ("a", 2);
const B: Who = ("b", 1);
const C: Who = ("c", 1);
const D: Who = ("d", 1);

#[test]
fn a_second_node_of_a_name_stops_when_the_first_has_answered_while_no_other_node_notices() {
    let mut net = Net::new(&[(A, B), (B, C), (C, D)]);
    net.plug(C, LATER);
    net.run(500);

    let noticed = [" stops", " keeps", " lost", " reaches a", "(\"b"];
    let mut outputs = net.outputs();
    outputs.retain(|output| noticed.iter().any(|part| output.contains(part)));
    assert_eq!(outputs, ["(\"a\", 2) stops for #1", "(\"c\", 1) keeps a#2 out for #1"]);
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(1); 3]);

    net.kill(A);
    net.plug(C, LATER);
    net.run(50);
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(2); 3], "its turn has come");
}

/// Two links of a node lead to two incarnations of another, on two networks; the second is cheaper.
/// The first is challenged.
fn with_a_second_on_another_network((first, second): (u64, u64)) -> Router {
    let mut router = router();
    router.handle_link(FIRST, incarnation_up(first, 9), at(1000));
    tell(&mut router, FIRST, said_by(first, 1), 1000);
    outputs(&mut router, 1010);
    router.handle_link(SECOND, incarnation_up(second, 1), at(1000));
    let challenge = Edge { to: id("a"), incarnation: second as u8, cost: 1, mtu: 0 };
    let told = announced(&outputs(&mut router, 1010), FIRST);
    assert!(told.iter().any(|told| told.edges.contains(&challenge)), "{told:?}");
    assert_eq!(sent_to_a(&mut router), Some(FIRST), "the second waits");
    router
}

/// What an incarnation of `a` says, and says when it is so far ahead.
fn said_by(incarnation: u64, ahead: u64) -> Advertisement {
    let mut said = of_incarnation(incarnation, advertisement("a", 1, &[("own", 9)]));
    said.id.sequence += ahead;
    said
}

const ANSWER: u64 = 1 << 20;

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
        let announce =
            RoutingMessage::Announce(vec![advertisement("a", 1, &[("own", 1)])]).encode();
        router.handle_routing(SECOND, announce.clone(), at(1050));
        assert_eq!(without_routing(outputs(&mut router, 1050)), [], "nothing is answered yet");
        tell(&mut router, FIRST, said_by(first, 1 + ANSWER), 1100);
        outputs(&mut router, 2060);
        assert_eq!(sent_to_a(&mut router), Some(FIRST));

        router.handle_routing(SECOND, announce, at(2070));
        let (node, incarnation, by) = (named("a"), Incarnation(second), Incarnation(first));
        let (link, over) = (SECOND, Some(FIRST));
        let reported = [
            RouterOutput::Refuse { link, by, over },
            RouterOutput::KeptOut { node, incarnation, by, link, over },
        ];
        assert_eq!(without_routing(outputs(&mut router, 2070)), reported);

        let down = LinkStatus { health: LinkHealth::Down, ..incarnation_up(first, 9) };
        router.handle_link(FIRST, down, at(2080));
        (2080..2100).for_each(|now| drop(outputs(&mut router, now)));
        assert_eq!(sent_to_a(&mut router), Some(SECOND), "the first has ended");
        assert_eq!(router.route(id("a")).unwrap().incarnation, incarnation);
    }
}

#[test]
fn a_second_node_on_another_network_has_the_name_of_one_that_answers_no_challenge() {
    for incarnations in [(1, 2), (2, 1)] {
        let mut router = with_a_second_on_another_network(incarnations);
        // What it has said before, and comes late, answers nothing.
        tell(&mut router, FIRST, said_by(incarnations.0, 2), 1100);
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
fn a_node_that_was_displaced_while_it_stood_still_is_the_one_that_stops() {
    let mut router = with_a_second_on_another_network((1, 2));
    (1990..2060).for_each(|now| drop(outputs(&mut router, now)));
    assert_eq!(sent_to_a(&mut router), Some(SECOND));
    tell(&mut router, SECOND, said_by(2, 1), 2070);
    (2070..2080).for_each(|now| drop(outputs(&mut router, now)));

    tell(&mut router, FIRST, said_by(1, 3), 2090);
    assert_eq!(without_routing(outputs(&mut router, 2090)), [], "it waits for the answer");
    tell(&mut router, SECOND, said_by(2, 1 + ANSWER), 2100);
    tell(&mut router, FIRST, said_by(1, 3), 2110);

    let refuse = RouterOutput::Refuse { link: FIRST, by: Incarnation(2), over: Some(SECOND) };
    assert!(outputs(&mut router, 2110).contains(&refuse));
    assert_eq!(sent_to_a(&mut router), Some(SECOND));
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
    assert!(net.outputs().iter().all(|outputs| !outputs.contains("stops")));

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
    assert!(net.outputs().iter().all(|outputs| !outputs.contains("stops")), "it had ended");
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
    assert!(net.outputs().iter().all(|outputs| !outputs.contains("stops")));
}

#[test]
fn where_two_halves_meet_that_have_each_a_node_of_a_name_the_older_stays_everywhere() {
    let mut net = Net::new(&[(A, B), (C, LATER), (C, D)]);
    assert_eq!(net.reached(D, "a"), Some(2));
    net.plug(B, C);
    net.run(3_000);

    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(1); 3]);
    let mut outputs = net.outputs();
    outputs.retain(|output| output.contains("stops"));
    assert_eq!(outputs, ["(\"a\", 2) stops for #1"]);
}

#[test]
fn a_second_node_that_goes_on_is_reported_again_every_twenty_seconds() {
    let mut router = with_a_second_on_another_network((1, 2));
    tell(&mut router, FIRST, said_by(1, 1 + ANSWER), 1100);
    outputs(&mut router, 2060);
    let announce = RoutingMessage::Announce(vec![advertisement("a", 1, &[("own", 1)])]).encode();

    let reported = (2..34).filter(|second| {
        router.handle_routing(SECOND, announce.clone(), at(second * 1_000 + 70));
        let outputs = outputs(&mut router, second * 1_000 + 70);
        outputs.iter().any(|output| matches!(output, RouterOutput::KeptOut { .. }))
    });

    assert_eq!(reported.collect::<Vec<_>>(), [2, 22]);
}
