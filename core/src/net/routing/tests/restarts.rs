//! Nodes that are restarted, and routers that are built again.

use super::*;

#[test]
fn a_restarted_node_is_told_with_its_new_incarnation() {
    let mut router = between_two();
    let mut restarted = advertisement("far", 1, &[("left", 1), ("right", 1)]);
    restarted.id.incarnation = Incarnation(2);

    // Its neighbours have heard the new incarnation instead of the old one, and have proved the
    // links again.
    tell(&mut router, FIRST, advertisement("left", 2, &[("own", 1)]), 1020);
    tell(&mut router, SECOND, advertisement("right", 2, &[("own", 5)]), 1020);
    let (node, incarnation) = (named("far"), Incarnation(1));
    let reported = without_routing(outputs(&mut router, 1030));
    assert!(reported.contains(&RouterOutput::Lost { node, incarnation }), "{reported:?}");
    let left = advertisement("left", 3, &[("own", 1), ("far", 1)]);
    tell(&mut router, FIRST, linked_to(2, "far", left), 1200);
    tell(&mut router, FIRST, restarted, 1200);

    let reported = without_routing(outputs(&mut router, 1210));
    let (node, incarnation) = (named("far"), Incarnation(2));
    assert_eq!(reported, [RouterOutput::Reachable { node, incarnation, mtu: 1376 }]);
}

#[test]
fn a_new_incarnation_of_which_the_neighbours_say_nothing_waits_for_the_old_one_to_answer() {
    let mut router = between_two();
    let mut restarted = advertisement("far", 1, &[("left", 1), ("right", 1)]);
    restarted.id.incarnation = Incarnation(2);

    tell(&mut router, FIRST, restarted.clone(), 1020);
    assert_eq!(without_routing(outputs(&mut router, 2010)), []);
    outputs(&mut router, 2020);
    tell(&mut router, FIRST, restarted, 2030);
    let lost = without_routing(outputs(&mut router, 2040));
    assert!(matches!(lost.last(), Some(RouterOutput::Lost { node, .. }) if *node == named("far")));
    let left = advertisement("left", 2, &[("own", 1), ("far", 1)]);
    tell(&mut router, FIRST, linked_to(2, "far", left), 2050);

    let reported = without_routing(outputs(&mut router, 2060));
    let (node, incarnation) = (named("far"), Incarnation(2));
    assert_eq!(reported, [RouterOutput::Reachable { node, incarnation, mtu: 1376 }]);
}

#[test]
fn a_router_built_anew_counts_on_and_tells_what_it_cannot_find_again() {
    let config = RouterConfig::new(named("own"), Incarnation(1));
    let reached = ["left", "gone"].map(|node| (named(node), Incarnation(1)));
    let mut router = Router::restarted(config, reached, at(1000));
    router.handle_link(FIRST, up("left", 1), at(1000));

    // The neighbour still holds what the old router said.
    tell(&mut router, FIRST, advertisement("own", 57, &[("left", 1)]), 1001);

    let reported = announced(&outputs(&mut router, 1010), FIRST);
    assert_eq!(reported.last().unwrap().id.sequence, 58);
    let lost = without_routing(outputs(&mut router, 2100));
    let (node, incarnation) = (named("gone"), Incarnation(1));
    assert_eq!(lost, [RouterOutput::Lost { node, incarnation }]);
}

#[test]
fn a_second_node_of_our_name_is_told_once_and_an_earlier_incarnation_of_ours_never() {
    let mut router = between_two();
    let mut usurper = advertisement("own", 1, &[]);
    usurper.id.incarnation = Incarnation(9);

    for now in [1020, 1030, 1040, 3000] {
        tell(&mut router, FIRST, usurper.clone(), now);
        assert_eq!(without_routing(outputs(&mut router, now)), [], "it is only repeated");
    }
    for now in [3020, 3030, 3040] {
        usurper.id.sequence += 1;
        tell(&mut router, FIRST, usurper.clone(), now);
    }

    let reported = without_routing(outputs(&mut router, 3050));
    assert_eq!(reported, [RouterOutput::NameTaken { incarnation: Incarnation(9), first: true }]);
}
