//! Services whose state only the primary holds.

use super::*;

/// Its component dies until the node enters the safe state.
pub(super) async fn bring_to_rest(node: &TestNode) {
    for _ in 0..20 {
        if matches!(node.state(), NodeState::InSafeState { .. }) {
            return;
        }
        let component = node.sender::<Add>("counter/replica").unwrap();
        let _ = component.ask(Add(1000)).await;
        node.advance(MS).await;
    }
    panic!("{} is not at rest", node.name());
}

#[blastema_testkit::test]
async fn a_hot_service_declares_that_only_its_primary_has_the_state_and_later_that_it_is_lost() {
    let robot = Robot::start(StandbyKind::Hot).await;
    assert_eq!(robot.add(5).await, Ok(5));
    let first = robot.primary();
    let others: Vec<_> = (0..3).filter(|member| *member != first).collect();
    for member in &others {
        bring_to_rest(&robot.members[*member]).await;
    }
    robot.asker.advance(200 * MS).await;

    let fault =
        standing(&robot.members[first], &FaultKind::Unreplicated).await.expect("it is declared");
    assert_eq!(fault.location.to_string(), format!("{}:counter/replica/body", MEMBERS[first]));
    assert!(
        fault.detail.contains("service counter: no standby holds its state"),
        "{}",
        fault.detail
    );
    assert_eq!(robot.add(1).await, Ok(6), "it goes on");
    robot.members[others[0]].restart().await.unwrap();
    robot.asker.advance(500 * MS).await;
    let left = standing(&robot.members[first], &FaultKind::Unreplicated).await;
    assert_eq!(left, None, "one of them holds it again");

    bring_to_rest(&robot.members[others[0]]).await;
    robot.asker.advance(200 * MS).await;
    assert!(standing(&robot.members[first], &FaultKind::Unreplicated).await.is_some());
    robot.members[first].shutdown().await;
    for member in &others {
        robot.members[*member].restart().await.unwrap();
    }
    robot.asker.advance(3000 * MS).await;

    assert_eq!(robot.add(1).await, Ok(1), "no replica was left that had it");
    let next = robot.primary();
    let fault =
        standing(&robot.members[next], &FaultKind::StateLost).await.expect("it is declared");
    assert!(fault.detail.contains("starts again with the state"), "{}", fault.detail);
}

#[blastema_testkit::test]
async fn standbys_whose_components_were_removed_hold_nothing() {
    let robot = Robot::start(StandbyKind::Hot).await;
    assert_eq!(robot.add(5).await, Ok(5));
    let first = robot.primary();
    for member in (0..3).filter(|member| *member != first) {
        robot.members[member].remove_child("counter/replica").await.unwrap();
    }
    robot.asker.advance(500 * MS).await;

    let fault =
        standing(&robot.members[first], &FaultKind::Unreplicated).await.expect("it is declared");
    assert!(fault.detail.contains("at rest, stopped"), "{}", fault.detail);
    assert_eq!(robot.add(1).await, Ok(6));
}
