//! Announcements: told to every neighbour until it confirms them, compared, outdone.

use super::{Known, LinkNumber, Router, RouterOutput};
use crate::net::advertisement::{
    Advertisement, Edge, HAVE_HEADER, NEIGHBOURS_MAX, Routing, STAMP, Stamp,
};
use crate::net::frame::FRAME_HEADER;
use crate::net::node_id::NodeId;
use crate::{Incarnation, NodeName};
use std::collections::BTreeMap;

impl Router {
    /// Our own links have changed: everybody must know.
    pub(super) fn announce_links(&mut self) {
        let mut edges: BTreeMap<NodeId, Edge> = BTreeMap::new();
        for adjacent in self.links.values() {
            let edge = Edge { to: adjacent.id, cost: adjacent.cost, mtu: adjacent.mtu };
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
        self.own.stamp.sequence = self.own.stamp.sequence.saturating_add(1);
        self.refresh_at = self.now + self.config.refresh;
        self.flood(self.id, None);
    }

    pub(super) fn advertisement(&self, origin: NodeId) -> Option<&Advertisement> {
        if origin == self.id {
            return Some(&self.own);
        }
        self.known.get(&origin).map(|known| &known.advertisement)
    }

    /// Gives an origin's newest advertisement to every neighbour but the one that it came from.
    pub(super) fn flood(&mut self, origin: NodeId, except: Option<LinkNumber>) {
        let links: Vec<_> = self.links.keys().copied().filter(|l| Some(*l) != except).collect();
        for link in links {
            self.announce(link, &[origin]);
        }
    }

    /// Gives these origins' advertisements to a neighbour until it confirms them.
    pub(super) fn announce(&mut self, link: LinkNumber, origins: &[NodeId]) {
        let again = self.now + self.config.resend;
        let Some(adjacent) = self.links.get_mut(&link) else { return };
        let room = usize::from(adjacent.mtu) - FRAME_HEADER;
        self.wake_at = self.wake_at.min(again);
        adjacent.pending.extend(origins.iter().map(|origin| (*origin, again)));
        let mut frame = Vec::new();
        let mut length = 1;
        let mut frames = Vec::new();
        for advertisement in origins.iter().filter_map(|origin| self.advertisement(*origin)) {
            if length + advertisement.length() > room {
                frames.push(std::mem::take(&mut frame));
                length = 1;
            }
            length += advertisement.length();
            frame.push(advertisement.clone());
        }
        frames.push(frame);
        for frame in frames.into_iter().filter(|frame| !frame.is_empty()) {
            let bytes = Routing::Announce(frame).encode();
            self.outputs.push_back(RouterOutput::Routing { link, bytes });
        }
    }

    /// Tells a neighbour all that we know of, so that it can send what we lack.
    pub(super) fn compare(&mut self, link: LinkNumber) {
        let Some(adjacent) = self.links.get_mut(&link) else { return };
        adjacent.compare_at = self.now + self.config.compare;
        self.wake_at = self.wake_at.min(adjacent.compare_at);
        let room = (usize::from(adjacent.mtu) - FRAME_HEADER - HAVE_HEADER) / STAMP;
        let mut stamps: Vec<_> =
            self.known.values().map(|known| known.advertisement.stamp).collect();
        stamps.push(self.own.stamp);
        stamps.sort();
        let mut first = NodeId(0);
        let count = stamps.chunks(room).len();
        for (n, chunk) in stamps.chunks(room).enumerate() {
            let end = chunk.last().map_or(NodeId(u32::MAX), |stamp| stamp.origin);
            let last = if n + 1 == count { NodeId(u32::MAX) } else { end };
            let have = Routing::Have { range: Some((first, last)), stamps: chunk.to_vec() };
            self.outputs.push_back(RouterOutput::Routing { link, bytes: have.encode() });
            first = NodeId(last.0.saturating_add(1));
        }
    }

    pub(super) fn say_have(&mut self, link: LinkNumber, stamps: Vec<Stamp>) {
        let Some(adjacent) = self.links.get(&link) else { return };
        let room = (usize::from(adjacent.mtu) - FRAME_HEADER - HAVE_HEADER) / STAMP;
        for chunk in stamps.chunks(room) {
            let have = Routing::Have { range: None, stamps: chunk.to_vec() };
            self.outputs.push_back(RouterOutput::Routing { link, bytes: have.encode() });
        }
    }

    pub(super) fn handle_announce(&mut self, link: LinkNumber, advertisements: Vec<Advertisement>) {
        let mut confirmed = Vec::new();
        let mut better = Vec::new();
        for advertisement in advertisements {
            let stamp = advertisement.stamp;
            if stamp.origin == self.id {
                self.hear_of_ourselves(&advertisement);
                better.push(stamp.origin);
                continue;
            }
            let held = self.known.get(&stamp.origin).map(|known| known.advertisement.stamp);
            let later = held.is_some_and(|held| held.incarnation < stamp.incarnation);
            let contested = later && self.is_contested(&advertisement.node, stamp.incarnation);
            let held = self.known.get(&stamp.origin).map(|known| &known.advertisement);
            match held {
                Some(held) if held.node != advertisement.node => {
                    let held = Some(held.node.clone());
                    self.tell_collision(held, advertisement.node);
                }
                Some(held) if held.stamp > stamp => {
                    self.refusals.stale += 1;
                    better.push(stamp.origin);
                }
                Some(held) if held.stamp == stamp => {
                    confirmed.push(stamp);
                    if let Some(adjacent) = self.links.get_mut(&link) {
                        adjacent.pending.remove(&stamp.origin);
                    }
                }
                // Confirmed, so that it is not repeated; not kept, so that it is asked for once it counts.
                Some(_) if contested => {
                    confirmed.push(stamp);
                    self.tell_why(link, stamp.origin);
                }
                None if self.known.len() >= self.config.nodes_max => {
                    self.refusals.too_large += 1;
                }
                _ => {
                    confirmed.push(stamp);
                    self.learn(advertisement, link);
                }
            }
        }
        self.say_have(link, confirmed);
        if !better.is_empty() {
            self.announce(link, &better);
        }
    }

    pub(super) fn learn(&mut self, advertisement: Advertisement, from: LinkNumber) {
        let origin = advertisement.stamp.origin;
        let expires = self.now + self.config.lifetime;
        self.wake_at = self.wake_at.min(expires);
        let known = Known { advertisement, expires, reached: false, ended: false };
        let before = self.known.insert(origin, known).map(|known| known.advertisement);
        let now = &self.known[&origin].advertisement;
        let same = before.is_some_and(|before| {
            before.edges == now.edges && before.stamp.incarnation == now.stamp.incarnation
        });
        if !same {
            self.outdate();
        }
        if let Some(adjacent) = self.links.get_mut(&from) {
            adjacent.pending.remove(&origin);
        }
        self.flood(origin, Some(from));
    }

    /// Somebody repeats what a router of our name once said.
    pub(super) fn hear_of_ourselves(&mut self, advertisement: &Advertisement) {
        let (theirs, ours) = (advertisement.stamp, self.own.stamp);
        if advertisement.node != self.own.node {
            self.tell_collision(Some(self.own.node.clone()), advertisement.node.clone());
        } else if theirs.incarnation > ours.incarnation {
            self.defend(theirs.incarnation);
        } else if theirs > ours || theirs == ours && *advertisement != self.own {
            // This router was built anew within its node's life: it continues the old one's count.
            self.own.stamp.sequence = theirs.sequence;
            self.renew();
        }
    }

    pub(super) fn handle_have(
        &mut self,
        link: LinkNumber,
        range: Option<(NodeId, NodeId)>,
        stamps: &[Stamp],
    ) {
        let mut better = Vec::new();
        let mut wanted = Vec::new();
        for &stamp in stamps {
            let Stamp { origin, .. } = stamp;
            let nothing = Stamp { origin, incarnation: Incarnation(0), sequence: 0 };
            let held = self.advertisement(origin).map_or(nothing, |held| held.stamp);
            if held > stamp {
                better.push(origin);
            } else if held < stamp {
                wanted.push(held);
            } else if let Some(adjacent) = self.links.get_mut(&link) {
                adjacent.pending.remove(&origin);
            }
        }
        if let Some((first, last)) = range
            && first <= last
        {
            let listed: std::collections::BTreeSet<_> = stamps.iter().map(|s| s.origin).collect();
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
        if self.told != pair {
            self.told = pair;
            self.outputs.push_back(RouterOutput::NumberTaken { node, refused });
        }
    }

    pub(super) fn forget_the_old(&mut self) {
        let before = self.known.len();
        self.known.retain(|_, known| known.expires > self.now);
        if self.known.len() != before {
            self.outdate();
        }
    }
}
