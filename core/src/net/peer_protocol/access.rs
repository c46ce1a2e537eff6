//! What peers may do here, by the policy of the robot.
//!
//! A peer's binding and subscription is judged once, and again when another policy counts. A
//! verdict that changes is told to the peer at once; everything else of the session goes on.

use super::{
    PeerProtocol, PeerProtocolOutput, PeerSession, RemoteTopic, TopicContract, control, subscribe,
};
use crate::net::trust::access::{AccessDenied, AccessPolicy, BindingNeeds, needs};
use crate::net::trust::policy::Verb;
use crate::net::wire::message::PeerMessage;
use crate::net::wire::node_id::NodeId;
use crate::{DeliveryError, ObjectName, TrafficClass};

/// What the component of a service is called after the service's name.
const REPLICA: &str = "/replica";
/// The contract by which services are asked.
const SERVICE_CONTRACT: &str = "blastema/serve";

type AccessVerdict = Result<(), Box<AccessDenied>>;

/// What a peer has bound here. The record of a binding that the policy refuses later stays until
/// the session ends: requests through it are on their way.
#[derive(Debug)]
pub(super) struct PeerBound {
    pub(super) object: ObjectName,
    pub(super) contract: String,
    pub(super) access: BindingAccess,
    /// The stream of the replies.
    pub(super) replies: TrafficClass,
}

/// What a peer listens to here. What the policy refuses is remembered: the peer is to ask again
/// once it may.
#[derive(Debug)]
pub(super) struct PeerSubscription {
    pub(super) topic: TopicContract,
    pub(super) is_refused: bool,
}

/// What a peer may send through a binding.
#[derive(Debug)]
pub(super) struct BindingAccess {
    ask: AccessVerdict,
    tell: AccessVerdict,
}

impl BindingAccess {
    fn of(policy: &AccessPolicy, peer: NodeId, object: &ObjectName, contract: &str) -> Self {
        let name = || policy.object(object);
        let both = |verdict: AccessVerdict| BindingAccess { ask: verdict.clone(), tell: verdict };
        match needs(contract) {
            BindingNeeds::Nothing => both(Ok(())),
            BindingNeeds::Membership => both(policy.check_membership(peer, &name(), contract)),
            BindingNeeds::OwnNode => both(Err(policy.deny(peer, &name(), contract))),
            // A service and a name of the robot belong to no node.
            BindingNeeds::Right(verb) => both(policy.check(peer, verb, object.as_str(), contract)),
            BindingNeeds::RightAtNode(verb) => {
                both(policy.check(peer, verb, policy.own().as_str(), contract))
            }
            BindingNeeds::AskOrTell => {
                // The component of a service has no way around the rights at the service.
                let service = object.as_str().strip_suffix(REPLICA);
                let check = |verb| {
                    let verdict = policy.check(peer, verb, &name(), contract);
                    let of_service =
                        |service| policy.check(peer, Verb::Ask, service, SERVICE_CONTRACT);
                    verdict.and_then(|()| service.map_or(Ok(()), of_service))
                };
                BindingAccess { ask: check(Verb::Ask), tell: check(Verb::Tell) }
            }
        }
    }

    /// Why no request, or no message without a reply, may come this way.
    pub(super) fn refusal(&self, is_request: bool) -> Option<Box<AccessDenied>> {
        let verdict = if is_request { &self.ask } else { &self.tell };
        verdict.as_ref().err().cloned()
    }

    /// Why nothing may come this way.
    fn full_refusal(&self) -> Option<&AccessDenied> {
        self.tell.as_ref().err().and(self.ask.as_ref().err()).map(|denied| &**denied)
    }
}

impl PeerProtocol {
    /// From now on this policy counts.
    pub fn handle_access(&mut self, policy: AccessPolicy) {
        for (peer, known) in self.peers.iter_mut() {
            let Some(session) = &mut known.record.session else { continue };
            let PeerSession { bound, subscriptions, barred, forbidden, .. } = session;
            let mut tell = |message| self.outputs.push_back(control(peer, &message));
            for (binding, bound) in bound {
                let access = BindingAccess::of(&policy, peer, &bound.object, &bound.contract);
                let before = std::mem::replace(&mut bound.access, access);
                let newly = bound.access.full_refusal().filter(|_| before.full_refusal().is_none());
                if let Some(why) = newly.map(DeliveryError::from) {
                    let (binding, identity) = (*binding, Vec::new());
                    tell(PeerMessage::BindRefused { binding, why, identity });
                }
            }
            for (topic, interest) in &self.interests {
                let subscription = interest.subscription;
                if !may(&policy, peer, Verb::Publish, topic) {
                    if barred.insert(subscription) {
                        tell(PeerMessage::Unsubscribe { subscription });
                        forbidden.remove(&subscription);
                    }
                } else if barred.remove(&subscription) {
                    tell(subscribe(topic, interest));
                }
            }
            let (mut ended, mut again) = (Vec::new(), Vec::new());
            for (subscription, of_peer) in &mut *subscriptions {
                let verdict = listen(&policy, peer, &of_peer.topic);
                let (subscription, is_refused) = (*subscription, verdict.is_err());
                let was_refused = std::mem::replace(&mut of_peer.is_refused, is_refused);
                match verdict {
                    Err(denied) if !was_refused => {
                        let why = DeliveryError::from(&*denied);
                        tell(PeerMessage::SubscribeRefused { subscription, why });
                        ended.push(subscription);
                    }
                    Ok(()) if was_refused => {
                        tell(PeerMessage::SubscribeAgain { subscription });
                        again.push(subscription);
                    }
                    _ => {}
                }
            }
            for subscription in again {
                subscriptions.remove(&subscription);
            }
            let ended = ended
                .into_iter()
                .map(|subscription| PeerProtocolOutput::Unsubscribe { peer, subscription });
            self.outputs.extend(ended);
        }
        self.access = Some(policy);
    }

    /// What a peer may send through a binding.
    ///
    /// # Errors
    /// It may send nothing.
    pub(super) fn admit_binding(
        &mut self,
        peer: NodeId,
        object: &ObjectName,
        contract: &str,
    ) -> Result<BindingAccess, DeliveryError> {
        let Some(policy) = &self.access else {
            return Ok(BindingAccess { ask: Ok(()), tell: Ok(()) });
        };
        let access = BindingAccess::of(policy, peer, object, contract);
        match access.full_refusal().cloned() {
            Some(denied) => Err(self.refuse_access(Box::new(denied))),
            None => Ok(access),
        }
    }

    /// Whether a peer may listen to this.
    pub(super) fn admit_subscription(
        &mut self,
        peer: NodeId,
        topic: &TopicContract,
    ) -> Result<(), DeliveryError> {
        let Some(policy) = &self.access else { return Ok(()) };
        listen(policy, peer, topic).map_err(|denied| self.refuse_access(denied))
    }

    /// Tells a peer that this node listens to a topic, unless it may not publish there.
    pub(super) fn offer_interest(&mut self, peer: NodeId, topic: &TopicContract) {
        let Some(interest) = self.interests.get(topic) else { return };
        let Some(session) = self.peers.open_mut(peer) else {
            return;
        };
        let policy = self.access.as_ref();
        if policy.is_some_and(|policy| !may(policy, peer, Verb::Publish, topic)) {
            session.barred.insert(interest.subscription);
            return;
        }
        self.outputs.push_back(control(peer, &subscribe(topic, interest)));
    }

    /// Whether the peer was told that this node listens to the topic.
    pub(super) fn was_offered(&mut self, peer: NodeId, topic: &TopicContract) -> bool {
        let session = self.peers.open(peer);
        let (Some(policy), Some(session)) = (&self.access, session) else { return true };
        let interest =
            self.interests.get(topic).map(|RemoteTopic { subscription, .. }| subscription);
        if interest.is_none_or(|subscription| !session.barred.contains(subscription)) {
            return true;
        }
        if let Err(denied) = policy.check(peer, Verb::Publish, &topic.topic, &topic.contract) {
            self.refuse_access(denied);
        }
        false
    }

    /// A peer refuses a subscription of this node, by its policy. What is refused already, and a
    /// subscription that this node does not have, is no news.
    pub(super) fn handle_subscription_forbidden(
        &mut self,
        peer: NodeId,
        subscription: u32,
        why: DeliveryError,
    ) {
        let session = self.peers.open_mut(peer);
        let is_own = self.interests.values().any(|own| own.subscription == subscription);
        if session.is_some_and(|session| is_own && session.forbidden.insert(subscription)) {
            self.outputs.push_back(PeerProtocolOutput::SubscriptionForbidden { why });
        } else {
            self.refusals.unexpected += 1;
        }
    }

    /// A peer does not refuse a subscription any more: it is offered again.
    pub(super) fn handle_subscribe_again(&mut self, peer: NodeId, subscription: u32) {
        let session = self.peers.open_mut(peer);
        if !session.is_some_and(|session| session.forbidden.remove(&subscription)) {
            self.refusals.unexpected += 1;
            return;
        }
        let own = self.interests.iter().find(|(_, own)| own.subscription == subscription);
        if let Some(topic) = own.map(|(topic, _)| topic.clone()) {
            self.offer_interest(peer, &topic);
        }
    }

    /// Whether a peer refuses a subscription of this node now.
    pub fn is_refused_a_subscription(&self) -> bool {
        self.peers.with_session().any(|(_, session)| !session.forbidden.is_empty())
    }

    /// Tells that a peer was refused something. Answers with what the peer is told.
    pub(super) fn refuse_access(&mut self, denied: Box<AccessDenied>) -> DeliveryError {
        let why = DeliveryError::from(&*denied);
        self.outputs.push_back(PeerProtocolOutput::AccessDenied { denied });
        why
    }
}

fn listen(policy: &AccessPolicy, peer: NodeId, topic: &TopicContract) -> AccessVerdict {
    policy.check(peer, Verb::Listen, &topic.topic, &topic.contract)
}

fn may(policy: &AccessPolicy, peer: NodeId, verb: Verb, topic: &TopicContract) -> bool {
    policy.check(peer, verb, &topic.topic, &topic.contract).is_ok()
}
