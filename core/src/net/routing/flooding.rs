//! Announcements: told to every neighbour until it confirms them, compared, outdone.

use super::{DatabaseEntry, Router, RouterAlarm, RouterOutput};
use crate::net::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, HAVE_HEADER, ID_LENGTH, NEIGHBOURS_MAX, RoutingMessage,
};
use crate::net::wire::frame::FRAME_HEADER;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::sorted::{SortedMap, SortedSet};
use crate::{Incarnation, NodeName};
use std::time::Duration;

/// How long what was said before a withdrawal counts: what is true follows at once, and no session
/// must notice.
const BELIEF: Duration = Duration::from_millis(50);
/// Above this a number is not outdone but withdrawn: ours must not come to those that were. Half a
/// year of counting is left.
const JUMP_MAX: u32 = u32::MAX - (1 << 20);
/// How many withdrawals of a node are remembered: the echo of one is no news, and what it took back
/// is not taken again. Of more lies at once, some are withdrawn again.
const WITHDRAWN_MAX: usize = 8;
/// Lies in our name within this time that are no accident, and how many.
const FORGED_PERIOD: Duration = Duration::from_secs(10);
const FORGED_MANY: u32 = 3;

impl Router {
    /// Our own links have changed: everybody must know.
    pub(super) fn announce_links(&mut self) {
        let mut edges: SortedMap<NodeId, Edge> = SortedMap::new();
        for adjacent in self.links.values() {
            let edge = Edge {
                to: adjacent.id,
                incarnation: Edge::incarnation_tag(adjacent.neighbour.incarnation),
                cost: adjacent.cost,
                mtu: adjacent.mtu,
            };
            let best = edges.entry(edge.to).or_insert(edge);
            if edge.cost < best.cost {
                *best = edge;
            }
        }
        self.own.edges = edges.into_values().take(NEIGHBOURS_MAX).collect();
        self.outdate();
        self.renew();
    }

    pub(super) fn renew(&mut self) {
        if self.own.id.sequence == u32::MAX {
            return self.begin_anew(self.own.withdrawal());
        }
        self.own.id.sequence += 1;
        self.refresh_at = self.now + self.config.refresh;
        self.flood(self.id, None);
    }

    pub(super) fn advertisement(&self, origin: NodeId) -> Option<&Advertisement> {
        if origin == self.id {
            return Some(&self.own);
        }
        self.known.get(&origin).map(|known| &known.advertisement)
    }

    /// An origin's newest advertisement, and before it, in one frame, what the origin has withdrawn
    /// to begin below it: frames overtake each other.
    fn advertisements_of(&self, origin: NodeId) -> Option<Vec<Advertisement>> {
        let newest = self.advertisement(origin)?;
        let withdrawn = self.known.get(&origin).and_then(|known| known.withdrawn.front().copied());
        let higher = withdrawn.filter(|advertisement_id| *advertisement_id > newest.id);
        let withdrawal = higher
            .map(|advertisement_id| Advertisement { id: advertisement_id, ..newest.withdrawal() });
        Some(withdrawal.into_iter().chain([newest.clone()]).collect())
    }

    /// Gives an origin's newest advertisement to every neighbour but the one that it came from.
    pub(super) fn flood(&mut self, origin: NodeId, except: Option<LinkId>) {
        let links: Vec<_> = self.links.keys().copied().filter(|l| Some(*l) != except).collect();
        for link in links {
            self.announce(link, &[origin]);
        }
    }

    /// Gives these origins' advertisements to a neighbour until it confirms them.
    pub(super) fn announce(&mut self, link: LinkId, origins: &[NodeId]) {
        let Some(adjacent) = self.links.get_mut(&link) else { return };
        let again = self.now + adjacent.patience(self.config.resend);
        let capacity = usize::from(adjacent.mtu) - FRAME_HEADER;
        self.wake_at = self.wake_at.min(again);
        adjacent.pending.extend(origins.iter().map(|origin| (*origin, again)));
        let mut frame = Vec::new();
        let mut length = 1;
        let mut frames = Vec::new();
        for advertisements in origins.iter().filter_map(|origin| self.advertisements_of(*origin)) {
            let more: usize = advertisements.iter().map(Advertisement::length).sum();
            if length + more > capacity {
                frames.push(std::mem::take(&mut frame));
                length = 1;
            }
            length += more;
            frame.extend(advertisements);
        }
        frames.push(frame);
        for frame in frames.into_iter().filter(|frame| !frame.is_empty()) {
            let bytes = RoutingMessage::Announce(frame).encode();
            self.outputs.push_back(RouterOutput::Routing { link, bytes });
        }
    }

    /// Tells a neighbour all that we know of, so that it can send what we lack.
    pub(super) fn compare(&mut self, link: LinkId) {
        let Some(adjacent) = self.links.get_mut(&link) else { return };
        let bytes = RoutingMessage::Numbered(link).encode();
        self.outputs.push_back(RouterOutput::Routing { link, bytes });
        adjacent.compare_at = self.now + adjacent.patience(self.config.compare);
        self.wake_at = self.wake_at.min(adjacent.compare_at);
        let capacity = (usize::from(adjacent.mtu) - FRAME_HEADER - HAVE_HEADER) / ID_LENGTH;
        let mut ids: Vec<_> = self.known.values().map(|known| known.advertisement.id).collect();
        ids.push(self.own.id);
        ids.sort();
        let mut first = NodeId(0);
        let count = ids.chunks(capacity).len();
        for (n, chunk) in ids.chunks(capacity).enumerate() {
            let end =
                chunk.last().map_or(NodeId(u32::MAX), |advertisement_id| advertisement_id.origin);
            let last = if n + 1 == count { NodeId(u32::MAX) } else { end };
            let have = RoutingMessage::Have { range: Some((first, last)), ids: chunk.to_vec() };
            self.outputs.push_back(RouterOutput::Routing { link, bytes: have.encode() });
            first = NodeId(last.0.saturating_add(1));
        }
    }

    pub(super) fn say_have(&mut self, link: LinkId, ids: Vec<AdvertisementId>) {
        let Some(adjacent) = self.links.get(&link) else { return };
        let capacity = (usize::from(adjacent.mtu) - FRAME_HEADER - HAVE_HEADER) / ID_LENGTH;
        for chunk in ids.chunks(capacity) {
            let have = RoutingMessage::Have { range: None, ids: chunk.to_vec() };
            self.outputs.push_back(RouterOutput::Routing { link, bytes: have.encode() });
        }
    }

    pub(super) fn handle_announce(&mut self, link: LinkId, advertisements: Vec<Advertisement>) {
        let mut confirmed = Vec::new();
        let mut better = SortedSet::new();
        for advertisement in advertisements {
            let advertisement_id = advertisement.id;
            if advertisement_id.origin == self.id {
                let echo = advertisement.withdrawn && self.withdrew.contains(&advertisement_id);
                if echo || advertisement == self.own {
                    confirmed.push(advertisement_id);
                } else if !self.hear_of_ourselves(&advertisement, link) {
                    better.insert(advertisement_id.origin);
                }
                continue;
            }
            let known = self.known.get(&advertisement_id.origin);
            if let Some(known) = known.filter(|known| known.withdrawn.contains(&advertisement_id)) {
                if advertisement.withdrawn {
                    confirmed.extend(known.advertisement.withdrawn.then_some(advertisement_id));
                    if let Some(adjacent) = self.links.get_mut(&link) {
                        adjacent.pending.remove(&advertisement_id.origin);
                    }
                } else {
                    // Its origin has withdrawn it: each node that still has it must know.
                    self.refusals.stale += 1;
                    let advertisements =
                        vec![advertisement.withdrawal(), known.advertisement.clone()];
                    self.say(link, advertisements);
                }
                continue;
            }
            let held = self.known.get(&advertisement_id.origin).map(|known| known.advertisement.id);
            let later = held.is_some_and(|held| held.incarnation < advertisement_id.incarnation);
            let contested =
                later && self.is_contested(&advertisement.node, advertisement_id.incarnation);
            let held = self.known.get(&advertisement_id.origin).map(|known| &known.advertisement);
            match held {
                Some(held) if held.node != advertisement.node => {
                    let held = Some(held.node.clone());
                    self.tell_collision(held, advertisement.node);
                }
                // Only who has it takes it back: a lie spreads from node to node, and so does this.
                Some(held) if advertisement.withdrawn && !takes_back(&advertisement, held) => {
                    if held.withdrawn || held.id > advertisement_id {
                        better.insert(advertisement_id.origin);
                    }
                }
                // After a withdrawal the origin counts from the beginning.
                Some(held) if held.withdrawn && !advertisement.withdrawn && !contested => {
                    confirmed.push(advertisement_id);
                    self.learn(advertisement, link);
                }
                // Of two that differ and have one id, everybody takes the same, which comes to
                // its origin sooner or later (RFC 2328, 13.1).
                Some(held)
                    if (held.id, held.withdrawn, &held.edges)
                        > (advertisement_id, advertisement.withdrawn, &advertisement.edges) =>
                {
                    self.refusals.stale += 1;
                    better.insert(advertisement_id.origin);
                }
                Some(held) if *held == advertisement => {
                    confirmed.push(advertisement_id);
                    if let Some(adjacent) = self.links.get_mut(&link) {
                        adjacent.pending.remove(&advertisement_id.origin);
                    }
                }
                // Confirmed, so that it is not repeated; not kept, so that it is asked for once it
                // counts.
                Some(_) if contested => {
                    confirmed.push(advertisement_id);
                    self.tell_why(link, advertisement_id.origin);
                }
                None if self.known.len() >= self.config.nodes_max => {
                    self.refusals.too_large += 1;
                }
                _ => {
                    confirmed.push(advertisement_id);
                    self.learn(advertisement, link);
                }
            }
        }
        self.say_have(link, confirmed);
        if !better.is_empty() {
            let better: Vec<_> = better.into_iter().collect();
            self.announce(link, &better);
        }
    }

    fn say(&mut self, link: LinkId, advertisements: Vec<Advertisement>) {
        let bytes = RoutingMessage::Announce(advertisements).encode();
        self.outputs.push_back(RouterOutput::Routing { link, bytes });
    }

    pub(super) fn learn(&mut self, advertisement: Advertisement, from: LinkId) {
        let origin = advertisement.id.origin;
        let expires = self.now + self.config.lifetime;
        self.wake_at = self.wake_at.min(expires);
        let before = self.known.remove(&origin);
        let effective = before.as_ref().and_then(DatabaseEntry::effective).cloned();
        let mut withdrawn = before.map(|before| before.withdrawn).unwrap_or_default();
        let mut believed = None;
        if advertisement.withdrawn {
            let until = self.now + BELIEF;
            self.wake_at = self.wake_at.min(until);
            believed = effective.clone().map(|effective| (effective, until));
            withdrawn.truncate(WITHDRAWN_MAX - 1);
            withdrawn.push_front(advertisement.id);
        }
        self.hear_given_up(effective.as_ref(), &advertisement);
        let (reached, ended) = (false, false);
        let known = DatabaseEntry { advertisement, expires, reached, ended, believed, withdrawn };
        let same = match (&effective, known.effective()) {
            (Some(before), Some(now)) => {
                before.edges == now.edges && before.id.incarnation == now.id.incarnation
            }
            _ => false,
        };
        self.known.insert(origin, known);
        if !same {
            self.outdate();
        }
        if let Some(adjacent) = self.links.get_mut(&from) {
            adjacent.pending.remove(&origin);
        }
        self.flood(origin, Some(from));
    }

    /// A message in our name: an earlier one of this node's routers, or a forged one. We say
    /// something newer (RFC 2328, 13.4), or, where nothing can be, withdraw it and count from the
    /// beginning. Answers no where what we say is newer already.
    pub(super) fn hear_of_ourselves(
        &mut self,
        advertisement: &Advertisement,
        link: LinkId,
    ) -> bool {
        let (theirs, ours) = (advertisement.id, self.own.id);
        if advertisement.node != self.own.node {
            self.tell_collision(Some(self.own.node.clone()), advertisement.node.clone());
        } else if theirs.incarnation > ours.incarnation {
            if self.is_more_than_a_rumour(theirs) {
                self.defend(theirs.incarnation);
            } else {
                self.defend_against_rumour(theirs.incarnation);
            }
            return false;
        } else if theirs < ours {
            return false;
        } else {
            self.count_forged(link);
            if advertisement.withdrawn {
                self.remember_withdrawn(theirs);
            }
            if advertisement.withdrawn && theirs.sequence >= JUMP_MAX {
                // Whatever else we say is taken now.
                self.renew();
            } else if theirs.sequence >= JUMP_MAX {
                self.begin_anew(advertisement.withdrawal());
            } else {
                // Also where this router was rebuilt within its node's incarnation: it continues
                // the count.
                self.own.id.sequence = theirs.sequence;
                self.renew();
            }
        }
        true
    }

    /// Takes back what was said in our name, and says what is true, in one frame, since frames
    /// overtake each other. Who does not hear it, answers our next announcement by what it still
    /// has, and hears it again.
    fn begin_anew(&mut self, withdrawal: Advertisement) {
        self.remember_withdrawn(withdrawal.id);
        self.own.id.sequence = 1;
        self.refresh_at = self.now + self.config.refresh;
        let length = 1 + withdrawal.length() + self.own.length() + FRAME_HEADER;
        let (withdrawal, own) = (vec![withdrawal], vec![self.own.clone()]);
        let both = [withdrawal.clone(), own.clone()].concat();
        for (&link, adjacent) in &mut self.links {
            let again = self.now + adjacent.patience(self.config.resend);
            self.wake_at = self.wake_at.min(again);
            adjacent.pending.insert(self.id, again);
            let fits = length <= usize::from(adjacent.mtu);
            let frames = if fits { vec![&both] } else { vec![&withdrawal, &own] };
            self.outputs.extend(frames.into_iter().map(|advertisements| {
                let bytes = RoutingMessage::Announce(advertisements.clone()).encode();
                RouterOutput::Routing { link, bytes }
            }));
        }
    }

    /// Its echo is no news.
    fn remember_withdrawn(&mut self, id: AdvertisementId) {
        if self.withdrew.len() == WITHDRAWN_MAX {
            self.withdrew.pop_front();
        }
        self.withdrew.push_back(id);
    }

    /// Counts what is said in our name, and tells when it does not cease.
    fn count_forged(&mut self, link: LinkId) {
        self.refusals.forged += 1;
        let (since, times) = self.forged;
        let fresh = self.now - since > FORGED_PERIOD;
        self.forged = if fresh { (self.now, 1) } else { (since, times.saturating_add(1)) };
        let times = self.forged.1;
        self.go_on(RouterAlarm::Forged);
        if times == FORGED_MANY
            && let Some(adjacent) = self.links.get(&link)
        {
            let neighbour = adjacent.neighbour.node.clone();
            self.outputs.push_back(RouterOutput::Forged { neighbour, times });
            self.begin_trouble(RouterAlarm::Forged);
        }
    }

    pub(super) fn handle_have(
        &mut self,
        link: LinkId,
        range: Option<(NodeId, NodeId)>,
        ids: &[AdvertisementId],
    ) {
        let mut better = Vec::new();
        let mut wanted = Vec::new();
        for &advertisement_id in ids {
            let AdvertisementId { origin, .. } = advertisement_id;
            let nothing = AdvertisementId { origin, incarnation: Incarnation(0), sequence: 0 };
            let held = self.advertisement(origin).map_or(nothing, |held| held.id);
            let known = self.known.get(&origin);
            if let Some(known) = known.filter(|known| known.withdrawn.contains(&advertisement_id))
                && held != advertisement_id
            {
                let withdrawal =
                    Advertisement { id: advertisement_id, ..known.advertisement.withdrawal() };
                self.say(link, vec![withdrawal, known.advertisement.clone()]);
            } else if held > advertisement_id {
                better.push(origin);
            } else if held < advertisement_id {
                wanted.push(held);
            } else if let Some(adjacent) = self.links.get_mut(&link) {
                adjacent.pending.remove(&origin);
            }
        }
        if let Some((first, last)) = range
            && first <= last
        {
            let listed: crate::sorted::SortedSet<_> = ids.iter().map(|s| s.origin).collect();
            let held = self.known.range(first..=last).map(|(origin, _)| *origin);
            let own = (first..=last).contains(&self.id).then_some(self.id);
            better.extend(held.chain(own).filter(|origin| !listed.contains(origin)));
        }
        if !better.is_empty() {
            self.announce(link, &better);
        }
        self.say_have(link, wanted);
    }

    pub(super) fn tell_collision(&mut self, node: Option<NodeName>, refused: NodeName) {
        self.refusals.unexpected += 1;
        let Some(node) = node else { return };
        let pair = Some((node.clone(), refused.clone()));
        self.go_on(RouterAlarm::NameTaken);
        if self.reported_conflict != pair {
            self.reported_conflict = pair;
            self.begin_trouble(RouterAlarm::NameTaken);
            self.outputs.push_back(RouterOutput::NumberTaken { node, refused });
        }
    }

    pub(super) fn forget_the_old(&mut self) {
        let now = self.now;
        let before = self.known.len();
        self.known.retain(|_, known| known.expires > now);
        let mut changed = self.known.len() != before;
        for known in self.known.values_mut() {
            changed |= known.believed.take_if(|(_, until)| *until <= now).is_some();
        }
        if changed {
            self.outdate();
        }
    }
}

/// Whether this withdrawal is of what is held.
fn takes_back(withdrawal: &Advertisement, held: &Advertisement) -> bool {
    let (void, held_id) = (withdrawal.id, held.id);
    let at_the_end = held_id.sequence >= JUMP_MAX && held_id <= void;
    !held.withdrawn && (held_id == void || held_id.incarnation == void.incarnation && at_the_end)
}
