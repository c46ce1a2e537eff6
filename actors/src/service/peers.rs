//! Messages between replicas, with their verified senders.
//!
//! A message names its sender, but any node may write any name. A vote or a configuration in the
//! name of another node could end or elect a primary. The sender that counts is the node of the
//! session; a message that names another one is refused.

use super::types::{CompareConfiguration, ReplicaMessage};
use crate::messaging::reply::Responder;
use crate::registry::ContractPort;
use crate::registry::access::MessageOrigin;
use crate::registry::service_fn::ServiceFn;
use actix::prelude::*;
use blastema_core::net::NodeId;
use blastema_core::{Contract, NodeName};
use std::sync::Arc;

/// A message that contains the name of its sender.
pub(super) trait NamesSender: Contract {
    /// Returns the name.
    fn sender_name(&self) -> &str;
}

impl NamesSender for ReplicaMessage {
    fn sender_name(&self) -> &str {
        &self.from
    }
}

impl NamesSender for CompareConfiguration {
    fn sender_name(&self) -> &str {
        &self.from
    }
}

/// A message of another replica.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct FromReplica<M: Contract> {
    /// The node of the session; `None` if the message names another one.
    pub(super) sender: Option<NodeName>,
    pub(super) message: M,
    pub(super) answer: Responder<M>,
}

/// Returns the port for messages of other replicas.
pub(super) fn port<M: NamesSender>(actor: Recipient<FromReplica<M>>) -> ContractPort {
    ContractPort::of_service_fn(receiver(actor))
}

fn receiver<M: NamesSender>(actor: Recipient<FromReplica<M>>) -> ServiceFn<M> {
    ServiceFn(Arc::new(move |message: M, MessageOrigin { peer }, answer| {
        let sender = NodeName::new(message.sender_name()).ok();
        // A replica sends no messages to itself.
        let sender = sender.filter(|name| peer == Some(NodeId::of(name)));
        actor.do_send(FromReplica { sender, message, answer });
    }))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registry::{MessageMetadata, Skeleton};
    use blastema_core::contract::codec;
    use blastema_doubles::{Probe, paused};

    #[test]
    fn a_message_that_names_another_sender_is_refused() {
        paused(async {
            let probe = Probe::<FromReplica<ReplicaMessage>>::start();
            let skeleton = receiver(probe.recipient());
            let node = |name: &str| NodeName::new(name).unwrap();
            let cases = [
                ("n2", Some("n2"), Some(node("n2"))),
                ("ghost", Some("n2"), None),
                ("n2", None, None),
                ("not a name!", Some("n2"), None),
            ];
            for (says, peer, sender) in cases {
                let mut bytes = Vec::new();
                let says = ReplicaMessage { from: says.to_owned(), message: Vec::new() };
                codec::encode(&says, &mut bytes).unwrap();
                let from = peer.map(|name| NodeId::of(&node(name)));
                skeleton
                    .deliver(
                        &bytes.into(),
                        MessageMetadata { from, ..MessageMetadata::default() },
                        None,
                    )
                    .unwrap();

                assert_eq!(probe.expect().await.sender, sender, "{says:?} by {peer:?}");
            }
        });
    }
}
