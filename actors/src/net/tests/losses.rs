//! What is counted, and where, when messages to another node do not arrive.

use super::*;
use crate::topic::Topics;
use blastema_core::net::NodeId;

/// What this module has counted of messages to `right`: object or topic, contract, reason, how
/// many.
fn counted(module: &Module) -> Vec<(String, String, DeadReason, u64)> {
    let right = NodeName::new("right").unwrap();
    let counts = module.host.dead_letters.counts().into_iter();
    let counts = counts.filter(|count| count.node.as_ref() == Some(&right));
    let row = |count: blastema_core::delivery::dead_letters::DeadLetterCount| {
        (count.object.to_string(), count.contract.to_string(), count.reason, count.count)
    };
    counts.map(row).collect()
}

fn row(
    to: &str,
    contract: &str,
    reason: DeadReason,
    count: u64,
) -> (String, String, DeadReason, u64) {
    (to.into(), contract.into(), reason, count)
}

/// Ten notes that are bound already, a message that waits for its binding, and five events.
async fn deliver_all(left: &Module) {
    let notes = left.sender::<Note>("right:acc");
    for n in 1..=10 {
        notes.deliver(Note(n)).await.unwrap();
    }
    left.sender::<Fresh>("right:acc").deliver(Fresh(1)).await.unwrap();
    for n in 0..5 {
        left.publisher().publish(Note(n)).unwrap();
    }
    advance(20 * MS).await;
}

/// One note arrives; then both cables are cut, and [`deliver_all`] sends.
async fn deliver_in_vain(robot: &Robot, left: &Module) {
    left.sender::<Note>("right:acc").deliver(Note(0)).await.unwrap();
    advance(10 * MS).await;
    robot.part("left");
    deliver_all(left).await;
}

/// What [`deliver_all`] sent, where no way leads there any more.
fn all_unreachable() -> [(String, String, DeadReason, u64); 3] {
    let why = DeadReason::Unreachable;
    [row("Note", "Note", why, 5), row("acc", "Fresh", why, 1), row("acc", "Note", why, 10)]
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_a_node_had_not_acknowledged_when_it_was_killed_is_counted_at_its_sender() {
    for returns in [true, false] {
        let mut robot = Robot::default();
        let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
        let right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
        advance(500 * MS).await;
        left.sender::<Note>("right:acc").deliver(Note(0)).await.unwrap();
        advance(10 * MS).await;
        assert_eq!(right.log.take(), [0]);

        robot.kill("ethernet/right");
        drop(right);
        deliver_all(&left).await;
        let next = if returns {
            Some(robot.module("right", 2, &[("ethernet", &["left"])]).await)
        } else {
            None
        };
        // A peer that is silent may still tell for a while what has arrived.
        advance(if returns { 3_000 * MS } else { 12_000 * MS }).await;

        let why = if returns { DeadReason::PeerDied } else { DeadReason::Unreachable };
        let all =
            [row("Note", "Note", why, 5), row("acc", "Fresh", why, 1), row("acc", "Note", why, 10)];
        assert_eq!(counted(&left), all, "it returns: {returns}");
        assert!(next.is_none_or(|next| next.log.take().is_empty()));
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_was_under_way_when_the_stack_panicked_is_counted() {
    for has_ended in [false, true] {
        let (robot, left, right) = pair().await;
        deliver_in_vain(&robot, &left).await;

        left.net.on_stack(move |stack| {
            if has_ended {
                // The session has returned its messages, and the gateway does not have them.
                let right = NodeId::of(&NodeName::new("right").unwrap());
                let peer = stack.floors.gateway.protocol.peers.get_mut(right).unwrap();
                peer.session.handle_incarnation(Incarnation(2), platform::now());
            }
            panic!("the sessions panic on purpose");
        });
        advance(10_000 * MS).await;

        assert_eq!(counted(&left), all_unreachable(), "the session has ended: {has_ended}");
        assert_eq!(right.log.take(), [0]);
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn events_for_which_there_is_no_room_on_the_way_are_counted_under_their_topic() {
    let (_robot, left, right) = pair().await;
    let publisher = left.publisher();

    (0..3000).for_each(|n| publisher.publish(Note(n)).unwrap());
    advance(300 * MS).await;

    let arrived = right.log.take().len() as u64;
    assert!(arrived > 0);
    assert_eq!(counted(&left), [row("Note", "Note", DeadReason::WayFull, 3000 - arrived)]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn events_between_two_sessions_are_lost_to_the_node_that_listened_and_each_is_counted() {
    for restarts in [false, true] {
        let mut robot = Robot::default();
        let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
        let mut right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
        advance(500 * MS).await;
        let publisher = left.publisher();
        let publish = async |numbers: std::ops::Range<u64>, every: Duration| {
            for n in numbers {
                publisher.publish(Note(n)).unwrap();
                advance(every).await;
            }
        };
        publish(0..5, 20 * MS).await;
        assert_eq!((right.log.take(), publisher.matched()), ((0..5).collect(), 2));

        match restarts {
            true => robot.kill("ethernet/right"),
            false => robot.cut("ethernet/left"),
        }
        publish(5..100, 100 * MS).await;
        assert_eq!(publisher.matched(), 1, "the other node is not there");
        assert!(left.host.feature::<Topics>().rows()[0].listening_nodes.is_empty());
        match restarts {
            true => right = robot.module("right", 2, &[("ethernet", &["left"])]).await,
            false => robot.restore("ethernet/left"),
        }
        publish(100..200, 20 * MS).await;

        let arrived = right.log.take();
        let lost = *arrived.first().expect("it is back");
        assert_eq!(arrived, (lost..200).collect::<Vec<_>>(), "it restarts: {restarts}");
        let counts = counted(&left).into_iter().map(|(.., count)| count);
        assert_eq!((counts.sum::<u64>(), publisher.matched()), (lost - 5, 2), "{restarts}");
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn events_after_the_end_of_a_node_that_left_are_lost_to_no_listener() {
    let (_robot, left, right) = pair().await;
    right.net.leave();
    advance(500 * MS).await;
    (0..5).for_each(|n| left.publisher().publish(Note(n)).unwrap());
    advance(500 * MS).await;
    assert_eq!(counted(&left), []);
}

/// What is reported of messages that were lost, and since it was asked last.
fn reported_losses(node: &Module) -> Vec<NodeCondition> {
    let mut conditions: Vec<_> =
        node.nodes.drain().into_iter().map(|reported| reported.condition).collect();
    let of_losses = |of: &NodeCondition| {
        matches!(of, NodeCondition::MessagesLost { .. } | NodeCondition::InSession)
    };
    conditions.retain(of_losses);
    conditions
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn each_message_of_an_outage_arrived_or_is_counted_and_a_fault_tells_of_them_until_it_is_over()
 {
    let (robot, left, right) = pair().await;
    let notes = left.sender::<Note>("right:acc");
    notes.deliver(Note(0)).await.unwrap();
    advance(10 * MS).await;
    assert_eq!(reported_losses(&left), [NodeCondition::InSession]);
    // What arrives from here on is not acknowledged.
    for end in ["ethernet/right", "ieee1394/right"] {
        let mute = Cut { direction: Direction::Outgoing, reported: false };
        robot.cable(end).do_send(mute);
    }
    for n in 1..=5 {
        notes.deliver(Note(n)).await.unwrap();
    }
    advance(20 * MS).await;
    robot.part("left");
    for n in 6..=12 {
        notes.deliver(Note(n)).await.unwrap();
    }
    advance(4_000 * MS).await;
    assert_eq!(reported_losses(&left), [], "the peer may still tell");

    for end in ["ethernet/left", "ieee1394/left", "ethernet/right", "ieee1394/right"] {
        robot.restore(end);
    }
    advance(1_500 * MS).await;

    assert_eq!(right.log.take(), [0, 1, 2, 3, 4, 5]);
    assert_eq!(counted(&left), [row("acc", "Note", DeadReason::Unreachable, 7)]);
    advance(1_000 * MS).await;
    let detail = "7 messages for right that had been accepted did not arrive, since sessions \
                  ended; the dead letters name their receivers";
    let lost = NodeCondition::MessagesLost { detail: detail.into() };
    assert_eq!(reported_losses(&left), [NodeCondition::InSession, lost, NodeCondition::InSession]);
}
