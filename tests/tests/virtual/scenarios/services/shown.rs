//! The views of services.

use super::*;
use blastema::{ServiceRow, ServiceState};

fn row(node: &TestNode) -> ServiceRow {
    let rows = node.services();
    let [row] = &rows[..] else { panic!("{}: {rows:?}", node.name()) };
    row.clone()
}

fn missing(node: &TestNode) -> Vec<String> {
    row(node).missing_members.iter().map(ToString::to_string).collect()
}

#[blastema_testkit::test]
async fn each_node_shows_its_state_the_primary_and_the_missing_members_of_a_service() {
    let robot = Robot::start(StandbyKind::Hot).await;
    let first = robot.primary();
    let others: Vec<_> = (0..3).filter(|member| *member != first).collect();
    for (member, own) in robot.members.iter().enumerate() {
        let row = row(own);
        let state = if member == first { ServiceState::Primary } else { ServiceState::Standby };
        assert_eq!((row.name.as_str(), row.state), ("counter", state), "{}", own.name());
        assert_eq!(row.primary.as_ref(), Some(robot.members[first].name()));
        assert_eq!((row.kind, row.members.len(), row.unreplicated), (StandbyKind::Hot, 3, false));
        assert_eq!(missing(own), [""; 0]);
        assert!(row.epoch > 0 && row.since > 1000 * MS && row.age <= 600 * MS, "{row:?}");
    }
    assert_eq!(robot.asker.services(), []);

    robot.cut(first);
    robot.asker.advance(2000 * MS).await;
    let cut_off = row(&robot.members[first]);
    assert_eq!((cut_off.state, cut_off.primary), (ServiceState::Candidate, None));
    let away: Vec<_> = others.iter().map(|member| MEMBERS[*member]).collect();
    assert_eq!(missing(&robot.members[first]), away);
    let next = robot.primary();
    let last = 3 - first - next;
    assert_eq!(row(&robot.members[next]).state, ServiceState::Primary);
    assert_eq!(row(&robot.members[last]).state, ServiceState::Standby);
    assert!(row(&robot.members[next]).epoch > cut_off.epoch);
    assert_eq!(missing(&robot.members[next]), [MEMBERS[first]]);

    robot.members[last].remove_child("counter/replica").await.unwrap();
    robot.asker.advance(500 * MS).await;
    assert_eq!(row(&robot.members[last]).state, ServiceState::Resting);
    assert!(row(&robot.members[next]).unreplicated);
    let picture = robot.members[next].snapshot().await;
    assert!(picture.contains(r#""services":[{"#) && picture.contains(r#""unreplicated":true"#));
}
