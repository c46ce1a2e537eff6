//! Which neighbour is next on the way to a node, and which one if that fails.
//!
//! Every router tells all others which links it has (see [`advertisement`]); each computes the
//! shortest paths by itself. Beside the next hop it keeps an alternate that leads on without coming
//! back (a loop-free alternate, RFC 5286, inequality 1), so that a failing link costs one look-up.
//!
//! An edge counts only if both its ends announce it: a dead node's last words lead nowhere.
//!
//! [`advertisement`]: super::advertisement

mod vocabulary;

pub use self::vocabulary::{Health, LinkStatus, RouterConfig, RouterOutput};

use super::advertisement::{
    Advertisement, Edge, HAVE_HEADER, NEIGHBOURS_MAX, Routing, STAMP, Stamp,
};
use super::frame::FRAME_HEADER;
use super::node_id::NodeId;
use super::packet::{Class, HOPS_MAX, Packet, Payload, Undelivered};
use super::topology::{self, Adjacent, Route, Topology};
use super::wire::Refusals;
use crate::{Incarnation, Instant, Machine, NodeName};
use bytes::Bytes;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// A link of this node, by its place in the node's configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkNumber(pub u16);

/// The machine of a node's router.
#[derive(Debug)]
pub struct Router {
    config: RouterConfig,
    id: NodeId,
    links: BTreeMap<LinkNumber, Adjacent>,
    known: BTreeMap<NodeId, Known>,
    own: Advertisement,
    routes: BTreeMap<NodeId, Route>,
    /// The paths must be computed anew, then.
    compute_at: Option<Instant>,
    computed_at: Instant,
    refresh_at: Instant,
    /// The last pair told of, so that a collision is told once and not with every flood.
    told: Option<(NodeName, NodeName)>,
    usurped: bool,
    /// Nodes that the router before this one could reach, and until when they may take to be found
    /// again.
    remembered: Option<(Instant, Vec<(NodeName, Incarnation)>)>,
    /// The earliest of all due times; computed anew only when it has come.
    wake_at: Instant,
    now: Instant,
    refusals: Refusals,
    outputs: VecDeque<RouterOutput>,
}

#[derive(Debug)]
struct Known {
    advertisement: Advertisement,
    expires: Instant,
}

/// A link's smallest MTU in bytes: an advertisement with all neighbours must fit.
pub const MTU_MIN: usize = 640;

impl Router {
    /// A router without links.
    pub fn new(config: RouterConfig, now: Instant) -> Self {
        let id = NodeId::of(&config.node);
        let stamp = Stamp { origin: id, incarnation: config.incarnation, sequence: 1 };
        let own = Advertisement { stamp, node: config.node.clone(), edges: Vec::new() };
        let refresh_at = now + config.refresh;
        Router {
            config,
            id,
            links: BTreeMap::new(),
            known: BTreeMap::new(),
            own,
            routes: BTreeMap::new(),
            compute_at: None,
            computed_at: Instant::ORIGIN,
            refresh_at,
            told: None,
            usurped: false,
            remembered: None,
            wake_at: refresh_at,
            now,
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
        }
    }

    /// A router in the place of one that failed. It finds its links and its place in the network
    /// again; what the old one could reach and this one cannot find is told as lost.
    pub fn reborn(
        config: RouterConfig,
        reached: impl IntoIterator<Item = (NodeName, Incarnation)>,
        now: Instant,
    ) -> Self {
        let mut router = Router::new(config, now);
        // Neighbours compare what they know at once, and again after this.
        let until = now + router.config.compare;
        router.remembered = Some((until, reached.into_iter().collect()));
        router.wake_at = router.wake_at.min(until);
        router
    }

    /// What was refused so far.
    pub fn refusals(&self) -> Refusals {
        self.refusals
    }

    /// The present route to a node.
    pub fn route(&self, node: NodeId) -> Option<&Route> {
        self.routes.get(&node)
    }

    /// Every node that can be reached, with the route to it.
    pub fn routes(&self) -> impl Iterator<Item = (NodeId, &Route)> {
        self.routes.iter().map(|(node, route)| (*node, route))
    }

    /// A link's state, cost or size has changed.
    pub fn handle_link(&mut self, link: LinkNumber, status: LinkStatus, now: Instant) {
        self.now = now;
        let LinkStatus { neighbour, health, cost, mtu } = status;
        let id = NodeId::of(&neighbour.node);
        let known = self.known.get(&id).map(|known| &known.advertisement.node);
        if known.is_some_and(|known| *known != neighbour.node) {
            let known = known.cloned();
            self.tell_collision(known, neighbour.node);
            return;
        }
        if health == Health::Down || mtu < MTU_MIN {
            if self.links.remove(&link).is_some() {
                self.choose_anew();
                self.announce_links();
            }
            return;
        }
        let (cost, mtu) = (cost.max(1), mtu.min(u16::MAX.into()) as u16);
        match self.links.get_mut(&link) {
            Some(adjacent) if adjacent.neighbour == neighbour => {
                let same = adjacent.cost == cost && adjacent.mtu == mtu;
                (adjacent.cost, adjacent.mtu, adjacent.health) = (cost, mtu, health);
                if same {
                    self.choose_anew();
                } else {
                    self.announce_links();
                }
            }
            _ => {
                let pending = BTreeMap::new();
                let adjacent =
                    Adjacent { neighbour, id, cost, mtu, health, pending, compare_at: now };
                self.links.insert(link, adjacent);
                self.announce_links();
                self.compare(link);
            }
        }
    }

    /// A neighbour's router said something.
    pub fn handle_routing(&mut self, link: LinkNumber, bytes: Bytes, now: Instant) {
        self.now = now;
        if !self.links.contains_key(&link) {
            self.refusals.unexpected += 1;
            return;
        }
        match Routing::decode(bytes) {
            Ok(Routing::Announce(advertisements)) => self.handle_announce(link, advertisements),
            Ok(Routing::Have { range, stamps }) => self.handle_have(link, range, &stamps),
            Err(error) => self.refusals.count(&error),
        }
    }

    /// A packet came over a link.
    pub fn handle_packet(&mut self, link: LinkNumber, packet: Bytes, now: Instant) {
        self.now = now;
        let packet = match Packet::decode(packet) {
            Ok(packet) => packet,
            Err(error) => return self.refusals.count(&error),
        };
        if packet.source == self.id {
            // It went in a circle, or somebody uses our name.
            self.refusals.unexpected += 1;
        } else if packet.destination != self.id {
            self.forward(packet, Some(link));
        } else {
            self.outputs.push_back(match packet.payload {
                Payload::Segment(segment) => {
                    RouterOutput::Segment { source: packet.source, segment }
                }
                Payload::Return { destination, reason } => {
                    RouterOutput::Undelivered { destination, reason }
                }
            });
        }
    }

    /// Our session with `destination` wants this sent.
    pub fn handle_segment(&mut self, destination: NodeId, class: Class, segment: Bytes) {
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let payload = Payload::Segment(segment);
        let packet = Packet { class, hops, destination, source, payload };
        match self.choose(destination, None) {
            Some(link) => self.pass(link, &packet),
            None => self.give_back(&packet, Undelivered::NoRoute),
        }
    }

    /// The same over every link whose way does not lead back here: the first copy that arrives counts.
    /// A link that is too small for it is left out.
    pub fn handle_copies(&mut self, destination: NodeId, class: Class, segment: &Bytes) {
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let payload = Payload::Segment(segment.clone());
        let packet = Packet { class, hops, destination, source, payload };
        let bytes = packet.encode();
        let ways = self.routes.get(&destination).map_or(&[][..], |route| &route.ways);
        let fits = |link: &&LinkNumber| {
            let mtu = self.links.get(link).map(|adjacent| usize::from(adjacent.mtu));
            mtu.is_some_and(|mtu| bytes.len() + FRAME_HEADER <= mtu)
        };
        let ways: Vec<_> = ways.iter().filter(fits).copied().collect();
        if ways.is_empty() {
            // One way that is there but too small, or none: its refusal says which.
            return self.handle_segment(destination, class, segment.clone());
        }
        for link in ways {
            self.outputs.push_back(RouterOutput::Packet { link, packet: bytes.clone() });
        }
    }

    fn forward(&mut self, packet: Packet, from: Option<LinkNumber>) {
        let Some(hops) = packet.hops.checked_sub(1) else {
            return self.give_back(&packet, Undelivered::TooManyHops);
        };
        let packet = Packet { hops, ..packet };
        match self.choose(packet.destination, from) {
            Some(link) => self.pass(link, &packet),
            None => self.give_back(&packet, Undelivered::NoRoute),
        }
    }

    fn pass(&mut self, link: LinkNumber, packet: &Packet) {
        let bytes = packet.encode();
        let mtu = self.links.get(&link).map_or(0, |adjacent| usize::from(adjacent.mtu));
        if bytes.len() + FRAME_HEADER > mtu {
            return self.give_back(packet, Undelivered::TooLarge);
        }
        self.outputs.push_back(RouterOutput::Packet { link, packet: bytes });
    }

    /// Tells a packet's source that it went no further. Nothing is said about a return.
    fn give_back(&mut self, packet: &Packet, reason: Undelivered) {
        let Payload::Segment(_) = packet.payload else { return };
        let destination = packet.destination;
        if packet.source == self.id {
            self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
            return;
        }
        let payload = Payload::Return { destination, reason };
        let (hops, source) = (self.config.hops.min(HOPS_MAX), self.id);
        let answer =
            Packet { class: Class::Control, hops, destination: packet.source, source, payload };
        if let Some(link) = self.choose(answer.destination, None) {
            self.pass(link, &answer);
        }
    }

    /// The look-up: the next hop if it is well, else the alternate, else whichever is better off;
    /// never back to where the packet came from.
    fn choose(&self, destination: NodeId, from: Option<LinkNumber>) -> Option<LinkNumber> {
        let route = self.routes.get(&destination)?;
        let from = from.and_then(|from| self.links.get(&from)).map(|adjacent| adjacent.id);
        route.choose(&self.links, from)
    }

    /// Links have come, gone or become suspect: some nodes are now reached another way.
    fn choose_anew(&mut self) {
        for (node, route) in &mut self.routes {
            let chosen = route.choose(&self.links, None);
            if chosen != route.chosen {
                route.chosen = chosen;
                if chosen.is_some() {
                    let mtu = topology::segment_limit(route.mtu);
                    self.outputs.push_back(RouterOutput::PathChanged { node: *node, mtu });
                }
            }
        }
    }

    /// Our own links have changed: everybody must know.
    fn announce_links(&mut self) {
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

    fn renew(&mut self) {
        self.own.stamp.sequence = self.own.stamp.sequence.saturating_add(1);
        self.refresh_at = self.now + self.config.refresh;
        self.flood(self.id, None);
    }

    fn advertisement(&self, origin: NodeId) -> Option<&Advertisement> {
        if origin == self.id {
            return Some(&self.own);
        }
        self.known.get(&origin).map(|known| &known.advertisement)
    }

    /// Gives an origin's newest advertisement to every neighbour but the one that it came from.
    fn flood(&mut self, origin: NodeId, except: Option<LinkNumber>) {
        let links: Vec<_> = self.links.keys().copied().filter(|l| Some(*l) != except).collect();
        for link in links {
            self.announce(link, &[origin]);
        }
    }

    /// Gives these origins' advertisements to a neighbour until it confirms them.
    fn announce(&mut self, link: LinkNumber, origins: &[NodeId]) {
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
    fn compare(&mut self, link: LinkNumber) {
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

    fn say_have(&mut self, link: LinkNumber, stamps: Vec<Stamp>) {
        let Some(adjacent) = self.links.get(&link) else { return };
        let room = (usize::from(adjacent.mtu) - FRAME_HEADER - HAVE_HEADER) / STAMP;
        for chunk in stamps.chunks(room) {
            let have = Routing::Have { range: None, stamps: chunk.to_vec() };
            self.outputs.push_back(RouterOutput::Routing { link, bytes: have.encode() });
        }
    }

    fn handle_announce(&mut self, link: LinkNumber, advertisements: Vec<Advertisement>) {
        let mut confirmed = Vec::new();
        let mut better = Vec::new();
        for advertisement in advertisements {
            let stamp = advertisement.stamp;
            if stamp.origin == self.id {
                self.hear_of_ourselves(&advertisement);
                better.push(stamp.origin);
                continue;
            }
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

    fn learn(&mut self, advertisement: Advertisement, from: LinkNumber) {
        let origin = advertisement.stamp.origin;
        let expires = self.now + self.config.lifetime;
        self.wake_at = self.wake_at.min(expires);
        let known = Known { advertisement, expires };
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
    fn hear_of_ourselves(&mut self, advertisement: &Advertisement) {
        let (theirs, ours) = (advertisement.stamp, self.own.stamp);
        if advertisement.node != self.own.node {
            self.tell_collision(Some(self.own.node.clone()), advertisement.node.clone());
        } else if theirs.incarnation > ours.incarnation {
            if !std::mem::replace(&mut self.usurped, true) {
                let incarnation = theirs.incarnation;
                self.outputs.push_back(RouterOutput::NameTaken { incarnation });
            }
        } else if theirs > ours || theirs == ours && *advertisement != self.own {
            // This router was built anew within its node's life: it continues the old one's count.
            self.own.stamp.sequence = theirs.sequence;
            self.renew();
        }
    }

    fn handle_have(&mut self, link: LinkNumber, range: Option<(NodeId, NodeId)>, stamps: &[Stamp]) {
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

    fn tell_collision(&mut self, node: Option<NodeName>, refused: NodeName) {
        self.refusals.unexpected += 1;
        let Some(node) = node else { return };
        let pair = Some((node.clone(), refused.clone()));
        if self.told != pair {
            self.told = pair;
            self.outputs.push_back(RouterOutput::NumberTaken { node, refused });
        }
    }

    fn outdate(&mut self) {
        // A change comes as a burst of floods: the first is acted on at once, the rest together.
        const TOGETHER: Duration = Duration::from_millis(5);
        self.compute_at.get_or_insert(self.now.max(self.computed_at + TOGETHER));
    }

    /// Computes the paths anew and tells what has changed.
    fn compute(&mut self) {
        self.compute_at = None;
        self.computed_at = self.now;
        let known = self.known.iter().map(|(id, known)| (*id, &known.advertisement));
        let topology = Topology::new(self.id, &self.links, known);
        let mut before = std::mem::replace(&mut self.routes, topology.routes());
        for (id, route) in &self.routes {
            let (mtu, incarnation) = (topology::segment_limit(route.mtu), route.incarnation);
            let output = match before.remove(id) {
                Some(old) if old.incarnation == incarnation => {
                    if !old.must_repeat_over(route) {
                        continue;
                    }
                    RouterOutput::PathChanged { node: *id, mtu }
                }
                _ => RouterOutput::Reachable { node: route.node.clone(), incarnation, mtu },
            };
            self.outputs.push_back(output);
        }
        for Route { node, incarnation, .. } in before.into_values() {
            self.outputs.push_back(RouterOutput::Lost { node, incarnation });
        }
    }

    fn give_up_remembered(&mut self) {
        if self.remembered.as_ref().is_none_or(|(until, _)| *until > self.now) {
            return;
        }
        for (node, incarnation) in self.remembered.take().into_iter().flat_map(|(_, nodes)| nodes) {
            if !self.routes.contains_key(&NodeId::of(&node)) {
                self.outputs.push_back(RouterOutput::Lost { node, incarnation });
            }
        }
    }

    fn earliest(&self) -> Instant {
        let links = self
            .links
            .values()
            .flat_map(|adjacent| adjacent.pending.values().copied().chain([adjacent.compare_at]));
        let ages = self.known.values().map(|known| known.expires);
        let remembered = self.remembered.iter().map(|(until, _)| *until);
        links.chain(ages).chain(remembered).fold(self.refresh_at, Instant::min)
    }

    fn forget_the_old(&mut self) {
        let before = self.known.len();
        self.known.retain(|_, known| known.expires > self.now);
        if self.known.len() != before {
            self.outdate();
        }
    }
}

impl Machine for Router {
    type Output = RouterOutput;

    fn poll_output(&mut self) -> Option<RouterOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Some(self.compute_at.map_or(self.wake_at, |at| at.min(self.wake_at)))
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.now = now;
        if self.refresh_at <= now {
            self.renew();
        }
        self.forget_the_old();
        let numbers: Vec<_> = self.links.keys().copied().collect();
        for link in numbers {
            let Some(adjacent) = self.links.get(&link) else { continue };
            let due = adjacent.pending.iter().filter(|(_, again)| **again <= now);
            let due: Vec<_> = due.map(|(origin, _)| *origin).collect();
            let compare = adjacent.compare_at <= now;
            if !due.is_empty() {
                self.announce(link, &due);
            }
            if compare {
                self.compare(link);
            }
        }
        if self.compute_at.is_some_and(|at| at <= now) {
            self.compute();
        }
        self.give_up_remembered();
        self.wake_at = self.earliest();
    }
}

#[cfg(test)]
mod tests;
