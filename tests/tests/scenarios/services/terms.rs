//! Nodes that were told different things of one service.

use super::*;
use blastema::FaultKind;

const LOOK: Duration = Duration::from_millis(1200);

async fn start(own: &str, medium: &MemoryMedium, spec: ServiceSpec<Counter>) -> TestNode {
    TestNode::start(node(own, medium).service(spec.hello_every(10 * MS))).await
}

fn on(members: &'static [&'static str]) -> ServiceSpec<Counter> {
    ServiceSpec::new("counter", members.iter().copied(), Counter::default)
}

/// What this node's record says now of members that were told otherwise.
async fn dispute(node: &TestNode) -> Option<String> {
    let record = node.faults().await;
    let standing = record.entries.iter().filter(|entry| entry.ended.is_none());
    let mut mismatches = standing.filter(|entry| entry.fault.kind == FaultKind::ContractMismatch);
    mismatches.next().map(|entry| entry.fault.detail.clone())
}

fn serving(nodes: &[TestNode]) -> usize {
    let serves =
        |node: &&TestNode| matches!(node.service_role("counter"), Some(Role::Primary { .. }));
    nodes.iter().filter(serves).count()
}

#[blastema_testkit::test]
async fn nodes_that_list_other_members_find_out_at_once_and_none_of_them_serves() {
    let cases: [[&'static [&'static str]; 3]; 3] = [
        [&["module1"], &MEMBERS, &MEMBERS],
        [&["module1"], &["module2"], &["module3"]],
        [&["module1", "module2"], &["module1", "module2"], &["module3", "module2"]],
    ];
    for lists in cases {
        let medium = MemoryMedium::default();
        let mut nodes = vec![];
        for (own, list) in MEMBERS.iter().zip(lists) {
            nodes.push(start(own, &medium, on(list)).await);
        }
        assert!(nodes[0].connected("module2", 2000 * MS).await);
        assert!(nodes[0].connected("module3", 2000 * MS).await);

        nodes[0].advance(LOOK).await;
        assert_eq!(serving(&nodes), 0, "{lists:?}");
        for node in &nodes {
            let said = dispute(node).await.unwrap_or_else(|| panic!("{lists:?}: {}", node.name()));
            assert!(said.contains("service counter") && said.contains("its nodes are"), "{said}");
            assert!(said.contains("write the same list, such as"), "{said}");
        }
        nodes[0].advance(5000 * MS).await;
        assert_eq!(serving(&nodes), 0, "{lists:?}");
    }
}

#[blastema_testkit::test]
async fn whoever_asks_a_disputed_service_is_told_why_and_what_to_write() {
    let medium = MemoryMedium::default();
    let asker = TestNode::start(node("module0", &medium)).await;
    let _nodes = [
        start("module1", &medium, on(&["module1", "module2"])).await,
        start("module2", &medium, on(&["module1", "module2"]).standby(StandbyKind::Hot)).await,
    ];
    asker.advance(3000 * MS).await;

    let counter = asker.service::<Add>("counter").unwrap();
    let asked_at = now();
    let refused = counter.ask(Add(1)).await.unwrap_err();
    assert!(now() - asked_at < 500 * MS, "{:?}", now() - asked_at);
    let Why::ContractDiffers { difference } = &refused.why else { panic!("{refused}") };
    assert!(difference.contains("its standbys are"), "{difference}");
    assert!(difference.contains("StandbyKind::Hot"), "{difference}");
}

#[blastema_testkit::test]
async fn a_service_goes_on_when_the_node_that_was_told_otherwise_begins_anew_and_is_right() {
    let medium = MemoryMedium::default();
    let wrong = start("module1", &medium, on(&["module1"])).await;
    let mut nodes = vec![
        start("module2", &medium, on(&MEMBERS)).await,
        start("module3", &medium, on(&MEMBERS)).await,
    ];
    wrong.advance(3000 * MS).await;
    assert_eq!(serving(&nodes), 0);
    wrong.shutdown().await;

    nodes.push(start("module1", &medium, on(&MEMBERS)).await);
    nodes[0].advance(3000 * MS).await;

    for node in &nodes {
        assert_eq!(dispute(node).await, None, "{}", node.name());
    }
    assert_eq!(serving(&nodes), 1);
    let counter = nodes[0].service::<Add>("counter").unwrap();
    assert_eq!(counter.ask(Add(1)).await.unwrap(), 1);
}

#[blastema_testkit::test]
async fn a_dispute_is_over_when_the_other_has_left_in_order_but_not_when_it_is_cut_off() {
    let medium = MemoryMedium::default();
    let wrong = start("module1", &medium, on(&["module1"])).await;
    let nodes = vec![
        start("module2", &medium, on(&MEMBERS)).await,
        start("module3", &medium, on(&MEMBERS)).await,
    ];
    wrong.advance(3000 * MS).await;
    wrong.cable("ethernet").unwrap().cut(Direction::Both, false);
    wrong.advance(5000 * MS).await;
    assert_eq!(serving(&nodes), 0, "where it is, it may serve");
    assert_eq!(serving(std::slice::from_ref(&wrong)), 0, "it does not either");

    wrong.cable("ethernet").unwrap().restore();
    wrong.advance(3000 * MS).await;
    wrong.shutdown().await;
    nodes[0].advance(2000 * MS).await;
    assert_eq!(serving(&nodes), 1);
    assert_eq!(dispute(&nodes[0]).await, None);
}

#[blastema_testkit::test]
async fn an_object_that_only_has_the_services_name_disputes_nothing() {
    let medium = MemoryMedium::default();
    let other = ChildSpec::new("counter", Counter::default);
    let other = TestNode::start(node("module3", &medium).child(other)).await;
    let nodes = vec![
        start("module1", &medium, on(&["module1", "module2"])).await,
        start("module2", &medium, on(&["module1", "module2"])).await,
    ];
    other.advance(5000 * MS).await;

    assert_eq!(serving(&nodes), 1);
    for node in nodes.iter().chain([&other]) {
        assert_eq!(dispute(node).await, None);
    }
}
