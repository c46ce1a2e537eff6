use super::*;
use crate::testing::{at, node};

/// Node `a` with `b` described.
fn beside_b(admission: DiscoveryAdmission) -> Discovery {
    let mut a = Discovery::new(DiscoveryConfig::new(node("a"), admission));
    a.handle_link(node("b"), "b:1".into(), true, at(0));
    a
}

fn beacon(discovery: &mut Discovery, name: &str, address: &str, millis: u64) {
    discovery.handle_beacon(node(name), address.into(), at(millis));
}

fn outputs(discovery: &mut Discovery) -> Vec<String> {
    let text = |output| match output {
        DiscoveryOutput::Connect { node, address } => format!("try {node} at {address}"),
        DiscoveryOutput::Disconnect { node } => format!("give {node} up"),
    };
    std::iter::from_fn(|| discovery.poll_output()).map(text).collect()
}

#[test]
fn only_who_is_admitted_and_not_described_is_tried() {
    let mut a = beside_b(DiscoveryAdmission::Only(["c", "a", "b"].map(node).into()));
    for (name, address) in [("c", "c:1"), ("d", "d:1"), ("a", "a:1"), ("b", "x:1")] {
        beacon(&mut a, name, address, 30);
    }
    assert_eq!(outputs(&mut a), ["try c at c:1"]);
    assert_eq!(a.refusals().total(), 0);
}

#[test]
fn what_does_not_prove_itself_is_given_up_and_not_tried_again_soon() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    beacon(&mut a, "c", "nowhere:1", 0);
    outputs(&mut a);

    a.handle_time(at(4_999));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
    a.handle_time(at(5_000));
    assert_eq!(outputs(&mut a), ["give c up"]);
    beacon(&mut a, "c", "nowhere:1", 34_999);
    assert_eq!(outputs(&mut a), Vec::<String>::new());
    beacon(&mut a, "c", "c:1", 34_999);
    assert_eq!(outputs(&mut a), ["try c at c:1"], "its right address is another matter");
    a.handle_link(node("c"), "c:1".into(), true, at(36_000));
    a.handle_time(at(50_000));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
}

#[test]
fn a_learned_neighbour_is_tried_for_long_after_it_went_and_then_forgotten() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    beacon(&mut a, "c", "c:1", 0);
    a.handle_link(node("c"), "c:1".into(), true, at(500));
    a.handle_link(node("b"), "b:1".into(), false, at(1_000));
    a.handle_link(node("c"), "c:1".into(), false, at(2_000));
    outputs(&mut a);

    a.handle_time(at(601_999));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
    a.handle_time(at(602_000));
    assert_eq!(outputs(&mut a), ["give c up"]);
    a.handle_time(at(10_000_000));
    assert_eq!(outputs(&mut a), Vec::<String>::new(), "who was described is never given up");
}

#[test]
fn a_neighbour_that_came_back_elsewhere_is_tried_there() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    beacon(&mut a, "c", "c:1", 0);
    a.handle_link(node("c"), "c:1".into(), true, at(500));
    outputs(&mut a);

    beacon(&mut a, "c", "c:2", 600);
    a.handle_link(node("c"), "c:1".into(), false, at(1_000));
    beacon(&mut a, "c", "c:2", 5_999);
    assert_eq!(outputs(&mut a), Vec::<String>::new(), "who is up, or was just now, is believed");
    beacon(&mut a, "c", "c:2", 6_010);
    assert_eq!(outputs(&mut a), ["give c up", "try c at c:2"]);
}

#[test]
fn a_flood_of_beacons_is_bounded_and_counted() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    for n in 0..5_000_u64 {
        beacon(&mut a, &format!("n{n}"), &format!("10.0.0.1:{n}"), n / 5);
    }
    a.handle_noise();

    assert_eq!(outputs(&mut a).len(), TRIED_MAX);
    assert_eq!((a.refusals().too_large, a.refusals().malformed), (5_000 - TRIED_MAX as u64, 1));
    assert!(a.neighbours.len() <= 1 + LEARNED_MAX);
    for round in 1..100_u64 {
        a.handle_time(at(5_000 * round));
        for n in 0..TRIED_MAX {
            beacon(&mut a, &format!("m{n}"), &format!("10.0.0.2:{round}{n}"), 5_000 * round);
        }
    }
    assert!(a.failed.len() <= FAILED_MAX && a.neighbours.len() <= 1 + LEARNED_MAX);
}
