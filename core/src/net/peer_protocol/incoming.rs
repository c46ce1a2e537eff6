//! Handles the messages of a peer.

use super::access::{PeerBound, PeerSubscription};
use super::node_state::REASON_MAX;
use super::peer::{Binding, PeerRecord, PendingCall, QueuedMessage};
use super::reply_cache::RequestVerdict;
use super::{
    BINDINGS_MAX, CALLS_MAX, MessageTarget, Peer, PeerProtocol, PeerProtocolOutput, RemoteTopic,
    TopicContract, control, refuse,
};
use crate::contract::{PEER_LIMIT, codec};
use crate::net::trust::roster::ROSTER_BYTES;
use crate::net::wire::message::{FORMS_MAX, PeerMessage, TICK_US};
use crate::net::wire::node_id::NodeId;
use crate::{DeliveryError, GatherBuffer, Instant, ObjectName, PeerIdentity, TrafficClass};
use bytes::Bytes;
use std::time::Duration;

/// The longest name of a topic, in bytes.
const TOPIC_MAX: usize = 255;
/// The longest signed roster, in bytes: its text, and a line.
const SIGNED_ROSTER_MAX: usize = 2 * ROSTER_BYTES;
/// The longest message of a directory, in bytes: no directory reads more.
const DIRECTORY_MAX: usize = 64 * 1024;
/// The longest error that is kept as it came, in bytes.
const ERROR_MAX: usize = 8 * 1024;

/// Of an error that is too long, the beginning is kept.
fn shorten(why: &mut DeliveryError) {
    if codec::encode_unbounded(why).len() <= ERROR_MAX {
        return;
    }
    let beginning = |text: &str| text.chars().take(ERROR_MAX / 4).collect();
    match why {
        DeliveryError::ContractDiffers { difference: text }
        | DeliveryError::Undecodable { reason: text }
        | DeliveryError::CheckFailed { reason: text }
        | DeliveryError::NotKept { reason: text }
        | DeliveryError::ReplyUnsent { reason: text } => *text = beginning(text),
        other => *other = DeliveryError::OutcomeUnknown { reason: beginning(&other.to_string()) },
    }
}

impl PeerProtocol {
    /// A peer says something.
    pub fn handle_message(&mut self, peer: NodeId, message: Bytes, now: Instant) {
        let mut message = match PeerMessage::decode(message) {
            Ok(message) => message,
            Err(error) => return self.refusals.count(&error),
        };
        if let PeerMessage::BindRefused { why, .. }
        | PeerMessage::TellRefused { why, .. }
        | PeerMessage::SubscribeRefused { why, .. }
        | PeerMessage::Reply { result: Err(why), .. } = &mut message
        {
            shorten(why);
        }
        let Some(Peer { record: PeerRecord { session: Some(session), .. }, incarnation, .. }) =
            self.peers.get_mut(peer)
        else {
            self.refusals.unexpected += 1;
            return;
        };
        let (epoch, incarnation) = (session.epoch, *incarnation);
        match message {
            PeerMessage::Bind { binding, object, identity } => {
                self.handle_bind(peer, binding, object, identity);
            }
            PeerMessage::Bound { binding } => {
                let sent = session.bound(peer, binding, &mut self.next_call);
                self.refusals.unexpected += u64::from(sent.is_none());
                self.outputs.extend(sent.into_iter().flatten());
            }
            PeerMessage::BindRefused { binding, why, identity } => {
                self.handle_bind_refused(peer, binding, why, &identity);
            }
            PeerMessage::Request { binding, call, timestamp, within, id, payload } => {
                let age = session.age(timestamp.saturating_mul(TICK_US), now);
                let within = Duration::from_micros(within.saturating_mul(TICK_US));
                let bound = session.bound.get(&binding);
                if let Some(replies) = bound.map(|bound| bound.replies)
                    && replies != TrafficClass::Request
                    && session.reply_streams.len() < CALLS_MAX
                {
                    session.reply_streams.insert(call, replies);
                }
                let left = within.checked_sub(age).filter(|left| !left.is_zero());
                let until = left.map(|left| now + left);
                if !within.is_zero() && left.is_none() {
                    return self.answer(peer, epoch, call, Err(DeliveryError::DeadlinePassed));
                }
                if let Some(denied) = bound.and_then(|bound| bound.access.refusal(true)) {
                    let why = self.refuse_access(denied);
                    return self.answer(peer, epoch, call, Err(why));
                }
                let key = id.map(|id| (peer, incarnation, id));
                let admitted = key.map(|key| self.requests.admit(key, (peer, epoch, call), now));
                match admitted {
                    None | Some(RequestVerdict::Serve) => {
                        let call = Some(call);
                        self.outputs.push_back(PeerProtocolOutput::Serve {
                            peer,
                            epoch,
                            binding,
                            call,
                            id,
                            age,
                            until,
                            payload: payload.into_bytes(),
                        });
                    }
                    Some(RequestVerdict::Wait) => {}
                    Some(RequestVerdict::Answer(reply)) => {
                        self.answer(peer, epoch, call, Ok(reply.into()));
                    }
                    Some(RequestVerdict::Refuse) => {
                        self.refusals.too_large += 1;
                        self.answer(peer, epoch, call, Err(DeliveryError::Full));
                    }
                }
            }
            PeerMessage::Tell { binding, timestamp_us, id, payload } => {
                let (call, age, until) = (None, session.age(timestamp_us, now), None);
                let bound = session.bound.get(&binding);
                if let Some(denied) = bound.and_then(|bound| bound.access.refusal(false)) {
                    let why = self.refuse_access(denied);
                    return self.tell(peer, &PeerMessage::TellRefused { binding, why });
                }
                self.outputs.push_back(PeerProtocolOutput::Serve {
                    peer,
                    epoch,
                    binding,
                    call,
                    id,
                    age,
                    until,
                    payload: payload.into_bytes(),
                });
            }
            PeerMessage::TellRefused { binding, why } => match session.numbers.get(&binding) {
                Some((object, contract, _)) => {
                    let to = MessageTarget::Object(object.clone(), contract);
                    self.outputs.push_back(PeerProtocolOutput::Lost { peer, to, why });
                }
                None => self.refusals.unexpected += 1,
            },
            PeerMessage::Reply { call, result } => match session.calls.remove(&call) {
                Some(PendingCall { reply_as, .. }) => {
                    let result = result.map(GatherBuffer::into_bytes);
                    self.outputs.push_back(PeerProtocolOutput::Resolve { reply_as, result });
                }
                None => self.refusals.unexpected += 1,
            },
            PeerMessage::Subscribe { subscription, topic, identities } => {
                self.handle_subscribe(peer, subscription, topic, &identities);
            }
            PeerMessage::SubscribeRefused {
                subscription,
                why: why @ DeliveryError::Forbidden { .. },
            } => self.handle_subscription_forbidden(peer, subscription, why),
            PeerMessage::SubscribeAgain { subscription } => {
                self.handle_subscribe_again(peer, subscription);
            }
            PeerMessage::SubscribeRefused { why, .. } => {
                let difference = why.to_string();
                self.outputs.push_back(PeerProtocolOutput::Differs { peer, difference });
            }
            PeerMessage::Unsubscribe { subscription } => {
                if session.subscriptions.remove(&subscription).is_none() {
                    self.refusals.unexpected += 1;
                    return;
                }
                self.outputs.push_back(PeerProtocolOutput::Unsubscribe { peer, subscription });
            }
            PeerMessage::Event { subscription, timestamp_us, payload } => {
                let age = session.age(timestamp_us, now);
                self.handle_peers_event(peer, subscription, age, payload.into_bytes());
            }
            PeerMessage::Announced { timestamp_us } => {
                session.age(timestamp_us, now);
                self.outputs.push_back(PeerProtocolOutput::Announced { peer });
            }
            PeerMessage::InSafeState { reason } => {
                let reason = Some(reason.chars().take(REASON_MAX).collect());
                self.outputs.push_back(PeerProtocolOutput::SafeState { peer, reason });
            }
            PeerMessage::AtWork => {
                self.outputs.push_back(PeerProtocolOutput::SafeState { peer, reason: None });
            }
            PeerMessage::RosterSerial { serial } => self.handle_serial(peer, serial),
            PeerMessage::RosterRequest => self.handle_roster_request(peer),
            PeerMessage::Roster { text } if text.len() > SIGNED_ROSTER_MAX => {
                self.refusals.too_large += 1;
            }
            PeerMessage::Roster { text } => self.handle_peers_roster(peer, text.into()),
            PeerMessage::Directory { message } if message.len() > DIRECTORY_MAX => {
                self.refusals.too_large += 1;
            }
            PeerMessage::Directory { message } => {
                self.outputs
                    .push_back(PeerProtocolOutput::Directory { peer, message: message.into() });
            }
            PeerMessage::Leaving => self.outputs.push_back(PeerProtocolOutput::Bye { peer }),
            PeerMessage::NotReady { binding } => match session.handle_not_ready(binding) {
                Some((object, true)) => {
                    self.outputs.push_back(PeerProtocolOutput::ObjectFull { peer, object });
                }
                Some((_, false)) => {}
                None => self.refusals.unexpected += 1,
            },
            PeerMessage::Ready { binding } => match session.handle_ready(binding) {
                Some((object, true)) => {
                    self.outputs.push_back(PeerProtocolOutput::ObjectReady { peer, object });
                }
                Some((_, false)) => {}
                None => self.refusals.unexpected += 1,
            },
        }
    }

    fn handle_bind(&mut self, peer: NodeId, binding: u32, object: ObjectName, identity: Vec<u8>) {
        let Some(session) = self.peers.open(peer) else {
            return;
        };
        if session.bound.contains_key(&binding) {
            self.refusals.unexpected += 1;
            return;
        }
        let epoch = session.epoch;
        let Some(identity) =
            self.take_in(peer, &[identity]).and_then(|mut read| read.pop()).map(Box::new)
        else {
            let why = DeliveryError::Undecodable { reason: "the contract's identity".into() };
            let refused = PeerMessage::BindRefused { binding, why, identity: Vec::new() };
            self.outputs.push_back(control(peer, &refused));
            return;
        };
        let access = match self.admit_binding(peer, &object, &identity.name) {
            Ok(access) => access,
            Err(why) => return self.handle_bound(peer, epoch, binding, Err((why, None))),
        };
        if let Some(session) = self.session(peer, epoch) {
            let replies =
                TrafficClass::of_message(&identity.name, identity.delivery, identity.bulk);
            let (object, contract) = (object.clone(), identity.name.clone());
            session.bound.insert(binding, PeerBound { object, contract, access, replies });
        }
        self.outputs.push_back(PeerProtocolOutput::Bind { peer, epoch, binding, object, identity });
    }

    fn handle_subscribe(
        &mut self,
        peer: NodeId,
        subscription: u32,
        topic: String,
        identities: &[Vec<u8>],
    ) {
        let session = self.peers.open(peer);
        if session.is_none_or(|session| session.subscriptions.contains_key(&subscription)) {
            self.refusals.unexpected += 1;
            return;
        }
        // A topic carries one contract, in several versions.
        let of_one = |all: &Vec<PeerIdentity>| {
            topic.len() <= TOPIC_MAX
                && all.first().is_some_and(|first| all.iter().all(|other| other.name == first.name))
        };
        let Some(identities) = self.take_in(peer, identities).filter(of_one) else {
            let why = DeliveryError::Undecodable { reason: "the contract's identity".into() };
            self.handle_subscribe_refused(peer, subscription, why);
            return;
        };
        let topic = TopicContract { topic, contract: identities[0].name.clone() };
        let verdict = self.admit_subscription(peer, &topic);
        if let Some(session) = self.peers.open_mut(peer) {
            let known = PeerSubscription { topic: topic.clone(), is_refused: verdict.is_err() };
            session.subscriptions.insert(subscription, known);
        }
        if let Err(why) = verdict {
            return self.handle_subscribe_refused(peer, subscription, why);
        }
        let output = PeerProtocolOutput::Subscribe { peer, subscription, topic, identities };
        self.outputs.push_back(output);
    }

    /// A peer wants something new of us: within bounds, and with a contract that can be read.
    fn take_in(&mut self, peer: NodeId, identities: &[Vec<u8>]) -> Option<Vec<PeerIdentity>> {
        let session = self.peers.open(peer)?;
        let are_many = session.bound.len() + session.subscriptions.len() >= BINDINGS_MAX;
        let is_long = |identity: &Vec<u8>| identity.len() > PEER_LIMIT;
        if are_many || identities.len() > FORMS_MAX || identities.iter().any(is_long) {
            self.refusals.too_large += 1;
            return None;
        }
        let read = identities.iter().map(|identity| PeerIdentity::decode(identity));
        read.collect::<Result<_, _>>().ok()
    }

    fn handle_bind_refused(
        &mut self,
        peer: NodeId,
        number: u32,
        why: DeliveryError,
        identity: &[u8],
    ) {
        let Some(session) = self.peers.open_mut(peer) else {
            return;
        };
        let Some(((object, name, _), binding)) = session.unbind(number) else {
            self.refusals.unexpected += 1;
            return;
        };
        if let Some((object, true)) = session.handle_ready(number) {
            self.outputs.push_back(PeerProtocolOutput::ObjectReady { peer, object });
        }
        let Binding { contract, waiting, .. } = binding;
        // Seen from our side, where the peer has sent its own.
        let theirs = PeerIdentity::decode(identity).ok();
        let why = match (theirs.map(|theirs| contract.check(&theirs)), why) {
            (Some(Err(difference)), DeliveryError::ContractDiffers { .. }) => {
                DeliveryError::ContractDiffers { difference: difference.to_string() }
            }
            (_, why) => why,
        };
        if let DeliveryError::ContractDiffers { difference } = &why {
            let difference = difference.clone();
            self.outputs.push_back(PeerProtocolOutput::Differs { peer, difference });
        }
        let waiting = waiting.unwrap_or_default();
        for QueuedMessage { pending, .. } in waiting {
            let to = MessageTarget::Object(object.clone(), name);
            let reply_as = pending.map(|pending| pending.reply_as);
            self.outputs.push_back(refuse(peer, to, reply_as, why.clone()));
        }
    }

    fn handle_peers_event(
        &mut self,
        peer: NodeId,
        subscription: u32,
        age: Duration,
        payload: Bytes,
    ) {
        let form = |interest: &RemoteTopic| {
            let form = usize::try_from(subscription.checked_sub(interest.subscription)?).ok()?;
            (form < interest.identities.len()).then_some(form)
        };
        let mut interests = self.interests.iter();
        // As many as the node has topics; they are few.
        match interests.find_map(|(topic, interest)| Some((topic, form(interest)?))) {
            Some((topic, form)) => {
                let topic = topic.clone();
                if !self.was_offered(peer, &topic) {
                    return;
                }
                self.outputs.push_back(PeerProtocolOutput::Event {
                    peer,
                    topic,
                    form,
                    age,
                    payload,
                });
            }
            // It crossed our unsubscribing.
            None => self.refusals.stale += 1,
        }
    }
}
