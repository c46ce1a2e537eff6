//! What peers may do here, by the policy of the robot.
//!
//! A peer's binding and subscription is judged once, and again when another policy counts: where
//! the verdict then differs, the session with the peer is reset, so that both ends agree again.

use super::{PeerProtocol, PeerProtocolOutput, RemoteTopic, TopicContract, subscribe};
use crate::net::trust::access::{AccessDenied, AccessPolicy, BindingNeeds, needs};
use crate::net::trust::policy::Verb;
use crate::net::wire::node_id::NodeId;
use crate::sorted::{SortedMap, SortedSet};
use crate::{DeliveryError, ObjectName};

/// What the component of a service is called after the service's name.
const REPLICA: &str = "/replica";
/// The contract by which services are asked.
const SERVICE_CONTRACT: &str = "blastema/serve";

/// What a session's peer has asked for.
#[derive(Debug, Default)]
pub(super) struct PeerAccess {
    /// What it has bound, as long as a policy counts.
    bindings: SortedMap<u32, (ObjectName, String)>,
    /// Those of its bindings that take requests only, or only messages without a reply.
    partial: SortedMap<u32, BindingAccess>,
    /// Its subscriptions; those that the policy refuses as well.
    subscriptions: SortedMap<u32, TopicContract>,
    /// Subscriptions of this node to topics on which the peer may not publish. It was not told of
    /// them.
    barred: SortedSet<u32>,
}

type AccessVerdict = Result<(), Box<AccessDenied>>;

/// What a peer may send through a binding.
#[derive(Debug, PartialEq, Eq)]
struct BindingAccess {
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
            // A service and a name of the robot belong to no node.
            BindingNeeds::Right(verb) => both(policy.check(peer, verb, object.as_str(), contract)),
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
}

impl PeerAccess {
    /// Why no request, or no message without a reply, may come through this binding.
    pub(super) fn refusal(&self, binding: u32, is_request: bool) -> Option<Box<AccessDenied>> {
        let BindingAccess { ask, tell } = self.partial.get(&binding)?;
        let verdict = if is_request { ask } else { tell };
        verdict.as_ref().err().cloned()
    }

    /// How much is kept of the peer's.
    #[cfg(test)]
    pub(super) fn kept(&self) -> usize {
        self.bindings.len() + self.subscriptions.len()
    }

    /// This node has ended a subscription.
    pub(super) fn interest_ended(&mut self, subscription: u32) {
        self.barred.remove(&subscription);
    }

    /// The peer has a subscription. Answers whether it is one more.
    pub(super) fn subscribe(&mut self, subscription: u32, topic: TopicContract) -> bool {
        self.subscriptions.insert(subscription, topic).is_none()
    }

    /// The peer has ended a subscription. Answers whether it had it.
    pub(super) fn unsubscribe(&mut self, subscription: u32) -> bool {
        self.subscriptions.remove(&subscription).is_some()
    }

    /// What was to be bound is not.
    pub(super) fn unbind(&mut self, binding: u32) {
        self.bindings.remove(&binding);
        self.partial.remove(&binding);
    }
}

impl PeerProtocol {
    /// From now on this policy counts.
    pub fn handle_access(&mut self, policy: AccessPolicy) {
        for (peer, state) in &self.peers {
            let Some(session) = &state.session else { continue };
            let (access, old) = (&session.access, self.access.as_ref());
            let judges_otherwise = old.is_none_or(|old| {
                let (mut bindings, mut topics) =
                    (access.bindings.values(), access.subscriptions.values());
                bindings.any(|(object, contract)| {
                    let before = BindingAccess::of(old, *peer, object, contract);
                    let after = BindingAccess::of(&policy, *peer, object, contract);
                    before.ask.is_ok() != after.ask.is_ok()
                        || before.tell.is_ok() != after.tell.is_ok()
                }) || topics.any(|topic| {
                    may(old, *peer, Verb::Listen, topic) != may(&policy, *peer, Verb::Listen, topic)
                }) || self.interests.keys().any(|topic| {
                    may(old, *peer, Verb::Publish, topic)
                        != may(&policy, *peer, Verb::Publish, topic)
                })
            });
            if judges_otherwise {
                self.outputs.push_back(PeerProtocolOutput::Reset { peer: *peer });
            }
        }
        self.access = Some(policy);
    }

    /// Whether a peer may bind this.
    pub(super) fn admit_binding(
        &mut self,
        peer: NodeId,
        binding: u32,
        object: &ObjectName,
        contract: &str,
    ) -> Result<(), DeliveryError> {
        let Some(policy) = &self.access else { return Ok(()) };
        let access = BindingAccess::of(policy, peer, object, contract);
        if let BindingAccess { ask: Err(denied), tell: Err(_) } = access {
            return Err(self.refuse_access(denied));
        }
        let Some(session) = self.peers.get_mut(&peer).and_then(|peer| peer.session.as_mut()) else {
            return Ok(());
        };
        let known = &mut session.access;
        known.partial.remove(&binding);
        if access.ask.is_err() || access.tell.is_err() {
            known.partial.insert(binding, access);
        }
        known.bindings.insert(binding, (object.clone(), contract.to_owned()));
        Ok(())
    }

    /// Whether a peer may listen to this.
    pub(super) fn admit_subscription(
        &mut self,
        peer: NodeId,
        topic: &TopicContract,
    ) -> Result<(), DeliveryError> {
        let Some(policy) = &self.access else { return Ok(()) };
        let verdict = policy.check(peer, Verb::Listen, &topic.topic, &topic.contract);
        verdict.map_err(|denied| self.refuse_access(denied))
    }

    /// Whether a peer may hand its faults to this node.
    pub(super) fn admit_notice(&mut self, peer: NodeId) -> bool {
        let policy = self.access.as_ref();
        let verdict =
            policy.map(|policy| policy.check(peer, Verb::Recover, policy.own().as_str(), ""));
        match verdict {
            Some(Err(denied)) => {
                self.refuse_access(denied);
                false
            }
            _ => true,
        }
    }

    /// Tells a peer that this node listens to a topic, unless it may not publish there.
    pub(super) fn offer_interest(&mut self, peer: NodeId, topic: &TopicContract) {
        let Some(interest) = self.interests.get(topic) else { return };
        let Some(session) = self.peers.get_mut(&peer).and_then(|peer| peer.session.as_mut()) else {
            return;
        };
        let policy = self.access.as_ref();
        if policy.is_some_and(|policy| !may(policy, peer, Verb::Publish, topic)) {
            session.access.barred.insert(interest.subscription);
            return;
        }
        self.outputs.push_back(super::control(peer, &subscribe(topic, interest)));
    }

    /// Whether the peer was told that this node listens to the topic.
    pub(super) fn was_offered(&mut self, peer: NodeId, topic: &TopicContract) -> bool {
        let session = self.peers.get(&peer).and_then(|peer| peer.session.as_ref());
        let (Some(policy), Some(session)) = (&self.access, session) else { return true };
        let interest =
            self.interests.get(topic).map(|RemoteTopic { subscription, .. }| subscription);
        if interest.is_none_or(|subscription| !session.access.barred.contains(subscription)) {
            return true;
        }
        if let Err(denied) = policy.check(peer, Verb::Publish, &topic.topic, &topic.contract) {
            self.refuse_access(denied);
        }
        false
    }

    /// Tells that a peer was refused something. Answers with what the peer is told.
    pub(super) fn refuse_access(&mut self, denied: Box<AccessDenied>) -> DeliveryError {
        let why = DeliveryError::from(&*denied);
        self.outputs.push_back(PeerProtocolOutput::AccessDenied { denied });
        why
    }
}

fn may(policy: &AccessPolicy, peer: NodeId, verb: Verb, topic: &TopicContract) -> bool {
    policy.check(peer, verb, &topic.topic, &topic.contract).is_ok()
}
