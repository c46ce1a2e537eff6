use super::claims::EPOCH_MAX;
use super::types::{DirectoryMessage, DirectoryRecord};
use super::*;
use crate::contract::codec;
use crate::net::trust::crypto::Seed;
use crate::net::trust::policy::Role;
use crate::net::trust::roster::{NodeRoster, RosterNode};
use crate::testing::{at, node};
use bytes::Bytes;
use std::time::Duration;

const LEASE: Duration = Duration::from_millis(400);

fn map() -> ObjectName {
    ObjectName::new("map").unwrap()
}

fn text(key: &DirectoryKey) -> String {
    match key {
        DirectoryKey::Object(name) => name.to_string(),
        DirectoryKey::Publisher { topic, contract } => format!("{contract} on {topic}"),
        DirectoryKey::Name(name) => format!("the name {name}"),
    }
}

/// Nodes `a`, `b`, `c` … that hear each other at once, unless they are parted.
struct Robot {
    now: u64,
    nodes: SortedMap<NodeName, Directory>,
    parted: bool,
    /// Sent while they are parted: from whom, and to whom.
    underway: Vec<(NodeName, NodeName, Bytes)>,
    outputs: Vec<String>,
    /// Of nodes that start from now on.
    settle: Duration,
    expected: BTreeSet<NodeName>,
}

impl Robot {
    fn new(names: &[&str]) -> Self {
        let (settle, expected) = (Duration::ZERO, BTreeSet::new());
        let (nodes, underway, outputs) = (SortedMap::new(), vec![], vec![]);
        let mut robot = Robot { now: 0, nodes, parted: false, underway, outputs, settle, expected };
        names.iter().for_each(|name| robot.start(name, 0));
        robot
    }

    fn start(&mut self, name: &str, incarnation: u64) {
        let incarnation = Incarnation(incarnation);
        let (settle, expected) = (self.settle, self.expected.clone());
        let config =
            DirectoryConfig { node: node(name), incarnation, lease: LEASE, settle, expected };
        let mut claims = Directory::new(config, at(self.now));
        for (other, theirs) in &mut self.nodes {
            theirs.handle_opened(node(name), incarnation, at(self.now));
            claims.handle_opened(other.clone(), theirs.config.incarnation, at(self.now));
        }
        self.nodes.insert(node(name), claims);
        self.carry();
    }

    /// `a` alone on one side, the others on the other.
    fn can_hear(&self, one: &NodeName, other: &NodeName) -> bool {
        !self.parted || (one.as_str() == "a") == (other.as_str() == "a")
    }

    /// Parts `a` from the others, or leads paths there again. Their sessions go on.
    fn part(&mut self, parted: bool) {
        self.parted = parted;
        let now = at(self.now);
        let all: Vec<_> = self.nodes.keys().cloned().collect();
        for (name, directory) in &mut self.nodes {
            for other in all.iter().filter(|other| *other != name) {
                if (name.as_str() == "a") != (other.as_str() == "a") {
                    match parted {
                        true => directory.handle_unreachable(other, now),
                        false => directory.handle_reachable(other, now),
                    }
                }
            }
        }
        for (from, to, message) in std::mem::take(&mut self.underway) {
            self.bring(from, to, message);
        }
        self.carry();
    }

    fn bring(&mut self, from: NodeName, to: NodeName, message: Bytes) {
        match self.can_hear(&from, &to) {
            true => {
                if let Some(claims) = self.nodes.get_mut(&to) {
                    claims.handle_message(&from, &message, at(self.now));
                }
            }
            false => self.underway.push((from, to, message)),
        }
    }

    fn carry(&mut self) {
        loop {
            let mut outputs = vec![];
            for (name, claims) in &mut self.nodes {
                outputs.extend(claims.poll_output().map(|output| (name.clone(), output)));
            }
            if outputs.is_empty() {
                return;
            }
            for (from, output) in outputs {
                match output {
                    DirectoryOutput::Send { to, message } => self.bring(from, to, message),
                    DirectoryOutput::StandsBy { .. } => {}
                    DirectoryOutput::Granted { name, .. } => {
                        self.outputs.push(format!("{from} has {name}"))
                    }
                    DirectoryOutput::Lost { name, to, .. } => {
                        self.outputs.push(format!("{from} lost {name} to {to}"));
                    }
                    DirectoryOutput::Refused { name, .. } => {
                        self.outputs.push(format!("{from} is refused {name}"));
                    }
                    DirectoryOutput::AccessDenied { denied } => {
                        let (peer, verb) = (&denied.peer, denied.verb);
                        self.outputs.push(format!("{from} refuses {peer} to {verb}"));
                    }
                    DirectoryOutput::Held { name, holder } => {
                        let known =
                            self.nodes[&from].shown.get(&name).map(|(holder, _)| holder.clone());
                        let overtaken = known != holder;
                        assert!(overtaken || self.nodes[&from].holder(&name) == holder);
                    }
                }
            }
        }
    }

    fn claim(&mut self, who: &str, policy: ClaimPolicy) -> Result<Option<u64>, ClaimRefused> {
        let wanted = ClaimRequest::new(map(), policy);
        let claimed = self.nodes.get_mut(&node(who)).unwrap().handle_claim(wanted, at(self.now));
        self.carry();
        claimed
    }

    fn advance(&mut self, millis: u64) {
        for _ in 0..millis {
            self.now += 1;
            self.nodes.values_mut().for_each(|claims| claims.handle_timeout(at(self.now)));
            self.carry();
        }
    }

    fn holder(&self, seen_by: &str) -> Option<String> {
        self.nodes[&node(seen_by)].holder(&map()).map(|holder| holder.node.to_string())
    }

    /// What one node knows of the objects and publishers of another, if that can be reached.
    fn seen(&self, by: &str, of: &str) -> Vec<String> {
        let mut nodes = self.nodes[&node(by)].nodes();
        let seen = nodes.find_map(|(name, _, keys)| {
            let keys = keys.filter(|key| !matches!(key, DirectoryKey::Name(_)));
            (*name == node(of)).then(|| keys.map(text).collect())
        });
        seen.unwrap_or_default()
    }

    fn outputs(&mut self) -> Vec<String> {
        std::mem::take(&mut self.outputs)
    }
}

#[test]
fn a_second_claimant_is_refused_or_stands_by_as_it_wishes() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    let epoch = robot.claim("b", ClaimPolicy::Refuse).unwrap().unwrap();

    let held = NameHeld { name: map(), holder: node("b"), epoch };
    assert_eq!(robot.claim("a", ClaimPolicy::Refuse), Err(held.into()));
    assert_eq!(robot.claim("c", ClaimPolicy::Standby), Ok(None));
    assert_eq!(robot.claim("b", ClaimPolicy::Refuse), Ok(Some(epoch)), "it has it already");

    assert_eq!(["a", "b", "c"].map(|seen_by| robot.holder(seen_by).unwrap()), ["b"; 3]);
    assert_eq!(robot.outputs(), ["b has map"]);
}

#[test]
fn the_first_standby_takes_over_when_the_lease_of_a_node_that_died_is_over() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    let old = robot.claim("a", ClaimPolicy::Standby).unwrap().unwrap();
    robot.claim("c", ClaimPolicy::Standby).unwrap();
    robot.claim("b", ClaimPolicy::Standby).unwrap();
    robot.advance(1000);
    robot.outputs();

    robot.nodes.remove(&node("a"));
    let now = at(robot.now);
    robot.nodes.values_mut().for_each(|claims| claims.handle_unreachable(&node("a"), now));
    robot.advance(300);
    assert_eq!(robot.holder("c").as_deref(), Some("a"), "its lease holds");
    let now = at(robot.now);
    robot.nodes.values_mut().for_each(|claims| claims.handle_ended(&node("a"), now));
    robot.advance(110);

    assert_eq!(robot.outputs(), ["b has map"]);
    let holder = robot.nodes[&node("c")].holder(&map()).unwrap();
    assert_eq!((holder.node, holder.object), (node("b"), map()));
    assert!(holder.epoch > old);
}

#[test]
fn a_name_that_is_given_back_goes_to_a_standby_at_once() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    robot.claim("c", ClaimPolicy::Refuse).unwrap();
    robot.claim("a", ClaimPolicy::Standby).unwrap();
    robot.outputs();

    robot.nodes.get_mut(&node("c")).unwrap().handle_withdrawn(&map(), at(0));
    robot.carry();
    robot.advance(1);

    assert_eq!(robot.outputs(), ["a has map"]);
    assert_eq!(robot.holder("c").as_deref(), Some("a"));
}

#[test]
fn two_halves_of_a_robot_agree_again_when_they_meet() {
    for (policy, after) in [(ClaimPolicy::Refuse, 0), (ClaimPolicy::Standby, 1)] {
        let mut robot = Robot::new(&["a", "b", "c"]);
        robot.claim("a", policy).unwrap();
        robot.claim("b", ClaimPolicy::Standby).unwrap();
        robot.part(true);
        robot.advance(500);
        let halves = (robot.holder("a").unwrap(), robot.holder("c").unwrap());
        assert_eq!(halves, ("a".to_owned(), "b".to_owned()));
        robot.outputs();

        robot.part(false);
        robot.advance(500);

        assert_eq!(["a", "b", "c"].map(|seen_by| robot.holder(seen_by).unwrap()), ["b"; 3]);
        assert_eq!(robot.outputs(), ["a lost map to b"]);
        assert_eq!(robot.nodes[&node("a")].own.len(), after, "{policy:?}");
    }
}

#[test]
fn a_node_that_begins_anew_has_nothing_until_it_claims_it() {
    let mut robot = Robot::new(&["a", "b"]);
    let old = robot.claim("a", ClaimPolicy::Refuse).unwrap().unwrap();
    robot.nodes.remove(&node("a"));
    robot.start("a", 1);

    assert_eq!(robot.holder("b"), None);
    let new = robot.claim("b", ClaimPolicy::Refuse).unwrap().unwrap();
    assert!(new > old);
}

#[test]
fn too_many_claims_and_nonsense_are_refused_and_counted_by_node() {
    let mut robot = Robot::new(&["a", "b"]);
    let hostile = (0..CLAIMS_MAX + PRESENT_MAX + 3).map(|n| outputs(&format!("name{n}"), 1));
    let claims = robot.nodes.get_mut(&node("b")).unwrap();
    hostile.for_each(|outputs| claims.hear(&node("a"), outputs, at(0)));
    claims.handle_message(&node("a"), b"\xff\xff", at(0));
    claims.handle_message(&node("stranger"), b"\0", at(0));

    let refusals = claims.refusals().next().unwrap().1;
    assert_eq!((refusals.too_large, refusals.malformed), (3, 1));
    assert_eq!(claims.held(), CLAIMS_MAX + PRESENT_MAX);
}

#[test]
fn an_epoch_that_leaves_no_greater_one_is_refused() {
    let mut robot = Robot::new(&["a", "b"]);
    let claims = robot.nodes.get_mut(&node("b")).unwrap();
    claims.hear(&node("a"), outputs("map", u64::MAX), at(0));
    claims.hear(&node("a"), outputs("plan", EPOCH_MAX - 1), at(0));

    assert_eq!(claims.refusals().next().unwrap().1.malformed, 1);
    robot.claim("b", ClaimPolicy::Refuse).unwrap();
    assert_eq!(robot.holder("a").as_deref(), Some("b"));
}

#[test]
fn a_node_that_starts_takes_no_name_before_it_has_heard_who_holds_it() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.claim("a", ClaimPolicy::Refuse).unwrap();
    robot.outputs();
    robot.parted = true; // Its sessions take a while.
    robot.settle = Duration::from_millis(350);
    robot.start("c", 9);
    assert_eq!(robot.claim("c", ClaimPolicy::Refuse), Ok(None), "it waits");
    robot.advance(200);
    assert_eq!(robot.outputs(), Vec::<String>::new());

    robot.part(false);
    robot.advance(150);

    assert_eq!(robot.outputs(), ["c is refused map"]);
    assert_eq!(robot.holder("c").as_deref(), Some("a"));
}

#[test]
fn a_name_that_nobody_has_is_granted_once_all_that_are_expected_were_heard_or_are_too_late() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.settle = Duration::from_millis(300);
    robot.expected = ["a", "b"].map(node).into();
    robot.start("c", 9);
    assert!(robot.claim("c", ClaimPolicy::Refuse).unwrap().is_some(), "all were heard");

    robot.expected = ["a", "gone"].map(node).into();
    robot.start("d", 9);
    let other = ClaimRequest::new(ObjectName::new("plan").unwrap(), ClaimPolicy::Refuse);
    let claims = robot.nodes.get_mut(&node("d")).unwrap();
    assert_eq!(claims.handle_claim(other, at(robot.now)), Ok(None));
    robot.outputs();
    robot.advance(299);
    assert_eq!(robot.outputs(), Vec::<String>::new());
    robot.advance(1);
    assert_eq!(robot.outputs(), ["d has plan"]);
}

#[test]
fn all_nodes_that_start_together_and_want_one_name_agree_without_a_dispute() {
    let mut robot = Robot::new(&[]);
    robot.settle = Duration::from_millis(300);
    for name in ["b", "c", "a"] {
        robot.start(name, 1);
        assert_eq!(robot.claim(name, ClaimPolicy::Standby), Ok(None));
    }
    robot.advance(400);

    assert_eq!(robot.outputs(), ["a has map"]);
}

#[test]
fn what_is_told_again_in_parts_does_not_come_and_go() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.claim("a", ClaimPolicy::Refuse).unwrap();
    let claims = robot.nodes.get_mut(&node("b")).unwrap();
    claims.hear(&node("a"), outputs("old", 7), at(0));
    while claims.poll_output().is_some() {}

    let epoch = claims.holder(&map()).unwrap().epoch;
    let first = DirectoryMessage::All { first: true, last: false, records: vec![] };
    claims.handle_message(&node("a"), &codec::encode_unbounded(&first), at(1));
    assert_eq!(claims.held(), 2);
    let last =
        DirectoryMessage::All { first: false, last: true, records: vec![outputs("map", epoch)] };
    claims.handle_message(&node("a"), &codec::encode_unbounded(&last), at(2));

    let old = ObjectName::new("old").unwrap();
    assert_eq!(claims.poll_output(), Some(DirectoryOutput::Held { name: old, holder: None }));
    assert_eq!((claims.poll_output(), claims.held()), (None, 1));
}

#[test]
fn a_directory_that_is_built_again_keeps_what_its_node_holds_and_what_others_have_told() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    let epoch = robot.claim("a", ClaimPolicy::Refuse).unwrap();
    robot.claim("b", ClaimPolicy::Standby).unwrap();
    robot.has("b", &[object("arm")]);
    robot.outputs();
    robot.advance(100);
    for name in ["a", "b"] {
        let mut lost = robot.nodes.remove(&node(name)).unwrap();
        // This was not carried out before the panic.
        lost.handle_present([object("leg")].into());
        robot.nodes.insert(node(name), lost.rebuilt(at(robot.now)));
        robot.carry();
    }
    robot.advance(500);

    assert_eq!(robot.outputs(), ["a has map"], "which it had");
    for (by, of) in [("a", "b"), ("b", "a"), ("c", "a"), ("c", "b")] {
        assert_eq!(robot.seen(by, of), ["leg"], "{by} of {of}");
    }
    assert_eq!(robot.nodes[&node("b")].holder(&map()).map(|holder| holder.epoch), epoch);
}

#[test]
fn what_a_node_has_counts_again_when_its_path_is_back_within_a_session() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.claim("a", ClaimPolicy::Refuse).unwrap();
    robot.has("a", &[object("arm")]);

    // Only one of the two misses the other: the other one says nothing again.
    let b = robot.nodes.get_mut(&node("b")).unwrap();
    b.handle_unreachable(&node("a"), at(0));
    robot.advance(400);
    assert_eq!((robot.holder("b"), robot.seen("b", "a")), (None, vec![]));
    robot.has("a", &[object("leg")]);
    let b = robot.nodes.get_mut(&node("b")).unwrap();
    b.handle_reachable(&node("a"), at(robot.now));
    robot.carry();

    assert_eq!(robot.seen("b", "a"), ["leg"]);
    assert_eq!(robot.holder("b").as_deref(), Some("a"));
}

#[test]
fn a_path_that_is_back_within_a_session_brings_what_changed_meanwhile_and_nothing_else() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.has("a", &[object("arm")]);
    robot.part(true);
    robot.advance(500);
    robot.has("a", &[object("leg")]);
    robot.part(false);
    assert_eq!(robot.seen("b", "a"), ["leg"]);

    let a = robot.nodes.get_mut(&node("a")).unwrap();
    a.handle_unreachable(&node("b"), at(robot.now));
    a.handle_reachable(&node("b"), at(robot.now));
    assert_eq!(a.poll_output(), None);
}

fn outputs(name: &str, epoch: u64) -> DirectoryRecord {
    let claim = NameClaim { epoch: Some(epoch), object: None };
    DirectoryRecord { key: DirectoryKey::Name(ObjectName::new(name).unwrap()), claim }
}

/// The robot's nodes, with this line of policy.
fn roster(line: &str) -> NodeRoster {
    let nodes = ["a", "b", "c"].iter().zip(1..).map(|(name, seed)| RosterNode {
        name: node(name),
        keys: Seed::new([seed; 32]).public_keys(),
        role: Role::Node,
    });
    let roster = NodeRoster::new(node("ranger"), nodes).expect("different nodes");
    let lines = format!("policy\n{line}end");
    NodeRoster::parse(&roster.to_text().replace("end", &lines)).expect("a line")
}

#[test]
fn only_who_may_claim_a_name_gets_it_and_another_policy_takes_it_away() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    // The other nodes know the policy, and the claimant does not mind it.
    let policy = roster("only b may claim on map\n");
    for own in ["b", "c"] {
        let machine = robot.nodes.get_mut(&node(own)).unwrap();
        machine.handle_access(AccessPolicy::new(node(own), &policy), at(0));
    }
    assert!(robot.claim("a", ClaimPolicy::Refuse).is_ok_and(|epoch| epoch.is_some()));
    // It tells them that it wants the name, and that it has it.
    let refusals = ["b refuses a to claim", "c refuses a to claim"];
    assert_eq!(robot.outputs(), [&refusals[..], &refusals, &["a has map"]].concat());
    assert_eq!((robot.holder("b"), robot.holder("c")), (None, None));
    robot.advance(5_000);
    assert_eq!(robot.outputs(), Vec::<String>::new());
    assert!(robot.claim("b", ClaimPolicy::Refuse).is_ok_and(|epoch| epoch.is_some()));
    let refused = robot.claim("c", ClaimPolicy::Standby);
    assert!(matches!(refused, Err(ClaimRefused::Forbidden { .. })), "{refused:?}");
    assert_eq!(robot.holder("c").as_deref(), Some("b"));
    robot.outputs();

    let policy = roster("only a c may claim on map\n");
    for own in ["b", "c"] {
        let machine = robot.nodes.get_mut(&node(own)).unwrap();
        machine.handle_access(AccessPolicy::new(node(own), &policy), at(robot.now));
        robot.carry();
    }
    assert!(robot.outputs().contains(&"b is refused map".to_owned()));
    robot.advance(5_000);
    assert_eq!(
        ["a", "b", "c"].map(|seen_by| robot.holder(seen_by)),
        [const { "a" }; 3].map(|a| Some(a.to_owned()))
    );
}

fn object(name: &str) -> DirectoryKey {
    DirectoryKey::Object(ObjectName::new(name).unwrap())
}

fn publisher(topic: &str) -> DirectoryKey {
    let topic = ObjectName::new(topic).unwrap();
    DirectoryKey::Publisher { topic, contract: "scan".to_owned() }
}

impl Robot {
    fn has(&mut self, who: &str, present: &[DirectoryKey]) {
        let present = present.iter().cloned().collect();
        assert_eq!(self.nodes.get_mut(&node(who)).unwrap().handle_present(present), 0);
        self.carry();
    }
}

#[test]
fn objects_and_publishers_come_and_go_beside_names_that_are_called_alike() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.claim("a", ClaimPolicy::Refuse).unwrap();

    robot.has("a", &[object("map"), publisher("map"), publisher("news")]);
    assert_eq!(robot.seen("b", "a"), ["map", "scan on map", "scan on news"]);
    let b = &robot.nodes[&node("b")];
    assert_eq!(b.nodes_with(&publisher("map")), [node("a")]);
    assert_eq!(b.nodes_with(&object("news")), []);
    robot.has("a", &[object("map"), publisher("news"), object("arm")]);
    assert_eq!(robot.seen("b", "a"), ["arm", "map", "scan on news"]);
    robot.has("a", &[]);
    assert_eq!(robot.seen("b", "a"), [""; 0]);
    assert_eq!(robot.holder("b").as_deref(), Some("a"));
}

#[test]
fn who_meets_a_node_is_told_of_all_that_it_has_and_forgets_it_a_lease_after_its_end() {
    let mut robot = Robot::new(&["a"]);
    let many: Vec<_> = (0..300).map(|n| object(&format!("leg{n}"))).collect();
    robot.has("a", &many);
    robot.claim("a", ClaimPolicy::Refuse).unwrap();

    robot.start("b", 0);
    assert_eq!(robot.seen("b", "a").len(), 300);
    // The next session of the same incarnation takes nothing away.
    robot.nodes.get_mut(&node("b")).unwrap().handle_ended(&node("a"), at(0));
    robot.nodes.get_mut(&node("b")).unwrap().handle_opened(node("a"), Incarnation(0), at(0));
    robot.nodes.get_mut(&node("a")).unwrap().handle_opened(node("b"), Incarnation(0), at(0));
    robot.carry();
    assert_eq!(robot.seen("b", "a").len(), 300);

    robot.nodes.remove(&node("a"));
    robot.nodes.get_mut(&node("b")).unwrap().handle_ended(&node("a"), at(0));
    robot.advance(399);
    assert_eq!(robot.holder("b").as_deref(), Some("a"));
    robot.advance(1);
    assert_eq!((robot.holder("b"), robot.nodes[&node("b")].peers.len()), (None, 0));
}

#[test]
fn a_publisher_counts_only_where_its_node_may_publish() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.has("a", &[publisher("map"), object("map")]);
    robot.outputs();
    for (line, seen) in
        [("only b may publish on map\n", &["map"][..]), ("", &["map", "scan on map"])]
    {
        let b = robot.nodes.get_mut(&node("b")).unwrap();
        b.handle_access(AccessPolicy::new(node("b"), &roster(line)), at(robot.now));
        assert_eq!(robot.seen("b", "a"), seen);
        let publishing = robot.nodes[&node("b")].nodes_with(&publisher("map"));
        assert_eq!(publishing.len(), seen.len() - 1);
    }
}

#[test]
fn what_is_beyond_the_bounds_of_a_node_is_not_told_and_not_taken() {
    let mut robot = Robot::new(&["a", "b"]);
    let all = (0..PRESENT_MAX + 5).map(|n| object(&format!("leg{n}"))).collect();
    let a = robot.nodes.get_mut(&node("a")).unwrap();
    assert_eq!(a.handle_present(all), 5);
    robot.carry();
    assert_eq!(robot.seen("b", "a").len(), PRESENT_MAX);

    let a = robot.nodes.get_mut(&node("a")).unwrap();
    let wide = (0..PRESENT_MAX).map(|n| object(&format!("{n:0>100}"))).collect();
    assert_eq!(a.handle_present(wide), PRESENT_MAX - PRESENT_BYTES_MAX / 106);
    assert_eq!(a.handle_present((0..PRESENT_MAX).map(|n| object(&format!("leg{n}"))).collect()), 0);
    while a.poll_output().is_some() {}

    let b = robot.nodes.get_mut(&node("b")).unwrap();
    let long = DirectoryKey::Publisher { topic: map(), contract: "x".repeat(256) };
    let claim = NameClaim::default();
    b.hear(&node("a"), DirectoryRecord { key: long, claim: claim.clone() }, at(0));
    for n in 0..CLAIMS_MAX + 3 {
        let key = object(&format!("more{n}"));
        b.hear(&node("a"), DirectoryRecord { key, claim: claim.clone() }, at(0));
    }
    let refusals = b.refusals().next().unwrap().1;
    assert_eq!((refusals.too_large, refusals.malformed), (3, 1));
}
