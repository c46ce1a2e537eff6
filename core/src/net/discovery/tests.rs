use super::*;

fn ms(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn node(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn domain(name: &str, medium: &str, admission: DiscoveryAdmission) -> DiscoveryDomain {
    DiscoveryDomain { name: name.into(), medium: medium.into(), admission }
}

fn of(name: &str, domains: Vec<DiscoveryDomain>) -> Discovery {
    Discovery::new(DiscoveryConfig::new(node(name), domains), ms(0))
}

/// Node `a` with `b` beside it on one network.
fn beside_b(admission: DiscoveryAdmission) -> Discovery {
    let mut a = of("a", vec![domain("ethernet", "udp", admission)]);
    a.handle_up(0, node("b"), "b:1".into(), ms(0));
    while a.poll_output().is_some() {}
    a
}

fn gossip(network: &str, medium: &str, neighbours: &[(&str, &str)]) -> Vec<u8> {
    let neighbours = neighbours.iter().map(|(name, at)| (node(name), (*at).to_owned())).collect();
    let gossip = Gossip { network: network.into(), medium: medium.into(), neighbours };
    codec::encode_unbounded(&vec![gossip])
}

fn outputs(discovery: &mut Discovery) -> Vec<String> {
    let text = |output| match output {
        DiscoveryOutput::Send { to, .. } => format!("tell {to}"),
        DiscoveryOutput::Connect { domain, node, address } => {
            format!("{domain}: try {node} at {address}")
        }
        DiscoveryOutput::Disconnect { domain, node } => format!("{domain}: give {node} up"),
    };
    std::iter::from_fn(|| discovery.poll_output()).map(text).collect()
}

#[test]
fn two_that_know_only_the_one_between_learn_of_each_other() {
    let mut b =
        of("b", vec![domain("ethernet", "udp", DiscoveryAdmission::Only(SortedSet::new()))]);
    b.handle_up(0, node("a"), "a:1".into(), ms(0));
    b.handle_up(0, node("c"), "c:1".into(), ms(5));
    b.handle_timeout(ms(20));

    for (name, learns) in [("a", "0: try c at c:1"), ("c", "0: try a at a:1")] {
        let Some(DiscoveryOutput::Send { to, message }) = b.poll_output() else { panic!() };
        assert_eq!(to, node(name));
        let mut other = of(name, vec![domain("eth0", "udp", DiscoveryAdmission::AnyNode)]);
        other.handle_up(0, node("b"), "b:1".into(), ms(0));
        other.handle_message(&node("b"), &message, ms(30));
        assert_eq!(outputs(&mut other), [learns]);
    }
    assert_eq!(outputs(&mut b), Vec::<String>::new());
}

#[test]
fn only_who_is_admitted_and_not_described_is_tried() {
    let mut a = beside_b(DiscoveryAdmission::Only([node("c"), node("a"), node("b")].into()));
    let all = gossip("ethernet", "udp", &[("c", "c:1"), ("d", "d:1"), ("a", "a:1"), ("b", "x:1")]);
    a.handle_message(&node("b"), &all, ms(30));
    assert_eq!(outputs(&mut a), ["0: try c at c:1"]);
    assert_eq!(a.refusals().map(|(_, refusals)| refusals.total()).sum::<u64>(), 0);
}

#[test]
fn what_is_told_counts_on_networks_of_the_same_medium_that_the_teller_is_on() {
    let admission = || DiscoveryAdmission::AnyNode;
    let names = [("left", "udp"), ("right", "udp"), ("wire", "tcp"), ("far", "udp")];
    let domains = names.map(|(name, medium)| domain(name, medium, admission()));
    let mut a = of("a", domains.into());
    for n in 0..3 {
        a.handle_up(n, node("b"), "b:1".into(), ms(0));
    }

    a.handle_message(&node("b"), &gossip("right", "udp", &[("c", "c:1")]), ms(10));
    assert_eq!(outputs(&mut a), ["1: try c at c:1"], "the one of the same name");
    a.handle_message(&node("b"), &gossip("else", "udp", &[("d", "d:1")]), ms(20));
    assert_eq!(outputs(&mut a), ["0: try d at d:1", "1: try d at d:1"], "either may be meant");
    a.handle_message(&node("b"), &gossip("far", "unix", &[("e", "/e")]), ms(30));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
}

#[test]
fn what_does_not_prove_itself_is_given_up_and_not_tried_again_soon() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    let forged = gossip("ethernet", "udp", &[("c", "nowhere:1")]);
    a.handle_message(&node("b"), &forged, ms(0));
    outputs(&mut a);

    a.handle_timeout(ms(4_999));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
    a.handle_timeout(ms(5_000));
    assert_eq!(outputs(&mut a), ["0: give c up"]);
    a.handle_message(&node("b"), &forged, ms(34_999));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
    a.handle_message(&node("b"), &gossip("ethernet", "udp", &[("c", "c:1")]), ms(35_010));
    assert_eq!(outputs(&mut a), ["0: try c at c:1"], "its right address is another matter");
    a.handle_up(0, node("c"), "c:1".into(), ms(36_000));
    a.handle_timeout(ms(50_000));
    assert_eq!(outputs(&mut a), ["tell b", "tell c"]);
}

#[test]
fn a_learned_neighbour_is_tried_for_long_after_it_went_and_then_forgotten() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    a.handle_message(&node("b"), &gossip("ethernet", "udp", &[("c", "c:1")]), ms(0));
    a.handle_up(0, node("c"), "c:1".into(), ms(500));
    a.handle_down(0, node("b"), "b:1".into(), ms(1_000));
    a.handle_down(0, node("c"), "c:1".into(), ms(2_000));
    outputs(&mut a);

    a.handle_timeout(ms(601_999));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
    a.handle_timeout(ms(602_000));
    assert_eq!(outputs(&mut a), ["0: give c up"]);
    a.handle_timeout(ms(10_000_000));
    assert_eq!(outputs(&mut a), Vec::<String>::new(), "who was described is never given up");
}

#[test]
fn a_neighbour_that_came_back_elsewhere_is_tried_there() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    a.handle_message(&node("b"), &gossip("ethernet", "udp", &[("c", "c:1")]), ms(0));
    a.handle_up(0, node("c"), "c:1".into(), ms(500));
    outputs(&mut a);
    let elsewhere = gossip("ethernet", "udp", &[("c", "c:2")]);

    a.handle_message(&node("b"), &elsewhere, ms(600));
    a.handle_down(0, node("c"), "c:1".into(), ms(1_000));
    a.handle_message(&node("b"), &elsewhere, ms(5_999));
    assert_eq!(outputs(&mut a), Vec::<String>::new(), "who is up, or was just now, is believed");
    a.handle_message(&node("b"), &elsewhere, ms(6_010));
    assert_eq!(outputs(&mut a), ["0: give c up", "0: try c at c:2"]);
}

#[test]
fn a_flood_of_gossip_and_of_nodes_is_bounded_and_counted_by_who_says_it() {
    let mut a = beside_b(DiscoveryAdmission::AnyNode);
    let names: Vec<_> = (0..5_000).map(|n| (format!("n{n}"), format!("10.0.0.1:{n}"))).collect();
    for (round, some) in names.chunks(100).enumerate() {
        let some: Vec<_> = some.iter().map(|(n, at)| (n.as_str(), at.as_str())).collect();
        let at = ms(20 * round as u64);
        a.handle_message(&node("b"), &gossip("ethernet", "udp", &some), at);
        a.handle_message(&node("b"), &gossip("ethernet", "udp", &some), at);
    }
    a.handle_message(&node("b"), &[0xff; 40_000], ms(2_000));
    let huge = "x".repeat(200);
    a.handle_message(&node("b"), &gossip("ethernet", "udp", &[("c", &huge)]), ms(2_010));
    a.handle_message(&node("z"), &gossip("ethernet", "udp", &[("c", "c:1")]), ms(2_020));

    assert_eq!(outputs(&mut a).len(), TRIED_MAX);
    let (who, refusals) = a.refusals().next().unwrap();
    assert_eq!(who, Some(&node("b")));
    assert_eq!((refusals.unexpected, refusals.malformed), (50, 2));
    assert_eq!(refusals.too_large, 5_000 - TRIED_MAX as u64);
    assert!(a.neighbours.len() <= 1 + LEARNED_MAX && a.tellers.len() == 1);

    for n in 0..40_u64 {
        a.handle_beacon(0, node(&format!("m{n}")), format!("10.0.0.2:{n}"), ms(2_030));
    }
    assert_eq!(a.refusals().last().unwrap().1.too_large, 40);
    a.handle_timeout(ms(100_000));
    assert!(a.failed.len() <= FAILED_MAX && a.neighbours.len() == 1);
}

#[test]
fn a_node_says_by_beacon_where_it_is() {
    let mut a =
        of("a", vec![domain("ethernet", "udp", DiscoveryAdmission::Only([node("c")].into()))]);
    for name in ["a", "b", "c"] {
        a.handle_beacon(0, node(name), format!("{name}:1"), ms(0));
    }
    a.handle_beacon(7, node("c"), "c:1".into(), ms(0));
    assert_eq!(outputs(&mut a), ["0: try c at c:1"]);
    a.handle_unusable(0, &node("c"), ms(1));
    a.handle_beacon(0, node("c"), "c:1".into(), ms(2));
    assert_eq!(outputs(&mut a), Vec::<String>::new());
}
