//! What the manual says is what the code does: its tables, and sentences that nothing else proves.

use blastema::core::contract::codec::SIZE_LIMIT;
use blastema::core::delivery::dead_letters::KINDS_MAX;
use blastema::core::delivery::quarantine::QuarantineConfig;
use blastema::core::detection::{
    FAULTS_ON_RECORD, LOCAL_HANDOVER, MONITOR_ROWS_MAX, REMOTE_HANDOVER,
};
use blastema::core::net::{RouterConfig, SessionConfig};
use blastema::core::recovery::{CASES_MAX, LadderStep, SupervisorRules};
use blastema::core::service::MEMBERS_MAX;
use blastema::prelude::*;
use blastema::{DEFAULT_DEADLINE, FaultLocation, Incarnation, NodeName};
use blastema_testkit::TestNode;
use blastema_tests::{Part, serves};
use std::fs;
use std::path::Path;
use std::time::Duration;

fn page(name: &str) -> String {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../actors/src/manual");
    fs::read_to_string(folder.join(name)).unwrap_or_else(|error| panic!("{name}: {error}"))
}

/// The cells of the row of a page's tables that begins with this one.
fn row(page: &str, first: &str) -> Vec<String> {
    let begin = format!("| {first} |");
    let line = page.lines().find(|line| line.starts_with(&begin));
    let line = line.unwrap_or_else(|| panic!("the page has no row {first:?}"));
    line.trim_matches('|').split(" | ").map(|cell| cell.trim().to_owned()).collect()
}

fn node() -> NodeName {
    NodeName::new("module1").expect("a name")
}

#[test]
fn the_list_of_faults_is_that_of_the_code_with_the_measures_of_the_default_plan() {
    let (page, plan) = (page("faults.md"), Plan::default());
    let rung = |step: &LadderStep| match step.attempts {
        1 => step.action.to_string(),
        attempts => format!("{} ×{attempts}", step.action),
    };
    for kind in FaultKind::built_in() {
        let row = row(&page, &format!("`{}`", kind.code()));
        let ladder = plan.answer(&node(), kind, &FaultLocation::Node(node()));
        let actions: Vec<String> = ladder.steps().iter().map(rung).collect();

        assert_eq!(row[1], kind.text());
        assert_eq!(row[2], format!("{:?}", kind.severity()).to_lowercase());
        assert_eq!(row[4], actions.join(", "), "{kind}");
    }
}

#[test]
fn the_limits_are_those_of_the_code() {
    let page = page("limits.md");
    #[track_caller]
    fn check(page: &str, first: &str, says: impl Into<String>) {
        let (row, says) = (row(page, first), says.into());
        assert!(row[1].contains(&says), "{first}: the code says {says:?}, the page {:?}", row[1]);
    }
    let thousands = |n: usize| format!("{},{:03}", n / 1000, n % 1000);
    let incarnation = Incarnation::FIRST;
    let session = SessionConfig::new(node(), incarnation, node());
    let router = RouterConfig::new(node(), incarnation);
    let rules = SupervisorRules::default();

    check(&page, "wait for a reply", format!("{} s", DEFAULT_DEADLINE.as_secs()));
    check(
        &page,
        "incarnations that one message may kill",
        QuarantineConfig::default().kills.to_string(),
    );
    let restarts = format!("{} in {} s", rules.intensity, rules.period.as_secs());
    check(&page, "restarts", restarts);
    let mebibytes = |bytes: usize| format!("{} MiB", bytes >> 20);
    check(&page, "bytes of one message in a session", mebibytes(session.message_max));
    assert!(page.contains(&format!("`max_size`, up to {}", mebibytes(SIZE_LIMIT))));
    check(&page, "rows of the monitor's table", thousands(MONITOR_ROWS_MAX));
    check(&page, "faults on record", FAULTS_ON_RECORD.to_string());
    let (local, remote) = (LOCAL_HANDOVER.per_second, REMOTE_HANDOVER.per_second);
    check(&page, "faults handed to the recoverer", format!("{local} a second, {remote} to other"));
    check(&page, "locations that are treated at one time", CASES_MAX.to_string());
    check(&page, "dead letters", format!("{KINDS_MAX} counts"));
    check(&page, "nodes in one network; neighbours of a node", router.nodes_max.to_string());
    check(&page, "hops", router.hops.to_string());
    check(&page, "nodes that carry one service", MEMBERS_MAX.to_string());
    let says = format!("{}, or {}", session.buffer_messages, mebibytes(session.buffer_bytes));
    check(
        &page,
        "replies and messages of the middleware of one class that wait for one peer",
        says,
    );
}

#[test]
fn each_reason_for_which_a_message_fails_has_its_row() {
    let (page, code) = (page("sending.md"), include_str!("../../../core/src/delivery/mod.rs"));
    let lines = code.lines().skip_while(|line| *line != "pub enum DeliveryError {").skip(1);
    for line in lines.take_while(|line| *line != "}").map(str::trim_start) {
        let name = format!("`{}`", line.trim_end_matches([',', ' ', '{']));
        let is_row = |row: &str| row.split('|').nth(1).is_some_and(|cell| cell.contains(&name));
        assert!(!line.starts_with(char::is_uppercase) || page.lines().any(is_row), "{name}");
    }
}

/// Has the receiver end itself.
#[derive(Debug, Request)]
#[contract(reply = ())]
struct End;

fn survey() -> ChildSpec<Part<(), End>> {
    serves("survey", (), |_, _, cx| cx.stop())
}

#[blastema_testkit::test]
async fn a_child_whose_end_was_final_takes_no_messages() {
    for restart in [Restart::Transient, Restart::Temporary] {
        let node = Node::builder("module1").child_with(survey(), restart);
        let node = TestNode::start(node).await;
        let survey: Sender<End> = node.sender("survey").unwrap();

        survey.ask(End).await.unwrap();
        node.advance(Duration::from_secs(1)).await;

        assert_eq!(survey.tell(End).unwrap_err().kind, DeliveryError::Stopped, "{restart:?}");
        assert_eq!(node.state(), NodeState::Running);
        node.expect_no_faults().await;
    }
}

#[blastema_testkit::test]
async fn the_history_of_faults_ends_with_the_node() {
    let builder = Node::builder("module1").child(survey());
    let node = TestNode::start(builder).await;
    let mut faults = node.fault_events();
    node.sender::<End>("survey").unwrap().ask(End).await.unwrap();
    node.advance(Duration::from_secs(1)).await;

    node.shutdown().await;

    let mut told = 0;
    while faults.next().await.is_some() {
        told += 1;
    }
    assert_eq!(told, 3, "found, decided, recovered");
}
