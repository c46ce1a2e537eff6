//! Nodes that are restarted, and routers that are built again.

use super::*;

#[test]
fn a_restarted_node_is_told_with_its_new_incarnation() {
    let mut router = between_two();
    let restarted = of_incarnation(2, advertisement("far", 1, &[("left", 1), ("right", 1)]));

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
fn a_new_incarnation_is_reached_as_soon_as_a_neighbour_has_a_link_to_it() {
    let mut router = between_two();
    let restarted = of_incarnation(2, advertisement("far", 1, &[("left", 1), ("right", 1)]));

    tell(&mut router, FIRST, restarted, 1020);
    let lost = without_routing(outputs(&mut router, 1030));
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
    assert_eq!(reported.last().unwrap().id, advertisement("own", 58, &[]).id);
    let lost = without_routing(outputs(&mut router, 2100));
    let (node, incarnation) = (named("gone"), Incarnation(1));
    assert_eq!(lost, [RouterOutput::Lost { node, incarnation }]);
}

#[test]
fn what_an_earlier_incarnation_has_said_is_outdone_once_and_is_no_second_node() {
    let mut router = between_two();
    // The clock was set back: the earlier one has the greater number.
    let earlier = of_incarnation(9, advertisement("own", 1, &[("left", 1)]));

    for now in [1020, 1030, 1040, 3000] {
        tell(&mut router, FIRST, earlier.clone(), now);
        let outputs = outputs(&mut router, now);
        let own = announced(&outputs, FIRST).into_iter().find(|own| own.node == named("own"));
        assert!(own.is_some_and(|own| own.id > earlier.id), "{outputs:?}");
        assert_eq!(without_routing(outputs), []);
    }
}

#[test]
fn of_two_nodes_that_outdo_each_other_the_later_one_stops() {
    for (theirs, stops) in [(9, false), (0, true)] {
        let mut router = between_two();
        let mut other = of_incarnation(theirs, advertisement("own", 1, &[("left", 1)]));
        let mut reported = Vec::new();
        for n in 1..=6 {
            other.id.sequence = router.database.own.id.sequence + 1;
            tell(&mut router, FIRST, other.clone(), 1000 + 200 * n);
            reported.extend(without_routing(outputs(&mut router, 1000 + 200 * n)));
        }
        let taken = RouterOutput::NameTaken { by: Incarnation(theirs) };
        assert_eq!(reported.contains(&taken), stops, "{reported:?}");
    }
}
