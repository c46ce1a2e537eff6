//! Neighbours that never come, and ways that are not left.

use super::*;
use blastema_contract::strategy::Reroute;
use blastema_core::FaultLocation;

fn right() -> NodeName {
    NodeName::new("right").unwrap()
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_neighbour_that_never_comes_is_told_five_seconds_after_the_start_and_until_it_comes() {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
    for _ in 0..50 {
        advance(100 * MS).await;
    }
    assert_eq!(left.links.drain(), []);

    advance(500 * MS).await;

    let reported = left.links.expect().await;
    assert_eq!(reported.neighbour, Some(right()));
    let LinkCondition::Down { reason } = reported.condition else { panic!("{reported:?}") };
    assert!(reason.starts_with("never heard since the start"), "{reason}");
    assert!(reason.contains("ethernet/right"), "{reason}");
    let _right = robot.module("right", 1, &[("ethernet", &["left"])]).await;
    advance(500 * MS).await;
    assert_eq!(left.links.expect().await.condition, LinkCondition::Up);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn why_a_medium_does_not_open_stays_the_cause_for_as_long_as_it_does_not() {
    let mut robot = Robot::default();
    let left = robot.module("left", 1, &[("ethernet", &["right"])]).await;
    robot.cable("ethernet/left").do_send(Cut { direction: Direction::Both, reported: true });
    for _ in 0..100 {
        advance(100 * MS).await;
    }

    let reported = left.links.drain();
    let [LinkReported { condition: LinkCondition::Down { reason }, .. }] = &reported[..] else {
        panic!("{reported:?}");
    };
    assert!(reason.starts_with("the cable is cut"), "{reason}");

    robot.restore("ethernet/left");
    let LinkCondition::Down { reason } = left.links.expect().await.condition else {
        panic!("the neighbour is missing");
    };
    assert!(reason.starts_with("never heard since the start"), "{reason}");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn another_way_is_promised_where_one_is_left_and_is_connected_no_longer_than_one_is() {
    let (robot, left, _right) = pair().await;
    let ask = || left.net.reroute().send(Reroute { location: FaultLocation::Node(right()) });
    let peer = right();
    let connected = || tokio::time::timeout(MS, left.net.connected(&peer));
    robot.cut("ethernet/left");
    advance(300 * MS).await;
    assert!(ask().await.unwrap().is_ok());
    assert!(connected().await.is_ok());

    // Its last hello is 100 ms old and more, but not 175: perhaps it is only late.
    robot.cut("ieee1394/left");
    advance(120 * MS).await;
    let asked = ask();
    advance(200 * MS).await;

    assert!(asked.await.unwrap().is_err());
    assert!(ask().await.unwrap().is_err());
    assert!(connected().await.is_err(), "although the session still waits for a path");
    robot.restore("ieee1394/left");
    advance(800 * MS).await;
    assert!(connected().await.is_ok());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_peer_that_has_restarted_is_not_connected_by_the_session_of_its_last_incarnation() {
    let (_robot, left, _right) = pair().await;
    let peer = right();
    for (incarnation, is_connected) in [(1, true), (2, false)] {
        let (node, incarnation) = (peer.clone(), Incarnation(incarnation));
        left.net
            .on_stack(move |stack| stack.floors.gateway.handle_reachable(&node, incarnation, 1000));
        settle().await;
        let connected = tokio::time::timeout(MS, left.net.connected(&peer)).await;
        assert_eq!(connected.is_ok(), is_connected);
    }
}
