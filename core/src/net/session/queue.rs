//! What waits to be cut into parts: each key in its order.

use crate::net::session::ordering_key::OrderingKey;
use crate::sorted::SortedMap;
use crate::{Credit, GatherBuffer};
use std::ops::RangeFrom;

/// A message, with the credit that it holds until the peer has acknowledged it.
#[derive(Debug)]
pub(crate) struct OutboundMessage {
    pub(crate) bytes: GatherBuffer,
    #[expect(dead_code, reason = "it is held until it is dropped")]
    pub(crate) credit: Option<Credit>,
}

/// Messages that wait. Each key keeps its order; of each only the first is ever looked at, so
/// that however much waits in one, nothing of another has to be found behind it.
#[derive(Debug, Default)]
pub(super) struct SendQueue {
    /// By key, in the order of arrival there.
    messages: SortedMap<(OrderingKey, u64), OutboundMessage>,
    /// The first of each key, by arrival.
    heads: SortedMap<u64, OrderingKey>,
    arrivals: u64,
}

impl SendQueue {
    pub(super) fn len(&self) -> usize {
        self.messages.len()
    }

    pub(super) fn is_empty(&self) -> bool {
        self.messages.is_empty()
    }

    pub(super) fn push(&mut self, key: OrderingKey, message: OutboundMessage) {
        let number = self.arrivals;
        self.arrivals += 1;
        if self.head(key).is_none() {
            self.heads.insert(number, key);
        }
        self.messages.insert((key, number), message);
    }

    /// The first of those that arrived at `from` or later and are the first of their key.
    pub(super) fn first(
        &self,
        from: RangeFrom<u64>,
    ) -> Option<(u64, OrderingKey, &OutboundMessage)> {
        let (&number, &key) = self.heads.range(from).next()?;
        self.messages.get(&(key, number)).map(|message| (number, key, message))
    }

    /// Takes out what is the first of its key: the next of it is so then.
    pub(super) fn take(&mut self, number: u64) -> Option<(OrderingKey, OutboundMessage)> {
        let key = self.heads.remove(&number)?;
        let message = self.messages.remove(&(key, number))?;
        if let Some(next) = self.head(key) {
            self.heads.insert(next, key);
        }
        Some((key, message))
    }

    /// All of them, in the order in which they arrived.
    pub(super) fn into_messages(self) -> impl Iterator<Item = OutboundMessage> {
        let by_arrival = self.messages.into_iter().map(|((_, number), message)| (number, message));
        by_arrival.collect::<SortedMap<_, _>>().into_values()
    }

    fn head(&self, key: OrderingKey) -> Option<u64> {
        let all = (key, 0)..=(key, u64::MAX);
        self.messages.range(all).next().map(|((_, number), _)| *number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytes::Bytes;

    fn parcel(text: &'static str) -> OutboundMessage {
        OutboundMessage { bytes: Bytes::from_static(text.as_bytes()).into(), credit: None }
    }

    #[test]
    fn each_strand_keeps_its_order_and_shows_only_its_first() {
        let (map, leg) = (OrderingKey::Object(1), OrderingKey::Object(2));
        let mut queue = SendQueue::default();
        for (key, text) in [(map, "m1"), (map, "m2"), (leg, "l1"), (map, "m3"), (leg, "l2")] {
            queue.push(key, parcel(text));
        }
        let first =
            |queue: &SendQueue, from| queue.first(from).map(|(number, key, _)| (number, key));

        assert_eq!(first(&queue, 0..), Some((0, map)));
        assert_eq!(first(&queue, 1..), Some((2, leg)), "what follows in a key is not looked at");
        let take = |queue: &mut SendQueue, number| {
            queue.take(number).map(|(key, message)| (key, message.bytes))
        };
        let text = |text: &'static str| Bytes::from_static(text.as_bytes()).into();
        assert_eq!(take(&mut queue, 1), None, "nor taken");
        assert_eq!(take(&mut queue, 2), Some((leg, text("l1"))));
        assert_eq!(first(&queue, 1..), Some((4, leg)));
        assert_eq!(take(&mut queue, 0), Some((map, text("m1"))));

        assert_eq!(first(&queue, 0..), Some((1, map)));
        let rest = queue.into_messages().map(|message| message.bytes);
        assert!(rest.eq(["m2", "m3", "l2"].map(text)), "in the order of arrival");
    }
}
