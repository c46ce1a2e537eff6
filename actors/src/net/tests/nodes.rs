//! Nodes that die, stay away, leave, and tell of themselves.

use super::*;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_node_that_dies_and_returns_is_a_new_incarnation_and_what_it_owed_is_resolved() {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
    let right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
    advance(500 * MS).await;
    let sender = left.sender::<Add>("right:acc");
    assert_eq!(sender.ask(Add(3)).await.unwrap(), 3);

    robot.kill("ethernet/right");
    drop(right);
    let asked = actix_rt::spawn(async move { sender.ask_within(Add(1), 60_000 * MS).await });
    advance(20 * MS).await;
    let right = robot.module("right", 2, &[("ethernet", &["left"])]).await;
    advance(1000 * MS).await;

    let error = asked.await.unwrap().unwrap_err();
    assert_eq!(error.kind, DeliveryError::PeerDied { incarnation: Incarnation(1) });
    assert_eq!(left.sender::<Add>("right:acc").ask(Add(5)).await.unwrap(), 5);
    left.publisher().publish(Note(7)).unwrap();
    advance(10 * MS).await;
    assert_eq!(right.log.take(), [7]);
    let reports = left.nodes.drain();
    assert!(reports.iter().any(|report| report.incarnation == Incarnation(2)));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_node_that_stays_away_is_lost_and_what_it_owed_is_resolved() {
    let (robot, left, _right) = pair().await;
    let sender = left.sender::<Add>("right:acc");
    assert_eq!(sender.ask(Add(3)).await.unwrap(), 3);

    robot.kill("ethernet/right");
    robot.kill("ieee1394/right");
    let error = sender.ask_within(Add(1), 60_000 * MS).await.unwrap_err();

    assert!(matches!(error.kind, DeliveryError::OutcomeUnknown { .. }), "{}", error.kind);
    let refused = left.sender::<Note>("right:acc").tell(Note(1)).unwrap_err();
    assert_eq!(refused.kind, DeliveryError::Unreachable { node: "right".into() });
    let conditions: Vec<_> =
        left.nodes.drain().into_iter().map(|report| report.condition).collect();
    assert!(
        matches!(
            conditions[..],
            [NodeCondition::Reachable, NodeCondition::InSession, NodeCondition::Lost { .. }]
        ),
        "{conditions:?}"
    );
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_fault_is_told_to_another_nodes_recoverer_and_confirmed() {
    let (robot, left, right) = pair().await;
    let port = left.net.recoverer_of(&NodeName::new("right").unwrap());
    let fault = Fault {
        id: FaultId(1),
        kind: FaultKind::Panic,
        severity: Severity::Error,
        location: FaultLocation::Object("left:acc".parse().unwrap()),
        incarnation: Incarnation(1),
        detail: "boom".into(),
        found_at: platform::now(),
        symptom_of: None,
        count: 1,
    };

    port.send(Recover { fault: fault.clone() }).await.unwrap();
    assert_eq!(right.faults.expect().await.fault.location, fault.location);

    robot.cut("ethernet/left");
    robot.cut("ieee1394/left");
    let unconfirmed = port.send(Recover { fault }).await;
    assert!(unconfirmed.is_err(), "the notifier has to know");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_node_that_leaves_in_order_delivers_first() {
    let (_robot, left, right) = pair().await;

    for n in 0..10 {
        left.sender::<Note>("right:acc").tell(Note(n)).unwrap();
    }
    left.net.leave();
    advance(100 * MS).await;

    assert_eq!(right.log.take(), (0..10).collect::<Vec<_>>());
    let why = right.sender::<Add>("left:acc").ask(Add(1)).await.unwrap_err().kind;
    assert_eq!(why, DeliveryError::Left { node: "left".into() });
    let reported = right.nodes.drain().into_iter().map(|report| report.condition);
    let reported: Vec<_> = reported.collect();
    use NodeCondition::{InSession, Left, Reachable};
    assert_eq!(reported, [Reachable, InSession, Left]);
}
