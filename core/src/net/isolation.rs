//! Nodes that cannot be recovered: what they send is refused everywhere.
//!
//! Every node has one vote on every other node, and is believed about its own vote alone: what it
//! says comes over the session with it. Whose votes count is the same for all nodes of a robot:
//!
//! ```text
//! majority (unless said otherwise)   more than half of the nodes that are there, without the accused
//! wardens                            the newest word of any of the nodes that are named
//! ```
//!
//! Whatever the others think, a node's own vote holds for itself at once: no node must take what it
//! takes for wrong. So one hostile node shuts out itself alone, and half of them no other node; and
//! a node whose neighbours all refuse it is cut off, however few they are among the others.
//!
//! Votes are told to every node that a session is open with, and again whenever a session begins.
//! Those of a node that is kept out are void.

use super::wire::node_id::NodeId;
use crate::contract::codec;
use crate::sorted::{SortedMap, SortedSet};
use crate::{Incarnation, NodeName};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Nodes that one node may have voted on, at most: a quarter of what a router knows, and more than
/// anyone has reason to.
const VOTES_MAX: usize = 64;
/// Nodes whose votes are remembered, at most: as many as sessions are.
const VOTERS_MAX: usize = 512;
/// The most bytes of one message: all votes of one node.
const MESSAGE_MAX: usize = 64 * 1024;
/// The most letters of a cause.
const CAUSE_MAX: usize = 200;

/// Whose votes count.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IsolationAuthority {
    /// More than half of the nodes that are there, without the accused and these, which have no
    /// vote.
    MajorityWithout(SortedSet<NodeName>),
    /// The newest word of any of these, whatever the others think.
    Named(SortedSet<NodeName>),
}

impl Default for IsolationAuthority {
    fn default() -> Self {
        IsolationAuthority::MajorityWithout(SortedSet::new())
    }
}

/// What this node thinks of another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct IsolationDecision<'a> {
    /// Of which.
    pub node: &'a NodeName,
    /// It is to be kept out, or to be let in again.
    pub isolated: bool,
    /// Why.
    pub cause: &'a str,
}

/// Why this node has no say on another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum VoteRefused {
    /// It is this node itself.
    Oneself,
    /// It has voted on so many already.
    TooMany {
        /// How many.
        limit: usize,
    },
}

/// What is to be done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IsolationOutput {
    /// Tell another node.
    Tell {
        /// Whom.
        to: NodeName,
        /// What.
        message: Bytes,
    },
    /// From now on nothing is taken from this node and nothing sent there, or all is well again.
    Isolate {
        /// Which.
        node: NodeName,
        /// Whether it is isolated.
        isolated: bool,
        /// Who decided, and why.
        reason: String,
    },
    /// A node wants it isolated, and not enough others do.
    Accused {
        /// Which.
        node: NodeName,
        /// Who wants it, and why.
        reason: String,
    },
}

/// What one node thinks of another.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Vote {
    isolated: bool,
    /// The voter's incarnation, and which of its votes: of two of one incarnation, the greater is
    /// the newer. With another incarnation it was restarted, whichever number is greater: only its
    /// present incarnation has a session.
    incarnation: Incarnation,
    /// Higher than every vote on that node that the voter knew of and that counts beside its own:
    /// no other node can use up the numbers.
    revision: u64,
    /// Its place among all votes that this node has heard.
    heard: u64,
    cause: String,
}

/// A node's votes as it tells them.
#[derive(Debug, Serialize, Deserialize)]
struct Ballot {
    incarnation: Incarnation,
    votes: Vec<(NodeName, bool, u64, String)>,
}

/// Who is kept out, as one node knows it.
#[derive(Debug)]
pub struct Isolation {
    own: NodeName,
    incarnation: Incarnation,
    judges: IsolationAuthority,
    /// By whom they are about, and whose they are.
    votes: SortedMap<NodeName, SortedMap<NodeName, Vote>>,
    isolated: SortedSet<NodeName>,
    peers: SortedSet<NodeName>,
    heard: u64,
    refused: u64,
    outputs: VecDeque<IsolationOutput>,
}

impl Isolation {
    /// No votes yet.
    pub fn new(own: NodeName, incarnation: Incarnation, judges: IsolationAuthority) -> Self {
        Isolation {
            own,
            incarnation,
            judges,
            votes: SortedMap::new(),
            isolated: SortedSet::new(),
            peers: SortedSet::new(),
            heard: 0,
            refused: 0,
            outputs: VecDeque::new(),
        }
    }

    /// From now on the word of others counts.
    pub fn handle_authority(&mut self, judges: IsolationAuthority) {
        self.judges = judges;
        self.settle();
    }

    /// The next thing to do, in order.
    pub fn poll_output(&mut self) -> Option<IsolationOutput> {
        self.outputs.pop_front()
    }

    /// Whether nothing is taken from this node.
    pub fn is_isolated(&self, node: &NodeName) -> bool {
        self.isolated.contains(node)
    }

    /// The node of this number, if a session with it is open.
    pub fn peer(&self, id: NodeId) -> Option<NodeName> {
        self.peers.iter().find(|peer| NodeId::of(peer) == id).cloned()
    }

    /// What was refused: nonsense, too much, and what isolated nodes said.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// Whether it has a session with this node, or a node has voted on it.
    pub fn knows(&self, node: &NodeName) -> bool {
        self.peers.contains(node) || self.votes.contains_key(node) || self.is_isolated(node)
    }

    /// This node decides.
    ///
    /// # Errors
    /// It has no say on this one.
    pub fn handle_decision(
        &mut self,
        IsolationDecision { node, isolated, cause }: IsolationDecision<'_>,
    ) -> Result<(), VoteRefused> {
        if *node == self.own {
            return Err(VoteRefused::Oneself);
        }
        let own = self.votes.get(node).and_then(|votes| votes.get(&self.own));
        if own.is_some_and(|vote| vote.isolated && isolated) && self.is_isolated(node) {
            return Ok(());
        }
        if own.is_none() && !self.can_admit_voter(&self.own.clone()) {
            self.refused += 1;
            return Err(VoteRefused::TooMany { limit: VOTES_MAX });
        }
        let judges = &self.judges;
        let counts = |(voter, vote): (&NodeName, &Vote)| {
            let is_warden = matches!(judges, IsolationAuthority::Named(all) if all.contains(voter));
            (is_warden || *voter == self.own).then_some(vote.revision)
        };
        // That it is admitted is said even where no node is known to have objected: an earlier
        // incarnation of this node may have.
        let newest = self.votes.get(node).into_iter().flatten().filter_map(counts).max();
        let revision = newest.unwrap_or(0).saturating_add(1);
        let (own, incarnation) = (self.own.clone(), self.incarnation);
        self.keep(node, own, (isolated, incarnation, revision, cause));
        let message = self.ballot(|about| about == node);
        for to in self.peers.iter().filter(|peer| *peer != node) {
            let (to, message) = (to.clone(), message.clone());
            self.outputs.push_back(IsolationOutput::Tell { to, message });
        }
        self.settle();
        self.tell_accused(node);
        Ok(())
    }

    /// A session with this node has begun.
    pub fn handle_opened(&mut self, node: NodeName) {
        let votes = self.votes.iter().filter(|(about, _)| **about != node);
        let any = votes.into_iter().any(|(_, votes)| votes.contains_key(&self.own));
        if any && !self.is_isolated(&node) {
            let message = self.ballot(|about| *about != node);
            self.outputs.push_back(IsolationOutput::Tell { to: node.clone(), message });
        }
        self.peers.insert(node);
        self.settle();
    }

    /// The session with this node has ended.
    pub fn handle_ended(&mut self, node: &NodeName) {
        self.peers.remove(node);
        self.settle();
    }

    /// Another node tells its votes, over the session with it.
    pub fn handle_ballot(&mut self, from: &NodeName, message: &[u8]) {
        let ballot = codec::decode_bounded::<Ballot, MESSAGE_MAX>(message);
        let (Ok(Ballot { incarnation, votes }), false) = (ballot, self.is_isolated(from)) else {
            self.refused += 1;
            return;
        };
        let mut crowded = self.count_of(from) == 0 && self.voters().len() >= VOTERS_MAX;
        for (node, isolated, revision, cause) in votes {
            if node == self.own {
                // It is for the others to keep this node out.
                continue;
            }
            let is_new = self.votes.get(&node).is_none_or(|votes| !votes.contains_key(from));
            // What is too much once is so for the rest of the message, and not sought again.
            crowded |= node != *from && is_new && !crowded && !self.can_admit_voter(from);
            let known = self.votes.get(&node).and_then(|votes| votes.get(from));
            if node == *from || crowded {
                self.refused += 1;
            } else if known
                .is_none_or(|known| incarnation != known.incarnation || revision > known.revision)
            {
                self.keep(&node, from.clone(), (isolated, incarnation, revision, &cause));
                self.settle();
                self.tell_accused(&node);
            }
        }
    }

    fn keep(
        &mut self,
        node: &NodeName,
        voter: NodeName,
        (isolated, incarnation, revision, cause): (bool, Incarnation, u64, &str),
    ) {
        self.heard += 1;
        let cause = cause.chars().take(CAUSE_MAX).collect();
        let vote = Vote { isolated, incarnation, revision, heard: self.heard, cause };
        self.votes.entry(node.clone()).or_default().insert(voter, vote);
    }

    /// This node's own votes, on these nodes.
    fn ballot(&self, on: impl Fn(&NodeName) -> bool) -> Bytes {
        let own = |(about, votes): (&NodeName, &SortedMap<NodeName, Vote>)| {
            let vote = votes.get(&self.own).filter(|_| on(about))?;
            Some((about.clone(), vote.isolated, vote.revision, vote.cause.clone()))
        };
        let votes = self.votes.iter().filter_map(own).collect();
        codec::encode_unbounded(&Ballot { incarnation: self.incarnation, votes }).into()
    }

    /// Whether this one may vote on one more. Its vote that a node is admitted, where no node says
    /// otherwise any more, gives way.
    fn can_admit_voter(&mut self, voter: &NodeName) -> bool {
        if self.count_of(voter) < VOTES_MAX {
            return true;
        }
        let is_spent = |votes: &SortedMap<NodeName, Vote>| {
            votes.contains_key(voter) && votes.values().all(|vote| !vote.isolated)
        };
        let spent = self.votes.iter().find(|(_, votes)| is_spent(votes)).map(|(about, _)| about);
        let spent = spent.cloned().and_then(|about| self.votes.get_mut(&about));
        spent.is_some_and(|votes| votes.remove(voter).is_some())
    }

    fn count_of(&self, voter: &NodeName) -> usize {
        self.votes.values().filter(|votes| votes.contains_key(voter)).count()
    }

    fn voters(&self) -> SortedSet<&NodeName> {
        self.votes.values().flat_map(SortedMap::keys).collect()
    }

    /// Judges everybody on whom there are votes, until nothing changes any more.
    fn settle(&mut self) {
        // An isolated node takes its votes along: each turn leaves fewer.
        while let Some(node) = self.misjudged() {
            let isolated = !self.is_isolated(&node);
            let reason = self.reason(&node, isolated);
            if isolated {
                self.isolated.insert(node.clone());
                self.votes.values_mut().for_each(|votes| drop(votes.remove(&node)));
            } else {
                self.isolated.remove(&node);
            }
            self.outputs.push_back(IsolationOutput::Isolate { node, isolated, reason });
        }
        self.votes.retain(|_, votes| !votes.is_empty());
    }

    fn misjudged(&self) -> Option<NodeName> {
        let wrong = |node: &&NodeName| self.judge(node) != self.is_isolated(node);
        self.votes.keys().chain(&self.isolated).find(wrong).cloned()
    }

    fn judge(&self, node: &NodeName) -> bool {
        let Some(votes) = self.votes.get(node) else { return false };
        match &self.judges {
            IsolationAuthority::Named(wardens) => {
                let words = votes.iter().filter(|(voter, _)| wardens.contains(*voter));
                let newest = words.max_by_key(|(voter, vote)| (vote.revision, *voter));
                let newest = newest.map(|(_, vote)| vote);
                // The word of a node that is no warden holds for itself, until it hears a warden's.
                let own = votes.get(&self.own).filter(|_| !wardens.contains(&self.own));
                let last = own.into_iter().chain(newest).max_by_key(|vote| vote.heard);
                last.is_some_and(|vote| vote.isolated)
            }
            IsolationAuthority::MajorityWithout(guests) => {
                let here = self.peers.iter().chain([&self.own]).chain(votes.keys());
                let here = here.filter(|voter| *voter != node && !guests.contains(*voter));
                let here: SortedSet<_> = here.filter(|voter| !self.is_isolated(voter)).collect();
                let many = |says: &dyn Fn(&&Vote) -> bool| {
                    let votes = votes.iter().filter(|(voter, _)| !guests.contains(*voter));
                    votes.map(|(_, vote)| vote).filter(says).count() * 2 > here.len()
                };
                match votes.get(&self.own) {
                    // What was said of it before does not outdo it.
                    Some(own) if own.isolated => {
                        !many(&|vote| !vote.isolated && vote.heard > own.heard)
                    }
                    _ => many(&|vote| vote.isolated),
                }
            }
        }
    }

    /// Whose votes say so, and what the newest gives for its cause.
    fn reason(&self, node: &NodeName, isolated: bool) -> String {
        let votes = self.votes.get(node).into_iter().flatten();
        let votes: Vec<_> = votes.filter(|(_, vote)| vote.isolated == isolated).collect();
        let names: Vec<_> = votes.iter().map(|(voter, _)| voter.as_str()).collect();
        let newest = votes.iter().max_by_key(|(_, vote)| vote.revision);
        let cause = newest.map_or("", |(_, vote)| vote.cause.as_str());
        format!("by {}: {cause}", names.join(", "))
    }

    fn tell_accused(&mut self, node: &NodeName) {
        let accused = self.votes.get(node).is_some_and(|votes| votes.values().any(|v| v.isolated));
        if accused && !self.is_isolated(node) {
            let (node, reason) = (node.clone(), self.reason(node, true));
            self.outputs.push_back(IsolationOutput::Accused { node, reason });
        }
    }
}

#[cfg(test)]
mod tests;
