//! What is going on with one peer, as long as its session lasts.

use super::BINDINGS_MAX;
use super::access::{PeerBound, PeerSubscription};
use super::types::{Call, PeerProtocolOutput, SessionEpoch};
use crate::net::peer_protocol::age::AgeEstimator;
use crate::net::session::ordering_key::OrderingKey;
use crate::net::wire::message::{PeerMessage, TICK_US};
use crate::net::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use crate::{
    ContractIdentity, Credit, Delivery, GatherBuffer, Instant, MessageId, ObjectName, TrafficClass,
};
use std::collections::BTreeSet;
use std::time::Duration;

/// A binding: the object, the contract's name and fingerprint.
pub(super) type BindingKey = (ObjectName, &'static str, u64);
/// Which binding has which number. Numbers are not used again in the next session.
pub(super) type BindingTable = SortedMap<u32, BindingKey>;

/// What the protocol keeps of a peer.
#[derive(Debug, Default)]
pub(super) struct PeerRecord {
    pub(super) session: Option<PeerSession>,
    /// What the bindings of the session before were, for messages that come back late.
    pub(super) past: BindingTable,
    /// Requests that are sent again in the next session.
    pub(super) again: Vec<Call>,
    /// In this session it was asked for its roster, and has not sent it yet.
    pub(super) asked_roster: bool,
}

#[derive(Debug)]
pub(super) struct PeerSession {
    pub(super) epoch: SessionEpoch,
    clock: SessionClock,
    pub(super) bindings: SortedMap<BindingKey, Binding>,
    pub(super) numbers: BindingTable,
    /// Our requests that are not answered, by their number on the wire.
    pub(super) calls: SortedMap<u64, PendingCall>,
    /// What the peer has bound here.
    pub(super) bound: SortedMap<u32, PeerBound>,
    /// What it listens to here.
    pub(super) subscriptions: SortedMap<u32, PeerSubscription>,
    /// Subscriptions of this node to topics on which the peer may not publish. It was not told of
    /// them, or was told that they have ended.
    pub(super) barred: BTreeSet<u32>,
    /// Subscriptions of this node that the peer refuses by its policy.
    pub(super) forbidden: BTreeSet<u32>,
    /// The peer's requests that are not answered and whose replies take another stream than data.
    pub(super) reply_streams: SortedMap<u64, TrafficClass>,
    /// The peer's objects that have no room, and by which of our bindings it has said so.
    pub(super) full: SortedMap<ObjectName, BTreeSet<u32>>,
}

/// The timestamps of both ends.
#[derive(Debug)]
struct SessionClock {
    /// Our timestamps count from here.
    began: Instant,
    /// Known from the peer's first timestamp on.
    ages: Option<AgeEstimator>,
}

/// How the messages of a binding travel.
#[derive(Clone, Copy)]
pub(super) struct BindingRoute {
    number: u32,
    /// `None` if only the newest counts.
    stream: Option<TrafficClass>,
    /// What they stay in order with.
    key: OrderingKey,
}

#[derive(Debug)]
pub(super) struct Binding {
    pub(super) number: u32,
    /// That of its object.
    pub(super) key: OrderingKey,
    pub(super) contract: ContractIdentity,
    /// Messages that wait until the peer has agreed; `None` once it has.
    pub(super) waiting: Option<Vec<QueuedMessage>>,
}

impl Binding {
    pub(super) fn route(&self) -> BindingRoute {
        BindingRoute { number: self.number, stream: self.stream(), key: self.key }
    }

    pub(super) fn stream(&self) -> Option<TrafficClass> {
        let is_ordered = self.contract.delivery != Delivery::Newest;
        is_ordered.then(|| self.contract.message_class())
    }
}

#[derive(Debug)]
pub(super) struct QueuedMessage {
    pub(super) id: Option<MessageId>,
    pub(super) sent: Instant,
    pub(super) payload: GatherBuffer,
    pub(super) pending: Option<PendingCall>,
    pub(super) credit: Option<Credit>,
}

/// A request of ours.
#[derive(Debug)]
pub(super) struct PendingCall {
    /// The caller's number.
    pub(super) reply_as: u64,
    pub(super) until: Option<Instant>,
    /// It may be sent again.
    pub(super) again: Option<Box<Call>>,
}

impl PeerSession {
    pub(super) fn new(epoch: SessionEpoch, began: Instant) -> Self {
        PeerSession {
            epoch,
            clock: SessionClock { began, ages: None },
            bindings: SortedMap::new(),
            numbers: SortedMap::new(),
            calls: SortedMap::new(),
            bound: SortedMap::new(),
            subscriptions: SortedMap::new(),
            barred: BTreeSet::new(),
            forbidden: BTreeSet::new(),
            reply_streams: SortedMap::new(),
            full: SortedMap::new(),
        }
    }

    /// The peer says that an object has no room. Answers whether that is news, and of which object;
    /// `None` if nothing was bound that this could be about.
    pub(super) fn handle_not_ready(&mut self, binding: u32) -> Option<(ObjectName, bool)> {
        let (object, ..) = self.numbers.get(&binding)?;
        let full = self.full.entry(object.clone()).or_default();
        let news = full.is_empty();
        full.insert(binding).then(|| (object.clone(), news))
    }

    /// The peer says that an object has room again. Answers likewise; `None` also if the contrary
    /// was not said.
    pub(super) fn handle_ready(&mut self, binding: u32) -> Option<(ObjectName, bool)> {
        let (object, ..) = self.numbers.get(&binding)?;
        let full = self.full.get_mut(object)?;
        if !full.remove(&binding) {
            return None;
        }
        let news = full.is_empty();
        if news {
            self.full.remove(object);
        }
        Some((object.clone(), news))
    }

    /// The peer refuses this binding: at once, or because its policy has changed.
    pub(super) fn unbind(&mut self, number: u32) -> Option<(BindingKey, Binding)> {
        let key = self.numbers.get(&number)?;
        let binding = self.bindings.get(key).filter(|binding| binding.number == number)?;
        // What was sent through a binding may come back, and is to be known then.
        let was_used = binding.waiting.is_none() && self.numbers.len() < BINDINGS_MAX;
        let key = key.clone();
        if !was_used {
            self.numbers.remove(&number);
        }
        let binding = self.bindings.remove(&key)?;
        Some((key, binding))
    }

    pub(super) fn timestamp_us(&self, sent: Instant) -> u64 {
        u64::try_from((sent - self.clock.began).as_micros()).unwrap_or(u64::MAX)
    }

    pub(super) fn age(&mut self, timestamp_us: u64, now: Instant) -> Duration {
        let ages = self.clock.ages.get_or_insert_with(|| AgeEstimator::new(timestamp_us, now));
        ages.handle(timestamp_us, now)
    }

    pub(super) fn send(
        &mut self,
        peer: NodeId,
        route: BindingRoute,
        waiting: QueuedMessage,
        next_call: &mut u64,
    ) -> PeerProtocolOutput {
        let QueuedMessage { id, sent, payload, pending, credit } = waiting;
        let BindingRoute { number: binding, stream, key } = route;
        let timestamp_us = self.timestamp_us(sent);
        let message = match pending {
            None => PeerMessage::Tell { binding, timestamp_us, id, payload },
            Some(pending) => {
                *next_call += 1;
                let call = *next_call;
                // A deadline of less than a tick is one all the same.
                let within = pending.until.map_or(0, |until| ticks(until - sent).max(1));
                self.calls.insert(call, pending);
                let timestamp = timestamp_us / TICK_US;
                PeerMessage::Request { binding, call, timestamp, within, id, payload }
            }
        };
        carry(peer, (binding << 1) | 1, stream, key, &message, credit)
    }

    /// The peer has agreed: what waited goes out. `None` if nothing was asked.
    pub(super) fn bound(
        &mut self,
        peer: NodeId,
        number: u32,
        next_call: &mut u64,
    ) -> Option<Vec<PeerProtocolOutput>> {
        let key = self.numbers.get(&number)?;
        let binding = self.bindings.get_mut(key)?;
        let (waiting, route) = (binding.waiting.take()?, binding.route());
        Some(waiting.into_iter().map(|one| self.send(peer, route, one, next_call)).collect())
    }
}

fn ticks(span: Duration) -> u64 {
    u64::try_from(span.as_micros()).unwrap_or(u64::MAX) / TICK_US
}

/// Hands a message over as its contract wants it to travel. Channels of subscriptions are even,
/// those of bindings odd.
pub(super) fn carry(
    peer: NodeId,
    channel: u32,
    stream: Option<TrafficClass>,
    key: OrderingKey,
    message: &PeerMessage,
    credit: Option<Credit>,
) -> PeerProtocolOutput {
    let message = message.encode();
    match stream {
        Some(stream) => PeerProtocolOutput::Send { peer, stream, key, message, credit },
        None => PeerProtocolOutput::SendNewest { peer, channel, message, credit },
    }
}
