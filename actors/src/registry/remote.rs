//! Objects of other nodes: their names, and the way to them.

use super::encoding::encoding;
use super::lookup::{CurrentReceiver, CurrentSender};
use super::{Inner, Registry};
use crate::messaging::error::{Receiver, RequestError, SendError};
use crate::messaging::reply::{ReplyFuture, Responder};
use crate::messaging::sender::Sender;
use crate::messaging::sink::MessageSink;
use crate::platform::panics;
use crate::registry::ReplyTo;
use blastema_core::contract::codec;
use blastema_core::directory::Holder;
use blastema_core::{
    Contract, ContractIdentity, DeliveryError, GatherBuffer, MessageId, NodeName, ObjectAddress,
    ObjectName,
};
use std::marker::PhantomData;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;
use tokio::sync::watch;
use tracing::error;

/// Before a name that is claimed, in the place of a node: whichever holds it.
const ANY_NODE: &str = "*";

/// A request for an object of another node, beside its contents.
pub(crate) struct OutgoingRequest {
    pub(crate) id: Option<MessageId>,
    pub(crate) within: Option<Duration>,
    pub(crate) reply_to: ReplyTo,
}

/// The ways to objects of other nodes, provided by the network.
pub(crate) trait StubFactory: Send + Sync {
    /// A way to this object for this contract. What stands in its way is found when it is used.
    fn stub(&self, to: ObjectAddress, contract: ContractIdentity) -> Arc<dyn RemoteStub>;

    /// Whether a path leads to the node now: a session outlives its paths.
    fn is_reachable(&self, node: &NodeName) -> bool;

    /// Completes when the node is connected next; never where it is connected already.
    fn opening(&self, node: &NodeName) -> Pin<Box<dyn Future<Output = ()> + Send>>;
}

/// The way to one object of another node, for one contract.
pub(crate) trait RemoteStub: Send + Sync {
    /// Ships one encoded message. Where it is a request and was taken, its `reply_to` is called
    /// once. Never waits.
    ///
    /// # Errors
    /// Why the message was not taken.
    fn send(
        &self,
        message: GatherBuffer,
        asked: Option<OutgoingRequest>,
    ) -> Result<(), DeliveryError>;

    /// Completes when there may be space for a message that was refused so.
    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>>;
}

/// Finds who holds a name of the whole robot.
pub(crate) trait NameResolver: Send + Sync {
    /// Who holds the name now.
    fn holder(&self, name: &ObjectName) -> Option<Holder>;
    /// Changes whenever another object holds some name.
    fn revision(&self) -> watch::Receiver<u64>;
}

/// The holder of a name of the whole robot.
pub(super) struct Claimed {
    name: ObjectName,
    names: Arc<dyn NameResolver>,
}

impl CurrentReceiver for Claimed {
    fn current(&self) -> Result<(String, u64), DeliveryError> {
        let holder = self.names.holder(&self.name);
        let holder =
            holder.ok_or_else(|| DeliveryError::Unclaimed { name: self.name.to_string() })?;
        Ok((holder.to_string(), holder.epoch))
    }

    fn changes(&self) -> watch::Receiver<u64> {
        self.names.revision()
    }
}

/// The ways to what this node does not have itself.
#[derive(Default)]
pub(super) struct RemoteNames {
    /// To other nodes.
    stubs: Option<Arc<dyn StubFactory>>,
    /// To the holders of names of the whole robot.
    names: Option<Arc<dyn NameResolver>>,
}

impl Registry {
    /// Names of objects of other nodes lead there.
    pub(crate) fn connect(&self, stubs: Arc<dyn StubFactory>) {
        self.lock().remote.stubs = Some(stubs);
    }

    /// Whether a path leads to another node now.
    pub(crate) fn is_reachable(&self, node: &NodeName) -> bool {
        let stubs = self.lock().remote.stubs.clone();
        stubs.is_some_and(|stubs| stubs.is_reachable(node))
    }

    /// Completes when a node is connected that is not connected now.
    pub(crate) async fn opening(&self, node: &NodeName) {
        let stubs = self.lock().remote.stubs.clone();
        match stubs {
            Some(stubs) => stubs.opening(node).await,
            None => std::future::pending().await,
        }
    }

    /// Names of the whole robot, such as `*:map`, are looked up there.
    pub(crate) fn set_name_resolver(&self, names: Arc<dyn NameResolver>) {
        self.lock().remote.names = Some(names);
    }
}

impl Inner {
    /// The way to what is called so, unless it is to be an object of this node, or there is no
    /// network.
    pub(super) fn way_elsewhere(&self, name: &str) -> Result<Option<RemoteWay>, DeliveryError> {
        let Some((node, claimed)) = name.split_once(':') else { return Ok(None) };
        if node == ANY_NODE {
            let unknown = || DeliveryError::Unknown { name: name.to_owned() };
            let name = ObjectName::new(claimed).map_err(|_| unknown())?;
            let names = self.remote.names.clone().ok_or_else(unknown)?;
            return Ok(Some(RemoteWay::Claimed(Claimed { name, names })));
        }
        let (Some(stubs), Ok(to)) = (&self.remote.stubs, name.parse::<ObjectAddress>()) else {
            return Ok(None);
        };
        Ok((self.node.as_ref() != Some(&to.node)).then(|| RemoteWay::Stub(to, stubs.clone())))
    }
}

/// The way to what this node does not have itself.
pub(super) enum RemoteWay {
    /// To an object of another node.
    Stub(ObjectAddress, Arc<dyn StubFactory>),
    /// To the holder of a name.
    Claimed(Claimed),
}

impl RemoteWay {
    pub(super) fn sender<M: Contract>(self, registry: &Registry) -> Sender<M> {
        match self {
            RemoteWay::Stub(to, stubs) => {
                let stub = stubs.stub(to.clone(), ContractIdentity::of::<M>());
                Sender(Arc::new(Outlet::<M> { stub, to, sends: PhantomData }))
            }
            RemoteWay::Claimed(holder) => CurrentSender::to(holder, registry.clone()),
        }
    }
}

/// Messages of one contract to an object of another node.
struct Outlet<M: Contract> {
    stub: Arc<dyn RemoteStub>,
    to: ObjectAddress,
    sends: PhantomData<fn(M)>,
}

impl<M: Contract> Outlet<M> {
    fn send(&self, message: &M, asked: Option<OutgoingRequest>) -> Result<(), DeliveryError> {
        if let Some(why) = crate::arbiter::heartbeat::send_refusal() {
            return Err(why);
        }
        let encoded = codec::encode_parcel(message);
        self.stub.send(encoded.map_err(|error| encoding(error, M::MAX_SIZE))?, asked)
    }
}

impl<M: Contract> MessageSink<M> for Outlet<M> {
    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        self.send(&message, None).map_err(|why| SendError::new(why, message))
    }

    fn receiver(&self) -> Option<Receiver> {
        let ObjectAddress { node, object } = self.to.clone();
        let (node, contract) = (Some(node), M::NAME);
        Some(Receiver { node, object, contract, queue: None, unavailable: None, deadline: None })
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        self.stub.space()
    }

    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        within: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        let (answer, reply) = Responder::awaited();
        // Only what may come twice needs to be known again.
        let id = id.or_else(|| M::IDEMPOTENT.then(crate::messaging::message_id::next_id));
        let reply_to = move |result: Result<GatherBuffer, DeliveryError>| {
            let decode = |reply: GatherBuffer| codec::decode_shared_reply::<M>(&reply.into_bytes());
            let decoded = result.and_then(|reply| {
                let read = panics::caught(|| decode(reply));
                let read = read.and_then(|read| read.map_err(|error| error.to_string()));
                read.map_err(|reason| DeliveryError::Undecodable { reason })
            });
            // If the caller has stopped waiting, the reply is dropped here, on the network's
            // thread.
            let given = panics::caught(|| match decoded {
                Ok(reply) => answer.give(reply),
                Err(why) => answer.refuse(why, None),
            });
            if let Err(panicked) = given {
                error!(
                    contract = M::NAME,
                    "the Drop of a reply whose caller has stopped waiting {panicked}"
                );
            }
        };
        let asked = OutgoingRequest { id, within, reply_to: Box::new(reply_to) };
        match self.send(&message, Some(asked)) {
            Ok(()) => Ok(reply),
            Err(why) => Err(RequestError::new(why, Some(message))),
        }
    }
}
