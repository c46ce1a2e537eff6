//! Messages, requests and events between two nodes.

use super::*;
use crate::topic::Topics;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_flood_is_refused_when_full_and_nothing_accepted_is_lost() {
    let (robot, left, right) = pair().await;
    let sender = left.sender::<Note>("right:acc");
    robot.part("left");

    let mut accepted = 0;
    for n in 0..20_000 {
        match sender.tell(Note(n)) {
            Ok(()) => accepted += 1,
            Err(error) => {
                assert_eq!(
                    error.kind,
                    DeliveryError::WayFull {
                        node: "right".into(),
                        class: blastema_core::TrafficClass::Request
                    }
                );
                break;
            }
        }
        if n % 100 == 0 {
            settle().await;
        }
    }
    assert!((1000..20_000).contains(&accepted), "it has a bound: {accepted}");
    robot.unite("left");
    sender.deliver(Note(accepted)).await.unwrap();
    advance(3000 * MS).await;

    assert_eq!(right.log.take(), (0..=accepted).collect::<Vec<_>>());
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_grew_old_on_the_way_is_not_delivered_but_counted() {
    let (robot, left, right) = pair().await;
    let publisher = left.host.feature::<Topics>().publisher::<Fresh>(Fresh::NAME).unwrap();
    let sender = left.sender::<Fresh>("right:acc");
    publisher.publish(Fresh(1)).unwrap();
    sender.tell(Fresh(2)).unwrap();
    advance(10 * MS).await;
    assert_eq!(right.log.take(), [1, 2]);

    robot.part("left");
    publisher.publish(Fresh(3)).unwrap();
    sender.tell(Fresh(4)).unwrap();
    left.sender::<Note>("right:acc").tell(Note(5)).unwrap();
    advance(500 * MS).await;
    robot.unite("left");
    advance(1000 * MS).await;
    publisher.publish(Fresh(6)).unwrap();
    advance(10 * MS).await;

    assert_eq!(right.log.take(), [5, 6]);
    let acc = ObjectName::new("acc").unwrap();
    assert_eq!(right.host.dead_letters.count(&acc, DeadReason::Expired), 2);
}
