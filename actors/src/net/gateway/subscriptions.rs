//! Topics that peers listen to: their events are sent there.

use super::ObjectGateway;
use super::local::LocalInput;
use super::undelivered::UndeliveredEvents;
use crate::net::credit::SenderCredit;
use crate::net::stub::PeerSendState;
use crate::topic::{EventForward, ForwardId, RemoteForward, Reservation, TopicKey, described};
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::{MessageTarget, TopicContract};
use blastema_core::{
    ContractIdentity, Credit, Delivery, DeliveryError, FaultKind, GatherBuffer, Instant, NodeName,
    PeerIdentity, TrafficClass,
};
use std::pin::Pin;
use std::sync::Arc;
use tracing::{debug, warn};

/// A topic of which one event in so many finds no capacity, within a second, is overloaded,
const LOST_SHARE: u64 = 10;
/// if there are so many of them.
const LOST_MIN: u64 = 10;

/// Subscriptions of the past whose losses are counted, of all peers: as many as one peer has at
/// most.
const PAST_MAX: usize = 16 * 1024;

/// The events of one topic that go to one peer.
pub(super) struct Forwarded {
    pub(super) id: ForwardId,
    pub(super) key: TopicKey,
    /// What the peer takes the events for, until an object here names the topic.
    pub(super) unverified: Option<Vec<PeerIdentity>>,
    /// Under which number they go, and in which stream; `None` if only the newest counts.
    pub(super) by: (u32, Option<TrafficClass>),
    pub(super) losses: Arc<UndeliveredEvents>,
}

/// Takes events of one topic to one peer.
struct PeerForward {
    target: ForwardTarget,
    send_state: Arc<PeerSendState>,
    /// `None` if only the newest counts.
    class: Option<TrafficClass>,
    /// What they hold.
    credit: Arc<SenderCredit>,
}

#[derive(Clone)]
struct ForwardTarget {
    gateway: Recipient<LocalInput>,
    peer: NodeId,
    subscription: u32,
    losses: Arc<UndeliveredEvents>,
}

impl ForwardTarget {
    fn send(&self, event: &GatherBuffer, sent: Instant, credit: Credit) {
        let ForwardTarget { gateway, peer, subscription, losses } = self.clone();
        let event = event.clone();
        gateway.do_send(LocalInput::Event { peer, subscription, losses, event, sent, credit });
    }
}

/// In which stream events go; `None` if only the newest counts.
fn event_stream(delivery: Delivery, bulk: bool) -> Option<TrafficClass> {
    (delivery != Delivery::Newest).then(|| TrafficClass::of_event(delivery, bulk))
}

impl EventForward for PeerForward {
    fn has_ended(&self) -> bool {
        self.target.losses.have_ended()
    }

    fn forward(&self, event: &GatherBuffer, sent: Instant) -> bool {
        if self.target.losses.take_late() {
            return true;
        }
        let is_open = self.send_state.has_session() && !self.send_state.is_isolated();
        let taken = is_open.then(|| self.credit.take_for_event(event.len())).flatten();
        match taken {
            Some(credit) => {
                self.target.send(event, sent, credit);
                true
            }
            None => {
                let why = self.send_state.why_not();
                self.target.losses.take(why);
                why != DeadReason::WayFull
            }
        }
    }

    fn reserve(&self, bytes: usize, waits: bool) -> Reservation {
        if self.class.is_none() || self.has_ended() || !self.send_state.takes_messages() {
            return Reservation::Needless;
        }
        let taken = if waits { self.credit.take(bytes) } else { self.credit.take_for_event(bytes) };
        match taken {
            Some(credit) => {
                let target = self.target.clone();
                Reservation::Taken(Box::new(move |event, sent| target.send(event, sent, credit)))
            }
            None => Reservation::Full,
        }
    }

    fn full(&self) -> DeliveryError {
        self.send_state.way_full(self.class.unwrap_or(TrafficClass::Event))
    }

    fn capacity(&self) -> Pin<Box<dyn Future<Output = ()> + Send>> {
        let (credit, state) = (self.credit.clone(), self.send_state.clone());
        Box::pin(async move { state.capacity(&credit).await })
    }
}

impl ObjectGateway {
    pub(super) fn subscribe(
        &mut self,
        peer: NodeId,
        subscription: u32,
        topic: &TopicContract,
        theirs: Vec<PeerIdentity>,
    ) {
        let key = match TopicKey::new(&topic.topic, &topic.contract) {
            Ok(key) => key,
            Err(why) => return self.protocol.handle_subscribe_refused(peer, subscription, why),
        };
        // Whether it wants the newest only must be known before the first event.
        let class = theirs.first().and_then(|theirs| event_stream(theirs.delivery, theirs.bulk));
        let wanted = theirs.clone();
        let (by, unverified) = match self.setup.topics.identities(&key.topic).first() {
            None => ((subscription, class), Some(theirs)),
            Some(ours) => match version_of(ours, &theirs) {
                Ok(form) => (
                    (subscription.saturating_add(form), event_stream(ours.delivery, ours.bulk)),
                    None,
                ),
                Err(difference) => {
                    let difference = self.topic_differs(peer, &key, ours, &theirs, &difference);
                    self.differs(peer, &difference);
                    let why = DeliveryError::ContractDiffers { difference };
                    self.protocol.handle_subscribe_refused(peer, subscription, why);
                    return;
                }
            },
        };
        let Some(node) = self.protocol.peers.get(peer).map(|peer| peer.node.clone()) else {
            return;
        };
        let send_state = self.setup.stubs.send_state(&node);
        let (losses, gateway) = (self.losses(&node, &key), self.setup.stack.clone());
        let target = ForwardTarget { gateway, peer, subscription, losses: losses.clone() };
        let credit = send_state.credits().sender(by.1);
        let forward = PeerForward { target, send_state, class: by.1, credit };
        let forward: RemoteForward = Arc::new(forward);
        self.end_forward((peer, subscription));
        let before = self.past.get(&(peer, key.topic.clone())).map(|past| &past.id);
        let id = self.setup.topics.forward(&key, node, wanted, forward, before);
        let forwarded = Forwarded { id, key: key.clone(), unverified, by, losses };
        self.forwards.insert((peer, subscription), forwarded);
        // An object may have named the topic just now.
        self.compare_forwards(&key);
    }

    pub(super) fn end_forward(&mut self, forward: (NodeId, u32)) -> Option<Forwarded> {
        let ended = self.forwards.remove(&forward)?;
        self.setup.topics.end_forward(&ended.id);
        Some(ended)
    }

    /// Under which number, and how, events of this topic go to the peers that subscribed when it
    /// had no contract here yet. It has one once an object here has named it, before its first
    /// event.
    pub(super) fn compare_forwards(&mut self, key: &TopicKey) {
        let identities = self.setup.topics.identities(&key.topic);
        let Some(ours) = identities.first() else { return };
        let mut differing = Vec::new();
        for (forward, known) in &mut self.forwards {
            let same = known.key.topic == key.topic;
            let Some(theirs) = known.unverified.take_if(|_| same) else { continue };
            match version_of(ours, &theirs) {
                Ok(form) => {
                    known.by =
                        (forward.1.saturating_add(form), event_stream(ours.delivery, ours.bulk))
                }
                Err(difference) => differing.push((*forward, theirs, difference)),
            }
        }
        for (forward, theirs, difference) in differing {
            let (peer, subscription) = forward;
            let difference = self.topic_differs(peer, key, ours, &theirs, &difference);
            self.differs(peer, &difference);
            self.end_forward(forward);
            let why = DeliveryError::ContractDiffers { difference };
            self.protocol.handle_subscribe_refused(peer, subscription, why);
        }
    }

    /// Names both nodes and the contract that each means by a topic.
    fn topic_differs(
        &self,
        peer: NodeId,
        key: &TopicKey,
        ours: &ContractIdentity,
        theirs: &[PeerIdentity],
        difference: &str,
    ) -> String {
        let here = self.setup.registry.node().map_or("this node".into(), |node| node.to_string());
        let there = self.protocol.peers.name(peer);
        let carried = described(&ours.brief());
        let wanted = theirs.first().map_or_else(String::new, described);
        format!(
            "the topic \"{}\" carries {carried} on {here}, and {there} listens to {wanted}: \
             {difference}",
            key.topic
        )
    }

    /// What this peer does not get of the topic.
    pub(super) fn losses(&self, node: &NodeName, key: &TopicKey) -> Arc<UndeliveredEvents> {
        Arc::new(UndeliveredEvents::new(self.setup.dead_letters.clone(), node, key))
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
        ended.losses.end(why.into());
        let is_away = matches!(why, DeliveryError::Left { .. })
            || self.setup.may_be_away.contains(&ended.losses.node);
        let (is_kept, topics) = (self.past.len() < PAST_MAX, &self.setup.topics);
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
        for (_, past) in self.past.iter().filter(|((of, _), _)| *of == peer) {
            self.setup.topics.end_forward(&past.id);
        }
        self.past.retain(|(of, _), _| *of != peer);
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
                let known = self.protocol.peers.get_mut(peer);
                let node = known.map(|known| {
                    let by_session = [DeadReason::Unreachable, DeadReason::PeerDied];
                    // The middleware's own are repeated.
                    let is_lost = !contract.starts_with("blastema/");
                    known.lost += u64::from(is_lost && by_session.contains(&why.into()));
                    known.node.clone()
                });
                self.setup.dead_letters.take_for(node, &object, contract, why);
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
        let Some(nodes) = &self.setup.nodes else { return };
        for (_, peer) in self.protocol.peers.iter_mut().filter(|(_, peer)| peer.lost > 0) {
            let found = peer.lost;
            let condition = if found > peer.lost_reported {
                peer.lost_reported = found;
                let detail = format!(
                    "{found} messages for {} that had been accepted did not arrive, since sessions \
                     ended; the dead letters name their receivers",
                    peer.node
                );
                warn!("{detail}");
                NodeCondition::MessagesLost { detail }
            } else if self.setup.stubs.send_state(&peer.node).has_session() {
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
        for (topic, [events, lost]) in self.setup.topics.take_losses() {
            if lost < LOST_MIN || lost * LOST_SHARE < events {
                continue;
            }
            let detail = format!(
                "of {events} events on {topic} in a second, {lost} found no capacity with a listener \
                 or on the way to another node: publish less, use `deliver`, or make the listeners' \
                 queues larger; the dead letters name who lost them"
            );
            self.setup.faults.declare_passing(FaultKind::Overload, detail);
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

/// Which of a listener's versions is ours, from 0 for its present one.
///
/// # Errors
/// What differs from its present one.
fn version_of(ours: &ContractIdentity, theirs: &[PeerIdentity]) -> Result<u32, String> {
    match theirs.iter().position(|theirs| ours.check(theirs).is_ok()) {
        Some(form) => Ok(form as u32),
        None => {
            let present = theirs.first().map(|theirs| ours.check(theirs));
            Err(present.and_then(Result::err).map_or(String::new(), |d| d.to_string()))
        }
    }
}
