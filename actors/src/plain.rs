//! Plain actix actors among components: the one place where actix types are shown.
//!
//! A plain actor sends to components through a [`Sender`], as components do; [`recipient`] is for
//! code that wants an actix `Recipient`. Components send to a plain actor through what [`sender`]
//! returns. A plain actor has no guard, no bounded queue and no life cycle: what is promised of
//! components is not promised of it.
//!
//! ```
//! use actix::prelude::*;
//! use blastema::plain::{self, ServeRequest};
//! use blastema::prelude::*;
//!
//! #[derive(Clone, Debug, Event)]
//! struct Alarm(u32);
//!
//! struct Siren;
//! impl Actor for Siren {
//!     type Context = actix::Context<Self>;
//! }
//! impl Handler<ServeRequest<Alarm>> for Siren {
//!     type Result = ();
//!     fn handle(&mut self, ServeRequest(alarm): ServeRequest<Alarm>, _: &mut Self::Context) {
//!         assert_eq!(alarm.0, 7);
//!         System::current().stop();
//!     }
//! }
//!
//! let system = System::new();
//! system.block_on(async {
//!     let siren: Sender<Alarm> = plain::sender(Siren.start().recipient());
//!     siren.tell(Alarm(7)).unwrap();
//! });
//! system.run().unwrap();
//! ```

use crate::arbiter::heartbeat;
use crate::messaging::error::{RequestError, SendError};
use crate::messaging::reply::{ReplyFuture, Responder};
use crate::messaging::sender::Sender;
use crate::messaging::sink::MessageSink;
use actix::fut::wrap_future;
use actix::prelude::{
    Actor, Addr, AsyncContext, Context, Handler, Message, Recipient, ResponseFuture,
};
use blastema_core::{Contract, DeliveryError, MessageId};
use std::pin::Pin;
use std::time::Duration;

/// A message to a component. The reply reports the result of its delivery.
#[derive(Debug)]
pub struct Deliver<M>(pub M);

impl<M: Contract> Message for Deliver<M> {
    type Result = Result<M::Reply, DeliveryError>;
}

/// A message to a plain actor, which replies as the contract requires.
#[derive(Debug)]
pub struct ServeRequest<M>(pub M);

impl<M: Contract> Message for ServeRequest<M> {
    type Result = M::Reply;
}

/// The way to a component, for code that wants a `Recipient`. It lives on the present arbiter.
///
/// # Panics
/// Outside of an actix arbiter.
pub fn recipient<M: Contract>(sender: &Sender<M>) -> Recipient<Deliver<M>> {
    Forwarder(sender.clone()).start().recipient()
}

/// The way to a plain actor, for components and all others that want a [`Sender`]. It lives on the
/// present arbiter; the bound is that of the actor's mailbox.
///
/// # Panics
/// Outside of an actix arbiter.
pub fn sender<M: Contract>(recipient: Recipient<ServeRequest<M>>) -> Sender<M> {
    Sender(std::sync::Arc::new(Outside { relay: Relay(recipient).start() }))
}

/// Between `Recipient`s and one component.
struct Forwarder<M: Contract>(Sender<M>);

impl<M: Contract> Actor for Forwarder<M> {
    type Context = Context<Self>;
}

impl<M: Contract> Handler<Deliver<M>> for Forwarder<M> {
    type Result = ResponseFuture<Result<M::Reply, DeliveryError>>;

    fn handle(&mut self, Deliver(message): Deliver<M>, _: &mut Self::Context) -> Self::Result {
        let sender = self.0.clone();
        Box::pin(async move { sender.ask(message).await.map_err(|error| error.kind) })
    }
}

/// Asks a plain actor, and passes its answer on.
struct Relay<M: Contract>(Recipient<ServeRequest<M>>);

impl<M: Contract> Actor for Relay<M> {
    type Context = Context<Self>;
}

struct Pass<M: Contract> {
    message: M,
    responder: Option<Responder<M>>,
}

impl<M: Contract> Message for Pass<M> {
    type Result = ();
}

impl<M: Contract> Handler<Pass<M>> for Relay<M> {
    type Result = ();

    fn handle(&mut self, Pass { message, responder }: Pass<M>, context: &mut Self::Context) {
        match responder {
            None => self.0.do_send(ServeRequest(message)),
            Some(responder) => {
                let served = self.0.send(ServeRequest(message));
                context.spawn(wrap_future(async move {
                    match served.await {
                        Ok(reply) => responder.give(reply),
                        Err(_) => responder.refuse(DeliveryError::Stopped, None),
                    }
                }));
            }
        }
    }
}

struct Outside<M: Contract> {
    relay: Addr<Relay<M>>,
}

impl<M: Contract> Outside<M> {
    fn pass(&self, message: M, responder: Option<Responder<M>>) -> Result<(), SendError<M>> {
        if let Some(why) = heartbeat::send_refusal() {
            return Err(SendError::new(why, message));
        }
        self.relay.try_send(Pass { message, responder }).map_err(|refused| match refused {
            actix::dev::SendError::Full(Pass { message, .. }) => {
                SendError::new(DeliveryError::Full, message)
            }
            actix::dev::SendError::Closed(Pass { message, .. }) => {
                SendError::new(DeliveryError::Stopped, message)
            }
        })
    }
}

impl<M: Contract> MessageSink<M> for Outside<M> {
    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        self.pass(message, None)
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        // An actix mailbox does not report that it has capacity again.
        Box::pin(tokio::time::sleep(heartbeat::HEARTBEAT_INTERVAL))
    }

    fn ask(
        &self,
        message: M,
        _: Option<MessageId>,
        _: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        let (responder, reply) = Responder::awaited();
        self.pass(message, Some(responder))?;
        Ok(reply)
    }
}
