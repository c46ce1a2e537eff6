//! Callers that were answered in an epoch, and restarted nodes that do not know it.

use super::*;

/// A robot whose service has had two primaries, and a caller.
async fn in_its_second_epoch() -> (Robot, blastema::ServiceRef<Add>) {
    let robot = Robot::start(StandbyKind::Warm).await;
    let first = robot.primary();
    robot.cut(first);
    robot.asker.advance(1000 * MS).await;
    robot.mend(first);
    robot.asker.advance(2000 * MS).await;
    assert_ne!(robot.primary(), first);
    let counter = robot.asker.service::<Add>("counter").unwrap();
    (robot, counter)
}

#[blastema_testkit::test]
async fn a_caller_does_not_accept_a_restarted_node_with_another_configuration_and_a_lower_epoch() {
    if !blastema_doubles::long() {
        return;
    }
    let (mut robot, counter) = in_its_second_epoch().await;
    assert_eq!(counter.ask(Add(1)).await.map_err(|error| error.kind), Ok(1));
    let own = MEMBERS[robot.primary()];
    // The node ends without leaving.
    drop(robot.members.remove(robot.primary()));
    // The nodes that know the epoch are out of sight for a moment.
    for other in &robot.members {
        pull_cable(other);
    }
    let wrong = ServiceSpec::new("counter", [own], Counter::default).heartbeat_every(10 * MS);
    let wrong = node(own, &robot.medium).service(wrong);
    let wrong = TestNode::start(wrong).await;
    assert!(robot.asker.connected(own, 2000 * MS).await);
    while wrong.service_role("counter") != Some(Role::Primary { epoch: 1 }) {
        robot.asker.advance(MS).await;
    }

    let clone = counter.clone();
    let meanwhile = async {
        robot.asker.advance(300 * MS).await;
        for other in &robot.members {
            plug_cable(other);
        }
        robot.asker.advance(3000 * MS).await;
    };
    let (answer, ()) = tokio::join!(clone.ask(Add(1)), meanwhile);
    assert_eq!(answer.map_err(|error| error.kind), Ok(2), "by {:?}", counter.primary());
    for sum in 3..=100 {
        let answer = clone.ask(Add(1)).await.map_err(|error| error.kind);
        assert_eq!(answer, Ok(sum), "by {:?}", counter.primary());
        robot.asker.advance(5 * MS).await;
    }
}

#[blastema_testkit::test]
async fn a_caller_accepts_a_service_whose_nodes_have_all_restarted() {
    let (mut robot, counter) = in_its_second_epoch().await;
    assert_eq!(counter.ask(Add(1)).await.map_err(|error| error.kind), Ok(1));
    robot.members.clear();
    for own in MEMBERS {
        let again = node(own, &robot.medium).service(super::counter(StandbyKind::Warm));
        robot.members.push(TestNode::start(again).await);
    }

    assert_eq!(counter.ask(Add(2)).await.map_err(|error| error.kind), Ok(2));
    let asked_at = now();
    assert_eq!(counter.ask(Add(2)).await.map_err(|error| error.kind), Ok(4));
    assert!(now() - asked_at < 100 * MS, "{:?}", now() - asked_at);
}
