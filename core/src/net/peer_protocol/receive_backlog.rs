//! Where messages of other nodes wait until their receivers have room.
//!
//! ```text
//!   sender's node                          receiver's node
//!      │ tell ──────────────────────────────► │  its queue is full: this one waits
//!      │ ◄───────────────────────── full 1    │  through binding 1
//!      │ tell ──────────────────────────────► │  was under way: waits behind it
//!      │ ◄───────────────────────── backlog 1    │  the last that waited has been taken
//! ```
//!
//! Each object has a line of its own for each peer, so that no message waits for another's
//! receiver. What a peer may have waiting is what its side can have under way before it has heard
//! that it is to stop. A peer that goes on after that loses the messages that do not fit, and they
//! are counted.

use crate::ObjectName;
use crate::net::wire::Refusals;
use crate::net::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use std::collections::VecDeque;

/// The messages of one peer that wait here at most: twice what its two ordered streams and the way
/// to them hold, once for what they hold when it is told to stop, and once for what follows until
/// it has heard.
pub const MESSAGES_MAX: usize = 20 * 1024;
/// Their bytes, likewise.
pub const BYTES_MAX: usize = 20 << 20;

/// Messages of all peers that wait for room, in order.
#[derive(Debug)]
pub struct ReceiveBacklog<T> {
    /// Peers of which something waits, or did not fit.
    peers: SortedMap<NodeId, PeerBacklog<T>>,
}

#[derive(Debug)]
struct PeerBacklog<T> {
    lines: SortedMap<ObjectName, Line<T>>,
    messages: usize,
    bytes: usize,
    refusals: Refusals,
}

#[derive(Debug)]
struct Line<T> {
    /// The binding by which the peer was told to stop.
    binding: u32,
    /// Each with its bytes; never empty.
    waiting: VecDeque<(T, usize)>,
}

/// What became of a message that was to wait.
#[derive(Debug, PartialEq, Eq)]
pub enum BacklogVerdict<T> {
    /// It is the first for this object: the peer is to be told to stop.
    First,
    /// It waits behind others.
    Behind,
    /// The peer has not heeded what it was told; there is no room for this any more.
    Refused(T),
}

impl<T> Default for ReceiveBacklog<T> {
    fn default() -> Self {
        ReceiveBacklog { peers: SortedMap::new() }
    }
}

impl<T> ReceiveBacklog<T> {
    /// Something of this peer waits for this object: what comes later waits behind it.
    pub fn is_waiting(&self, peer: NodeId, object: &ObjectName) -> bool {
        self.line(peer, object).is_some()
    }

    fn line(&self, peer: NodeId, object: &ObjectName) -> Option<&Line<T>> {
        self.peers.get(&peer)?.lines.get(object)
    }

    /// The object has no room for this message of so many bytes, which came through that binding.
    pub fn handle_full(
        &mut self,
        peer: NodeId,
        object: &ObjectName,
        binding: u32,
        message: T,
        bytes: usize,
    ) -> BacklogVerdict<T> {
        let backlog = self.peers.entry(peer).or_default();
        if backlog.messages >= MESSAGES_MAX || backlog.bytes + bytes > BYTES_MAX {
            backlog.refusals.too_large += 1;
            return BacklogVerdict::Refused(message);
        }
        backlog.messages += 1;
        backlog.bytes += bytes;
        if let Some(line) = backlog.lines.get_mut(object) {
            line.waiting.push_back((message, bytes));
            return BacklogVerdict::Behind;
        }
        let line = Line { binding, waiting: VecDeque::from([(message, bytes)]) };
        backlog.lines.insert(object.clone(), line);
        BacklogVerdict::First
    }

    /// The message that is next for this object.
    pub fn first(&self, peer: NodeId, object: &ObjectName) -> Option<&T> {
        let (message, _) = self.line(peer, object)?.waiting.front()?;
        Some(message)
    }

    /// That message does not wait any more. Answers the binding by which the peer is to be told to
    /// go on, if it was the last.
    pub fn handle_taken(&mut self, peer: NodeId, object: &ObjectName) -> Option<u32> {
        let backlog = self.peers.get_mut(&peer)?;
        let line = backlog.lines.get_mut(object)?;
        if let Some((_, bytes)) = line.waiting.pop_front() {
            backlog.messages -= 1;
            backlog.bytes -= bytes;
        }
        if !line.waiting.is_empty() {
            return None;
        }
        let line = backlog.lines.remove(object)?;
        Some(line.binding)
    }

    /// The session with this peer is over. Answers what waited, in order for each object.
    pub fn handle_ended(&mut self, peer: NodeId) -> impl Iterator<Item = (ObjectName, T)> + use<T> {
        let lines = self.peers.remove(&peer).map(|backlog| backlog.lines).unwrap_or_default();
        lines.into_iter().flat_map(|(object, line)| {
            line.waiting.into_iter().map(move |(message, _)| (object.clone(), message))
        })
    }

    /// What did not fit, by peer.
    pub fn refusals(&self) -> impl Iterator<Item = (NodeId, Refusals)> {
        self.peers.iter().map(|(peer, backlog)| (*peer, backlog.refusals))
    }
}

impl<T> Default for PeerBacklog<T> {
    fn default() -> Self {
        let refusals = Refusals::default();
        PeerBacklog { lines: SortedMap::new(), messages: 0, bytes: 0, refusals }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::object;

    const PEER: NodeId = NodeId(1);
    const OTHER: NodeId = NodeId(2);

    fn fill(backlog: &mut ReceiveBacklog<usize>, bytes: usize) -> usize {
        let arm = object("arm");
        let mut admit = |n: &usize| backlog.handle_full(PEER, &arm, 7, *n, bytes);
        (0..100_000).take_while(|n| !matches!(admit(n), BacklogVerdict::Refused(_))).count()
    }

    #[test]
    fn each_object_has_its_line_and_the_peer_is_told_once_at_either_end() {
        let mut backlog = ReceiveBacklog::default();
        let (arm, leg) = (object("arm"), object("leg"));

        assert_eq!(backlog.handle_full(PEER, &arm, 7, 1, 10), BacklogVerdict::First);
        assert_eq!(backlog.handle_full(PEER, &arm, 8, 2, 10), BacklogVerdict::Behind);
        assert_eq!(backlog.handle_full(OTHER, &arm, 7, 3, 10), BacklogVerdict::First);
        assert!(backlog.is_waiting(PEER, &arm) && !backlog.is_waiting(PEER, &leg));

        assert_eq!(backlog.first(PEER, &arm), Some(&1));
        assert_eq!(backlog.handle_taken(PEER, &arm), None);
        assert_eq!(backlog.first(PEER, &arm), Some(&2));
        assert_eq!(backlog.handle_taken(PEER, &arm), Some(7), "by the binding that was stopped");
        assert!(!backlog.is_waiting(PEER, &arm) && backlog.is_waiting(OTHER, &arm));
        assert_eq!(backlog.first(PEER, &arm), None);
        assert_eq!(backlog.handle_taken(PEER, &arm), None);
        assert_eq!(backlog.handle_full(PEER, &arm, 8, 4, 10), BacklogVerdict::First);
    }

    #[test]
    fn a_peer_that_does_not_stop_is_refused_and_counted_and_others_are_not() {
        for (bytes, fits) in [(0, MESSAGES_MAX), (1 << 20, BYTES_MAX >> 20)] {
            let mut backlog = ReceiveBacklog::default();

            assert_eq!(fill(&mut backlog, bytes), fits);
            assert_eq!(fill(&mut backlog, bytes), 0);

            let too_large = |(peer, refusals): (NodeId, Refusals)| (peer, refusals.too_large);
            assert_eq!(backlog.refusals().map(too_large).collect::<Vec<_>>(), [(PEER, 2)]);
            assert_eq!(
                backlog.handle_full(OTHER, &object("arm"), 7, 0, bytes),
                BacklogVerdict::First
            );
            backlog.handle_taken(PEER, &object("arm"));
            assert_eq!(fill(&mut backlog, bytes), 1, "what was taken makes room");
        }
    }

    #[test]
    fn the_end_of_a_session_hands_out_what_waited_and_leaves_nothing() {
        let mut backlog = ReceiveBacklog::default();
        let (arm, leg) = (object("arm"), object("leg"));
        for (n, object) in [(1, &leg), (2, &arm), (3, &leg)] {
            backlog.handle_full(PEER, object, 7, n, 10);
        }

        let left: Vec<_> = backlog.handle_ended(PEER).collect();

        assert_eq!(left, [(arm, 2), (leg.clone(), 1), (leg.clone(), 3)]);
        assert_eq!(backlog.refusals().count(), 0);
        assert_eq!(backlog.handle_full(PEER, &leg, 7, 4, 10), BacklogVerdict::First);
    }
}
