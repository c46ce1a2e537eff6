//! Nodes with different configurations of one service.

use super::*;

const LOOK: Duration = Duration::from_millis(1200);

async fn start(own: &str, medium: &MemoryMedium, spec: ServiceSpec<Counter>) -> TestNode {
    TestNode::start(node(own, medium).service(spec.heartbeat_every(10 * MS))).await
}

fn on(members: &'static [&'static str]) -> ServiceSpec<Counter> {
    ServiceSpec::new("counter", members.iter().copied(), Counter::default)
}

/// Returns the detail of this node's open fault of a configuration mismatch.
async fn mismatch(node: &TestNode) -> Option<String> {
    standing(node, &FaultKind::ContractMismatch).await.map(|fault| fault.detail)
}

#[blastema_testkit::test]
async fn of_nodes_with_different_lists_at_most_one_serves_and_each_declares_what_to_write() {
    let cases: [[&'static [&'static str]; 3]; 4] = [
        [&["module1"], &MEMBERS, &MEMBERS],
        [&["module1"], &["module2"], &["module3"]],
        [&["module1", "module2"], &["module1", "module2"], &["module3", "module2"]],
        [&["module1", "module2"], &["module2", "module1"], &["module3", "module2"]],
    ];
    for (case, lists) in cases.into_iter().enumerate() {
        let medium = MemoryMedium::default();
        let mut nodes = vec![];
        for (own, list) in MEMBERS.iter().zip(lists) {
            nodes.push(start(own, &medium, on(list)).await);
        }
        assert!(nodes[0].connected("module2", 2000 * MS).await);
        assert!(nodes[0].connected("module3", 2000 * MS).await);

        nodes[0].advance(LOOK).await;
        for node in &nodes {
            let detail =
                mismatch(node).await.unwrap_or_else(|| panic!("{lists:?}: {}", node.name()));
            assert!(
                detail.contains("service counter") && detail.contains("its nodes are"),
                "{detail}"
            );
            assert!(detail.contains("write the same list, such as"), "{detail}");
        }
        for _ in 0..50 {
            nodes[0].advance(100 * MS).await;
            assert!(serving(&nodes).len() <= 1, "{lists:?}: {:?}", serving(&nodes));
        }
        // Two nodes with one list elect a primary before they meet the third one.
        assert_eq!(serving(&nodes).len(), [1, 0, 1, 0][case], "{lists:?}: {:?}", serving(&nodes));
    }
}

#[blastema_testkit::test]
async fn a_caller_of_a_service_with_different_configurations_learns_at_the_deadline_what_to_write()
{
    let medium = MemoryMedium::default();
    let asker = TestNode::start(node("module0", &medium)).await;
    let nodes = [
        start("module1", &medium, on(&["module1", "module2"])).await,
        start("module2", &medium, on(&["module1", "module2"]).standby(StandbyKind::Hot)).await,
    ];
    asker.advance(3000 * MS).await;
    for node in &nodes {
        assert_eq!(node.services()[0].state, blastema::ServiceState::Fenced, "{}", node.name());
    }

    let counter = asker.service::<Add>("counter").unwrap();
    let asked_at = now();
    let refused = counter.ask_within(Add(1), 1000 * MS).await.unwrap_err();
    let waited = now() - asked_at;
    assert!(waited >= 1000 * MS && waited < 1100 * MS, "the mismatch might have ended: {waited:?}");
    let DeliveryError::ContractDiffers { difference } = &refused.kind else { panic!("{refused}") };
    assert!(difference.contains("its standbys are"), "{difference}");
    assert!(difference.contains("StandbyKind::Hot"), "{difference}");
}

/// Another version of the contract.
#[derive(Clone, Debug, Request)]
#[contract(name = "counter/add", reply = u64)]
struct AddParts {
    thousandths: i64,
}

#[blastema_testkit::test]
async fn a_caller_with_another_contract_is_refused_at_once() {
    let robot = Robot::start(StandbyKind::Warm).await;
    let counter = robot.asker.service::<AddParts>("counter").unwrap();
    let asked_at = now();

    let refused = counter.ask(AddParts { thousandths: 1 }).await.unwrap_err();

    assert!(matches!(refused.kind, DeliveryError::ContractDiffers { .. }), "{refused}");
    assert!(now() - asked_at < 100 * MS, "{:?}", now() - asked_at);
}

#[blastema_testkit::test]
async fn a_request_is_answered_when_the_node_that_prevented_a_primary_has_left_in_order() {
    let medium = MemoryMedium::default();
    let asker = TestNode::start(node("module0", &medium)).await;
    let slow = on(&MEMBERS).heartbeat_every(20 * MS);
    let wrong = TestNode::start(node("module1", &medium).service(slow)).await;
    let second = start("module2", &medium, on(&MEMBERS)).await;
    // The two meet before there is a majority.
    asker.advance(LOOK).await;
    let nodes = [second, start("module3", &medium, on(&MEMBERS)).await];
    asker.advance(3000 * MS).await;
    assert_eq!(serving(&nodes).len(), 0);

    let counter = asker.service::<Add>("counter").unwrap();
    let meanwhile = async {
        asker.advance(1000 * MS).await;
        wrong.shutdown().await;
        asker.advance(1000 * MS).await;
        assert_eq!(serving(&nodes).len(), 1);
        assert_eq!(mismatch(&nodes[0]).await, None);
    };
    let (answered, ()) = tokio::join!(counter.ask_within(Add(1), 5000 * MS), meanwhile);

    assert_eq!(answered.map_err(|error| error.kind), Ok(1));
    assert_eq!(add(&asker).await, Ok(2), "it took effect once");
}

#[blastema_testkit::test]
async fn where_a_node_may_have_begun_a_mismatch_that_lasts_leaves_the_outcome_unknown() {
    let mut robot = Robot::start(StandbyKind::Warm).await;
    let counter = robot.asker.service::<Add>("counter").unwrap();
    assert_eq!(counter.ask(Add(1)).await.map_err(|error| error.kind), Ok(1));
    let first = robot.primary();
    robot.cut(first);
    for member in (0..3).filter(|member| *member != first) {
        robot.members[member].shutdown().await;
        let interval = MS * (20 + u32::try_from(member).unwrap());
        let spec = on(&MEMBERS).heartbeat_every(interval);
        let again = node(MEMBERS[member], &robot.medium).service(spec);
        robot.members[member] = TestNode::start(again).await;
    }
    robot.asker.advance(3000 * MS).await;

    // The caller asks the node that it knows, and cannot know the outcome there.
    let failed = counter.ask_within(Add(1), 1000 * MS).await.unwrap_err();

    let DeliveryError::OutcomeUnknown { reason } = &failed.kind else { panic!("{failed}") };
    assert!(reason.contains("its primary sends a heartbeat every"), "{reason}");
}

async fn add(node: &TestNode) -> Result<u64, DeliveryError> {
    let counter = node.service::<Add>("counter").unwrap();
    counter.ask_within(Add(1), 500 * MS).await.map_err(|error| error.kind)
}

#[blastema_testkit::test]
async fn a_primary_is_not_disturbed_by_a_wrong_node_which_comes_into_step_once_it_is_right() {
    let wrong: [&'static [&'static str]; 3] =
        [&["module1"], &["module3", "module2", "module1"], &["module1", "module2", "module0"]];
    for wrong in wrong {
        let medium = MemoryMedium::default();
        let mut nodes = vec![
            start("module2", &medium, on(&MEMBERS)).await,
            start("module3", &medium, on(&MEMBERS)).await,
        ];
        nodes[0].advance(2000 * MS).await;
        assert_eq!(add(&nodes[0]).await, Ok(1), "{wrong:?}");
        let roles = |nodes: &[TestNode]| {
            nodes.iter().map(|node| node.service_role("counter")).collect::<Vec<_>>()
        };
        let before = roles(&nodes);

        let newcomer = start("module1", &medium, on(wrong)).await;
        for _ in 0..20 {
            newcomer.advance(100 * MS).await;
            assert_eq!(roles(&nodes), before, "{wrong:?}");
        }

        assert_eq!(serving(std::slice::from_ref(&newcomer)).len(), 0, "{wrong:?}");
        for node in nodes.iter().chain([&newcomer]) {
            let detail = mismatch(node).await.expect("it is declared");
            assert!(detail.contains("its nodes are"), "{detail}");
        }
        // Callers on the wrong node are served as well.
        assert_eq!(add(&newcomer).await, Ok(2), "{wrong:?}");
        newcomer.shutdown().await;
        nodes.push(start("module1", &medium, on(&MEMBERS)).await);
        nodes[0].advance(3000 * MS).await;
        for node in &nodes {
            assert_eq!(mismatch(node).await, None, "{wrong:?}: {}", node.name());
        }
        assert_eq!((serving(&nodes).len(), add(&nodes[2]).await), (1, Ok(3)), "{wrong:?}");
    }
}

#[blastema_testkit::test]
async fn nodes_that_have_met_do_not_serve_beside_each_other_when_they_are_cut_off() {
    let medium = MemoryMedium::default();
    let nodes = vec![
        start("module1", &medium, on(&["module1", "module2"])).await,
        start("module2", &medium, on(&["module2", "module1"])).await,
        start("module3", &medium, on(&["module3", "module1"])).await,
    ];
    nodes[0].advance(LOOK).await;
    pull_cable(&nodes[0]);
    for _ in 0..30 {
        nodes[0].advance(100 * MS).await;
        assert_eq!(serving(&nodes), [""; 0]);
    }
    for node in &nodes {
        assert!(mismatch(node).await.is_some(), "{}", node.name());
    }
}

#[blastema_testkit::test]
async fn a_list_is_changed_while_all_nodes_are_stopped_and_callers_keep_their_references() {
    let medium = MemoryMedium::default();
    let asker = TestNode::start(node("module0", &medium)).await;
    let short = || on(&["module1", "module2"]);
    let mut nodes =
        vec![start("module1", &medium, short()).await, start("module2", &medium, short()).await];
    let counter = asker.service::<Add>("counter").unwrap();
    let ask = async |add| {
        let answer = counter.ask_within(Add(add), 10_000 * MS).await;
        answer.map_err(|error| error.kind)
    };
    assert_eq!(ask(1).await, Ok(1));
    // The next primary has a later epoch than the first one after the change.
    nodes[0].shutdown().await;
    nodes[0] = start("module1", &medium, short()).await;
    assert_eq!(ask(1).await, Ok(2));
    let epoch = |nodes: &[TestNode]| {
        let epochs = nodes.iter().filter_map(|node| match node.service_role("counter") {
            Some(Role::Primary { epoch }) => Some(epoch),
            _ => None,
        });
        epochs.collect::<Vec<_>>()
    };
    let before = epoch(&nodes);

    for node in &nodes {
        node.shutdown().await;
    }
    nodes.clear();
    for own in MEMBERS {
        nodes.push(start(own, &medium, on(&MEMBERS)).await);
    }

    assert_eq!(ask(5).await, Ok(5), "the state is lost");
    let after = epoch(&nodes);
    assert!(after.len() == 1 && before.len() == 1 && after < before, "{before:?}, {after:?}");
    asker.advance(LOOK).await;
    for node in &nodes {
        assert_eq!(mismatch(node).await, None, "{}", node.name());
    }
}

#[blastema_testkit::test]
async fn a_listed_node_that_does_not_carry_the_service_is_named_while_the_others_serve() {
    let medium = MemoryMedium::default();
    let nodes = vec![
        start("module1", &medium, on(&MEMBERS)).await,
        start("module2", &medium, on(&MEMBERS)).await,
    ];
    nodes[0].advance(2000 * MS).await;
    let without = TestNode::start(node("module3", &medium)).await;
    assert!(without.connected("module1", 2000 * MS).await);
    assert!(without.connected("module2", 2000 * MS).await);
    without.advance(1100 * MS).await;

    assert_eq!(serving(&nodes).len(), 1);
    for node in &nodes {
        let detail = mismatch(node).await.expect("redundancy is missing");
        assert!(detail.contains("without this service: module3"), "{detail}");
    }
    without.shutdown().await;
    let _with = start("module3", &medium, on(&MEMBERS)).await;
    nodes[0].advance(3000 * MS).await;
    assert_eq!((mismatch(&nodes[0]).await, mismatch(&nodes[1]).await), (None, None));
}

#[blastema_testkit::test]
async fn an_object_that_only_has_the_services_name_is_no_mismatch() {
    let medium = MemoryMedium::default();
    let other = ChildSpec::new("counter", Counter::default);
    let other = TestNode::start(node("module3", &medium).child(other)).await;
    let nodes = vec![
        start("module1", &medium, on(&["module1", "module2"])).await,
        start("module2", &medium, on(&["module1", "module2"])).await,
    ];
    other.advance(5000 * MS).await;

    assert_eq!(serving(&nodes).len(), 1);
    for node in nodes.iter().chain([&other]) {
        assert_eq!(mismatch(node).await, None);
    }
}
