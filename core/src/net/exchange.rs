//! What this node's objects and those of other nodes want of each other: bindings, calls,
//! subscriptions, fault notices.
//!
//! The first message of a contract to an object asks its node to bind: both compare the contract's
//! name, version and fingerprint, and what follows carries only a number. Whatever was promised is
//! resolved: with the reply, or when the session with the callee's node ends.
//!
//! A peer's part of it lives as long as the session with it. Each session has an epoch, so that what
//! was begun in one is never answered in the next.

mod dealings;
mod vocabulary;

pub use self::vocabulary::{Call, Epoch, ExchangeOutput, TopicContract};

use self::dealings::{Binding, Numbers, Session, WAITING, Waiting};

use super::message::Message;
use super::naming::Announcement;
use super::node_id::NodeId;
use super::segment::Stream;
use super::wire::Refusals;
use crate::{ContractIdentity, Instant, ObjectName, PeerIdentity, Why};
use bytes::Bytes;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// The most messages that wait for one binding, whatever senders were told.
const WAITING_MAX: usize = 8 * WAITING;
/// The most bindings and subscriptions that a peer may have here, each.
const BINDINGS_MAX: usize = 16 * 1024;

/// The machine of one node's dealings with all others. It waits for nothing: deadlines are the
/// caller's, silence the session's.
#[derive(Debug, Default)]
pub struct Exchange {
    peers: BTreeMap<NodeId, Peer>,
    /// What is listened to here.
    interests: BTreeMap<TopicContract, Interest>,
    next_subscription: u32,
    next_binding: u32,
    next_call: u64,
    epochs: u64,
    refusals: Refusals,
    outputs: VecDeque<ExchangeOutput>,
}

#[derive(Debug)]
struct Interest {
    subscription: u32,
    identity: ContractIdentity,
}

/// What is going on with a peer.
#[derive(Debug, Default)]
struct Peer {
    reachable: bool,
    session: Option<Session>,
    /// What the bindings of the session before were, for messages that come back late.
    past: Numbers,
}

impl Exchange {
    /// An exchange in the place of one that failed. No number of the old one's is used again.
    pub fn reborn(&self) -> Self {
        Exchange {
            next_subscription: self.next_subscription,
            next_binding: self.next_binding,
            next_call: self.next_call,
            epochs: self.epochs,
            refusals: self.refusals,
            ..Exchange::default()
        }
    }

    /// The next thing to do, in order.
    pub fn poll_output(&mut self) -> Option<ExchangeOutput> {
        self.outputs.pop_front()
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// A path to this node is known, or none any more.
    pub fn handle_reachable(&mut self, peer: NodeId, reachable: bool) {
        self.peers.entry(peer).or_default().reachable = reachable;
    }

    /// Whether a path to this node is known.
    pub fn is_reachable(&self, peer: NodeId) -> bool {
        self.peers.get(&peer).is_some_and(|peer| peer.reachable)
    }

    /// A session with this peer has begun.
    pub fn handle_opened(&mut self, peer: NodeId, now: Instant) {
        self.epochs += 1;
        let session = Session {
            epoch: Epoch(self.epochs),
            began: now,
            ages: None,
            bindings: BTreeMap::new(),
            numbers: BTreeMap::new(),
            calls: BTreeMap::new(),
            notices: BTreeSet::new(),
            taken: 0,
        };
        self.peers.entry(peer).or_default().session = Some(session);
        for (topic, interest) in &self.interests {
            let message = subscribe(topic, interest);
            self.outputs.push_back(control(peer, &message));
        }
    }

    /// The session with this peer is over: everything that is under way with it is resolved.
    pub fn handle_ended(&mut self, peer: NodeId, why: &Why) {
        let Some(state) = self.peers.get_mut(&peer) else { return };
        let Some(mut session) = state.session.take() else { return };
        state.past = std::mem::take(&mut session.numbers);
        for reply_as in session.calls.into_values() {
            self.outputs.push_back(ExchangeOutput::Resolve { reply_as, result: Err(why.clone()) });
        }
        for ((object, contract, _), binding) in session.bindings {
            for waiting in binding.waiting.into_iter().flatten() {
                let to = (object.clone(), contract);
                self.outputs.push_back(refuse(peer, to, waiting.reply_as, why.clone()));
            }
        }
        for number in session.notices {
            self.outputs.push_back(ExchangeOutput::Noticed { number, arrived: false });
        }
        self.outputs.push_back(ExchangeOutput::Forget { peer });
    }

    /// An object here wants to send.
    pub fn handle_call(&mut self, call: Call) {
        let Call { node, object, contract, id, sent, payload, reply_as } = call;
        let peer = NodeId::of(&node);
        let known = self.peers.get_mut(&peer);
        let reachable = known.as_ref().is_some_and(|peer| peer.reachable);
        let Some(session) = known.and_then(|peer| peer.session.as_mut()) else {
            let unreachable = Why::Unreachable { node: node.to_string() };
            let why = if reachable { Why::Restarting } else { unreachable };
            self.outputs.push_back(refuse(peer, (object, contract.name), reply_as, why));
            return;
        };
        let key = (object, contract.name, contract.fingerprint);
        let waiting = Waiting { id, sent, payload, reply_as };
        match session.bindings.get_mut(&key) {
            Some(Binding { waiting: None, number, .. }) => {
                let number = *number;
                let sent = session.send(peer, number, waiting, &mut self.next_call);
                self.outputs.push_back(sent);
            }
            Some(Binding { waiting: Some(queue), .. }) => {
                if queue.len() == WAITING {
                    self.outputs.push_back(ExchangeOutput::Full { peer });
                }
                if queue.len() < WAITING_MAX {
                    queue.push(waiting);
                } else {
                    let refused = refuse(peer, (key.0, key.1), reply_as, Why::Full);
                    self.outputs.push_back(refused);
                }
            }
            None => {
                self.next_binding = self.next_binding.wrapping_add(1);
                let number = self.next_binding;
                let identity = contract.full().encode().into();
                let object = key.0.clone();
                session.numbers.insert(number, key.clone());
                let binding = Binding { number, contract, waiting: Some(vec![waiting]) };
                session.bindings.insert(key, binding);
                let bind = Message::Bind { binding: number, object, identity };
                self.outputs.push_back(control(peer, &bind));
            }
        }
    }

    /// The answer to [`ExchangeOutput::Bind`]: this is bound, or why not, and the contract as it is
    /// known here.
    pub fn handle_bound(
        &mut self,
        peer: NodeId,
        epoch: Epoch,
        binding: u32,
        result: Result<(), (Why, Option<ContractIdentity>)>,
    ) {
        if self.session(peer, epoch).is_none() {
            return;
        }
        let answer = match result {
            Ok(()) => Message::Bound { binding },
            Err((why, known)) => {
                let identity = known.map(|known| known.full().encode().into()).unwrap_or_default();
                Message::BindRefused { binding, why, identity }
            }
        };
        self.outputs.push_back(control(peer, &answer));
    }

    /// An object here has answered, or will not.
    pub fn handle_answer(
        &mut self,
        peer: NodeId,
        epoch: Epoch,
        call: u64,
        result: Result<Bytes, Why>,
    ) {
        if self.session(peer, epoch).is_some() {
            let message = Message::Reply { call, result }.encode();
            self.outputs.push_back(ExchangeOutput::Send { peer, stream: Stream::Data, message });
        }
    }

    /// This node listens to a topic from now on, or no more.
    pub fn handle_interest(&mut self, topic: TopicContract, identity: Option<ContractIdentity>) {
        let message = match identity {
            Some(identity) => {
                self.next_subscription += 1;
                let interest = Interest { subscription: self.next_subscription, identity };
                let message = subscribe(&topic, &interest);
                let before = self.interests.insert(topic, interest);
                if let Some(Interest { subscription, .. }) = before {
                    self.tell_all(&Message::Unsubscribe { subscription });
                }
                message
            }
            None => match self.interests.remove(&topic) {
                Some(Interest { subscription, .. }) => Message::Unsubscribe { subscription },
                None => return,
            },
        };
        self.tell_all(&message);
    }

    /// An event was published here, at `sent`, for a peer's subscription.
    pub fn handle_event(&mut self, peer: NodeId, subscription: u32, payload: Bytes, sent: Instant) {
        if let Some(session) = self.peers.get(&peer).and_then(|peer| peer.session.as_ref()) {
            let stamp_us = session.stamp_us(sent);
            let message = Message::Event { subscription, stamp_us, payload }.encode();
            self.outputs.push_back(ExchangeOutput::Send { peer, stream: Stream::Data, message });
        }
    }

    /// What a peer wants to listen to has another contract here.
    pub fn handle_subscribe_refused(&mut self, peer: NodeId, subscription: u32, why: Why) {
        if self.is_open(peer) {
            let message = Message::SubscribeRefused { subscription, why };
            self.outputs.push_back(control(peer, &message));
        }
    }

    /// Tells a peer's recoverer of a fault. The number is the caller's.
    pub fn handle_notice(&mut self, peer: NodeId, number: u64, payload: Bytes) {
        match self.peers.get_mut(&peer).and_then(|peer| peer.session.as_mut()) {
            Some(session) => {
                session.notices.insert(number);
                let message = Message::Notice { number, payload };
                self.outputs.push_back(control(peer, &message));
            }
            None => self.outputs.push_back(ExchangeOutput::Noticed { number, arrived: false }),
        }
    }

    /// A peer's fault has arrived at our recoverer.
    pub fn handle_noticed(&mut self, peer: NodeId, epoch: Epoch, number: u64) {
        if self.session(peer, epoch).is_some() {
            self.outputs.push_back(control(peer, &Message::Confirmed { number }));
        }
    }

    /// Tells one peer, or all, which objects this node has.
    pub fn handle_own_names(
        &mut self,
        to: Option<NodeId>,
        announcement: &Announcement,
        now: Instant,
    ) {
        for (peer, state) in &self.peers {
            if let Some(session) = &state.session
                && to.is_none_or(|to| to == *peer)
            {
                let Announcement { complete, added, removed } = announcement.clone();
                let stamp_us = session.stamp_us(now);
                let message = Message::Names { stamp_us, complete, added, removed };
                self.outputs.push_back(control(*peer, &message));
            }
        }
    }

    /// This node ends in order.
    pub fn handle_leave(&mut self) {
        self.tell_all(&Message::Bye);
    }

    /// Something waits for a peer to agree to a contract.
    pub fn is_waiting(&self) -> bool {
        let sessions = self.peers.values().filter_map(|peer| peer.session.as_ref());
        sessions.flat_map(|session| session.bindings.values()).any(|b| b.waiting.is_some())
    }

    fn tell_all(&mut self, message: &Message) {
        for (peer, state) in &self.peers {
            if state.session.is_some() {
                self.outputs.push_back(control(*peer, message));
            }
        }
    }

    fn is_open(&self, peer: NodeId) -> bool {
        self.peers.get(&peer).is_some_and(|peer| peer.session.is_some())
    }

    fn session(&mut self, peer: NodeId, epoch: Epoch) -> Option<&mut Session> {
        let session = self.peers.get_mut(&peer)?.session.as_mut()?;
        (session.epoch == epoch).then_some(session)
    }

    /// A message that was not sent: its session ended first, or it was full.
    pub fn handle_returned(&mut self, peer: NodeId, message: Bytes, why: Why) {
        let Ok(message) = Message::decode(message) else { return };
        let session = self.peers.get_mut(&peer).and_then(|peer| peer.session.as_mut());
        match message {
            Message::Request { call, .. } => {
                if let Some(reply_as) = session.and_then(|session| session.calls.remove(&call)) {
                    self.outputs.push_back(ExchangeOutput::Resolve { reply_as, result: Err(why) });
                }
            }
            Message::Tell { binding, .. } => {
                let past = self.peers.get(&peer).and_then(|peer| {
                    let present = peer.session.as_ref().map(|session| &session.numbers);
                    present.and_then(|numbers| numbers.get(&binding)).or(peer.past.get(&binding))
                });
                let to = past.map(|(object, contract, _)| (object.clone(), *contract));
                self.outputs.push_back(ExchangeOutput::Lost { peer, to, why });
            }
            Message::Event { .. } => {
                self.outputs.push_back(ExchangeOutput::Lost { peer, to: None, why });
            }
            // What belongs to the session itself ends with it.
            _ => {}
        }
    }

    /// A peer says something.
    pub fn handle_message(&mut self, peer: NodeId, message: Bytes, now: Instant) {
        let message = match Message::decode(message) {
            Ok(message) => message,
            Err(error) => return self.refusals.count(&error),
        };
        let Some(session) = self.peers.get_mut(&peer).and_then(|peer| peer.session.as_mut()) else {
            self.refusals.unexpected += 1;
            return;
        };
        let epoch = session.epoch;
        match message {
            Message::Bind { binding, object, identity } => {
                self.handle_bind(peer, binding, object, &identity);
            }
            Message::Bound { binding } => {
                let sent = session.bound(peer, binding, &mut self.next_call);
                self.refusals.unexpected += u64::from(sent.is_none());
                self.outputs.extend(sent.into_iter().flatten());
            }
            Message::BindRefused { binding, why, identity } => {
                self.handle_bind_refused(peer, binding, why, &identity);
            }
            Message::Request { binding, call, id, payload } => {
                let (call, age) = (Some(call), Duration::ZERO);
                let serve = ExchangeOutput::Serve { peer, epoch, binding, call, id, age, payload };
                self.outputs.push_back(serve);
            }
            Message::Tell { binding, stamp_us, id, payload } => {
                let (call, age) = (None, session.age(stamp_us, now));
                let serve = ExchangeOutput::Serve { peer, epoch, binding, call, id, age, payload };
                self.outputs.push_back(serve);
            }
            Message::Reply { call, result } => match session.calls.remove(&call) {
                Some(reply_as) => {
                    self.outputs.push_back(ExchangeOutput::Resolve { reply_as, result });
                }
                None => self.refusals.unexpected += 1,
            },
            Message::Subscribe { subscription, topic, identity } => {
                self.handle_subscribe(peer, subscription, topic, &identity);
            }
            Message::SubscribeRefused { why, .. } => {
                let difference = why.to_string();
                self.outputs.push_back(ExchangeOutput::Differs { peer, difference });
            }
            Message::Unsubscribe { subscription } => {
                session.taken = session.taken.saturating_sub(1);
                self.outputs.push_back(ExchangeOutput::Unsubscribe { peer, subscription });
            }
            Message::Event { subscription, stamp_us, payload } => {
                let age = session.age(stamp_us, now);
                self.handle_peers_event(subscription, age, payload);
            }
            Message::Notice { number, payload } => {
                self.outputs.push_back(ExchangeOutput::Notice { peer, epoch, number, payload });
            }
            Message::Confirmed { number } => {
                if session.notices.remove(&number) {
                    self.outputs.push_back(ExchangeOutput::Noticed { number, arrived: true });
                }
            }
            Message::Names { stamp_us, complete, added, removed } => {
                session.age(stamp_us, now);
                let announcement = Announcement { complete, added, removed };
                self.outputs.push_back(ExchangeOutput::Names { peer, announcement });
            }
            Message::Bye => self.outputs.push_back(ExchangeOutput::Bye { peer }),
        }
    }

    fn handle_bind(&mut self, peer: NodeId, binding: u32, object: ObjectName, identity: &[u8]) {
        let Some((epoch, identity)) = self.take_in(peer, identity) else {
            let why = Why::Undecodable { reason: "the contract's identity".into() };
            let refused = Message::BindRefused { binding, why, identity: Bytes::new() };
            self.outputs.push_back(control(peer, &refused));
            return;
        };
        self.outputs.push_back(ExchangeOutput::Bind { peer, epoch, binding, object, identity });
    }

    fn handle_subscribe(
        &mut self,
        peer: NodeId,
        subscription: u32,
        topic: String,
        identity: &[u8],
    ) {
        let Some((_, identity)) = self.take_in(peer, identity) else {
            let why = Why::Undecodable { reason: "the contract's identity".into() };
            self.handle_subscribe_refused(peer, subscription, why);
            return;
        };
        let topic = TopicContract { topic, contract: identity.name.clone() };
        let output = ExchangeOutput::Subscribe { peer, subscription, topic, identity };
        self.outputs.push_back(output);
    }

    /// A peer wants something new of us: within bounds, and with a contract that can be read.
    fn take_in(&mut self, peer: NodeId, identity: &[u8]) -> Option<(Epoch, Box<PeerIdentity>)> {
        let session = self.peers.get_mut(&peer)?.session.as_mut()?;
        let identity = PeerIdentity::decode(identity).ok();
        if session.taken >= BINDINGS_MAX {
            self.refusals.too_large += 1;
            return None;
        }
        session.taken += 1;
        Some((session.epoch, Box::new(identity?)))
    }

    fn handle_bind_refused(&mut self, peer: NodeId, number: u32, why: Why, identity: &[u8]) {
        let Some(session) = self.peers.get_mut(&peer).and_then(|peer| peer.session.as_mut()) else {
            return;
        };
        let binding = session.numbers.remove(&number).and_then(|key| {
            let binding = session.bindings.remove(&key)?;
            Some((key, binding))
        });
        let Some(((object, name, _), Binding { contract, waiting, .. })) = binding else {
            self.refusals.unexpected += 1;
            return;
        };
        // Seen from our side, where the peer has sent its own.
        let theirs = PeerIdentity::decode(identity).ok();
        let why = match (theirs.map(|theirs| contract.check(&theirs)), why) {
            (Some(Err(difference)), Why::ContractDiffers { .. }) => {
                Why::ContractDiffers { difference: difference.to_string() }
            }
            (_, why) => why,
        };
        if let Why::ContractDiffers { difference } = &why {
            let difference = difference.clone();
            self.outputs.push_back(ExchangeOutput::Differs { peer, difference });
        }
        let waiting = waiting.unwrap_or_default();
        if waiting.len() > WAITING {
            self.outputs.push_back(ExchangeOutput::Room { peer });
        }
        for Waiting { reply_as, .. } in waiting {
            let to = (object.clone(), name);
            self.outputs.push_back(refuse(peer, to, reply_as, why.clone()));
        }
    }

    fn handle_peers_event(&mut self, subscription: u32, age: Duration, payload: Bytes) {
        let mut interests = self.interests.iter();
        // As many as the node has topics; they are few.
        match interests.find(|(_, interest)| interest.subscription == subscription) {
            Some((topic, _)) => {
                let topic = topic.clone();
                self.outputs.push_back(ExchangeOutput::Event { topic, age, payload });
            }
            // It crossed our unsubscribing.
            None => self.refusals.stale += 1,
        }
    }
}

fn control(peer: NodeId, message: &Message) -> ExchangeOutput {
    ExchangeOutput::Send { peer, stream: Stream::Control, message: message.encode() }
}

fn subscribe(topic: &TopicContract, interest: &Interest) -> Message {
    let Interest { subscription, identity } = interest;
    let identity = identity.full().encode().into();
    Message::Subscribe { subscription: *subscription, topic: topic.topic.clone(), identity }
}

fn refuse(
    peer: NodeId,
    to: (ObjectName, &'static str),
    reply_as: Option<u64>,
    why: Why,
) -> ExchangeOutput {
    match reply_as {
        Some(reply_as) => ExchangeOutput::Resolve { reply_as, result: Err(why) },
        None => ExchangeOutput::Lost { peer, to: Some(to), why },
    }
}

#[cfg(test)]
mod tests;
