//! What did not arrive at other nodes, as dead letters.

use super::Gateway;
use super::peer::Peer;
use crate::host::office::DeadLetterOffice;
use crate::topic::TopicKey;
use blastema_core::net::NodeId;
use blastema_core::net::exchange::Addressee;
use blastema_core::{NodeName, ObjectName, Why};
use tracing::debug;

/// Counts the events of one topic that do not go to one peer.
pub(super) struct Losses {
    office: DeadLetterOffice,
    node: NodeName,
    key: TopicKey,
    topic: Option<ObjectName>,
}

impl Losses {
    /// One event more.
    pub(super) fn take(&self, why: &Why) {
        if let Some(topic) = &self.topic {
            let contract = self.key.contract.to_string();
            self.office.take_for(Some(self.node.clone()), topic, contract, why);
        }
    }
}

impl Gateway {
    /// What this peer does not get of the topic.
    pub(super) fn losses(&self, peer: &Peer, key: &TopicKey) -> Losses {
        let (office, topic) = (self.wiring.dead_letters.clone(), key.lost_to());
        Losses { office, node: peer.node.clone(), key: key.clone(), topic }
    }

    /// Counts a message to this peer that did not arrive, or perhaps not.
    pub(super) fn bury(&mut self, peer: NodeId, to: Addressee, why: &Why) {
        let known = self.peers.get(&peer);
        let counted = match to {
            Addressee::Object(object, contract) => {
                let node = known.map(|peer| peer.node.clone());
                self.wiring.dead_letters.take_for(node, &object, contract, why);
                true
            }
            Addressee::Subscription(number) => {
                let all = (peer, 0)..=(peer, u32::MAX);
                let forwarded = self.forwards.range(all).map(|(_, forwarded)| forwarded);
                let lost = forwarded.filter(|forwarded| forwarded.by.0 == number).zip(known).next();
                let losses = lost.map(|(forwarded, known)| self.losses(known, &forwarded.key));
                losses.inspect(|losses| losses.take(why)).is_some()
            }
            Addressee::Forgotten => false,
        };
        if !counted {
            self.lost += 1;
            debug!(%peer, %why, "a message did not arrive, and nobody knows any more for whom it was");
        }
    }
}
