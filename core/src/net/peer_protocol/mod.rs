//! What this node's objects and those of other nodes want of each other: bindings, calls and
//! subscriptions.
//!
//! The first message of a contract to an object asks its node to bind: both compare the contract's
//! name, version and fingerprint, and what follows carries only a number. Whatever was promised is
//! resolved: with the reply, or when the session with the callee's node ends.
//!
//! A peer's part of it lives as long as the session with it. Each session has an epoch, so that
//! what was begun in one is never answered in the next.

mod access;
mod age;
mod incoming;
mod node_state;
mod peer;
mod peers;
mod reply_cache;
mod types;

pub mod receive_backlog;

pub use self::peers::{Peer, Peers};
pub use self::types::{
    Call, MessageTarget, PeerProtocolOutput, SessionEpoch, TopicContract, TransmitState,
};

use self::node_state::{AnnouncedState, REASON_MAX};
use self::peer::{Binding, PeerRecord, PeerSession, PendingCall, QueuedMessage, carry};
use self::peers::SessionMaker;
use self::reply_cache::ReplyCache;

use super::session::Session;
use super::session::ordering_key::OrderingKey;
use super::trust::access::AccessPolicy;
use super::wire::Refusals;
use super::wire::message::{FORMS_MAX, PeerMessage};
use super::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use crate::{
    ContractIdentity, Credit, DeliveryError, GatherBuffer, Incarnation, Instant, NodeName,
    TrafficClass,
};
use bytes::Bytes;
use std::collections::VecDeque;
use std::time::Duration;

/// The most bindings and subscriptions that a peer may have here, each.
const BINDINGS_MAX: usize = 16 * 1024;

/// The most peers that are remembered. Twice what a router knows at a time: robots change.
const PEERS_MAX: usize = 512;
/// A session that is built again counts on from there: more than any session needs.
const NUMBERS_PER_LIFE: u32 = 1 << 16;
/// The most requests to one peer that wait for its next session.
const AGAIN_MAX: usize = 1024;
/// The most unanswered requests of one peer whose replies have a stream of their own; beyond, they
/// go with what others send.
const CALLS_MAX: usize = 64 * 1024;
/// For the caller to see its deadline pass by itself.
const GRACE: Duration = Duration::from_secs(1);

/// The machine of one node's dealings with all others. It waits for nothing: silence is the
/// session's matter, and callers mind their deadlines.
#[derive(Debug)]
pub struct PeerProtocol {
    /// The other nodes, and the sessions with them.
    pub peers: Peers,
    maker: SessionMaker,
    /// What is listened to here.
    interests: SortedMap<TopicContract, RemoteTopic>,
    next_subscription: u32,
    next_binding: u32,
    next_call: u64,
    /// Requests of other nodes that are known by an identity.
    requests: ReplyCache,
    /// What peers may do here; without one, everything.
    access: Option<AccessPolicy>,
    /// The objects of this node answer: peers are told that it is connected.
    is_started: bool,
    /// What peers are told of this node.
    own: AnnouncedState,
    refusals: Refusals,
    outputs: VecDeque<PeerProtocolOutput>,
}

#[derive(Debug)]
struct RemoteTopic {
    /// The number of the present version; those before it have the numbers after it.
    subscription: u32,
    identities: Vec<ContractIdentity>,
}

impl PeerProtocol {
    /// That of this node, whose sessions end when a peer is silent for so long.
    pub fn new(node: NodeName, incarnation: Incarnation, idle_timeout: Duration) -> Self {
        PeerProtocol {
            peers: Peers::default(),
            maker: SessionMaker::new(node, incarnation, idle_timeout),
            interests: SortedMap::new(),
            next_subscription: 0,
            next_binding: 0,
            next_call: 0,
            requests: ReplyCache::default(),
            access: None,
            is_started: false,
            own: AnnouncedState::default(),
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
        }
    }

    /// Makes the row of a node, unless it has one. The seed is of the system's random source.
    pub fn meet(&mut self, node: &NodeName, seed: u64, now: Instant) -> NodeId {
        let id = NodeId::of(node);
        if self.peers.get(id).is_none() {
            let session = self.maker.session(node.clone(), self.maker.forgotten, seed, now);
            self.peers.insert(id, Peer::new(node.clone(), session));
        }
        id
    }

    /// Which peer is to make way for a node that is new, if one has to: one without a path.
    pub fn expendable(&self, new: &NodeName) -> Option<NodeId> {
        if self.peers.iter().count() < PEERS_MAX || self.peers.get(NodeId::of(new)).is_some() {
            return None;
        }
        self.peers.iter().find(|(_, peer)| peer.is_expendable()).map(|(id, _)| id)
    }

    /// Forgets a peer, with all that is known of it. Says whether that ends what differed.
    pub fn forget(&mut self, peer: NodeId) -> bool {
        let Some(gone) = self.peers.remove(peer) else { return false };
        self.maker.forgotten = self.maker.forgotten.max(gone.session.number());
        !gone.differences().is_empty()
    }

    /// Builds the machine of the sessions with a peer again. Returns the old one.
    pub fn replace_session(&mut self, peer: NodeId, seed: u64, now: Instant) -> Option<Session> {
        let known = self.peers.get_mut(peer)?;
        let number = known.session.number().saturating_add(NUMBERS_PER_LIFE);
        let session = self.maker.session(known.node.clone(), number, seed, now);
        let old = std::mem::replace(&mut known.session, session);
        if let Some((incarnation, mtu)) = known.path {
            known.handle_reachable(incarnation, mtu, now);
        }
        Some(old)
    }

    /// This node ends in order: what was sent is to be delivered, then every session ends.
    pub fn close(&mut self, now: Instant) {
        self.maker.closed = true;
        for peer in self.peers.ids() {
            if let Some(peer) = self.peers.get_mut(peer) {
                peer.session.handle_close(now);
            }
        }
    }

    /// The next thing to do, in order.
    pub fn poll_output(&mut self) -> Option<PeerProtocolOutput> {
        self.outputs.pop_front()
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// The start of this node is over: its objects answer.
    pub fn handle_started(&mut self, now: Instant) {
        self.is_started = true;
        for (peer, session) in self.peers.with_session() {
            let timestamp_us = session.timestamp_us(now);
            self.outputs.push_back(control(peer, &PeerMessage::Announced { timestamp_us }));
        }
    }

    /// Whether the request with this number is sent again in the next session.
    pub fn is_to_repeat(&self, reply_as: u64) -> bool {
        let mut again = self.peers.iter().flat_map(|(_, peer)| &peer.record.again);
        again.any(|call| call.reply_as == Some(reply_as))
    }

    /// The session of this number has begun. Says whether that ends what differed in an earlier
    /// incarnation of the peer.
    pub fn handle_opened(
        &mut self,
        peer: NodeId,
        incarnation: Incarnation,
        number: u32,
        now: Instant,
    ) -> bool {
        let Some(known) = self.peers.get_mut(peer) else { return false };
        let differed = known.begin(number, incarnation);
        let session = PeerSession::new(SessionEpoch(number), now);
        let state = &mut known.record;
        state.session = Some(session);
        state.asked_roster = false;
        let again = std::mem::take(&mut state.again);
        let topics: Vec<_> = self.interests.keys().cloned().collect();
        self.outputs.extend(self.own.messages().map(|message| control(peer, &message)));
        topics.iter().for_each(|topic| self.offer_interest(peer, topic));
        if self.is_started {
            self.outputs.push_back(control(peer, &PeerMessage::Announced { timestamp_us: 0 }));
        }
        again.into_iter().for_each(|call| self.handle_call(call));
        differed
    }

    /// The session with this peer is over: everything that is under way with it is resolved.
    pub fn handle_ended(&mut self, peer: NodeId, why: &DeliveryError) {
        let Some(Peer { record: state, .. }) = self.peers.get_mut(peer) else { return };
        let Some(mut session) = state.session.take() else { return };
        state.past = std::mem::take(&mut session.numbers);
        for pending in session.calls.into_values() {
            give_up(state, &mut self.outputs, pending, why, TransmitState::Perhaps);
        }
        for ((object, contract, _), binding) in session.bindings {
            for waiting in binding.waiting.into_iter().flatten() {
                match waiting.pending {
                    Some(pending) => {
                        give_up(state, &mut self.outputs, pending, why, TransmitState::Nothing)
                    }
                    None => {
                        let to = MessageTarget::Object(object.clone(), contract);
                        self.outputs.push_back(PeerProtocolOutput::Lost {
                            peer,
                            to,
                            why: why.clone(),
                        });
                    }
                }
            }
        }
        self.outputs.push_back(PeerProtocolOutput::Forget { peer, why: why.clone() });
    }

    /// An object here wants to send.
    pub fn handle_call(&mut self, call: Call) {
        let again = (call.contract.idempotent && call.id.is_some() && call.reply_as.is_some())
            .then(|| Box::new(call.without_credit()));
        let Call { node, object, contract, id, sent, until, payload, reply_as, credit } = call;
        let peer = NodeId::of(&node);
        let known = self.peers.get_mut(peer);
        let reachable = known.as_ref().is_some_and(|peer| peer.path.is_some());
        let Some(session) = known.and_then(|peer| peer.record.session.as_mut()) else {
            let unreachable = DeliveryError::Unreachable { node: node.to_string() };
            let why = if reachable { DeliveryError::Restarting } else { unreachable };
            let to = MessageTarget::Object(object, contract.name);
            return self.outputs.push_back(refuse(peer, to, reply_as, why));
        };
        let key = (object, contract.name, contract.fingerprint);
        let pending = reply_as.map(|reply_as| PendingCall { reply_as, until, again });
        let waiting = QueuedMessage { id, sent, payload, pending, credit };
        if let Some(binding @ Binding { waiting: None, .. }) = session.bindings.get(&key) {
            let bound = binding.route();
            let sent = session.send(peer, bound, waiting, &mut self.next_call);
            return self.outputs.push_back(sent);
        }
        match session.bindings.get_mut(&key).and_then(|binding| binding.waiting.as_mut()) {
            Some(queue) => queue.push(waiting),
            None => {
                self.next_binding = self.next_binding.wrapping_add(1);
                let number = self.next_binding;
                let identity = contract.full().encode();
                let object = key.0.clone();
                session.numbers.insert(number, key.clone());
                let (order, waiting) = (OrderingKey::to(&object), Some(vec![waiting]));
                let binding = Binding { number, key: order, contract, waiting };
                session.bindings.insert(key, binding);
                let bind = PeerMessage::Bind { binding: number, object, identity };
                self.outputs.push_back(control(peer, &bind));
            }
        }
    }

    /// The answer to [`PeerProtocolOutput::Bind`]: this is bound, or why not, and the contract as
    /// it is known here.
    pub fn handle_bound(
        &mut self,
        peer: NodeId,
        epoch: SessionEpoch,
        binding: u32,
        result: Result<(), (DeliveryError, Option<ContractIdentity>)>,
    ) {
        let Some(session) = self.session(peer, epoch) else { return };
        if result.is_err() {
            session.bound.remove(&binding);
        }
        let answer = match result {
            Ok(()) => PeerMessage::Bound { binding },
            Err((why, known)) => {
                let identity = known.map(|known| known.full().encode()).unwrap_or_default();
                PeerMessage::BindRefused { binding, why, identity }
            }
        };
        self.outputs.push_back(control(peer, &answer));
    }

    /// An object here has no room for what came through this binding.
    pub fn handle_full(&mut self, peer: NodeId, binding: u32) {
        self.tell(peer, &PeerMessage::NotReady { binding });
    }

    /// It has room again.
    pub fn handle_capacity(&mut self, peer: NodeId, binding: u32) {
        self.tell(peer, &PeerMessage::Ready { binding });
    }

    fn tell(&mut self, peer: NodeId, message: &PeerMessage) {
        if self.peers.open(peer).is_some() {
            self.outputs.push_back(control(peer, message));
        }
    }

    /// An object here has answered, or will not.
    pub fn handle_answer(
        &mut self,
        peer: NodeId,
        epoch: SessionEpoch,
        call: u64,
        result: Result<GatherBuffer, DeliveryError>,
        now: Instant,
    ) {
        let mut askers =
            self.requests.resolve((peer, epoch, call), result.as_ref().ok(), now).into_iter();
        let last = askers.next_back();
        for (peer, epoch, call) in askers {
            self.answer(peer, epoch, call, result.clone());
        }
        if let Some((peer, epoch, call)) = last {
            self.answer(peer, epoch, call, result);
        }
    }

    fn answer(
        &mut self,
        peer: NodeId,
        epoch: SessionEpoch,
        call: u64,
        result: Result<GatherBuffer, DeliveryError>,
    ) {
        let Some(session) = self.session(peer, epoch) else { return };
        let stream = session.reply_streams.remove(&call).unwrap_or(TrafficClass::Request);
        let (key, message) =
            (OrderingKey::Call(call), PeerMessage::Reply { call, result }.encode());
        let credit = None;
        self.outputs.push_back(PeerProtocolOutput::Send { peer, stream, key, message, credit });
    }

    /// Time passes: what was to be answered by now is given up.
    pub fn handle_time(&mut self, now: Instant) {
        self.requests.expire(now);
        let late = |until: Option<Instant>| until.is_some_and(|until| until + GRACE <= now);
        let mut over = Vec::new();
        for (_, Peer { record: state, .. }) in self.peers.iter_mut() {
            let again = state.again.extract_if(.., |call| late(call.until));
            over.extend(again.filter_map(|call| call.reply_as));
            let Some(session) = &mut state.session else { continue };
            let calls = session.calls.values().filter(|pending| late(pending.until));
            over.extend(calls.map(|pending| pending.reply_as));
            session.calls.retain(|_, pending| !late(pending.until));
        }
        for reply_as in over {
            let result = Err(DeliveryError::DeadlinePassed);
            self.outputs.push_back(PeerProtocolOutput::Resolve { reply_as, result });
        }
    }

    /// This node listens to a topic from now on, by the present version of its contract and the
    /// earlier ones that it understands; or no more, if there is none.
    pub fn handle_interest(&mut self, topic: TopicContract, identities: Vec<ContractIdentity>) {
        if !identities.is_empty() && self.interests.contains_key(&topic) {
            // A topic carries one contract. A second subscription would have the latched event
            // sent again.
            return;
        }
        let before = self.interests.remove(&topic);
        if let Some(RemoteTopic { subscription, .. }) = before {
            for peer in self.peers.ids() {
                self.end_interest(peer, subscription);
            }
        }
        if identities.is_empty() {
            return;
        }
        let subscription = self.next_subscription + 1;
        self.next_subscription += FORMS_MAX as u32;
        let interest = RemoteTopic { subscription, identities };
        self.interests.insert(topic.clone(), interest);
        self.peers.ids().into_iter().for_each(|peer| self.offer_interest(peer, &topic));
    }

    /// This node does not listen any more. Tells a peer that was told that it does.
    fn end_interest(&mut self, peer: NodeId, subscription: u32) {
        let Some(session) = self.peers.open_mut(peer) else { return };
        if !session.barred.remove(&subscription) {
            session.forbidden.remove(&subscription);
            self.tell(peer, &PeerMessage::Unsubscribe { subscription });
        }
    }

    /// An event was published here, at `sent`, for a peer's subscription. It goes in this stream;
    /// `None` if only the newest counts.
    pub fn handle_event(
        &mut self,
        peer: NodeId,
        subscription: u32,
        stream: Option<TrafficClass>,
        payload: GatherBuffer,
        sent: Instant,
        credit: Option<Credit>,
    ) {
        if let Some(session) = self.peers.open(peer) {
            let timestamp_us = session.timestamp_us(sent);
            let message = PeerMessage::Event { subscription, timestamp_us, payload };
            let key = OrderingKey::Subscription(subscription);
            let sent = carry(peer, subscription << 1, stream, key, &message, credit);
            self.outputs.push_back(sent);
        }
    }

    /// What a peer wants to listen to has another contract here.
    pub fn handle_subscribe_refused(
        &mut self,
        peer: NodeId,
        subscription: u32,
        why: DeliveryError,
    ) {
        self.tell(peer, &PeerMessage::SubscribeRefused { subscription, why });
    }

    /// This node ends in order.
    pub fn handle_leave(&mut self) {
        self.tell_all(&PeerMessage::Leaving);
    }

    fn tell_all(&mut self, message: &PeerMessage) {
        for (peer, _) in self.peers.with_session() {
            self.outputs.push_back(control(peer, message));
        }
    }

    /// Something waits for a peer to agree to a contract.
    pub fn is_waiting(&self) -> bool {
        let mut bindings = self.peers.with_session().flat_map(|(_, open)| open.bindings.values());
        bindings.any(|binding| binding.waiting.is_some())
    }

    fn session(&mut self, peer: NodeId, epoch: SessionEpoch) -> Option<&mut PeerSession> {
        self.peers.open_mut(peer).filter(|session| session.epoch == epoch)
    }

    /// A message that did not arrive, or perhaps not: its session ended first, or was full.
    pub fn handle_returned(
        &mut self,
        peer: NodeId,
        message: Bytes,
        why: DeliveryError,
        sent: TransmitState,
    ) {
        let Ok(message) = PeerMessage::decode(message) else { return };
        match message {
            PeerMessage::Request { call, .. } => {
                let Some(Peer { record: state, .. }) = self.peers.get_mut(peer) else { return };
                let session = state.session.as_mut();
                if let Some(pending) = session.and_then(|session| session.calls.remove(&call)) {
                    give_up(state, &mut self.outputs, pending, &why, sent);
                }
            }
            PeerMessage::Tell { binding, .. } => {
                let past = self.peers.get(peer).and_then(|Peer { record, .. }| {
                    let present = record.session.as_ref().map(|session| &session.numbers);
                    present.and_then(|numbers| numbers.get(&binding)).or(record.past.get(&binding))
                });
                let to = past.map_or(MessageTarget::Forgotten, |(object, contract, _)| {
                    MessageTarget::Object(object.clone(), contract)
                });
                self.outputs.push_back(PeerProtocolOutput::Lost { peer, to, why });
            }
            PeerMessage::Event { subscription, .. } => {
                let to = MessageTarget::Subscription(subscription);
                self.outputs.push_back(PeerProtocolOutput::Lost { peer, to, why });
            }
            // It was made, and the session does not take it: the caller that waits for it is told
            // so.
            PeerMessage::Reply { call, result } => {
                let error = match (why, result) {
                    (DeliveryError::TooLargeForSession { limit }, _) => {
                        DeliveryError::ReplyTooLarge { limit }
                    }
                    (DeliveryError::WayFull { .. }, Ok(_)) => {
                        let reason = "too many replies wait on the way to the caller".to_owned();
                        DeliveryError::OutcomeUnknown { reason }
                    }
                    (DeliveryError::WayFull { .. }, Err(error)) => error,
                    _ => return,
                };
                self.tell(peer, &PeerMessage::Reply { call, result: Err(error) });
            }
            // What belongs to the session itself ends with it.
            _ => {}
        }
    }

    /// This node is in the safe state, for this reason, or has left it.
    pub fn handle_safe_state(&mut self, reason: Option<String>) {
        let shortened = reason.map(|reason| reason.chars().take(REASON_MAX).collect());
        self.own.safe_state = Some(shortened);
        self.tell_own();
    }

    /// This node uses this roster: its serial number, and its signed text.
    pub fn handle_roster(&mut self, serial: u64, text: Bytes) {
        self.own.roster = Some((serial, text));
        self.tell_own();
    }

    fn tell_own(&mut self) {
        let messages: Vec<_> = self.own.messages().collect();
        messages.iter().for_each(|message| self.tell_all(message));
    }

    /// The directory of this node says this to that of a peer.
    pub fn handle_directory(&mut self, peer: NodeId, message: Bytes) {
        self.tell(peer, &PeerMessage::Directory { message: message.into() });
    }

    /// A peer has the roster of this serial number. It is asked for it, if that is newer.
    fn handle_serial(&mut self, peer: NodeId, serial: u64) {
        if self.own.roster.as_ref().is_some_and(|(own, _)| serial > *own) {
            self.outputs.push_back(control(peer, &PeerMessage::RosterRequest));
            if let Some(known) = self.peers.get_mut(peer) {
                known.record.asked_roster = true;
            }
        }
    }

    /// A peer sends its roster. What was not asked for is not taken.
    fn handle_peers_roster(&mut self, peer: NodeId, text: Bytes) {
        let known = self.peers.get_mut(peer);
        if known.is_some_and(|known| std::mem::take(&mut known.record.asked_roster)) {
            self.outputs.push_back(PeerProtocolOutput::Roster { peer, text });
        } else {
            self.refusals.unexpected += 1;
        }
    }

    /// A peer has an older roster.
    fn handle_roster_request(&mut self, peer: NodeId) {
        if let Some((_, text)) = self.own.roster.clone() {
            self.outputs.push_back(control(peer, &PeerMessage::Roster { text: text.into() }));
        }
    }
}

/// A request is not going to be answered in this session: it waits for the next one, or is
/// resolved.
fn give_up(
    state: &mut PeerRecord,
    outputs: &mut VecDeque<PeerProtocolOutput>,
    pending: PendingCall,
    why: &DeliveryError,
    sent: TransmitState,
) {
    let PendingCall { reply_as, again, .. } = pending;
    // A peer that has left, or has no capacity, is not asked again.
    let helps = !matches!(
        why,
        DeliveryError::Left { .. }
            | DeliveryError::WayFull { .. }
            | DeliveryError::TooLargeForSession { .. }
    );
    match again {
        Some(call) if helps && state.again.len() < AGAIN_MAX => state.again.push(*call),
        _ => {
            let result = Err(match why {
                why if sent == TransmitState::Nothing => why.clone(),
                // Its death is certain, and so is that no answer will come.
                DeliveryError::PeerDied { .. } => why.clone(),
                why => DeliveryError::OutcomeUnknown { reason: why.to_string() },
            });
            outputs.push_back(PeerProtocolOutput::Resolve { reply_as, result });
        }
    }
}

fn control(peer: NodeId, message: &PeerMessage) -> PeerProtocolOutput {
    let (stream, key) = (TrafficClass::Control, OrderingKey::default());
    PeerProtocolOutput::Send { peer, stream, key, message: message.encode(), credit: None }
}

fn subscribe(topic: &TopicContract, interest: &RemoteTopic) -> PeerMessage {
    let RemoteTopic { subscription, identities } = interest;
    // What differs is told of the present version.
    let present = identities.first().map(ContractIdentity::full);
    let former = identities.iter().skip(1).map(ContractIdentity::brief);
    let all = present.into_iter().chain(former).take(FORMS_MAX);
    let identities = all.map(|identity| identity.encode()).collect();
    PeerMessage::Subscribe { subscription: *subscription, topic: topic.topic.clone(), identities }
}

fn refuse(
    peer: NodeId,
    to: MessageTarget,
    reply_as: Option<u64>,
    why: DeliveryError,
) -> PeerProtocolOutput {
    match reply_as {
        Some(reply_as) => PeerProtocolOutput::Resolve { reply_as, result: Err(why) },
        None => PeerProtocolOutput::Lost { peer, to, why },
    }
}

#[cfg(test)]
mod tests;
