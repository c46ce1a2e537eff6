//! Announcements: told to every neighbour until it confirms them, compared, outdone.

use super::keys::SignatureCheck;
use super::names::UnusedLink;
use super::topology::{Adjacency, patience};
use super::{DatabaseEntry, Router, RouterOutput};
use crate::Instant;
use crate::NodeName;
use crate::net::REPORT_INTERVAL;
use crate::net::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, HAVE_HEADER, ID_LENGTH, NEIGHBOURS_MAX, RoutingMessage,
};
use crate::net::wire::frame::FRAME_HEADER;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::sorted::{SortedMap, SortedSet};
use std::time::Duration;

impl Router {
    /// A node with news announces it at once, and again after 5 ms for each of its links: it sends
    /// its neighbours 200 announcements a second at most, however often its links change (OSPF:
    /// MinLSInterval).
    const PACE: Duration = Duration::from_millis(5);

    /// When our own links are announced next.
    pub(super) fn refresh_due(&self) -> Instant {
        let links = u32::try_from(self.links.len()).unwrap_or(u32::MAX);
        let paced = Self::PACE.saturating_mul(links).min(self.config.refresh);
        self.announced_at + if self.has_news { paced } else { self.config.refresh }
    }

    /// Our own links have changed: all nodes must know.
    pub(super) fn announce_links(&mut self) {
        self.outdate();
        self.has_news = true;
        if self.own.edges.is_empty() || self.refresh_due() <= self.now {
            return self.renew();
        }
        self.wake_at = self.wake_at.min(self.refresh_due());
    }

    pub(super) fn renew(&mut self) {
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
        let challenges = self.unused.values().map(UnusedLink::challenge);
        self.own.edges = edges.into_values().chain(challenges).take(NEIGHBOURS_MAX).collect();
        self.own.id.sequence = self.own.id.sequence.saturating_add(1);
        self.sign();
        (self.announced_at, self.has_news) = (self.now, false);
        self.flood(self.id, None);
    }

    pub(super) fn advertisement(&self, origin: NodeId) -> Option<&Advertisement> {
        if origin == self.id {
            return Some(&self.own);
        }
        self.known.get(&origin).map(|known| &known.advertisement)
    }

    /// Gives an origin's newest advertisement to every neighbour that has it neither from the
    /// origin itself nor from the neighbour that it came from. Among `n` nodes that are all linked
    /// to each other, one change then takes `n - 1` messages, where each node told all others.
    ///
    /// Nothing is lost for good. The origin repeats its advertisement to the neighbours in it until
    /// they confirm it. If such a link fails, the origin's next advertisement does not list it, and
    /// is passed on. If the origin fails, neighbours that compare what they know find the rest.
    pub(super) fn flood(&mut self, origin: NodeId, except: Option<LinkId>) {
        let Some(advertisement) = self.advertisement(origin) else { return };
        let links = advertisement.edges.iter().filter(|edge| edge.mtu != Edge::CHALLENGE);
        let told: SortedSet<_> = links.map(|edge| (edge.to, edge.incarnation)).collect();
        let lacks = |(link, adjacent): (&LinkId, &Adjacency)| {
            let incarnation = Edge::incarnation_tag(adjacent.neighbour.incarnation);
            let has_it = origin != self.id && told.contains(&(adjacent.id, incarnation));
            (Some(*link) != except && !has_it).then_some(*link)
        };
        let links: Vec<_> = self.links.iter().filter_map(lacks).collect();
        for link in links {
            self.announce(link, &[origin]);
        }
    }

    /// Gives these origins' advertisements to a neighbour until it confirms them.
    pub(super) fn announce(&mut self, link: LinkId, origins: &[NodeId]) {
        let Some(adjacent) = self.links.get_mut(&link) else { return };
        let first = patience(adjacent.mtu, self.config.resend);
        let longest = first * 8;
        let capacity = usize::from(adjacent.mtu) - FRAME_HEADER;
        for origin in origins {
            let (due, pause) = adjacent.pending.entry(*origin).or_insert((self.now, first));
            *due = self.now + *pause;
            self.wake_at = self.wake_at.min(*due);
            // A neighbour that confirms late has too much to do already.
            *pause = (*pause * 2).min(longest);
        }
        let mut frame = Vec::new();
        let mut length = 1;
        let mut frames = Vec::new();
        for advertisement in origins.iter().filter_map(|origin| self.advertisement(*origin)) {
            let more = advertisement.length();
            if length + more > capacity {
                frames.push(std::mem::take(&mut frame));
                length = 1;
            }
            length += more;
            frame.push(advertisement.clone());
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
        adjacent.compare_at = self.now + patience(adjacent.mtu, self.config.compare);
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
            let id = advertisement.id;
            let held = self.advertisement(id.origin);
            if held.is_some_and(|held| *held == advertisement) {
                confirmed.push(id);
                if let Some(adjacent) = self.links.get_mut(&link) {
                    adjacent.pending.remove(&id.origin);
                }
                continue;
            }
            let is_named_so = held.is_none_or(|held| held.node == advertisement.node);
            if is_named_so && held.is_some_and(|held| held.rank() > advertisement.rank()) {
                self.refusals.stale += 1;
                better.insert(id.origin);
                continue;
            }
            match self.check_signature(&advertisement, link) {
                SignatureCheck::ByOrigin => {}
                // Confirmed, so that it is not repeated, and not kept, so that it is asked for
                // again when neighbours compare what they know.
                SignatureCheck::Refused => {
                    confirmed.push(id);
                    continue;
                }
                SignatureCheck::Later => continue,
            }
            let held = self.advertisement(id.origin);
            if let Some(held) = held.filter(|held| held.node != advertisement.node) {
                self.tell_collision(held.node.clone(), advertisement.node);
            } else if id.origin == self.id {
                self.outdo(&advertisement);
            } else if held.is_none() && self.known.len() >= self.config.nodes_max {
                self.refusals.too_large += 1;
            } else {
                confirmed.push(id);
                self.learn(advertisement, link);
            }
        }
        self.say_have(link, confirmed);
        if !better.is_empty() {
            let better: Vec<_> = better.into_iter().collect();
            self.announce(link, &better);
        }
    }

    fn learn(&mut self, advertisement: Advertisement, from: LinkId) {
        let origin = advertisement.id.origin;
        let expires = self.now + self.config.lifetime;
        self.wake_at = self.wake_at.min(expires);
        let before = self.known.remove(&origin).map(|before| before.advertisement);
        let same = before.is_some_and(|before| {
            before.edges == advertisement.edges && before.incarnation == advertisement.incarnation
        });
        self.answer_challenge(&advertisement);
        self.known.insert(origin, DatabaseEntry { advertisement, expires });
        if !same {
            self.outdate();
        }
        if let Some(adjacent) = self.links.get_mut(&from) {
            adjacent.pending.remove(&origin);
        }
        self.flood(origin, Some(from));
    }

    /// Whether a neighbour was given an origin's newest advertisement, and still has time to
    /// confirm it.
    fn is_on_its_way(&self, link: LinkId, origin: NodeId) -> bool {
        let pending = self.links.get(&link).and_then(|adjacent| adjacent.pending.get(&origin));
        pending.is_some_and(|(due, _)| *due > self.now)
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
            let origin = advertisement_id.origin;
            let nothing = AdvertisementId { origin, sequence: 0 };
            let held = self.advertisement(origin).map_or(nothing, |held| held.id);
            if held > advertisement_id {
                // A confirmation of older news asks for nothing that is on its way. Each of many
                // late ones would be answered, and each answer be confirmed late again.
                if range.is_some() || !self.is_on_its_way(link, origin) {
                    better.push(origin);
                }
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

    pub(super) fn tell_collision(&mut self, node: NodeName, refused: NodeName) {
        self.refusals.unexpected += 1;
        let known = self.reported_conflict.as_ref().is_some_and(|(a, b, at)| {
            (a, b) == (&node, &refused) && self.now < *at + REPORT_INTERVAL
        });
        if !known {
            self.reported_conflict = Some((node.clone(), refused.clone(), self.now));
            self.outputs.push_back(RouterOutput::NumberTaken { node, refused });
        }
    }

    pub(super) fn forget_the_old(&mut self) {
        let now = self.now;
        let before = self.known.len();
        self.known.retain(|_, known| known.expires > now);
        if self.known.len() != before {
            self.outdate();
        }
    }
}
