//! What replicas say to each other, and which node says it.
//!
//! A message names its sender, but anybody may write any name: one that votes, or was told other
//! terms, in the name of another node could make a service resign, or elect somebody. So what
//! counts is the node that the session says it comes from, and the message's own word has to agree.

use super::words::{CompareTerms, ReplicaSays};
use crate::messaging::reply::Responder;
use crate::registry::ContractPort;
use crate::registry::access::MessageOrigin;
use crate::registry::service_fn::ServiceFn;
use actix::prelude::*;
use blastema_core::net::NodeId;
use blastema_core::{Contract, NodeName};
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
    ContractPort::of_service_fn(receiver(body))
}

fn receiver<M: Signed>(body: Recipient<Spoken<M>>) -> ServiceFn<M> {
    ServiceFn(Arc::new(move |message: M, MessageOrigin { peer }, answer| {
        let by = NodeName::new(message.from()).ok();
        // A replica on this node says nothing to itself.
        let by = by.filter(|name| peer == Some(NodeId::of(name)));
        body.do_send(Spoken { by, message, answer });
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::{MessageMetadata, Skeleton};
    use blastema_core::contract::codec;
    use blastema_doubles::{Probe, paused};

    #[test]
    fn a_replica_is_heard_in_no_name_but_its_own() {
        paused(async {
            let heard = Probe::<Spoken<ReplicaSays>>::start();
            let gate = receiver(heard.recipient());
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
