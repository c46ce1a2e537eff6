//! No credit is lost, whatever becomes of the messages that held it.

use super::*;
use blastema_core::DeliveryError;

/// Much at once, all of which counts.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(max_size = 1_100_000, bulk)]
struct Map(Vec<u8>);

/// Of which only the newest counts.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(delivery = "newest")]
struct Position(u64);

/// How many messages are accepted at once, until the path is full.
fn accepted<M: Contract>(sender: &Sender<M>, message: impl Fn() -> M) -> usize {
    let mut accepted = 0;
    loop {
        match sender.tell(message()).map_err(|error| error.kind) {
            Ok(()) => accepted += 1,
            Err(DeliveryError::WayFull { .. }) => return accepted,
            Err(other) => panic!("after {accepted}: {other}"),
        }
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn the_credit_to_a_peer_is_whole_after_cuts_panics_and_refusals() {
    let (robot, left, right) = pair().await;
    let (notes, maps) = (left.sender::<Note>("right:acc"), left.sender::<Map>("right:acc"));
    let (strange, positions) =
        (left.sender::<Note>("right:none"), left.sender::<Position>("right:acc"));
    let (questions, publisher) = (left.sender::<Add>("right:acc"), left.publisher());
    let mut random = 1_u64;
    for round in 0..60 {
        random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(round);
        for n in 0..200 {
            let _ = (notes.tell(Note(n)), strange.tell(Note(n)));
            let _ = (publisher.publish(Note(n)), positions.tell(Position(n)));
        }
        let _ = (maps.tell(Map(vec![7; 300_000])), maps.tell(Map(vec![])));
        // A caller that is cut off while its request is on its way.
        let questions = questions.clone();
        let caller =
            actix_rt::spawn(async move { questions.ask_within(Add(1), 2 * MS).await.is_ok() });
        advance(((random >> 40) % 8) as u32 * MS).await;
        match random >> 60 {
            0..4 => caller.abort(),
            4..6 => left.net.victims()[0].do_send(InjectPanic),
            6..8 => left.net.panic_sessions(),
            8..10 => right.net.panic_sessions(),
            10..14 => {
                robot.part("left");
                advance(if random & 0x1_0000 == 0 { 300 * MS } else { 3_000 * MS }).await;
                robot.unite("left");
            }
            _ => {}
        }
        advance(if random & 0x10_0000 == 0 { Duration::ZERO } else { 500 * MS }).await;
    }
    advance(10_000 * MS).await;

    // Seven eighths of 2048 messages, for the rest is for other senders.
    assert_eq!(accepted(&notes, || Note(1)), 1792);
    advance(1_000 * MS).await;
    assert_eq!(accepted(&maps, || Map(vec![])), 1792, "refused by the receiver");
    advance(1_000 * MS).await;
    assert_eq!(accepted(&maps, || Map(vec![7; 1 << 20])), 4);
    advance(1_000 * MS).await;
    assert_eq!(accepted(&positions, || Position(1)), 1792);
    let before = left.host.dead_letters.total();
    (0..1500).for_each(|n| publisher.publish(Note(n)).unwrap());
    assert_eq!(left.host.dead_letters.total() - before, 1500 - 1024);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_flood_of_one_sender_refuses_no_request_of_another() {
    let (_robot, left, right) = pair().await;
    let (notes, questions) = (left.sender::<Note>("right:acc"), left.sender::<Add>("right:acc"));
    let mut told = 0;
    for _ in 0..30 {
        told += accepted(&notes, || Note(1));
        assert!(questions.ask(Add(1)).await.is_ok());
    }
    advance(1_000 * MS).await;
    assert_eq!(right.log.take().len(), told);
}
