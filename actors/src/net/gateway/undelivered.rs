//! What did not arrive at other nodes, as dead letters.

use super::ObjectGateway;
use super::peer::GatewayPeer;
use crate::messaging::dead_letters::DeadLetterLog;
use crate::topic::TopicKey;
use blastema_contract::monitor::NodeReported;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::MessageTarget;
use blastema_core::{DeliveryError, FaultKind, NodeName, ObjectName};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, OnceLock};
use tracing::{debug, warn};

/// Why an event is not sent at all, to a peer that listens.
const REASONS: [DeadReason; 6] = [
    DeadReason::WayFull,
    DeadReason::Restarting,
    DeadReason::Unreachable,
    DeadReason::PeerDied,
    DeadReason::Left,
    DeadReason::Isolated,
];

/// A topic of which one event in so many finds no capacity, within a second, is overloaded,
const LOST_SHARE: u64 = 10;
/// if there are so many of them.
const LOST_MIN: u64 = 10;

/// Subscriptions of the past whose losses are counted, of all peers: as many as one peer has at
/// most.
const PAST_MAX: usize = 16 * 1024;

/// Counts the events of one topic that do not go to one peer.
pub(in crate::net) struct UndeliveredEvents {
    dead_letters: DeadLetterLog,
    node: NodeName,
    contract: String,
    topic: ObjectName,
    /// Losses that are not in the dead-letter log yet, by reason: a publisher only counts here,
    /// however many events are lost.
    counts: [AtomicU64; REASONS.len()],
    /// Why the subscription has ended with its session, once it has.
    ended: OnceLock<DeadReason>,
}

impl UndeliveredEvents {
    /// One event more that is not sent.
    pub(super) fn take(&self, reason: DeadReason) {
        match REASONS.iter().position(|known| *known == reason) {
            Some(place) => drop(self.counts[place].fetch_add(1, Relaxed)),
            None => self.write_down(reason, 1),
        }
    }

    pub(super) fn have_ended(&self) -> bool {
        self.ended.get().is_some()
    }

    /// One event more whose subscription may have ended. If the peer has ended it, the event is not
    /// missed. Returns whether it is counted.
    pub(super) fn take_late(&self) -> bool {
        self.ended.get().inspect(|why| self.take(**why)).is_some()
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

impl ObjectGateway {
    /// What this peer does not get of the topic.
    pub(super) fn losses(&self, peer: &GatewayPeer, key: &TopicKey) -> Arc<UndeliveredEvents> {
        Arc::new(UndeliveredEvents {
            dead_letters: self.wiring.dead_letters.clone(),
            node: peer.node.clone(),
            contract: key.contract.to_string(),
            topic: key.topic.clone(),
            counts: Default::default(),
            ended: OnceLock::new(),
        })
    }

    /// Records in the dead-letter log the losses counted since the last call.
    pub(super) fn collect_losses(&self) {
        self.forwards.values().for_each(|forwarded| forwarded.losses.collect());
        self.past.values().for_each(|past| past.losses.collect());
    }

    /// Ends a subscription that the peer has not ended. What is published is lost to the peer, and
    /// counted, until it subscribes again; and where it has left or may be away, no longer than its
    /// session has lasted.
    pub(super) fn retire(&mut self, forward: (NodeId, u32), why: &DeliveryError) {
        let Some(ended) = self.forwards.remove(&forward) else { return };
        // The first reason stays.
        let _ = ended.losses.ended.set(why.into());
        let is_away = matches!(why, DeliveryError::Left { .. })
            || self.wiring.may_be_away.contains(&ended.losses.node);
        let (is_kept, topics) = (self.past.len() < PAST_MAX, &self.wiring.topics);
        match is_kept && !is_away {
            true => topics.renew_forwards(&ended.key.topic),
            false => topics.end_forward(&ended.id),
        }
        if is_kept {
            let before = self.past.insert((forward.0, ended.key.topic.clone()), ended);
            before.iter().for_each(|before| topics.end_forward(&before.id));
        }
    }

    /// The peer has told what it listens to: what it listened to before is over.
    pub(super) fn forget_past(&mut self, peer: NodeId) {
        let topics = &self.wiring.topics;
        self.past.retain(|(of, _), past| {
            if *of == peer {
                topics.end_forward(&past.id);
            }
            *of != peer
        });
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
    /// added to that of the subscription, so that it is the nearest below. As long as the peer has
    /// not told what it listens to, they went in the session before.
    fn losses_under(&self, peer: NodeId, number: u32) -> Option<&UndeliveredEvents> {
        let past = self.past.iter().filter(|((of, _), _)| *of == peer).map(|(_, past)| past);
        let present = self.forwards.range((peer, 0)..=(peer, number)).next_back();
        let mut all = past.chain(present.map(|(_, forwarded)| forwarded));
        all.find(|of| of.by.0 == number).map(|of| &*of.losses)
    }
}
