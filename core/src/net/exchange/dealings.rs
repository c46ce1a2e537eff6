//! What is going on with one peer, as long as its session lasts.

use super::vocabulary::{Epoch, ExchangeOutput};
use crate::net::age::Ages;
use crate::net::message::Message;
use crate::net::node_id::NodeId;
use crate::net::segment::Stream;
use crate::{ContractIdentity, Instant, MessageId, ObjectName};
use bytes::Bytes;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// The messages that should wait for one binding at most: one round trip's worth of a fast sender.
/// Beyond, senders are told to stop.
pub(super) const WAITING: usize = 1024;

/// A binding: the object, the contract's name and fingerprint.
pub(super) type Bound = (ObjectName, &'static str, u64);
/// Which binding has which number. Numbers are not used again in the next session.
pub(super) type Numbers = BTreeMap<u32, Bound>;

#[derive(Debug)]
pub(super) struct Session {
    pub(super) epoch: Epoch,
    /// Our stamps count from here.
    pub(super) began: Instant,
    /// Known from the peer's first stamp on.
    pub(super) ages: Option<Ages>,
    pub(super) bindings: BTreeMap<Bound, Binding>,
    pub(super) numbers: Numbers,
    /// Our requests that are not answered, by their number on the wire, and the callers' numbers.
    pub(super) calls: BTreeMap<u64, u64>,
    pub(super) notices: BTreeSet<u64>,
    /// How many bindings and subscriptions the peer has here.
    pub(super) taken: usize,
}

#[derive(Debug)]
pub(super) struct Binding {
    pub(super) number: u32,
    pub(super) contract: ContractIdentity,
    /// Messages that wait until the peer has agreed; `None` once it has.
    pub(super) waiting: Option<Vec<Waiting>>,
}

#[derive(Debug)]
pub(super) struct Waiting {
    pub(super) id: Option<MessageId>,
    pub(super) sent: Instant,
    pub(super) payload: Bytes,
    pub(super) reply_as: Option<u64>,
}

impl Session {
    pub(super) fn stamp_us(&self, sent: Instant) -> u64 {
        u64::try_from((sent - self.began).as_micros()).unwrap_or(u64::MAX)
    }

    pub(super) fn age(&mut self, stamp_us: u64, now: Instant) -> Duration {
        self.ages.get_or_insert_with(|| Ages::new(stamp_us, now)).handle(stamp_us, now)
    }

    pub(super) fn send(
        &mut self,
        peer: NodeId,
        binding: u32,
        waiting: Waiting,
        next_call: &mut u64,
    ) -> ExchangeOutput {
        let Waiting { id, sent, payload, reply_as } = waiting;
        let stamp_us = self.stamp_us(sent);
        let message = match reply_as {
            None => Message::Tell { binding, stamp_us, id, payload },
            Some(reply_as) => {
                *next_call += 1;
                let call = *next_call;
                self.calls.insert(call, reply_as);
                Message::Request { binding, call, id, payload }
            }
        };
        ExchangeOutput::Send { peer, stream: Stream::Data, message: message.encode() }
    }

    /// The peer has agreed: what waited goes out. `None` if nothing was asked.
    pub(super) fn bound(
        &mut self,
        peer: NodeId,
        number: u32,
        next_call: &mut u64,
    ) -> Option<Vec<ExchangeOutput>> {
        let key = self.numbers.get(&number)?;
        let waiting = self.bindings.get_mut(key)?.waiting.take()?;
        let room = (waiting.len() > WAITING).then_some(ExchangeOutput::Room { peer });
        let sent = waiting.into_iter().map(|waiting| self.send(peer, number, waiting, next_call));
        // Room first: the session may find itself full, and must have the last word.
        Some(room.into_iter().chain(sent).collect())
    }
}
