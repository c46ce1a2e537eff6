//! Whole networks of routers that hear each other after a millisecond.

use super::*;
use crate::Machine;
use crate::net::link::Neighbour;
use crate::net::routing::RouterConfig;
use crate::sorted::{SortedMap, SortedSet};

const MS: Duration = Duration::from_millis(1);

/// A node's name, and its incarnation.
type Who = (&'static str, u64);

#[derive(Default)]
struct Net {
    now: Instant,
    routers: SortedMap<Who, Router>,
    /// Who has a cable to whom; its number on one's side says who is at the other.
    cables: SortedSet<(Who, Who)>,
    numbers: SortedMap<(Who, &'static str), LinkId>,
    wire: Vec<(Who, LinkId, bytes::Bytes)>,
    outputs: Vec<String>,
}

impl Net {
    fn new(cables: &[(Who, Who)]) -> Self {
        let mut net = Net { now: Instant::from_millis(1_000), ..Net::default() };
        cables.iter().for_each(|(a, b)| net.plug(*a, *b));
        net.run(1_000);
        net.outputs.clear();
        net
    }

    /// A link is one cable's, whichever incarnation is at its other end.
    fn number(&mut self, own: Who, far: &'static str) -> LinkId {
        let next = LinkId(self.numbers.len() as u16);
        *self.numbers.entry((own, far)).or_insert(next)
    }

    fn link(&mut self, own: Who, far: Who, health: LinkHealth) {
        let number = self.number(own, far.0);
        let neighbour =
            Neighbour { node: NodeName::new(far.0).unwrap(), incarnation: Incarnation(far.1) };
        let status = LinkStatus { neighbour, health, cost: 10, mtu: 1400 };
        if let Some(router) = self.routers.get_mut(&own) {
            router.handle_link(number, status, self.now);
        }
        self.settle(own);
    }

    fn plug(&mut self, a: Who, b: Who) {
        for (name, incarnation) in [a, b] {
            let config = RouterConfig::new(NodeName::new(name).unwrap(), Incarnation(incarnation));
            let now = self.now;
            self.routers.entry((name, incarnation)).or_insert_with(|| Router::new(config, now));
        }
        self.cables.extend([(a, b), (b, a)]);
        self.link(a, b, LinkHealth::Up);
        self.link(b, a, LinkHealth::Up);
    }

    fn unplug(&mut self, a: Who, b: Who) {
        self.cables.retain(|cable| *cable != (a, b) && *cable != (b, a));
        self.link(a, b, LinkHealth::Down);
        self.link(b, a, LinkHealth::Down);
    }

    fn kill(&mut self, who: Who) {
        self.routers.remove(&who);
        let far: Vec<_> = self.cables.iter().filter(|(a, _)| *a == who).map(|(_, b)| *b).collect();
        far.into_iter().for_each(|far| self.unplug(who, far));
    }

    fn settle(&mut self, who: Who) {
        while let Some(output) = self.routers.get_mut(&who).and_then(Machine::poll_output) {
            match output {
                RouterOutput::Routing { link, bytes } => {
                    let far = self.numbers.iter().find(|(_, number)| **number == link);
                    let far = far.map(|((_, far), _)| *far).unwrap();
                    let cable = self.cables.iter().find(|(a, b)| *a == who && b.0 == far).copied();
                    if let Some((_, far)) = cable {
                        let number = self.number(far, who.0);
                        self.wire.push((far, number, bytes));
                    }
                }
                RouterOutput::Reachable { node, incarnation, .. } => {
                    self.outputs.push(format!("{who:?} reaches {node}{incarnation}"));
                }
                RouterOutput::Lost { node, incarnation } => {
                    self.outputs.push(format!("{who:?} lost {node}{incarnation}"));
                }
                RouterOutput::NameTaken { incarnation, first } => {
                    self.outputs.push(format!("{who:?} taken by {incarnation}, first: {first}"));
                }
                RouterOutput::Over(trouble) => {
                    self.outputs.push(format!("{who:?} is rid of {trouble:?}"));
                }
                _ => {}
            }
        }
    }

    fn run(&mut self, millis: u64) {
        for _ in 0..millis {
            self.now = self.now + MS;
            for (to, link, bytes) in std::mem::take(&mut self.wire) {
                if let Some(router) = self.routers.get_mut(&to) {
                    router.handle_routing(link, bytes, self.now);
                }
                self.settle(to);
            }
            let all: Vec<_> = self.routers.keys().copied().collect();
            for who in all {
                let router = self.routers.get_mut(&who).unwrap();
                if router.poll_timeout().is_some_and(|due| due <= self.now) {
                    router.handle_timeout(self.now);
                }
                self.settle(who);
            }
        }
    }

    fn outputs(&mut self) -> Vec<String> {
        std::mem::take(&mut self.outputs)
    }

    fn reached(&self, by: Who, name: &str) -> Option<u64> {
        let route = self.routers[&by].route(NodeId::of(&NodeName::new(name).unwrap()))?;
        Some(route.incarnation.0)
    }
}

const A: Who = ("a", 1);
const LATER: Who = ("a", 2);
const B: Who = ("b", 1);
const C: Who = ("c", 1);
const D: Who = ("d", 1);

#[test]
fn a_second_node_of_a_name_is_kept_out_and_both_are_told_while_nobody_else_notices() {
    let mut net = Net::new(&[(A, B), (B, C), (C, D)]);
    net.plug(C, LATER);
    net.run(15_000);

    let mut outputs = net.outputs();
    outputs.retain(|outputs| outputs.contains("taken") || outputs.starts_with("(\"b"));
    assert_eq!(
        outputs,
        ["(\"a\", 1) taken by #2, first: true", "(\"a\", 2) taken by #1, first: false"]
    );
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(1); 3]);

    net.kill(A);
    net.run(50);
    assert_eq!([B, C, D].map(|by| net.reached(by, "a")), [Some(2); 3], "its turn has come");
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
fn an_incarnation_that_ended_without_anybodys_knowing_does_not_keep_the_next_one_out_for_long() {
    let mut net = Net::new(&[(A, B), (B, C)]);
    // Its link to B is not known to be dead.
    net.routers.remove(&A);
    net.plug(C, LATER);
    net.run(100);
    assert_eq!(net.reached(C, "a"), Some(1));
    net.run(1_000);
    assert_eq!(net.reached(C, "a"), Some(2));
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
    assert_eq!(net.outputs().iter().filter(|outputs| outputs.contains("rid")).count(), 1);
    net.plug(C, LATER);
    net.run(1_000);
    let again = "(\"a\", 1) taken by #2, first: true";
    let outputs = net.outputs();
    assert!(outputs.iter().any(|outputs| outputs == again), "{outputs:?}");

    // The older one ends instead.
    net.kill(A);
    net.run(75_000);
    let mut outputs = net.outputs();
    outputs.retain(|outputs| outputs.contains("rid"));
    assert_eq!(outputs, ["(\"a\", 2) is rid of NameTaken"]);
}

#[test]
fn whoever_disputes_and_defends_all_the_time_is_not_answered_each_time() {
    let mut net = Net::new(&[(A, B)]);
    let node = NodeName::new("a").unwrap();
    let link = net.number(A, "b");
    let mut sent = 0;
    for n in 0..1_000_u64 {
        let contender =
            AdvertisementId { origin: NodeId::of(&node), incarnation: Incarnation(9), sequence: 0 };
        let dispute = RoutingMessage::Dispute { contender, node: node.clone() }.encode();
        let router = net.routers.get_mut(&A).unwrap();
        router.handle_routing(link, dispute, net.now + MS * (n as u32 / 10));
        sent += std::iter::from_fn(|| router.poll_output()).count();
    }
    assert!(sent <= 5, "{sent}");

    let router = net.routers.get_mut(&B).unwrap();
    for n in 0..1_000 {
        let node = NodeName::new(&format!("n{n}")).unwrap();
        let contender =
            AdvertisementId { origin: NodeId::of(&node), incarnation: Incarnation(9), sequence: 0 };
        router.handle_dispute(link, contender, node);
    }
    assert!(router.disputes.len() <= 256);
}
