//! Queues, what becomes of what does not fit, and what becomes too old.

use super::{Add, Note, Slow, Stage, acc, logged, logging};
use crate::{Component, Context, DeliveryError, Event, Handle, WhenFull};
use blastema_contract::child::{ChildEvent, ChildOrder};
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_doubles::{advance, settle};
use std::time::Duration;
use tokio::task::spawn_local;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn deliver_ends_when_the_receiver_is_stopped() {
    let stage = Stage::new();
    let (mut child, acc) = stage.start(acc("acc").0.queue(1, WhenFull::Wait)).await;
    acc.tell(Slow(50)).unwrap();
    settle().await;
    acc.tell(Note(1)).unwrap();
    let waiting = spawn_local({
        let acc = acc.clone();
        async move { acc.deliver(Note(2)).await }
    });
    settle().await;
    assert!(!waiting.is_finished());

    child.order(ChildOrder::Stop { again: false });

    let refused = waiting.await.unwrap().unwrap_err();
    assert_eq!((refused.kind, refused.message), (DeliveryError::Stopped, Note(2)));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_component_queues_messages_before_its_first_incarnation() {
    let stage = Stage::new();
    let (spec, log) = acc("acc");
    let (mut child, acc) = stage.add(spec.queue(1, WhenFull::Refuse));

    acc.tell(Note(1)).unwrap();
    assert_eq!(acc.tell(Note(2)).unwrap_err().kind, DeliveryError::Restarting);

    assert_eq!(stage.begin(&mut *child, 1).await, ChildEvent::Started);
    settle().await;
    assert_eq!(logged(&log), [1]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_is_left_at_a_stop_goes_back_to_askers_and_to_the_dead_letters() {
    let stage = Stage::new();
    let (mut child, acc) = stage.start(acc("acc").0).await;
    acc.tell(Slow(50)).unwrap();
    settle().await;
    acc.tell(Note(1)).unwrap();
    let asked = spawn_local({
        let acc = acc.clone();
        async move { acc.ask(Add(3)).await }
    });
    settle().await;

    child.order(ChildOrder::Stop { again: false });

    let back = asked.await.unwrap().unwrap_err();
    assert_eq!((back.kind, back.message), (DeliveryError::Stopped, Some(Add(3))));
    let dead = &stage.environment.dead_letters;
    assert_eq!(dead.count(acc.name(), DeadReason::Stopped), 2);
}

#[derive(Clone, Event)]
#[contract(max_age = "100ms")]
struct Fresh(u64);

struct Picky(super::Log);
impl Component for Picky {}
impl Handle<Fresh> for Picky {
    async fn handle(&mut self, Fresh(millis): Fresh, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(millis);
        tokio::time::sleep(Duration::from_millis(millis)).await;
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_message_older_than_its_contract_allows_is_not_delivered_but_counted() {
    let stage = Stage::new();
    let (spec, log) = logging("picky", Picky);
    let (_child, picky) = stage.start(spec).await;
    picky.tell(Fresh(99)).unwrap();
    picky.tell(Fresh(2)).unwrap();
    picky.tell(Fresh(3)).unwrap();

    advance(Duration::from_secs(1)).await;

    // The second came 99 ms late, the third 101.
    assert_eq!(logged(&log), [99, 2]);
    let dead = &stage.environment.dead_letters;
    assert_eq!(dead.count(picky.name(), DeadReason::Expired), 1);
}
