//! What answers a contract at an object's name without being its component.
//!
//! Variables and leases are kept by the node, so that they outlive the lives of the component that they
//! belong to, and can be reached while it hangs. They are served on the thread of whoever asks.

use crate::host::pulse;
use crate::platform;
use crate::registry::{Doorway, Postmark, ReplyTo, encoded_reply};
use crate::reply::{Answer, Reply};
use crate::sender::{Inlet, RequestError, SendError};
use blastema_core::contract::codec;
use blastema_core::{Contract, FaultKind, MessageId, Why};
use bytes::Bytes;
use std::future::{self, Future};
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

/// Serves one message; the answer may be given later. Must not wait.
pub(crate) type Serve<M> = Arc<dyn Fn(M, Answer<M>) + Send + Sync>;

/// Where messages of one contract are served by a closure.
pub(crate) struct Desk<M: Contract>(pub(crate) Serve<M>);

impl<M: Contract> Clone for Desk<M> {
    fn clone(&self) -> Self {
        Desk(self.0.clone())
    }
}

impl<M: Contract> Inlet<M> for Desk<M> {
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        self.offer(message)
    }

    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        if let Some(why) = pulse::forbidden() {
            return Err(SendError::new(why, message));
        }
        (self.0)(message, Answer::called_back(Box::new(|_| ()), None));
        Ok(())
    }

    fn room<'a>(&'a self, _: &Why) -> Pin<Box<dyn Future<Output = ()> + Send + 'a>> {
        Box::pin(future::ready(()))
    }

    fn ask(
        &self,
        message: M,
        _: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<Reply<M>, RequestError<M>> {
        if let Some(why) = pulse::forbidden() {
            return Err(RequestError::new(why, Some(message)));
        }
        let until = within.map(|within| platform::now() + within);
        let (answer, reply) = Answer::awaited_until(until);
        (self.0)(message, answer);
        Ok(reply)
    }
}

impl<M: Contract> Doorway for Desk<M> {
    fn deliver(
        &self,
        message: &Bytes,
        Postmark { until, .. }: Postmark,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), Why> {
        let decoded = codec::decode_shared::<M>(message)
            .map_err(|error| Why::Undecodable { reason: error.to_string() });
        match (decoded, reply_to) {
            (Ok(message), reply_to) => {
                let callback = move |result: Result<M::Reply, Why>| {
                    if let Some(reply_to) = reply_to {
                        reply_to(result.and_then(|reply| encoded_reply::<M>(reply, None)));
                    }
                };
                let answer = Answer::called_back(Box::new(callback), until);
                (self.0)(message, answer);
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
        // The node's own contracts differ only between nodes of different versions, which sessions tell.
    }
}
