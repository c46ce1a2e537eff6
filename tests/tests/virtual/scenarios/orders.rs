//! What a person orders of a node from outside of its program.

use blastema::prelude::*;
use blastema::{
    ActuatorSpec, ComponentOrder, Connected, LostCommunicationPolicy, OrderReply, OrderVerb, Rung,
};
use blastema_testkit::TestNode;
use blastema_tests::{Part, moves};
use std::time::Duration;

const SECOND: Duration = Duration::from_secs(1);

#[derive(Clone, Copy, Debug, PartialEq, Request)]
#[contract(name = "orders/drive", reply = ())]
enum Drive {
    Safe,
    Stop,
}

fn wheels() -> ChildSpec<Part<(), Drive>> {
    moves("wheels", ActuatorSpec::new(Drive::Safe, SECOND), (), |(), _, _| {})
}

async fn order(node: &TestNode, verb: OrderVerb, name: Option<&str>) -> OrderReply {
    node.order(&ComponentOrder { verb, name: name.map(str::to_owned) }).await
}

#[blastema_testkit::test]
async fn a_person_acknowledges_that_communication_is_back_and_others_command_again() {
    let needs = Connected::heartbeat("orders/beat").timeout(SECOND);
    let stop = Rung::command("stop", "wheels", Drive::Stop);
    let policy = LostCommunicationPolicy::new("operator", needs).after(SECOND, stop);
    let builder = Node::builder("rover").child(wheels());
    let node = TestNode::start(builder.lost_communication(policy.until_acknowledged())).await;
    let beats = node.heartbeat("orders/beat", SECOND / 10).unwrap();
    node.advance(3 * SECOND).await;
    drop(beats);
    node.advance(5 * SECOND).await;

    let early = order(&node, OrderVerb::Acknowledge, None).await;
    assert!(
        early.refused.is_some_and(|why| why.contains("no policy for lost communication holds"))
    );
    let _beats = node.heartbeat("orders/beat", SECOND / 10).unwrap();
    node.advance(5 * SECOND).await;
    let rows = order(&node, OrderVerb::List, None).await.rows;
    let shown: Vec<_> = rows.iter().map(|row| (&*row.name, &*row.kind, &*row.state)).collect();
    assert_eq!(shown, [("wheels", "Part", "active"), ("operator", "policy", "stop")]);
    assert_eq!(rows[1].note, "communication is back: acknowledge");
    let unknown = order(&node, OrderVerb::Acknowledge, Some("pilot")).await;
    assert!(unknown.refused.is_some_and(|why| why.contains("it has operator")));

    let done = order(&node, OrderVerb::Acknowledge, None).await;

    assert_eq!(done.refused, None);
    node.advance(SECOND).await;
    let row = &order(&node, OrderVerb::Acknowledge, Some("operator")).await;
    assert!(row.refused.as_ref().is_some_and(|why| why.contains("holds no rung")));
    assert_eq!(row.rows[0].state, "others command");
}
