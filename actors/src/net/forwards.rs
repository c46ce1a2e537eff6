//! What is published here and listened to on other nodes.

use super::door::Gate;
use crate::platform;
use crate::topic::{Forward, ForwardId, TopicKey, Topics};
use actix::{Message, Recipient};
use blastema_core::net::NodeId;
use blastema_core::{Instant, PeerIdentity, Why};
use bytes::Bytes;
use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};

/// Events of one subscription that may wait in the gateway's mailbox; beyond, they are dropped.
const EVENTS_MAX: usize = 1024;

/// An event was published here that a peer listens to.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Published {
    pub(super) peer: NodeId,
    pub(super) subscription: u32,
    pub(super) event: Bytes,
    pub(super) sent: Instant,
}

/// What peers listen to here, by peer and their number of the subscription.
pub(super) struct Forwards {
    topics: Topics,
    known: BTreeMap<(NodeId, u32), Forwarded>,
}

struct Forwarded {
    id: ForwardId,
    key: TopicKey,
    /// What the peer takes the events for, until that could be compared.
    unverified: Option<Box<PeerIdentity>>,
    waiting: Arc<AtomicUsize>,
}

impl Forwards {
    pub(super) fn new(topics: Topics) -> Self {
        Forwards { topics, known: BTreeMap::new() }
    }

    /// Ships what is published on this topic from now on.
    ///
    /// # Errors
    /// [`Why::ContractDiffers`]: nothing will be shipped.
    pub(super) fn begin(
        &mut self,
        (peer, subscription): (NodeId, u32),
        key: TopicKey,
        theirs: Box<PeerIdentity>,
        gate: Arc<Gate>,
        gateway: Recipient<Published>,
    ) -> Result<(), Why> {
        let ours = self.topics.identity(&key);
        if let Some(Err(difference)) = ours.as_ref().map(|ours| ours.check(&theirs)) {
            return Err(Why::ContractDiffers { difference: difference.to_string() });
        }
        let waiting = Arc::new(AtomicUsize::new(0));
        let under_way = waiting.clone();
        let forward: Forward = Arc::new(move |event: &Bytes| {
            // Publishing never waits: what a peer cannot take now is not sent.
            if gate.is_open() && under_way.load(Relaxed) < EVENTS_MAX {
                under_way.fetch_add(1, Relaxed);
                let (event, sent) = (event.clone(), platform::now());
                gateway.do_send(Published { peer, subscription, event, sent });
            }
        });
        self.end((peer, subscription));
        let id = self.topics.forward(&key, forward);
        let unverified = ours.is_none().then_some(theirs);
        self.known.insert((peer, subscription), Forwarded { id, key, unverified, waiting });
        Ok(())
    }

    /// The gateway has taken an event over: may it go out? Where the topic had no contract here when
    /// the peer subscribed, that is found out with the first event.
    ///
    /// # Errors
    /// [`Why::Unknown`] if the subscription has ended; [`Why::ContractDiffers`] ends it.
    pub(super) fn admit(&mut self, forward: (NodeId, u32)) -> Result<(), Why> {
        let Some(known) = self.known.get_mut(&forward) else {
            return Err(Why::Unknown { name: "subscription".into() });
        };
        known.waiting.fetch_sub(1, Relaxed);
        let Some(theirs) = known.unverified.take() else { return Ok(()) };
        match self.topics.identity(&known.key).map(|ours| ours.check(&theirs)) {
            Some(Err(difference)) => {
                self.end(forward);
                Err(Why::ContractDiffers { difference: difference.to_string() })
            }
            _ => Ok(()),
        }
    }

    pub(super) fn end(&mut self, forward: (NodeId, u32)) {
        if let Some(Forwarded { id, .. }) = self.known.remove(&forward) {
            self.topics.end_forward(&id);
        }
    }

    /// Ends all of one peer.
    pub(super) fn end_all_of(&mut self, peer: NodeId) {
        let all: Vec<_> = self.known.range((peer, 0)..=(peer, u32::MAX)).map(|(k, _)| *k).collect();
        all.into_iter().for_each(|forward| self.end(forward));
    }

    /// Ends all.
    pub(super) fn end_all(&mut self) {
        let all: Vec<_> = self.known.keys().copied().collect();
        all.into_iter().for_each(|forward| self.end(forward));
    }
}
