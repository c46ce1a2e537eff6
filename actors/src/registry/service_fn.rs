//! What answers a contract at an object's name without being its component.
//!
//! Variables and leases are kept by the node, so that they outlive the lives of the component that
//! they belong to, and can be reached while it hangs. Requests are served on the thread of
//! the caller.

use crate::arbiter::heartbeat;
use crate::messaging::error::{RequestError, SendError};
use crate::messaging::reply::{ReplyFuture, Responder};
use crate::messaging::sender::Sender;
use crate::messaging::sink::MessageSink;
use crate::platform;
use crate::registry::access::MessageOrigin;
use crate::registry::encoding::encoded_reply;
use crate::registry::{ContractPort, MessageMetadata, ReplyTo, Skeleton};
use blastema_core::contract::codec;
use blastema_core::{Contract, DeliveryError, FaultKind, MessageId};
use bytes::Bytes;
use std::future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

/// Serves one message; the answer may be given later. Must not wait.
pub(crate) type ServeFn<M> = Arc<dyn Fn(M, MessageOrigin, Responder<M>) + Send + Sync>;

/// Where messages of one contract are served by a closure.
pub(crate) struct ServiceFn<M: Contract>(pub(crate) ServeFn<M>);

impl<M: Contract> Clone for ServiceFn<M> {
    fn clone(&self) -> Self {
        ServiceFn(self.0.clone())
    }
}

impl<M: Contract> MessageSink<M> for ServiceFn<M> {
    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        if let Some(why) = heartbeat::send_refusal() {
            return Err(SendError::new(why, message));
        }
        let answer = Responder::called_back(Box::new(|_| ()), None);
        (self.0)(message, MessageOrigin::default(), answer);
        Ok(())
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(future::ready(()))
    }

    fn ask(
        &self,
        message: M,
        _: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        if let Some(why) = heartbeat::send_refusal() {
            return Err(RequestError::new(why, Some(message)));
        }
        let until = within.map(|within| platform::now() + within);
        let (answer, reply) = Responder::awaited_until(until);
        (self.0)(message, MessageOrigin::default(), answer);
        Ok(reply)
    }
}

impl<M: Contract> Skeleton for ServiceFn<M> {
    fn deliver(
        &self,
        message: &Bytes,
        metadata: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError> {
        let decoded = codec::decode_shared::<M>(message).map_err(DeliveryError::from);
        match (decoded, reply_to) {
            (Ok(message), reply_to) => {
                let callback = move |result: Result<M::Reply, DeliveryError>| {
                    if let Some(reply_to) = reply_to {
                        reply_to(result.and_then(|reply| encoded_reply::<M>(reply, None)));
                    }
                };
                let answer = Responder::called_back(Box::new(callback), metadata.until);
                (self.0)(message, MessageOrigin::from(&metadata), answer);
                Ok(())
            }
            (Err(why), reply_to) => {
                if let Some(reply_to) = reply_to {
                    reply_to(Err(why.clone()));
                }
                Err(why)
            }
        }
    }

    fn declare(&self, _: FaultKind, _: String) {
        // The node's own contracts differ only between nodes of different versions, which sessions
        // tell.
    }
}

impl ContractPort {
    /// A contract that the node itself serves at the object's name.
    pub(crate) fn served_by<M: Contract>(
        serve: impl Fn(M, MessageOrigin, Responder<M>) + Send + Sync + 'static,
    ) -> Self {
        let service_fn = Arc::new(ServiceFn(Arc::new(serve)));
        ContractPort::new::<M>(Sender(service_fn.clone()), service_fn)
    }
}
