//! Panics of the network's own actors.

use super::*;

#[test]
fn a_panic_in_any_actor_of_the_network_is_survived_and_every_promise_resolved() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let count = left.net.victims().len();
        assert_eq!(count, 3);
        for victim in 0..=count {
            for module in [&left, &right] {
                let asked: Vec<_> = (0..10)
                    .map(|_| {
                        let sender = left.sender::<Add>("right:acc");
                        actix_rt::spawn(async move { sender.ask_within(Add(1), 60_000 * MS).await })
                    })
                    .collect();
                match module.net.victims().get(victim) {
                    Some(actor) => actor.do_send(InjectPanic),
                    None => module.net.panic_sessions(),
                }
                let reported = platform::now();
                for asked in asked {
                    // The reply, or why there is none: never nothing.
                    let _ = asked.await.unwrap();
                }
                assert!(platform::now() - reported < 3000 * MS, "{victim}");
                advance(2000 * MS).await;

                let reply = left.sender::<Add>("right:acc").ask(Add(0)).await;
                assert!(reply.is_ok(), "{victim}: {reply:?}");
                right.log.take();
                left.publisher().publish(Note(7)).unwrap();
                advance(50 * MS).await;
                assert_eq!(right.log.take(), [7], "{victim}");
            }
        }
        assert_eq!(left.exits.drain().len(), count + 1);
        let lost = left.nodes.drain().into_iter().chain(right.nodes.drain());
        let lost = lost.filter(|report| matches!(report.condition, NodeCondition::Lost { .. }));
        assert_eq!(lost.count(), 0);
    });
}

#[test]
fn a_panic_of_the_stack_gives_back_what_its_sessions_held() {
    paused(async {
        let (_robot, left, right) = pair().await;
        let sender = left.sender::<Note>("right:acc");
        sender.tell(Note(0)).unwrap();
        advance(10 * MS).await;

        for n in 1..50 {
            sender.tell(Note(n)).unwrap();
        }
        left.net.panic_sessions();
        advance(1000 * MS).await;

        let arrived = right.log.take();
        let buried = left.host.dead_letters.total();
        assert!(arrived.is_sorted());
        assert!(arrived.len() as u64 + buried >= 50, "{} arrived, {buried} told", arrived.len());
    });
}
