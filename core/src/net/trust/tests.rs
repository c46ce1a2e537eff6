//! The files and the policy as a whole.

use super::access::AccessPolicy;
use super::crypto::{KEY_BYTES, Seed};
use super::key_file::{KEY_FILE_BYTES, KeyFile, RobotFile};
use super::policy::{Pattern, PolicyLine, Role, Verb};
use super::roster::{NodeRoster, ROSTER_BYTES, ROSTER_NODES, RosterNode, RosterOrder};
use super::text::TrustProblem;
use super::text::{decode, encode};
use crate::NodeName;
use crate::net::wire::node_id::NodeId;
use proptest::prelude::*;

fn name(text: &str) -> NodeName {
    NodeName::new(text).expect("a name")
}

fn seed(byte: u8) -> Seed {
    Seed::new([byte; KEY_BYTES])
}

fn node(text: &str, byte: u8, role: Role) -> RosterNode {
    RosterNode { name: name(text), keys: seed(byte).public_keys(), role }
}

/// Nodes of every role, and two lines.
fn roster() -> NodeRoster {
    let nodes = [
        node("base", 1, Role::Node),
        node("arm", 2, Role::Node),
        node("laptop", 3, Role::Operator),
        node("tower", 4, Role::Node),
        node("visitor", 5, Role::Guest),
    ];
    let roster = NodeRoster::new(name("ranger"), nodes).expect("it can be");
    let lines = "policy\n  only base laptop may lease on base/wheels\n  \
                 only arm visitor may ask tell on arm/** by motion/*\nend";
    NodeRoster::parse(&roster.to_text().replace("end", lines)).expect("the lines are right")
}

fn key_file() -> KeyFile {
    let signer = seed(9).signer();
    KeyFile { robot: name("ranger"), node: name("base"), seed: seed(1), signer }
}

#[test]
fn the_files_are_written_as_in_the_golden_files_and_read_back() {
    let robot = RobotFile { seed: seed(9), roster: roster() };
    let signed = roster().sign(&seed(9));

    assert_eq!(*key_file().to_text(), include_str!("golden/base.key"));
    assert_eq!(*robot.to_text(), include_str!("golden/ranger.robot"));
    assert_eq!(signed, include_str!("golden/ranger.roster"));
    assert_eq!(KeyFile::parse(&key_file().to_text()), Ok(key_file()));
    assert_eq!(RobotFile::parse(&robot.to_text()), Ok(robot));
    assert_eq!(NodeRoster::parse_signed(&signed, &seed(9).signer()), Ok(roster()));
}

#[test]
fn a_key_file_that_is_wrong_names_the_line_and_repeats_no_word_of_it() {
    let text = key_file().to_text();
    let letters = encode(&[1; KEY_BYTES]);
    let check = |text: &str, expected: &str| {
        let error = KeyFile::parse(text).expect_err(expected).to_string();
        assert!(error.starts_with(expected), "{error}");
        assert!(!error.contains(&letters), "{error}");
    };
    check("", "line 1: the file does not begin with `blastema node key 1`: it is empty");
    check(&text.replace("key 1", "key 2"), "line 1");
    check(&text.replace("robot ", "robbot "), "line 2");
    check(&text.replace("node    base", "node"), "line 3: this line begins otherwise");
    check(&text.replace("node    base", &format!("node -{letters}")), "line 3");
    check(&text.replace("seed    ", ""), "line 4: this line begins otherwise");
    check(&text.replace(&letters, &letters[1..]), "line 4: a key has 43 letters");
    check(&format!("{}\n{letters}", *text), "line 6: nothing follows here");
    check(&" ".repeat(KEY_FILE_BYTES + 1), "line 1: the file has more than 4096 bytes");
}

#[test]
fn a_roster_that_is_wrong_names_the_line_and_what_to_write() {
    let text = roster().to_text();
    let check = |from: &str, to: &str, expected: &str| {
        let error = NodeRoster::parse(&text.replacen(from, to, 1)).expect_err(expected).to_string();
        assert!(error.starts_with(expected), "{error}");
    };
    check("serial  1", "serial  0", "line 3: a serial number is a whole number from 1 on");
    check("role operator", "role oprator", "line 6: a word is unknown: did you mean `operator`?");
    check("node    arm", "node    base", "line 5: node base is listed twice");
    check("node    arm", "device  arm", "line 5: this line begins otherwise");
    check("x25519", "x25518", "line 4: this line begins otherwise");
    check("only base laptop", "only bse", "line 10: a word is unknown: did you mean `base`?");
    check("may lease", "may leese", "line 10: a word is unknown: did you mean `lease`?");
    check("on base/wheels", "on base//wheels", "line 10: this line begins otherwise");
    check("on base/wheels", "", "line 10: this line begins otherwise");
    check("by motion/*", "by", "line 11: this line begins otherwise");
    check("end", "end\nsigned", "line 13: nothing follows here");
    check("end", "", "line 12: this line begins otherwise");
    let long = NodeRoster::parse(&" ".repeat(ROSTER_BYTES + 1)).expect_err("it is too long");
    assert_eq!(long.problem, TrustProblem::TooLong { most: ROSTER_BYTES });
}

#[test]
fn a_changed_list_and_one_of_another_robot_are_refused() {
    let signed = roster().sign(&seed(9));
    let check = |text: &str, signer: u8, expected: TrustProblem| {
        let error =
            NodeRoster::parse_signed(text, &seed(signer).signer()).expect_err("it is wrong");
        assert_eq!(error.problem, expected, "{text}");
    };
    check(&signed, 8, TrustProblem::NotSigned);
    check(&signed.replace("serial  1", "serial  2"), 9, TrustProblem::NotSigned);
    check(&signed.replace("role guest", "role node"), 9, TrustProblem::NotSigned);
    check(&roster().to_text(), 9, TrustProblem::NotSigned);
    check("", 9, TrustProblem::NotSigned);
    check(&format!("{signed}\n"), 9, TrustProblem::NotSigned);

    // The signer's own hand wrote it otherwise than the program does.
    let text = roster().to_text().replace("robot   ranger", "robot ranger");
    let signature = encode(&seed(9).sign_roster(text.as_bytes()));
    check(&format!("{text}signed  {signature}\n"), 9, TrustProblem::NotCanonical);
}

#[test]
fn nodes_that_cannot_be_told_apart_are_not_listed_together() {
    let mut full = roster();
    assert_eq!(full.add(node("base", 50, Role::Node)), Err(TrustProblem::NodeTwice(name("base"))));
    assert_eq!(full.add(node("may", 51, Role::Node)), Err(TrustProblem::ReservedName));
    assert_eq!(full.add(node("other", 2, Role::Node)), Err(TrustProblem::KeyTwice(name("arm"))));
    // Two words with one FNV-1a hash of 32 bits.
    full.add(node("costarring", 50, Role::Node)).expect("there is room");
    let error = full.add(node("liquid", 51, Role::Node)).expect_err("their numbers are equal");
    assert!(error.to_string().contains("as costarring has"), "{error}");

    let nodes = (0..=ROSTER_NODES).map(|number| {
        let mut bytes = [0; KEY_BYTES];
        bytes[..8].copy_from_slice(&number.to_be_bytes());
        let keys = Seed::new(bytes).public_keys();
        RosterNode { name: name(&format!("n{number}")), keys, role: Role::Node }
    });
    assert_eq!(
        NodeRoster::new(name("ranger"), nodes).expect_err("one is too many"),
        TrustProblem::TooManyNodes { most: ROSTER_NODES }
    );
}

#[test]
fn the_higher_serial_number_counts_and_two_lists_of_one_number_are_a_conflict() {
    let held = roster();
    let with = |serial: u64| NodeRoster { serial, ..roster() };
    let mut other = roster();
    assert!(other.replace_keys(&name("arm"), seed(77).public_keys()));

    assert_eq!(held.order_of(&with(2)), RosterOrder::Newer);
    assert_eq!(held.order_of(&held), RosterOrder::Same);
    assert_eq!(with(2).order_of(&held), RosterOrder::Older);
    assert_eq!(held.order_of(&other), RosterOrder::Conflicting);
    let foreign = NodeRoster { robot: name("rover"), serial: 7, ..roster() };
    assert_eq!(held.order_of(&foreign), RosterOrder::Conflicting);
}

#[test]
fn a_removed_node_leaves_the_policy_and_no_line_is_left_without_a_peer() {
    let mut roster = roster();
    assert_eq!(roster.remove(&name("visitor")).map(|node| node.is_some()), Ok(true));
    assert_eq!(roster.policy()[1].to_string(), "only arm may ask tell on arm/** by motion/*");
    assert_eq!(roster.remove(&name("arm")), Err(2));
    assert!(roster.node(&name("arm")).is_some());
    assert_eq!(roster.remove(&name("stranger")), Ok(None));
    assert!(!roster.replace_keys(&name("stranger"), seed(7).public_keys()));
}

#[test]
fn a_pattern_is_of_parts_between_slashes() {
    let check = |pattern: &str, names: &[&str], others: &[&str]| {
        let pattern = Pattern::parse(pattern).expect("a pattern");
        names.iter().for_each(|name| assert!(pattern.matches(name), "{pattern:?} {name}"));
        others.iter().for_each(|name| assert!(!pattern.matches(name), "{pattern:?} {name}"));
    };
    check("arm", &["arm"], &["arms", "arm/elbow", "a", ""]);
    check("*", &["arm"], &["arm/elbow"]);
    check("**", &["arm", "arm/left/elbow"], &[]);
    check("arm/*", &["arm/elbow"], &["arm", "arm/left/elbow"]);
    check("arm/**", &["arm", "arm/elbow", "arm/left/elbow"], &["army", "leg/arm"]);
    check("**/elbow", &["elbow", "arm/left/elbow"], &["arm/elbow/x"]);
    check("a/**/z/*", &["a/z/x", "a/b/z/x", "a/z/z/z"], &["a/z", "a/b/x"]);
    for wrong in ["", "/", "arm/", "arm*", "***", "a/**/**", "ärm"] {
        assert!(Pattern::parse(wrong).is_err(), "{wrong}");
    }
}

#[test]
fn what_a_peer_may_do_follows_from_its_role_and_from_the_lines_that_match() {
    const BY_ROLE: Result<(), Option<usize>> = Err(None);
    let roster = roster();
    let permitted = |roster: &NodeRoster, peer: &str, verb, object: &str, contract: &str| {
        let policy = AccessPolicy::new(name("base"), roster);
        let checked = policy.check(NodeId::of(&name(peer)), verb, object, contract);
        checked.map_err(|denied| denied.line)
    };
    let check = |peer: &str, verb, object: &str, contract: &str, expected| {
        let found = permitted(&roster, peer, verb, object, contract);
        assert_eq!(found, expected, "{peer} {verb} {object} {contract}");
    };
    // A line names them, or others.
    check("base", Verb::Lease, "base/wheels", "drive", Ok(()));
    check("laptop", Verb::Lease, "base/wheels", "drive", Ok(()));
    check("arm", Verb::Lease, "base/wheels", "drive", Err(Some(1)));
    check("base", Verb::Ask, "arm/elbow", "motion/move", Err(Some(2)));
    check("visitor", Verb::Ask, "arm/elbow", "motion/move", Ok(()));
    // No line is of this object, this verb, or this contract.
    check("arm", Verb::Lease, "base/lamp", "drive", Ok(()));
    check("base", Verb::Read, "arm/elbow", "motion/move", Ok(()));
    check("base", Verb::Ask, "arm/elbow", "state/now", Ok(()));
    check("visitor", Verb::Ask, "arm/elbow", "state/now", BY_ROLE);
    // One verb is a role's own.
    for (peer, operate) in [("base", false), ("laptop", true), ("tower", false)] {
        let expected = if operate { Ok(()) } else { BY_ROLE };
        check(peer, Verb::Operate, "base/wheels", "stop", expected);
    }
    check("stranger", Verb::Listen, "pose", "pose", BY_ROLE);
    // Another line that names a peer opens to it what the first one gives to others.
    let opened = roster.to_text().replace("end", "  only arm may lease on base/*\nend");
    let opened = NodeRoster::parse(&opened).expect("the line is right");
    assert_eq!(permitted(&opened, "arm", Verb::Lease, "base/wheels", "drive"), Ok(()));
    for verb in Verb::ALL {
        check("visitor", *verb, "x", "y", BY_ROLE);
    }
}

proptest! {
    #[test]
    fn any_bytes_come_back_from_their_letters_and_each_has_one_text(
        bytes: [u8; KEY_BYTES],
        letters in "[A-Za-z0-9_-]{43}",
    ) {
        prop_assert_eq!(decode(&encode(&bytes)), Some(bytes));
        if let Some(bytes) = decode::<KEY_BYTES>(&letters) {
            prop_assert_eq!(encode(&bytes), letters);
        }
    }

    #[test]
    fn any_roster_comes_back_from_its_text(
        robot in "[a-z][a-z0-9]{0,9}",
        serial in 1_u64..,
        nodes in prop::collection::btree_map("[a-z]{1,8}", (any::<[u8; 32]>(), 0..Role::ALL.len()), 1..9),
        verbs in prop::collection::vec(0..Verb::ALL.len(), 1..4),
        object in "(\\*|[a-z]{1,4})(/(\\*|[a-z]{1,4})){0,3}(/\\*\\*)?",
    ) {
        let listed = nodes.iter().map(|(text, (bytes, role))| RosterNode {
            name: name(text),
            keys: Seed::new(*bytes).public_keys(),
            role: Role::ALL[*role],
        });
        let roster = NodeRoster::new(name(&robot), listed);
        prop_assume!(roster.is_ok());
        let verbs: Vec<&str> = verbs.iter().map(|verb| Verb::ALL[*verb].word()).collect();
        let peers: Vec<&str> = nodes.keys().map(String::as_str).collect();
        let line = format!("only {} may {} on {object}", peers.join(" "), verbs.join(" "));
        let text = NodeRoster { serial, ..roster.unwrap() }.to_text();
        let roster = NodeRoster::parse(&text.replace("\nend\n", &format!("\npolicy\n{line}\nend\n")));
        let roster = roster.unwrap();

        prop_assert_eq!(roster.policy()[0].to_string(), line);
        prop_assert_eq!(NodeRoster::parse(&roster.to_text()), Ok(roster.clone()));
        let robot = seed(9);
        let signed = roster.sign(&robot);
        prop_assert_eq!(NodeRoster::parse_signed(&signed, &robot.signer()), Ok(roster));
    }

    #[test]
    fn no_text_makes_a_parser_panic(text in "(?s)(only |may |on |by |node |end\n|\\PC){0,40}") {
        let _ = KeyFile::parse(&text);
        let _ = RobotFile::parse(&text);
        let _ = NodeRoster::parse(&format!("blastema roster 1\nrobot r\nserial 1\n{text}"));
        let words: Vec<&str> = text.split_whitespace().collect();
        let _ = PolicyLine::parse(&words);
    }
}
