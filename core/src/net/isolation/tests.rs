use super::*;

fn node(name: &str) -> NodeName {
    NodeName::new(name).unwrap()
}

/// Nodes that all have a session with each other.
struct Robot {
    nodes: SortedMap<NodeName, Isolation>,
    outputs: Vec<String>,
    /// Whether the last decision counts.
    result: Result<(), VoteRefused>,
}

impl Robot {
    fn new(names: &[&str], judges: &IsolationAuthority) -> Self {
        let mut robot = Robot { nodes: SortedMap::new(), outputs: vec![], result: Ok(()) };
        names.iter().for_each(|name| robot.join(name, 1, judges));
        robot
    }

    fn join(&mut self, name: &str, incarnation: u64, judges: &IsolationAuthority) {
        let mut own = Isolation::new(node(name), Incarnation(incarnation), judges.clone());
        self.nodes.remove(&node(name));
        for (other, isolation) in &mut self.nodes {
            isolation.handle_ended(&node(name));
            isolation.handle_opened(node(name));
            own.handle_opened(other.clone());
        }
        self.nodes.insert(node(name), own);
        self.carry();
    }

    fn decides(&mut self, by: &str, about: &str, isolated: bool) -> Vec<String> {
        let by = self.nodes.get_mut(&node(by)).unwrap();
        let (node, cause) = (&node(about), "it floods");
        self.result = by.handle_decision(IsolationDecision { node, isolated, cause });
        self.carry();
        std::mem::take(&mut self.outputs)
    }

    fn carry(&mut self) {
        loop {
            let mut outputs = vec![];
            for (name, isolation) in &mut self.nodes {
                outputs.extend(isolation.poll_output().map(|output| (name.clone(), output)));
            }
            if outputs.is_empty() {
                return;
            }
            for (from, output) in outputs {
                match output {
                    IsolationOutput::Tell { to, message } => {
                        if let Some(isolation) = self.nodes.get_mut(&to) {
                            isolation.handle_ballot(&from, &message);
                        }
                    }
                    IsolationOutput::Isolate { node, isolated, reason } => {
                        let what = if isolated { "keeps out" } else { "admits" };
                        self.outputs.push(format!("{from} {what} {node} {reason}"));
                    }
                    IsolationOutput::Accused { .. } => {}
                }
            }
        }
    }

    /// Who keeps this node out.
    fn refuse(&self, about: &str) -> String {
        let refuse = |(_, isolation): &(&NodeName, &Isolation)| isolation.is_isolated(&node(about));
        let names: Vec<_> = self.nodes.iter().filter(refuse).map(|(n, _)| n.as_str()).collect();
        names.join("")
    }
}

fn wardens(names: &[&str]) -> IsolationAuthority {
    IsolationAuthority::Named(names.iter().map(|name| node(name)).collect())
}

#[test]
fn a_wardens_word_holds_everywhere_and_another_warden_can_take_it_back() {
    let mut robot = Robot::new(&["a", "b", "c", "d"], &wardens(&["a", "c"]));

    let outputs = robot.decides("a", "d", true);
    assert_eq!(outputs.len(), 3, "{outputs:?}");
    assert!(outputs.contains(&"c keeps out d by a: it floods".to_owned()));
    assert_eq!(robot.refuse("d"), "abc");

    robot.decides("c", "d", false);
    assert_eq!(robot.refuse("d"), "");
}

#[test]
fn who_is_no_warden_decides_for_itself_alone_until_a_warden_speaks() {
    let mut robot = Robot::new(&["a", "b", "c"], &wardens(&["a"]));
    robot.decides("b", "c", true);
    assert_eq!(robot.refuse("c"), "b");
    robot.decides("a", "c", false);
    assert_eq!(robot.refuse("c"), "");
}

#[test]
fn a_node_that_is_no_warden_uses_up_no_numbers_of_the_votes_of_wardens() {
    let mut robot = Robot::new(&["a", "b", "c", "d", "e"], &wardens(&["a", "b"]));
    // Every node hears the greatest number from one that has no say.
    let ballot = Ballot {
        incarnation: Incarnation(1),
        votes: vec![(node("d"), true, u64::MAX, "a lie".into())],
    };
    let message = codec::encode_unbounded(&ballot);
    for (name, isolation) in &mut robot.nodes {
        if *name != node("c") {
            isolation.handle_ballot(&node("c"), &message);
        }
    }
    robot.carry();
    for (by, isolated, refuse) in
        [("a", true, "abce"), ("b", false, ""), ("a", true, "abce"), ("b", false, "")]
    {
        robot.decides(by, "d", isolated);
        assert_eq!(robot.refuse("d"), refuse, "{by} {isolated}");
    }
}

#[test]
fn a_majority_isolates_and_a_single_node_shuts_out_nobody_but_itself() {
    let names = ["a", "b", "c", "d", "e"];
    let mut robot = Robot::new(&names, &IsolationAuthority::default());
    for about in ["a", "b", "c", "d"] {
        robot.decides("e", about, true);
    }
    for about in ["a", "b", "c", "d"] {
        assert_eq!(robot.refuse(about), "e", "about {about}");
    }

    robot.decides("a", "e", true);
    robot.decides("b", "e", true);
    assert_eq!(robot.refuse("e"), "ab", "two of four are no majority");
    let outputs = robot.decides("c", "e", true);
    assert_eq!(robot.refuse("e"), "abcd");
    assert!(outputs.contains(&"d keeps out e by a, b, c: it floods".to_owned()), "{outputs:?}");

    // What it said is void with it, and what it says now is not heard.
    let d = &robot.nodes[&node("d")];
    assert_eq!(d.count_of(&node("e")), 0);
    robot.decides("e", "f", true);
    assert_eq!(robot.refuse("f"), "e");
    assert!(robot.nodes[&node("d")].refused() >= 1);
}

#[test]
fn guests_have_no_vote_and_are_no_part_of_the_majority() {
    let guests = IsolationAuthority::MajorityWithout(["g", "h", "i"].map(node).into());
    let mut robot = Robot::new(&["a", "b", "e", "g", "h", "i"], &guests);
    for guest in ["g", "h", "i"] {
        robot.decides(guest, "a", true);
    }
    assert_eq!(robot.refuse("a"), "ghi");

    robot.decides("a", "e", true);
    assert_eq!(robot.refuse("e"), "a");
    robot.decides("b", "e", true);
    assert_eq!(robot.refuse("e"), "abghi");
}

#[test]
fn what_a_majority_has_isolated_a_majority_lets_in_again() {
    let mut robot = Robot::new(&["a", "b", "c", "d"], &IsolationAuthority::default());
    robot.decides("a", "d", true);
    robot.decides("b", "d", true);
    assert_eq!(robot.refuse("d"), "abc");

    robot.decides("a", "d", false);
    assert_eq!(robot.refuse("d"), "b", "who still thinks so, refuses it");
    robot.decides("c", "d", false);
    assert_eq!(robot.refuse("d"), "", "the others have said otherwise");
}

#[test]
fn of_two_nodes_each_decides_for_itself() {
    let mut robot = Robot::new(&["a", "b"], &IsolationAuthority::default());
    robot.decides("b", "a", true);
    assert_eq!(robot.refuse("a"), "b");
    robot.decides("b", "b", true);
    assert_eq!(robot.refuse("b"), "", "on itself a node has no say");
    assert_eq!(robot.result, Err(VoteRefused::Oneself));
}

#[test]
fn who_has_voted_on_too_many_is_told_that_its_word_does_not_count() {
    let mut robot = Robot::new(&["a", "b"], &IsolationAuthority::default());
    for n in 0..VOTES_MAX {
        robot.decides("a", &format!("n{n}"), true);
        assert_eq!(robot.result, Ok(()));
    }

    robot.decides("a", "b", true);

    assert_eq!(robot.result, Err(VoteRefused::TooMany { limit: VOTES_MAX }));
    assert_eq!(robot.refuse("b"), "");
    robot.decides("a", "n0", false);
    assert_eq!(robot.result, Ok(()), "what it has said once it can take back");

    robot.decides("a", "b", true);

    assert_eq!(robot.result, Ok(()), "and that makes room");
    assert_eq!(robot.refuse("b"), "a");
}

#[test]
fn what_others_said_before_does_not_outdo_a_nodes_own_word() {
    let mut robot = Robot::new(&["a", "b", "c", "d"], &IsolationAuthority::default());
    for voter in ["b", "c"] {
        robot.decides(voter, "d", false);
    }

    robot.decides("a", "d", true);
    assert_eq!(robot.refuse("d"), "a");

    for voter in ["b", "c"] {
        robot.decides(voter, "d", false);
    }
    assert_eq!(robot.refuse("d"), "", "a majority lets it in");
}

#[test]
fn known_is_who_is_there_and_whom_somebody_has_voted_on() {
    let mut robot = Robot::new(&["a", "b", "c"], &IsolationAuthority::default());
    robot.decides("b", "d", true);

    let known = |name| robot.nodes[&node("a")].knows(&node(name));
    assert_eq!(["b", "c", "d", "e"].map(known), [true, true, true, false]);
}

#[test]
fn who_was_away_is_told_when_it_is_back() {
    let judges = wardens(&["a"]);
    let mut robot = Robot::new(&["a", "b", "d"], &judges);
    robot.decides("a", "d", true);
    robot.join("c", 1, &judges);
    assert_eq!(robot.refuse("d"), "abc");
}

#[test]
fn a_warden_that_was_restarted_can_take_back_what_its_earlier_incarnation_has_said() {
    let judges = wardens(&["a"]);
    let mut robot = Robot::new(&["a", "b", "d"], &judges);
    robot.decides("a", "d", true);
    robot.decides("a", "d", false);
    robot.decides("a", "d", true);

    robot.join("a", 2, &judges);
    assert_eq!(robot.refuse("d"), "b", "its word holds without it");
    robot.decides("a", "d", false);
    assert_eq!(robot.refuse("d"), "");
}

#[test]
fn nobody_is_believed_about_another_ones_vote_and_nobody_floods_the_table() {
    let mut victim = Isolation::new(node("a"), Incarnation(1), IsolationAuthority::default());
    for name in ["b", "c", "hostile"] {
        victim.handle_opened(node(name));
    }
    let accuse = |names: Vec<String>| {
        let vote = |(n, name): (usize, String)| (node(&name), true, n as u64 + 1, "x".repeat(300));
        let votes = names.into_iter().enumerate().map(vote).collect();
        codec::encode_unbounded(&Ballot { incarnation: Incarnation(u64::MAX), votes })
    };
    victim.handle_ballot(&node("hostile"), &accuse((0..60).map(|n| format!("n{n}")).collect()));
    victim.handle_ballot(&node("hostile"), &accuse((0..70).map(|n| format!("n{n}")).collect()));
    victim.handle_ballot(&node("hostile"), &accuse(vec!["a".into(), "hostile".into()]));
    victim.handle_ballot(&node("hostile"), b"\xff\xff");

    assert_eq!((victim.votes.len(), victim.refused()), (VOTES_MAX, 6 + 1 + 1));
    let longest = victim.votes.values().flat_map(SortedMap::values).map(|vote| vote.cause.len());
    assert_eq!(longest.max(), Some(CAUSE_MAX));
    assert!(victim.isolated.is_empty());
}

#[test]
fn whatever_is_said_judging_comes_to_an_end() {
    // Three who accuse each other in a circle, seen by a fourth that believes each of them.
    let mut robot = Robot::new(&["a", "b", "c", "d"], &wardens(&["a", "b", "c"]));
    robot.decides("a", "b", true);
    robot.decides("b", "c", true);
    robot.decides("c", "a", true);
    assert!(["b", "c", "a"].iter().any(|about| robot.refuse(about).contains('d')));
}
