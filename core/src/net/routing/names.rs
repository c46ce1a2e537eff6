//! Two nodes of one name: the one that is reached, and answers, stays.
//!
//! ```text
//!  A ─── B ─── C ─── A'      C reaches A over B when A' comes up beside it
//!  ◄─challenge─┤             an edge to A in C's advertisement, with an MTU of 0, as no link has
//!  ───answer──►├──taken──►   A's next advertisement, with a far greater sequence
//! ```
//!
//! A link with another incarnation of a node that is reached is not used: that incarnation waits.
//! If the reached one answers a challenge, the other is told so, and stops. If no path leads there
//! any more, or no answer has come within a second, ten on a narrow link, the other has the name.
//! Only a node that is there can answer: what an ended incarnation has said was said before.
//!
//! Where two halves of a network meet that have each a node of one name, both hear that another
//! incarnation advertises links in their name. Each answers by a greater sequence (RFC 2328, 13.4).
//! What an earlier incarnation has said is outdone so; a node that outdoes in return is there, and
//! the later incarnation of both stops.

use super::topology::{Adjacency, patience};
use super::{LinkStatus, Router, RouterOutput};
use crate::net::link::Neighbour;
use crate::net::wire::advertisement::{Advertisement, Edge};
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::{QUIET, REPORT_INTERVAL};
use crate::sorted::SortedMap;
use crate::{Incarnation, Instant, NodeName};
use std::time::Duration;

/// How far an answer is ahead: beyond all that the incarnation has said before, and elsewhere.
const AHEAD: u64 = 1 << 20;
/// So many times another incarnation is outdone before it must be there: what has been said before
/// may be heard from several parts of a network, one after the other.
const OUTDONE_TIMES: u8 = 3;
/// An answer takes no longer on fast links.
const ANSWER_WITHIN: Duration = Duration::from_secs(1);
/// A node that is refused is told so at this interval, and one that is there is outdone so often.
const TELL_INTERVAL: Duration = Duration::from_millis(100);

/// A link that is not used.
#[derive(Clone, Debug)]
pub(super) struct UnusedLink {
    status: LinkStatus,
    /// Which incarnation is challenged, and from which sequence on it has answered.
    challenged: Option<(Incarnation, u64)>,
    /// By when it must answer; `None` once that is over.
    decide_at: Option<Instant>,
    told_at: Instant,
    /// When the user was told of it last.
    reported_at: Option<Instant>,
}

/// Which names and numbers two nodes contend for.
#[derive(Debug, Default)]
pub(super) struct NameContest {
    /// Links to another node of a name, which are not used.
    pub(super) unused: SortedMap<LinkId, UnusedLink>,
    /// Which other incarnation advertises links in this node's name, how often it was outdone, and
    /// when last.
    outdone: Option<(Incarnation, u8, Instant)>,
    /// The last reported pair, and when, so that a collision is not reported with every flood.
    reported: Option<(NodeName, NodeName, Instant)>,
}

/// The incarnation that has a name.
#[derive(Clone, Copy)]
struct ReachedHolder {
    incarnation: Incarnation,
    /// The link with it; `None` where it is reached over other nodes.
    over: Option<LinkId>,
    /// How long its answer may take.
    patience: Duration,
}

impl NameContest {
    /// Whether it is to be reported that two nodes have one number.
    pub(super) fn is_new_conflict(
        &mut self,
        node: &NodeName,
        refused: &NodeName,
        now: Instant,
    ) -> bool {
        let known = self
            .reported
            .as_ref()
            .is_some_and(|(a, b, at)| (a, b) == (node, refused) && now < *at + REPORT_INTERVAL);
        if !known {
            self.reported = Some((node.clone(), refused.clone(), now));
        }
        !known
    }

    /// Notes that another incarnation is outdone now. Returns how often that was so; `None` while
    /// the last time is too short ago.
    fn count_outdone(&mut self, other: Incarnation, now: Instant) -> Option<u8> {
        let times = match self.outdone {
            Some((known, times, at)) if known == other && now < at + QUIET => {
                if times >= OUTDONE_TIMES && now < at + TELL_INTERVAL {
                    // It is said again in a moment, since it is not confirmed.
                    return None;
                }
                times.saturating_add(1)
            }
            _ => 1,
        };
        self.outdone = Some((other, times, now));
        Some(times)
    }

    /// When the next challenge is decided.
    pub(super) fn decide_at(&self) -> Option<Instant> {
        self.unused.values().filter_map(|unused| unused.decide_at).min()
    }
}

impl UnusedLink {
    /// The challenge, as this node's advertisement has it.
    pub(super) fn challenge(&self) -> Edge {
        let Neighbour { node, incarnation } = &self.status.neighbour;
        let incarnation = Edge::incarnation_tag(*incarnation);
        Edge { to: NodeId::of(node), incarnation, cost: 1, mtu: Edge::CHALLENGE }
    }
}

impl Router {
    /// The incarnation that has the neighbour's name, if it is another one and is reached by
    /// another link to it, or without any link of this node to that name.
    fn name_holder(&self, link: LinkId, neighbour: &Neighbour) -> Option<ReachedHolder> {
        if let Some((over, near)) = self.links_to_others(link, neighbour).next() {
            let (incarnation, over) = (near.neighbour.incarnation, Some(over));
            let patience = patience(near.mtu, ANSWER_WITHIN);
            return Some(ReachedHolder { incarnation, over, patience });
        }
        let id = NodeId::of(&neighbour.node);
        let incarnation = self.database.newest(id)?.incarnation;
        if incarnation == neighbour.incarnation {
            return None;
        }
        let others = self.links.iter().filter(|(_, adjacent)| adjacent.id != id);
        let others: SortedMap<_, _> = others.map(|(link, other)| (*link, other.clone())).collect();
        let routes = self.topology_over(&others).routes();
        let route = routes.get(&id)?;
        let patience = patience(route.mtu, ANSWER_WITHIN);
        Some(ReachedHolder { incarnation, over: None, patience })
    }

    /// Links to other incarnations of a link's neighbour.
    fn links_to_others<'a>(
        &'a self,
        link: LinkId,
        neighbour: &'a Neighbour,
    ) -> impl Iterator<Item = (LinkId, &'a Adjacency)> {
        let id = NodeId::of(&neighbour.node);
        let others = self.links.iter().map(|(other, near)| (*other, near));
        others.filter(move |(other, near)| {
            *other != link && near.id == id && near.neighbour.incarnation != neighbour.incarnation
        })
    }

    /// A link is used from now on: those to other incarnations of its neighbour, which have left a
    /// challenge unanswered, are not.
    pub(super) fn set_silent_aside(&mut self, link: LinkId) {
        let Some(used) = self.links.get(&link) else { return };
        let silent = self.links_to_others(link, &used.neighbour);
        let silent: Vec<_> = silent.map(|(other, near)| (other, status_of(near))).collect();
        silent.into_iter().for_each(|(other, status)| self.set_aside(other, status));
    }

    /// Does not use a link.
    pub(super) fn set_aside(&mut self, link: LinkId, status: LinkStatus) {
        self.links.remove(&link);
        match self.names.unused.get_mut(&link) {
            Some(unused) if unused.status.neighbour == status.neighbour => unused.status = status,
            _ => {
                let holder = self.name_holder(link, &status.neighbour);
                let decide_at = holder.map(|holder| self.now + holder.patience);
                self.wake_at = self.wake_at.min(decide_at.unwrap_or(self.now));
                let (told_at, reported_at) = (Instant::ORIGIN, None);
                let unused =
                    UnusedLink { status, challenged: None, decide_at, told_at, reported_at };
                self.names.unused.insert(link, unused);
                self.challenge(link);
                self.announce_links();
            }
        }
    }

    /// Challenges the incarnation that has the name of a link's neighbour, once it is known what it
    /// has said. Returns whether that is another one than was challenged before.
    fn challenge(&mut self, link: LinkId) -> bool {
        let Some(unused) = self.names.unused.get(&link) else { return false };
        let neighbour = &unused.status.neighbour;
        let holder = self.name_holder(link, neighbour);
        let known = self.database.newest(NodeId::of(&neighbour.node));
        let Some((holder, known)) = holder.zip(known) else { return false };
        let incarnation = holder.incarnation;
        let same = unused.challenged.is_some_and(|(of, _)| of == incarnation);
        if same || known.incarnation != incarnation {
            return false;
        }
        let answer = known.id.sequence.saturating_add(AHEAD);
        let decide_at = self.now + holder.patience;
        let Some(unused) = self.names.unused.get_mut(&link) else { return false };
        unused.challenged = Some((incarnation, answer));
        unused.decide_at = Some(decide_at);
        self.wake_at = self.wake_at.min(decide_at);
        true
    }

    /// Whether the incarnation that has a name has answered the challenge.
    fn has_answered(&self, unused: &UnusedLink, holder: Incarnation) -> bool {
        let known = self.database.newest(NodeId::of(&unused.status.neighbour.node));
        unused.challenged.zip(known).is_some_and(|((of, answer), newest)| {
            of == holder && newest.incarnation == holder && newest.id.sequence >= answer
        })
    }

    /// A node that advertises a challenge waits for an answer.
    pub(super) fn answer_challenge(&mut self, advertisement: &Advertisement) {
        let mut edges = advertisement.edges.iter();
        if edges.any(|edge| edge.to == self.database.id() && edge.mtu == Edge::CHALLENGE) {
            self.database.own.id.sequence = self.database.own.id.sequence.saturating_add(AHEAD);
            self.renew();
        }
    }

    /// The time of a challenge is over.
    pub(super) fn decide_challenges(&mut self) {
        let mut late = Vec::new();
        for (link, unused) in self.names.unused.iter_mut() {
            if unused.decide_at.take_if(|at| *at <= self.now).is_some() {
                late.push(*link);
            }
        }
        late.into_iter().for_each(|link| self.use_again(link));
    }

    /// Routes have changed: which links can be used again, and what is to be challenged?
    pub(super) fn use_links_again(&mut self) {
        let links: Vec<_> = self.names.unused.keys().copied().collect();
        for link in links {
            if self.challenge(link) {
                self.renew();
            }
            self.use_again(link);
        }
    }

    fn use_again(&mut self, link: LinkId) {
        let Some(unused) = self.names.unused.get(&link) else { return };
        let status = unused.status.clone();
        if !self.is_kept_out(link, &status.neighbour) {
            self.handle_link(link, status, self.now);
        }
    }

    /// Whether a link with this neighbour is not used, for its name's sake.
    pub(super) fn is_kept_out(&self, link: LinkId, neighbour: &Neighbour) -> bool {
        let Some(holder) = self.name_holder(link, neighbour) else { return false };
        let unused =
            self.names.unused.get(&link).filter(|unused| unused.status.neighbour == *neighbour);
        unused.is_none_or(|unused| {
            unused.decide_at.is_some() || self.has_answered(unused, holder.incarnation)
        })
    }

    /// A neighbour whose link is not used announces itself over and over. Once the challenge is
    /// answered, it is told so, and the user is.
    pub(super) fn handle_kept_out(&mut self, link: LinkId) {
        let now = self.now;
        let due = |unused: &&UnusedLink| unused.told_at + TELL_INTERVAL <= now;
        let Some(unused) = self.names.unused.get(&link).filter(due) else { return };
        let Neighbour { node, incarnation } = unused.status.neighbour.clone();
        let holder = self.name_holder(link, &unused.status.neighbour);
        let answered = |holder: &ReachedHolder| self.has_answered(unused, holder.incarnation);
        let Some(ReachedHolder { incarnation: by, over, .. }) = holder.filter(answered) else {
            return;
        };
        self.outputs.push_back(RouterOutput::Refuse { link, by, over });
        let Some(unused) = self.names.unused.get_mut(&link) else { return };
        unused.told_at = now;
        if unused.reported_at.is_none_or(|at| now >= at + REPORT_INTERVAL) {
            unused.reported_at = Some(now);
            self.outputs.push_back(RouterOutput::KeptOut { node, incarnation, by, link, over });
        }
    }

    /// An advertisement in this node's name that is as new as its own, and differs: of a router
    /// before this one, of an earlier incarnation, or of another node.
    pub(super) fn outdo(&mut self, theirs: &Advertisement) {
        let sequence = theirs.id.sequence;
        if theirs.incarnation == self.database.own.incarnation {
            // This router continues the count of the one before it.
            self.database.own.id.sequence = sequence;
            return self.renew();
        }
        let Some(times) = self.names.count_outdone(theirs.incarnation, self.now) else { return };
        if times > OUTDONE_TIMES && self.database.own.incarnation > theirs.incarnation {
            return self.outputs.push_back(RouterOutput::NameTaken { by: theirs.incarnation });
        }
        self.database.own.id.sequence = sequence.saturating_add(AHEAD);
        self.renew();
    }
}

pub(super) fn status_of(adjacent: &Adjacency) -> LinkStatus {
    let Adjacency { neighbour, cost, mtu, health, .. } = adjacent;
    let (neighbour, mtu) = (neighbour.clone(), usize::from(*mtu));
    LinkStatus { neighbour, health: *health, cost: *cost, mtu }
}
