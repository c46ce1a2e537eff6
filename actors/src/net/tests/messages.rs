//! Messages, requests and events between two nodes.

use super::*;
use crate::topic::Topics;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_message_larger_than_any_frame_arrives_whole() {
    let (_robot, left, _right) = pair().await;
    let picture: Vec<u8> = (0..500_000u32).map(|n| n as u8).collect();

    let mirrored = left.sender("right:acc").ask(Mirror(picture.clone())).await.unwrap();

    assert!(mirrored == picture);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_contract_that_differs_is_refused_and_the_difference_shown() {
    let (_robot, left, right) = pair().await;
    let sender = left.host.registry.sender::<other::Add>("right:acc").unwrap();

    let error = sender.ask(other::Add { summand: 1.0 }).await.unwrap_err();

    let DeliveryError::ContractDiffers { difference } = error.kind else { panic!("{error:?}") };
    assert!(difference.contains("here") && difference.contains("there"), "{difference}");
    let declared = right.declared.expect().await;
    assert_eq!(declared.kind, FaultKind::ContractMismatch);
    assert_eq!(declared.object.as_str(), "acc");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_flood_is_refused_when_full_and_nothing_accepted_is_lost() {
    let (robot, left, right) = pair().await;
    let sender = left.sender::<Note>("right:acc");
    robot.cut("ethernet/left");
    robot.cut("ieee1394/left");

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
    robot.restore("ethernet/left");
    robot.restore("ieee1394/left");
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

    for end in ["ethernet/left", "ieee1394/left"] {
        robot.cut(end);
    }
    publisher.publish(Fresh(3)).unwrap();
    sender.tell(Fresh(4)).unwrap();
    left.sender::<Note>("right:acc").tell(Note(5)).unwrap();
    advance(500 * MS).await;
    for end in ["ethernet/left", "ieee1394/left"] {
        robot.restore(end);
    }
    advance(1000 * MS).await;
    publisher.publish(Fresh(6)).unwrap();
    advance(10 * MS).await;

    assert_eq!(right.log.take(), [5, 6]);
    let acc = ObjectName::new("acc").unwrap();
    assert_eq!(right.host.dead_letters.count(&acc, DeadReason::Expired), 2);
}
