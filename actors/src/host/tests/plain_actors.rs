//! Plain actix actors among components.

use super::{Add, Note, Stage, acc, logged};
use crate::plain::{self, Deliver, ServeRequest};
use crate::{ChildSpec, Component, Context, DeliveryError, Handle, Sender};
use actix::Actor;
use actix::prelude::Handler;
use blastema_contract::child::ChildOrder;
use blastema_doubles::settle;

struct Plain(u64);
impl Actor for Plain {
    type Context = actix::Context<Self>;
}
impl Handler<ServeRequest<Add>> for Plain {
    type Result = u64;
    fn handle(&mut self, ServeRequest(Add(n)): ServeRequest<Add>, _: &mut Self::Context) -> u64 {
        self.0 += n;
        self.0
    }
}

/// Asks whom it was given.
struct Asker(Sender<Add>);
impl Component for Asker {}
impl Handle<Add> for Asker {
    async fn handle(&mut self, add: Add, _: &mut Context<Self>) -> u64 {
        self.0.ask(add).await.unwrap()
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_plain_actor_sends_to_components_through_a_recipient() {
    let stage = Stage::new();
    let (spec, log) = acc("acc");
    let (mut child, acc) = stage.start(spec).await;
    let (add, note) = (plain::recipient(&acc.sender()), plain::recipient(&acc.sender()));

    assert_eq!(add.send(Deliver(Add(4))).await.unwrap(), Ok(4));
    note.do_send(Deliver(Note(5)));
    settle().await;
    assert_eq!(logged(&log), [5]);

    child.order(ChildOrder::Stop { again: false });
    settle().await;
    assert_eq!(add.send(Deliver(Add(4))).await.unwrap(), Err(DeliveryError::Stopped));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_component_sends_to_a_plain_actor_through_a_sender() {
    let stage = Stage::new();
    let plain = Plain(0).start();
    let sender = plain::sender(plain.clone().recipient());
    let kept = sender.clone();
    let spec = ChildSpec::new("asker", move || Asker(kept.clone()));
    let (_child, asker) = stage.start(spec).await;

    assert_eq!(asker.ask(Add(3)).await, Ok(3));
    sender.tell(Add(1)).unwrap();
    sender.deliver(Add(1)).await.unwrap();
    assert_eq!(sender.ask(Add(0)).await, Ok(5));
}
