//! Topics that peers listen to: their events are sent there.

use super::ObjectGateway;
use super::local::LocalInput;
use super::undelivered::UndeliveredEvents;
use crate::net::credit::SenderCredit;
use crate::net::stub::PeerSendState;
use crate::topic::{EventForward, ForwardId, RemoteForward, Reservation, TopicKey, described};
use actix::prelude::*;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::TopicContract;
use blastema_core::{
    ContractIdentity, Credit, Delivery, DeliveryError, GatherBuffer, Instant, PeerIdentity,
    TrafficClass,
};
use std::pin::Pin;
use std::sync::Arc;

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
        let taken = match waits {
            true => self.credit.take(bytes),
            false => self.credit.take_for_event(bytes),
        };
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
            Err(why) => return self.exchange.handle_subscribe_refused(peer, subscription, why),
        };
        // Whether it wants the newest only must be known before the first event.
        let class = theirs.first().and_then(|theirs| event_stream(theirs.delivery, theirs.bulk));
        let wanted = theirs.clone();
        let (by, unverified) = match self.wiring.topics.identities(&key.topic).first() {
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
                    self.exchange.handle_subscribe_refused(peer, subscription, why);
                    return;
                }
            },
        };
        let Some(known) = self.peers.get(&peer) else { return };
        let (send_state, gateway) = (known.send_state.clone(), self.wiring.stack.clone());
        let (losses, node) = (self.losses(known, &key), known.node.clone());
        let target = ForwardTarget { gateway, peer, subscription, losses: losses.clone() };
        let credit = send_state.credits().sender(by.1);
        let forward = PeerForward { target, send_state, class: by.1, credit };
        let forward: RemoteForward = Arc::new(forward);
        self.end_forward((peer, subscription));
        let before = self.past.get(&(peer, key.topic.clone())).map(|past| &past.id);
        let id = self.wiring.topics.forward(&key, (node, wanted), forward, before);
        let forwarded = Forwarded { id, key: key.clone(), unverified, by, losses };
        self.forwards.insert((peer, subscription), forwarded);
        // An object may have named the topic just now.
        self.compare_forwards(&key);
    }

    pub(super) fn end_forward(&mut self, forward: (NodeId, u32)) -> Option<Forwarded> {
        let ended = self.forwards.remove(&forward)?;
        self.wiring.topics.end_forward(&ended.id);
        Some(ended)
    }

    /// Under which number, and how, events of this topic go to the peers that subscribed when it
    /// had no contract here yet. It has one once an object here has named it, before its first
    /// event.
    pub(super) fn compare_forwards(&mut self, key: &TopicKey) {
        let identities = self.wiring.topics.identities(&key.topic);
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
            self.exchange.handle_subscribe_refused(peer, subscription, why);
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
        let here = self.wiring.registry.node().map_or("this node".into(), |node| node.to_string());
        let there = self.peers.get(&peer).map_or(peer.to_string(), |peer| peer.node.to_string());
        let carried = described(&ours.brief());
        let wanted = theirs.first().map_or_else(String::new, described);
        format!(
            "the topic \"{}\" carries {carried} on {here}, and {there} listens to {wanted}: \
             {difference}",
            key.topic
        )
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
