//! Cables and media that fail, are slow, or were never there.

use super::*;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_network_whose_interface_lost_its_carrier_is_given_up_at_once_and_proves_itself_again() {
    let (robot, left, right) = pair().await;
    let up = |rows: &[LinkRow]| rows.iter().map(|row| row.state).collect::<Vec<_>>();
    left.sender::<Note>("right:acc").tell(Note(0)).unwrap();
    advance(5 * MS).await;
    assert_eq!(right.log.take(), [0]);
    left.links.drain();

    robot.cut("ethernet/left");
    left.net.networks[0].1.do_send(CarrierChanged { present: false });
    left.sender::<Note>("right:acc").tell(Note(1)).unwrap();
    advance(5 * MS).await;

    assert_eq!(right.log.take(), [1], "a hello is not even late");
    let reported = left.links.expect().await;
    let LinkCondition::Down { reason } = reported.condition else { panic!("{reported:?}") };
    assert!(reason.contains("carrier"), "{reason}");
    robot.restore("ethernet/left");
    left.net.networks[0].1.do_send(CarrierChanged { present: true });
    advance(5 * MS).await;
    assert_eq!(up(&left.net.read_links().await), [LinkState::Down, LinkState::Up]);
    advance(1000 * MS).await;
    assert_eq!(up(&left.net.read_links().await), [LinkState::Up; 2]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_slow_medium_is_dearer_and_is_spared_hellos() {
    let (_robot, left, _right) = pair().await;

    left.net.networks[0].1.do_send(TransportReport::Rate { bytes_per_second: 11_520 });
    advance(1000 * MS).await;

    let rows = left.net.read_links().await;
    assert_eq!([rows[0].cost, rows[1].cost], [868, 10]);
    assert!(rows[0].hello_interval > 80 * MS, "{:?}", rows[0].hello_interval);
    assert_eq!(rows[1].hello_interval, 50 * MS);
    assert!(rows.iter().all(|row| row.state == LinkState::Up), "{rows:?}");
    assert_eq!(left.net.read_routes().await[0].next, LinkId(1));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_medium_that_cannot_be_opened_is_told_as_its_links_being_down() {
    let (mut robot, left, _right) = pair().await;
    left.links.drain();

    // Its end of the medium is taken.
    let usurper = robot.module("left", 2, &[("ethernet", &["right"])]).await;
    advance(10 * MS).await;

    let reported = usurper.links.expect().await;
    let LinkCondition::Down { reason } = reported.condition else { panic!("{reported:?}") };
    assert!(reason.contains("ethernet/left"), "{reason}");
    assert_eq!(left.links.drain(), []);
}
