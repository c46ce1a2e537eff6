//! What replicas say to each other, and which node says it.
//!
//! A message names its sender, but anybody may write any name: one that votes, or was told other
//! terms, in the name of another node could make a service resign, or elect somebody. So what
//! counts is the node that the session says it comes from, and the message's own word has to agree.

use super::words::{CompareTerms, ReplicaSays};
use crate::messaging::reply::Responder;
use crate::registry::service_fn::ServiceFn;
use crate::registry::{ContractPort, MessageMetadata, ReplyTo, Skeleton};
use actix::prelude::*;
use blastema_core::net::NodeId;
use blastema_core::{Contract, DeliveryError, FaultKind, NodeName};
use bytes::Bytes;
use std::sync::Arc;

/// A message that names the node that it comes from.
pub(super) trait Signed: Contract {
    /// That name.
    fn from(&self) -> &str;
}

impl Signed for ReplicaSays {
    fn from(&self) -> &str {
        &self.from
    }
}

impl Signed for CompareTerms {
    fn from(&self) -> &str {
        &self.from
    }
}

/// Another replica says something.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Spoken<M: Contract> {
    /// The node that it comes from; `None` if it says that it were another.
    pub(super) by: Option<NodeName>,
    pub(super) message: M,
    pub(super) answer: Responder<M>,
}

/// Where other replicas speak.
pub(super) fn port<M: Signed>(body: Recipient<Spoken<M>>) -> ContractPort {
    // A replica on this node says nothing to itself.
    let inside = desk(body.clone(), None);
    ContractPort::of_peers(inside, Arc::new(Gate(body)))
}

fn desk<M: Signed>(body: Recipient<Spoken<M>>, peer: Option<NodeId>) -> ServiceFn<M> {
    ServiceFn(Arc::new(move |message: M, answer| {
        let by = NodeName::new(message.from()).ok();
        let by = by.filter(|name| peer == Some(NodeId::of(name)));
        body.do_send(Spoken { by, message, answer });
    }))
}

/// Takes what comes from other nodes.
struct Gate<M: Signed>(Recipient<Spoken<M>>);

impl<M: Signed> Skeleton for Gate<M> {
    fn deliver(
        &self,
        message: &Bytes,
        postmark: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError> {
        desk(self.0.clone(), postmark.from).deliver(message, postmark, reply_to)
    }

    fn declare(&self, _: FaultKind, _: String) {
        // The node's own contracts differ only between nodes of different versions, which sessions
        // tell.
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::contract::codec;
    use blastema_doubles::{Probe, paused};

    #[test]
    fn a_replica_is_heard_in_no_name_but_its_own() {
        paused(async {
            let heard = Probe::<Spoken<ReplicaSays>>::start();
            let gate = Gate(heard.recipient());
            let node = |name: &str| NodeName::new(name).unwrap();
            let cases = [
                ("n2", Some("n2"), Some(node("n2"))),
                ("ghost", Some("n2"), None),
                ("n2", None, None),
                ("not a name!", Some("n2"), None),
            ];
            for (says, peer, by) in cases {
                let mut bytes = Vec::new();
                let says = ReplicaSays { from: says.to_owned(), message: Vec::new() };
                codec::encode(&says, &mut bytes).unwrap();
                let from = peer.map(|name| NodeId::of(&node(name)));
                gate.deliver(
                    &bytes.into(),
                    MessageMetadata { from, ..MessageMetadata::default() },
                    None,
                )
                .unwrap();

                assert_eq!(heard.expect().await.by, by, "{says:?} by {peer:?}");
            }
        });
    }
}
