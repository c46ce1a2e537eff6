//! Services without a primary.

use super::*;

async fn outage(node: &TestNode) -> Option<String> {
    standing(node, &FaultKind::ServiceUnavailable).await.map(|fault| fault.detail)
}

#[blastema_testkit::test]
async fn nodes_without_a_majority_declare_an_outage_with_the_missing_nodes_until_there_is_a_primary()
 {
    let robot = Robot::start(StandbyKind::Warm).await;
    let first = robot.primary();
    robot.cut(first);
    robot.asker.advance(5000 * MS).await;
    for member in (0..3).filter(|member| *member != first) {
        assert_eq!(outage(&robot.members[member]).await, None, "a takeover is none");
    }
    let fault = standing(&robot.members[first], &FaultKind::ServiceUnavailable).await;
    let fault = fault.expect("a node that is cut off sees no primary");
    assert_eq!(fault.location.to_string(), format!("{}:counter/replica/body", MEMBERS[first]));
    assert!(fault.detail.contains("service counter: no primary is known here"), "{}", fault.detail);

    (0..3).for_each(|member| robot.cut(member));
    robot.asker.advance(3000 * MS).await;
    for (member, own) in robot.members.iter().enumerate() {
        let fault = outage(own).await.expect("there is no majority");
        let away: Vec<_> = (0..3).filter(|other| *other != member).map(|n| MEMBERS[n]).collect();
        assert!(
            fault.contains(&format!("not reachable: {} (start them", away.join(", "))),
            "{fault}"
        );
    }

    (0..3).for_each(|member| robot.mend(member));
    robot.asker.advance(3000 * MS).await;
    assert_eq!(robot.serving().len(), 1);
    for own in &robot.members {
        assert_eq!(outage(own).await, None, "{}: it ends by itself", own.name());
    }
}

#[blastema_testkit::test]
async fn a_service_whose_components_are_all_stopped_declares_so_on_each_node() {
    let robot = Robot::start(StandbyKind::Hot).await;
    for own in &robot.members {
        own.remove_child("counter/replica").await.unwrap();
    }
    robot.asker.advance(3000 * MS).await;

    for own in &robot.members {
        let fault = outage(own).await.expect("no replica can serve");
        assert!(fault.contains("its component here accepts no jobs"), "{fault}");
    }
}
