//! Nodes that die, stay away, leave, and tell of themselves.

use super::*;

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

    robot.part("left");
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
