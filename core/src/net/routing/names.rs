//! Two nodes of one name: the one that is reached keeps it.
//!
//! ```text
//!  A ─── B ─── C ─── A'      C reaches A over B when A' comes up beside it
//!              C ──taken──► A'   the link with A' is not used while A is reached
//! ```
//!
//! A restarted node has its name as soon as no path leads to its old incarnation: the links that
//! led there have told of its end. Where two links of this node lead to two incarnations of another
//! one, on two networks, this node challenges the first by a new advertisement. If the first
//! confirms it within a second, ten on a narrow link, it keeps the name; if not, the second has it.
//!
//! Where two halves of a network meet that have each a node of one name, both hear that another
//! incarnation advertises links in their name. Each outdoes the other (RFC 2328, 13.4). What an
//! earlier incarnation has said is outdone once; a node that outdoes in return is there. Then the
//! later incarnation uses no link for ten seconds, and its neighbours keep it out from then on.

use super::topology::Adjacency;
use super::{LinkStatus, Router, RouterAlarm, RouterOutput};
use crate::net::active_alarms::QUIET;
use crate::net::link::Neighbour;
use crate::net::wire::advertisement::{Advertisement, RoutingMessage};
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::sorted::SortedMap;
use crate::{Incarnation, Instant};
use std::time::Duration;

/// How far what another incarnation has said is outdone: beyond all that it said elsewhere.
const OUTDONE_BY: u64 = 1 << 20;
/// So many times another incarnation is outdone before it must be there: what has been said before
/// may be heard from several parts of a network, one after the other.
const OUTDONE_TIMES: u8 = 3;
/// A restarted node is kept out for less: until its neighbours know of the restart.
const RESTARTED_WITHIN: Duration = Duration::from_secs(1);
/// Who is kept out hears of it so often, and a node that is there is outdone so often.
const TELL_INTERVAL: Duration = Duration::from_millis(100);
/// How long the later of two nodes uses no link: what both have said has spread by then.
const YIELDS_FOR: Duration = Duration::from_secs(10);

/// A link that is not used.
#[derive(Clone, Debug)]
pub(super) struct UnusedLink {
    status: LinkStatus,
    since: Instant,
    /// The sequence of this node's advertisement that the other incarnation must confirm, and by
    /// when; `None` once that is decided, and where no link leads to the other one.
    challenge: u64,
    decide_at: Option<Instant>,
    told_at: Instant,
    is_reported: bool,
}

/// What is known of other nodes with this one's name.
#[derive(Debug, Default)]
pub(super) struct Namesakes {
    /// Which advertises links in this node's name, how often it was outdone, and when last.
    outdone: Option<(Incarnation, u8, Instant)>,
    /// Which is reached by the neighbours, since when they say so, and when they did last.
    taken: Option<(Incarnation, Instant, Instant)>,
    /// The last fault that was reported, so that it is reported once.
    reported: Option<Incarnation>,
    /// Until when this node uses no link.
    pub(super) yields_until: Option<Instant>,
}

impl Router {
    /// The incarnation that has the neighbour's name, if it is another one and is reached by
    /// another link to it, or without any link of this node to that name.
    fn name_holder(&self, link: LinkId, neighbour: &Neighbour) -> Option<Incarnation> {
        if let Some(direct) = self.direct_holder(link, neighbour) {
            return Some(direct);
        }
        let id = NodeId::of(&neighbour.node);
        let held = self.known.get(&id)?.advertisement.incarnation;
        if held == neighbour.incarnation {
            return None;
        }
        let others = self.links.iter().filter(|(_, adjacent)| adjacent.id != id);
        let others: SortedMap<_, _> = others.map(|(link, other)| (*link, other.clone())).collect();
        let is_reached = self.topology_over(&others).routes().contains_key(&id);
        is_reached.then_some(held)
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

    /// The other incarnation of a link's neighbour to which another link leads, unless it has left
    /// a challenge unanswered.
    fn direct_holder(&self, link: LinkId, neighbour: &Neighbour) -> Option<Incarnation> {
        let unused = self.unused.get(&link).filter(|unused| unused.status.neighbour == *neighbour);
        let counts = |near: &Adjacency| {
            unused.is_none_or(|unused| {
                unused.decide_at.is_some() || near.confirmed >= unused.challenge
            })
        };
        let mut others = self.links_to_others(link, neighbour);
        let holder = others.find(|(_, near)| counts(near))?;
        Some(holder.1.neighbour.incarnation)
    }

    /// A link is used from now on: those to other incarnations of its neighbour, which have left a
    /// challenge unanswered, are not.
    pub(super) fn set_silent_aside(&mut self, link: LinkId) {
        let Some(used) = self.links.get(&link) else { return };
        let silent = self.links_to_others(link, &used.neighbour);
        let silent: Vec<_> = silent.map(|(other, near)| (other, status_of(near))).collect();
        silent.into_iter().for_each(|(other, status)| self.set_aside(other, status));
    }

    /// The time of a challenge is over.
    pub(super) fn decide_challenges(&mut self) {
        let now = self.now;
        for unused in self.unused.values_mut() {
            unused.decide_at = unused.decide_at.filter(|at| *at > now);
        }
        self.use_links_again();
    }

    /// Does not use a link.
    pub(super) fn set_aside(&mut self, link: LinkId, status: LinkStatus) {
        if self.links.remove(&link).is_some() {
            self.announce_links();
        }
        match self.unused.get_mut(&link) {
            Some(unused) if unused.status.neighbour == status.neighbour => unused.status = status,
            _ => {
                let (since, told_at, is_reported) = (self.now, Instant::ORIGIN, false);
                let others = self.links_to_others(link, &status.neighbour);
                let wait = others.map(|(_, near)| near.patience(RESTARTED_WITHIN)).max();
                let decide_at = wait.map(|wait| since + wait);
                if let Some(at) = decide_at {
                    self.renew();
                    self.wake_at = self.wake_at.min(at);
                }
                let challenge = self.own.id.sequence;
                let unused =
                    UnusedLink { status, since, challenge, decide_at, told_at, is_reported };
                self.unused.insert(link, unused);
            }
        }
    }

    /// Notes which links lead to another incarnation than their node is announced in.
    pub(super) fn look_for_namesakes(&mut self) {
        for adjacent in self.links.values_mut() {
            let known = self.known.get(&adjacent.id).map(|known| known.advertisement.incarnation);
            if known.is_none_or(|known| known == adjacent.neighbour.incarnation) {
                adjacent.differs_since = None;
            } else {
                let since = *adjacent.differs_since.get_or_insert(self.now);
                self.wake_at = self.wake_at.min(since + RESTARTED_WITHIN);
            }
        }
    }

    pub(super) fn set_aside_due(&self) -> Option<Instant> {
        let since = self.links.values().filter_map(|adjacent| adjacent.differs_since);
        since.min().map(|since| since + RESTARTED_WITHIN)
    }

    pub(super) fn challenge_due(&self) -> Option<Instant> {
        self.unused.values().filter_map(|unused| unused.decide_at).min()
    }

    /// Sets aside the links that have led to another incarnation for so long, where the announced
    /// one is reached.
    pub(super) fn set_namesakes_aside(&mut self) {
        let now = self.now;
        let mut others = Vec::new();
        for (link, adjacent) in self.links.iter_mut() {
            if adjacent.differs_since.is_some_and(|since| since + RESTARTED_WITHIN <= now) {
                adjacent.differs_since = Some(now);
                others.push((*link, status_of(adjacent)));
            }
        }
        for (link, status) in others {
            if self.name_holder(link, &status.neighbour).is_some() {
                self.set_aside(link, status);
            }
        }
    }

    /// Routes have changed: which links can be used again?
    pub(super) fn use_links_again(&mut self) {
        let unused = &self.unused;
        let is_free = |link, unused: &UnusedLink| !self.is_kept_out(link, &unused.status.neighbour);
        let free = unused.iter().filter(|(link, unused)| is_free(**link, unused));
        let free: Vec<_> = free.map(|(link, unused)| (*link, unused.status.clone())).collect();
        for (link, status) in free {
            self.handle_link(link, status, self.now);
        }
    }

    /// Whether a link with this neighbour is not used, for its name's sake or our own's.
    ///
    /// With keys the neighbour has proved who it is, and an advertisement may be a replay: the link
    /// is used until it has led for a second to another incarnation than the one that outdoes it,
    /// unless another link leads to the other one.
    pub(super) fn is_kept_out(&self, link: LinkId, neighbour: &Neighbour) -> bool {
        let is_judged = self.keys.is_none() || self.unused.contains_key(&link);
        self.namesakes.yields_until.is_some()
            || self.direct_holder(link, neighbour).is_some()
            || is_judged && self.name_holder(link, neighbour).is_some()
    }

    /// A neighbour whose link is not used announces itself over and over: it is told why, and after
    /// a while the user is.
    pub(super) fn handle_kept_out(&mut self, link: LinkId) {
        let now = self.now;
        // Only an answered challenge is a reason to tell it.
        let is_decided = |unused: &&UnusedLink| unused.decide_at.is_none_or(|at| at <= now);
        let due = |unused: &&UnusedLink| unused.told_at + TELL_INTERVAL <= now;
        let Some(unused) = self.unused.get(&link).filter(is_decided).filter(due) else { return };
        let Neighbour { node, incarnation } = unused.status.neighbour.clone();
        let is_lasting = unused.since + RESTARTED_WITHIN <= now;
        let Some(by) = self.name_holder(link, &unused.status.neighbour) else { return };
        let bytes = RoutingMessage::Taken { by }.encode();
        self.outputs.push_back(RouterOutput::Routing { link, bytes });
        self.go_on(RouterAlarm::NameTaken);
        let Some(unused) = self.unused.get_mut(&link) else { return };
        unused.told_at = now;
        if is_lasting && !std::mem::replace(&mut unused.is_reported, true) {
            self.begin_trouble(RouterAlarm::NameTaken);
            self.outputs.push_back(RouterOutput::KeptOut { node, incarnation, by });
        }
    }

    /// A neighbour does not use its link with this node, since it reaches another of its name.
    pub(super) fn handle_taken(&mut self, by: Incarnation) {
        if by == self.incarnation() {
            self.refusals.unexpected += 1;
            return;
        }
        let now = self.now;
        let goes_on = |&(other, _, last): &(Incarnation, Instant, Instant)| {
            other == by && now < last + RESTARTED_WITHIN / 2
        };
        let since = self.namesakes.taken.filter(goes_on).map_or(now, |(_, since, _)| since);
        self.namesakes.taken = Some((by, since, now));
        if since + RESTARTED_WITHIN <= now {
            self.report_namesake(by, false);
        }
    }

    /// An advertisement in this node's name that is as new as its own, and differs: of a router
    /// before this one, of an earlier incarnation, or of another node. Returns whether ours is
    /// newer now.
    pub(super) fn outdo(&mut self, theirs: &Advertisement) {
        let sequence = theirs.id.sequence;
        if theirs.incarnation == self.incarnation() {
            // This router continues the count of the one before it.
            self.own.id.sequence = sequence;
            return self.renew();
        }
        let times = match self.namesakes.outdone {
            Some((other, times, at)) if other == theirs.incarnation && self.now < at + QUIET => {
                if times >= OUTDONE_TIMES && self.now < at + TELL_INTERVAL {
                    // It is said again in a moment, since it is not confirmed.
                    return;
                }
                times.saturating_add(1)
            }
            _ => 1,
        };
        self.namesakes.outdone = Some((theirs.incarnation, times, self.now));
        if times > OUTDONE_TIMES {
            let is_first = self.incarnation() < theirs.incarnation;
            self.report_namesake(theirs.incarnation, is_first);
            if !is_first {
                return self.yield_name();
            }
        }
        self.own.id.sequence = sequence.saturating_add(OUTDONE_BY);
        self.renew();
    }

    fn report_namesake(&mut self, incarnation: Incarnation, first: bool) {
        self.go_on(RouterAlarm::NameTaken);
        if self.namesakes.reported != Some(incarnation) {
            self.namesakes.reported = Some(incarnation);
            self.begin_trouble(RouterAlarm::NameTaken);
            self.outputs.push_back(RouterOutput::NameTaken { incarnation, first });
        }
    }

    fn yield_name(&mut self) {
        let until = self.now + YIELDS_FOR;
        self.wake_at = self.wake_at.min(until);
        (self.namesakes.yields_until, self.namesakes.outdone) = (Some(until), None);
        let links: Vec<_> = self.links.iter().map(|(link, a)| (*link, status_of(a))).collect();
        for (link, status) in links {
            self.links.remove(&link);
            self.set_aside(link, status);
        }
        self.announce_links();
    }

    pub(super) fn end_yield(&mut self) {
        self.namesakes.yields_until = None;
        self.use_links_again();
    }

    /// Nothing was heard of it for a minute: what begins again is told of again.
    pub(super) fn forget_namesakes(&mut self) {
        let yields_until = self.namesakes.yields_until;
        self.namesakes = Namesakes { yields_until, ..Namesakes::default() };
        self.unused.values_mut().for_each(|unused| unused.is_reported = false);
    }
}

fn status_of(adjacent: &Adjacency) -> LinkStatus {
    let Adjacency { neighbour, cost, mtu, health, .. } = adjacent;
    let (neighbour, mtu) = (neighbour.clone(), usize::from(*mtu));
    LinkStatus { neighbour, health: *health, cost: *cost, mtu }
}
