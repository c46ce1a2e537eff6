//! Requests of other nodes that are known by an identity: each takes effect at most once, however
//! often it is sent.
//!
//! A caller that has lost the way to its answer sends the request again in the next session. Here
//! it is known by the caller's node, its incarnation and the request's identity: what is being
//! served is not begun again, and what was answered is answered with the same reply. A request that
//! failed is forgotten: its caller was told, and sending it again is the caller's decision.

use super::types::SessionEpoch;
use crate::net::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use crate::{GatherBuffer, Incarnation, Instant, MessageId};
use bytes::Bytes;
use std::collections::BTreeSet;
use std::time::Duration;

/// How long a reply is remembered: longer than any deadline within which a caller sends again.
const REMEMBERED: Duration = Duration::from_secs(60);
/// The most requests that are known at a time, of all callers.
const REQUESTS_MAX: usize = 4096;
/// The most bytes of remembered replies: four of the largest, or a thousand of the usual.
const BYTES_MAX: usize = 4 << 20;
/// The most repetitions of one request that are answered together.
const ASKERS_MAX: usize = 8;

/// By what a request is known.
pub(super) type RequestKey = (NodeId, Incarnation, MessageId);
/// One sending of it.
pub(super) type RequestOrigin = (NodeId, SessionEpoch, u64);

/// The table of one callee.
#[derive(Clone, Debug, Default)]
pub(super) struct ReplyCache {
    known: SortedMap<RequestKey, Stage>,
    /// Those being served, by the sending that began it.
    serving: SortedMap<RequestOrigin, RequestKey>,
    /// Those that were answered, the oldest first.
    answered: BTreeSet<(Instant, RequestKey)>,
    bytes: usize,
}

#[derive(Clone, Debug)]
enum Stage {
    Serving { askers: Vec<RequestOrigin> },
    Answered { reply: Bytes },
}

/// What is to be done with a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum RequestVerdict {
    /// It is new: serve it.
    Serve,
    /// It is being served; the answer goes to this sending as well.
    Wait,
    /// It was served.
    Answer(Bytes),
    /// Too many are known.
    Refuse,
}

impl ReplyCache {
    pub(super) fn admit(
        &mut self,
        key: RequestKey,
        asker: RequestOrigin,
        now: Instant,
    ) -> RequestVerdict {
        self.expire(now);
        match self.known.get_mut(&key) {
            Some(Stage::Answered { reply }) => return RequestVerdict::Answer(reply.clone()),
            Some(Stage::Serving { askers }) if askers.len() < ASKERS_MAX => {
                askers.push(asker);
                return RequestVerdict::Wait;
            }
            Some(Stage::Serving { .. }) => return RequestVerdict::Refuse,
            None => {}
        }
        if self.known.len() >= REQUESTS_MAX && !self.forget_oldest() {
            return RequestVerdict::Refuse;
        }
        self.known.insert(key, Stage::Serving { askers: vec![asker] });
        self.serving.insert(asker, key);
        RequestVerdict::Serve
    }

    /// The sending that was served is answered, with a reply or with an error. Answers who is to be
    /// told.
    pub(super) fn resolve(
        &mut self,
        asker: RequestOrigin,
        reply: Option<&GatherBuffer>,
        now: Instant,
    ) -> Vec<RequestOrigin> {
        let Some(key) = self.serving.remove(&asker) else { return vec![asker] };
        let askers = match self.known.remove(&key) {
            Some(Stage::Serving { askers }) => askers,
            _ => vec![asker],
        };
        if let Some(reply) = reply.filter(|reply| reply.len() <= BYTES_MAX) {
            self.bytes += reply.len();
            // In one piece: a blob may be a small part of what it keeps in memory.
            let reply = reply.clone().into_bytes();
            self.known.insert(key, Stage::Answered { reply });
            self.answered.insert((now, key));
            while self.bytes > BYTES_MAX && self.forget_oldest() {}
        }
        askers
    }

    /// Forgets replies to requests that are not sent again any more.
    pub(super) fn expire(&mut self, now: Instant) {
        while self.answered.first().is_some_and(|(at, _)| *at + REMEMBERED <= now) {
            self.forget_oldest();
        }
    }

    /// False if nothing is there that may be forgotten.
    fn forget_oldest(&mut self) -> bool {
        let Some((_, key)) = self.answered.pop_first() else { return false };
        if let Some(Stage::Answered { reply }) = self.known.remove(&key) {
            self.bytes -= reply.len();
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CALLER: NodeId = NodeId(7);

    fn key(sequence: u64) -> RequestKey {
        (CALLER, Incarnation(1), MessageId { sender: 3, sequence })
    }

    fn asker(epoch: u32, call: u64) -> RequestOrigin {
        (CALLER, SessionEpoch(epoch), call)
    }

    fn at(secs: u64) -> Instant {
        Instant::from_millis(secs * 1000)
    }

    #[test]
    fn a_request_is_served_once_and_every_sending_of_it_answered() {
        let mut requests = ReplyCache::default();
        assert_eq!(requests.admit(key(1), asker(1, 10), at(0)), RequestVerdict::Serve);
        assert_eq!(requests.admit(key(1), asker(2, 20), at(1)), RequestVerdict::Wait);

        let reply = Bytes::from_static(b"reply");
        let askers = requests.resolve(asker(1, 10), Some(&reply.clone().into()), at(2));

        assert_eq!(askers, [asker(1, 10), asker(2, 20)]);
        assert_eq!(requests.admit(key(1), asker(3, 30), at(3)), RequestVerdict::Answer(reply));
        let restarted = (CALLER, Incarnation(2), key(1).2);
        assert_eq!(requests.admit(restarted, asker(4, 1), at(3)), RequestVerdict::Serve);
    }

    #[test]
    fn a_request_that_failed_may_be_tried_again() {
        let mut requests = ReplyCache::default();
        requests.admit(key(1), asker(1, 10), at(0));
        assert_eq!(requests.resolve(asker(1, 10), None, at(1)), [asker(1, 10)]);
        assert_eq!(requests.admit(key(1), asker(1, 11), at(2)), RequestVerdict::Serve);
    }

    #[test]
    fn replies_are_forgotten_by_age_number_and_size_and_requests_in_service_never() {
        let mut requests = ReplyCache::default();
        requests.admit(key(0), asker(1, 0), at(0));
        let large = GatherBuffer::from(vec![0; BYTES_MAX / 4]);
        for n in 1..=6 {
            requests.admit(key(n), asker(1, n), at(n));
            requests.resolve(asker(1, n), Some(&large), at(n));
            assert!(requests.bytes <= BYTES_MAX);
        }
        assert_eq!(requests.admit(key(1), asker(2, 1), at(7)), RequestVerdict::Serve, "too much");
        assert!(matches!(requests.admit(key(6), asker(2, 6), at(7)), RequestVerdict::Answer(_)));
        assert_eq!(requests.admit(key(6), asker(2, 7), at(66)), RequestVerdict::Serve, "too old");
        assert_eq!(requests.admit(key(0), asker(2, 0), at(70)), RequestVerdict::Wait);

        for n in 100..100 + REQUESTS_MAX as u64 {
            requests.admit(key(n), asker(1, n), at(70));
        }
        assert_eq!(requests.known.len(), REQUESTS_MAX);
        assert_eq!(requests.admit(key(9999), asker(1, 9999), at(70)), RequestVerdict::Refuse);
    }
}
