use super::*;

const LEASE: Duration = Duration::from_millis(400);

fn ms(millis: u64) -> Instant {
    Instant::from_millis(millis)
}

fn node(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

fn map() -> ObjectName {
    ObjectName::new("map").unwrap()
}

/// Nodes `a`, `b`, `c` … that hear each other at once, unless they are parted.
struct Robot {
    now: u64,
    nodes: BTreeMap<NodeName, Claims>,
    parted: bool,
    told: Vec<String>,
}

impl Robot {
    fn new(names: &[&str]) -> Self {
        let mut robot = Robot { now: 0, nodes: BTreeMap::new(), parted: false, told: vec![] };
        names.iter().for_each(|name| robot.start(name, 0));
        robot
    }

    fn start(&mut self, name: &str, incarnation: u64) {
        let incarnation = Incarnation(incarnation);
        let config = ClaimsConfig { node: node(name), incarnation, lease: LEASE };
        let mut claims = Claims::new(config, ms(self.now));
        for (other, theirs) in &mut self.nodes {
            theirs.handle_opened(node(name), incarnation, ms(self.now));
            claims.handle_opened(other.clone(), theirs.config.incarnation, ms(self.now));
        }
        self.nodes.insert(node(name), claims);
        self.carry();
    }

    /// `a` alone on one side, the others on the other.
    fn can_hear(&self, one: &NodeName, other: &NodeName) -> bool {
        !self.parted || (one.as_str() == "a") == (other.as_str() == "a")
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
                    ClaimsOutput::Send { to, message } if self.can_hear(&from, &to) => {
                        if let Some(claims) = self.nodes.get_mut(&to) {
                            claims.handle_message(&from, &message, ms(self.now));
                        }
                    }
                    ClaimsOutput::Send { .. } => {}
                    ClaimsOutput::Granted { name, .. } => {
                        self.told.push(format!("{from} has {name}"))
                    }
                    ClaimsOutput::Lost { name, to, .. } => {
                        self.told.push(format!("{from} lost {name} to {to}"));
                    }
                }
            }
        }
    }

    fn claim(&mut self, who: &str, policy: ClaimPolicy) -> Result<Option<u64>, NameHeld> {
        let claimed =
            self.nodes.get_mut(&node(who)).unwrap().handle_claim(&map(), policy, ms(self.now));
        self.carry();
        claimed
    }

    fn advance(&mut self, millis: u64) {
        for _ in 0..millis {
            self.now += 1;
            self.nodes.values_mut().for_each(|claims| claims.handle_timeout(ms(self.now)));
            self.carry();
        }
    }

    fn holder(&self, seen_by: &str) -> Option<&str> {
        self.nodes[&node(seen_by)].holder(&map()).map(|(holder, _)| holder.as_str())
    }

    fn told(&mut self) -> Vec<String> {
        std::mem::take(&mut self.told)
    }
}

#[test]
fn a_second_claimant_is_refused_or_stands_by_as_it_wishes() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    let epoch = robot.claim("b", ClaimPolicy::Refuse).unwrap().unwrap();

    let held = NameHeld { name: map(), holder: node("b"), epoch };
    assert_eq!(robot.claim("a", ClaimPolicy::Refuse), Err(held));
    assert_eq!(robot.claim("c", ClaimPolicy::Standby), Ok(None));
    assert_eq!(robot.claim("b", ClaimPolicy::Refuse), Ok(Some(epoch)), "it has it already");

    assert_eq!(["a", "b", "c"].map(|seen_by| robot.holder(seen_by)), [Some("b"); 3]);
    assert_eq!(robot.told(), ["b has map"]);
}

#[test]
fn the_first_standby_takes_over_when_the_lease_of_a_node_that_died_is_over() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    let old = robot.claim("a", ClaimPolicy::Standby).unwrap().unwrap();
    robot.claim("c", ClaimPolicy::Standby).unwrap();
    robot.claim("b", ClaimPolicy::Standby).unwrap();
    robot.advance(1000);
    robot.told();

    robot.nodes.remove(&node("a"));
    robot.nodes.values_mut().for_each(|claims| claims.handle_ended(&node("a")));
    robot.advance(300);
    assert_eq!(robot.holder("c"), Some("a"), "its lease holds");
    robot.advance(110);

    assert_eq!(robot.told(), ["b has map"]);
    let (holder, new) = robot.nodes[&node("c")].holder(&map()).unwrap();
    assert_eq!(holder, &node("b"));
    assert!(new > old);
}

#[test]
fn a_name_that_is_given_back_goes_to_a_standby_at_once() {
    let mut robot = Robot::new(&["a", "b", "c"]);
    robot.claim("c", ClaimPolicy::Refuse).unwrap();
    robot.claim("a", ClaimPolicy::Standby).unwrap();
    robot.told();

    robot.nodes.get_mut(&node("c")).unwrap().handle_withdrawn(&map());
    robot.carry();
    robot.advance(1);

    assert_eq!(robot.told(), ["a has map"]);
    assert_eq!(robot.holder("c"), Some("a"));
}

#[test]
fn two_halves_of_a_robot_agree_again_when_they_meet() {
    for (policy, after) in [(ClaimPolicy::Refuse, 0), (ClaimPolicy::Standby, 1)] {
        let mut robot = Robot::new(&["a", "b", "c"]);
        robot.claim("a", policy).unwrap();
        robot.claim("b", ClaimPolicy::Standby).unwrap();
        robot.parted = true;
        robot.advance(500);
        assert_eq!((robot.holder("a"), robot.holder("c")), (Some("a"), Some("b")));
        robot.told();

        robot.parted = false;
        robot.advance(500);

        assert_eq!(["a", "b", "c"].map(|seen_by| robot.holder(seen_by)), [Some("b"); 3]);
        assert_eq!(robot.told(), ["a lost map to b"]);
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
fn what_went_astray_is_found_by_its_sum_and_told_again() {
    let mut robot = Robot::new(&["a", "b"]);
    robot.parted = true;
    robot.claim("a", ClaimPolicy::Refuse).unwrap();
    robot.parted = false;
    assert_eq!(robot.holder("b"), None);

    robot.advance(101);

    assert_eq!(robot.holder("b"), Some("a"));
}

#[test]
fn too_many_claims_and_nonsense_are_refused() {
    let mut robot = Robot::new(&["a", "b"]);
    let hostile = (0..CLAIMS_MAX + 3)
        .map(|n| Told { name: ObjectName::new(&format!("name{n}")).unwrap(), epoch: Some(1) });
    let claims = robot.nodes.get_mut(&node("b")).unwrap();
    hostile.for_each(|told| claims.hear(&node("a"), told, ms(0)));
    claims.handle_message(&node("a"), b"\xff\xff", ms(0));
    claims.handle_message(&node("stranger"), b"\0", ms(0));

    assert_eq!(claims.refused(), 4);
    assert_eq!(claims.held(), CLAIMS_MAX);
}
