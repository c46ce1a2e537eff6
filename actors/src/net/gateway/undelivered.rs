//! What did not arrive at other nodes, as dead letters.

use super::GatewayActor;
use super::peer::GatewayPeer;
use crate::messaging::dead_letters::DeadLetterLog;
use crate::topic::TopicKey;
use blastema_contract::monitor::NodeReported;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::MessageTarget;
use blastema_core::{DeliveryError, FaultKind, NodeName, ObjectName};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use tracing::{debug, warn};

/// Why an event is not sent at all, to a peer that listens.
const REASONS: [DeadReason; 5] = [
    DeadReason::WayFull,
    DeadReason::Restarting,
    DeadReason::Unreachable,
    DeadReason::Left,
    DeadReason::Isolated,
];

/// A topic of which one event in so many finds no capacity, within a second, is overloaded,
const LOST_SHARE: u64 = 10;
/// if there are so many of them.
const LOST_MIN: u64 = 10;

/// Subscriptions of the past of which it is known what they were, of all peers: as many as one peer
/// has at most.
const PAST_MAX: usize = 16 * 1024;

/// Counts the events of one topic that do not go to one peer.
pub(super) struct UndeliveredEvents {
    dead_letters: DeadLetterLog,
    node: NodeName,
    contract: String,
    topic: ObjectName,
    /// Losses that are not in the dead-letter log yet, by reason: a publisher only counts here,
    /// however many events are lost.
    counts: [AtomicU64; REASONS.len()],
}

impl UndeliveredEvents {
    /// One event more that is not sent.
    pub(super) fn take(&self, reason: DeadReason) {
        match REASONS.iter().position(|known| *known == reason) {
            Some(place) => drop(self.counts[place].fetch_add(1, Relaxed)),
            None => self.write_down(reason, 1),
        }
    }

    /// Records the counted losses in the dead-letter log.
    fn collect(&self) {
        for (reason, count) in REASONS.into_iter().zip(&self.counts) {
            match count.swap(0, Relaxed) {
                0 => {}
                many => self.write_down(reason, many),
            }
        }
    }

    fn write_down(&self, reason: DeadReason, many: u64) {
        let (node, contract) = (Some(self.node.clone()), self.contract.clone());
        self.dead_letters.take_many(node, &self.topic, contract, (reason, many));
    }
}

impl Drop for UndeliveredEvents {
    /// A publisher may have counted one more since the last look.
    fn drop(&mut self) {
        self.collect();
    }
}

/// A subscription whose events may still come back, or be about to go.
pub(super) struct EndedSubscription {
    /// Under which number its events went.
    number: u32,
    losses: Arc<UndeliveredEvents>,
    /// Why it ended.
    reason: DeadReason,
}

impl GatewayActor {
    /// What this peer does not get of the topic.
    pub(super) fn losses(&self, peer: &GatewayPeer, key: &TopicKey) -> Arc<UndeliveredEvents> {
        Arc::new(UndeliveredEvents {
            dead_letters: self.wiring.dead_letters.clone(),
            node: peer.node.clone(),
            contract: key.contract.to_string(),
            topic: key.topic.clone(),
            counts: Default::default(),
        })
    }

    /// Records in the dead-letter log the losses counted since the last call.
    pub(super) fn collect_losses(&self) {
        self.forwards.values().for_each(|forwarded| forwarded.losses.collect());
        self.past.values().for_each(|past| past.losses.collect());
    }

    /// Ends a subscription that the peer has not ended: what is lost of it is counted until the
    /// peer's next session is open.
    pub(super) fn retire(&mut self, forward: (NodeId, u32), why: &DeliveryError) {
        if let Some(ended) = self.end_forward(forward)
            && self.past.len() < PAST_MAX
        {
            let past =
                EndedSubscription { number: ended.by.0, losses: ended.losses, reason: why.into() };
            self.past.insert(forward, past);
        }
    }

    /// A session begins: nothing of the one before comes back any more.
    pub(super) fn forget_past(&mut self, peer: NodeId) {
        let all = (peer, 0)..=(peer, u32::MAX);
        let past: Vec<_> = self.past.range(all).map(|(key, _)| *key).collect();
        past.iter().for_each(|key| drop(self.past.remove(key)));
    }

    /// Counts an event that found its subscription ended. If the peer has ended it, the
    /// event is not missed.
    pub(super) fn record_late(&self, forward: (NodeId, u32)) {
        if let Some(past) = self.past.get(&forward) {
            past.losses.write_down(past.reason, 1);
        }
    }

    /// Counts a message to this peer that did not arrive, or perhaps not.
    pub(super) fn record_undelivered(
        &mut self,
        peer: NodeId,
        to: MessageTarget,
        why: &DeliveryError,
    ) {
        match to {
            MessageTarget::Object(object, contract) => {
                let known = self.peers.get_mut(&peer);
                let node = known.map(|known| {
                    let by_session = [DeadReason::Unreachable, DeadReason::PeerDied];
                    // The middleware's own are repeated.
                    let is_lost = !contract.starts_with("blastema/");
                    known.lost += u64::from(is_lost && by_session.contains(&why.into()));
                    known.node.clone()
                });
                self.wiring.dead_letters.take_for(node, &object, contract, why);
            }
            MessageTarget::Subscription(number) => match self.losses_under(peer, number) {
                Some(losses) => losses.write_down(why.into(), 1),
                None => debug!(%peer, %why, "an event came back whose subscription has ended"),
            },
            MessageTarget::Forgotten => {
                debug!(%peer, %why, "a message came back, and to whom is not known")
            }
        }
    }

    /// Reports how many accepted messages were lost with the sessions of each peer, until a session
    /// is open with it and no more are found.
    pub(super) fn look_at_losses(&mut self) {
        let Some(nodes) = &self.wiring.nodes else { return };
        for peer in self.peers.values_mut().filter(|peer| peer.lost > 0) {
            let condition = if peer.lost > peer.lost_reported {
                peer.lost_reported = peer.lost;
                let detail = format!(
                    "{} messages for {} that had been accepted did not arrive, since sessions ended; \
                     the dead letters name their receivers",
                    peer.lost, peer.node
                );
                warn!("{detail}");
                NodeCondition::MessagesLost { detail }
            } else if peer.send_state.has_session() {
                (peer.lost, peer.lost_reported) = (0, 0);
                NodeCondition::InSession
            } else {
                continue;
            };
            let (node, incarnation) = (peer.node.clone(), peer.incarnation);
            nodes.do_send(NodeReported { node, incarnation, condition });
        }
    }

    /// Declares the topics that lose more than a share of their events for lack of capacity.
    pub(super) fn look_at_topics(&self) {
        for (topic, [events, lost]) in self.wiring.topics.take_losses() {
            if lost < LOST_MIN || lost * LOST_SHARE < events {
                continue;
            }
            let detail = format!(
                "of {events} events on {topic} in a second, {lost} found no capacity with a listener \
                 or on the way to another node: publish less, use `deliver`, or make the listeners' \
                 queues larger; the dead letters name who lost them"
            );
            self.wiring.faults.declare_passing(FaultKind::Overload, detail);
        }
    }

    /// What counts the events that went to the peer under this number: the version of a contract is
    /// added to that of the subscription, so that it is the nearest below.
    fn losses_under(&self, peer: NodeId, number: u32) -> Option<&UndeliveredEvents> {
        let below = (peer, 0)..=(peer, number);
        let present = self.forwards.range(below.clone()).next_back();
        let present = present.map(|(_, forwarded)| (forwarded.by.0, &forwarded.losses));
        let past = self.past.range(below).next_back().map(|(_, past)| (past.number, &past.losses));
        let mut all = present.into_iter().chain(past);
        all.find(|(by, _)| *by == number).map(|(_, losses)| &**losses)
    }
}
