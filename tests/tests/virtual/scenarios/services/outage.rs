//! Services without a primary.

use super::*;

async fn outage(node: &TestNode) -> Option<String> {
    standing(node, &FaultKind::ServiceUnavailable).await.map(|fault| fault.detail)
}

#[blastema_testkit::test]
async fn nodes_without_a_majority_say_that_nobody_serves_and_who_is_missing_until_somebody_does() {
    let robot = Robot::start(StandbyKind::Warm).await;
    let first = robot.primary();
    robot.cut(first);
    robot.asker.advance(5000 * MS).await;
    for member in (0..3).filter(|member| *member != first) {
        assert_eq!(outage(&robot.members[member]).await, None, "a takeover is none");
    }
    let told = standing(&robot.members[first], &FaultKind::ServiceUnavailable).await;
    let told = told.expect("a node that is cut off sees no primary");
    assert_eq!(told.location.to_string(), format!("{}:counter/replica/body", MEMBERS[first]));
    assert!(told.detail.contains("service counter: nobody is known here"), "{}", told.detail);

    (0..3).for_each(|member| robot.cut(member));
    robot.asker.advance(3000 * MS).await;
    for (member, own) in robot.members.iter().enumerate() {
        let told = outage(own).await.expect("there is no majority");
        let away: Vec<_> = (0..3).filter(|other| *other != member).map(|n| MEMBERS[n]).collect();
        assert!(told.contains(&format!("not heard: {} (start them", away.join(", "))), "{told}");
    }

    (0..3).for_each(|member| robot.mend(member));
    robot.asker.advance(3000 * MS).await;
    assert_eq!(robot.serving().len(), 1);
    for own in &robot.members {
        assert_eq!(outage(own).await, None, "{}: it ends by itself", own.name());
    }
}

#[blastema_testkit::test]
async fn a_service_whose_components_were_all_stopped_says_so_on_each_node() {
    let robot = Robot::start(StandbyKind::Hot).await;
    for own in &robot.members {
        own.remove_child("counter/replica").await.unwrap();
    }
    robot.asker.advance(3000 * MS).await;

    for own in &robot.members {
        let told = outage(own).await.expect("no replica can serve");
        assert!(told.contains("its component here takes nothing"), "{told}");
    }
}
