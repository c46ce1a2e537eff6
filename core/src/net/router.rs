//! Which neighbour is next on the way to a node, and which one if that fails.
//!
//! Every router tells all others which links it has (see [`advertisement`]); each computes the
//! shortest paths by itself. Beside the next hop it keeps an alternate that leads on without coming
//! back (a loop-free alternate, RFC 5286, inequality 1), so that a failing link costs one look-up.
//!
//! An edge counts only if both its ends announce it: a dead node's last words lead nowhere.
//!
//! [`advertisement`]: super::advertisement

use super::advertisement::{
    Advertisement, Edge, HAVE_HEADER, NEIGHBOURS_MAX, Routing, STAMP, Stamp,
};
use super::frame::FRAME_HEADER;
use super::link::Neighbour;
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

/// How a router behaves.
#[derive(Clone, Debug)]
pub struct RouterConfig {
    /// Our own name.
    pub node: NodeName,
    /// Our own life.
    pub incarnation: Incarnation,
    /// The most nodes that are remembered; more are refused and counted. Bounds memory and the time
    /// that a change takes.
    pub nodes_max: usize,
    /// How often we repeat what nothing has changed in. Shorter repairs sooner and costs more.
    pub refresh: Duration,
    /// A node that nobody has heard of for so long is forgotten. At least three times `refresh`.
    pub lifetime: Duration,
    /// How often neighbours compare what they know.
    pub compare: Duration,
    /// After how long an advertisement is repeated that a neighbour has not confirmed.
    pub resend: Duration,
    /// How many nodes may pass a packet on, at most 31.
    pub hops: u8,
}

impl RouterConfig {
    /// The usual behaviour for this node.
    pub fn new(node: NodeName, incarnation: Incarnation) -> Self {
        RouterConfig {
            node,
            incarnation,
            nodes_max: 256,
            refresh: Duration::from_secs(10),
            lifetime: Duration::from_secs(35),
            compare: Duration::from_secs(1),
            // Several round trips of any medium that a robot has, and still within one hello or two.
            resend: Duration::from_millis(40),
            hops: 16,
        }
    }
}

/// What a router must know of a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkStatus {
    /// Who is at its other end.
    pub neighbour: Neighbour,
    /// It carries, or it does not.
    pub health: Health,
    /// How dear it is to use; the cheaper of two paths is taken. 0 counts as 1.
    pub cost: u16,
    /// The largest frame that it carries, in bytes.
    pub mtu: usize,
}

/// Whether a link can be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Health {
    /// It carries.
    Up,
    /// It may have failed: taken only where there is no other way.
    Suspect,
    /// It does not carry.
    Down,
}

/// What a router wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum RouterOutput {
    /// Give this to the link as the router's own.
    Routing {
        /// Which link.
        link: LinkNumber,
        /// What.
        bytes: Bytes,
    },
    /// Give this packet to the link.
    Packet {
        /// Which link.
        link: LinkNumber,
        /// The packet.
        packet: Bytes,
    },
    /// A segment arrived for our session with the source.
    Segment {
        /// Who sent it.
        source: NodeId,
        /// The segment.
        segment: Bytes,
    },
    /// A packet of ours could not be delivered.
    Undelivered {
        /// Where it should have gone.
        destination: NodeId,
        /// Why it did not.
        reason: Undelivered,
    },
    /// A node can be reached, or has a new incarnation.
    Reachable {
        /// Which.
        node: NodeName,
        /// In which of its lives.
        incarnation: Incarnation,
        /// The largest segment that can be sent to it, in bytes.
        mtu: usize,
    },
    /// What is sent to this node takes another way from now on. Repeat what is not acknowledged.
    PathChanged {
        /// Which.
        node: NodeId,
        /// The largest segment that can be sent to it, in bytes.
        mtu: usize,
    },
    /// No path leads to a node any more.
    Lost {
        /// Which.
        node: NodeName,
        /// In which of its lives.
        incarnation: Incarnation,
    },
    /// Two names give one node number. The second is ignored; give it another name.
    NumberTaken {
        /// Who has it.
        node: NodeName,
        /// Who is ignored.
        refused: NodeName,
    },
    /// A node of our name has come up elsewhere in the network.
    NameTaken {
        /// Its incarnation, greater than ours.
        incarnation: Incarnation,
    },
}

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
        let suspect = health == Health::Suspect;
        let (cost, mtu) = (cost.max(1), mtu.min(u16::MAX.into()) as u16);
        match self.links.get_mut(&link) {
            Some(adjacent) if adjacent.neighbour == neighbour => {
                let same = adjacent.cost == cost && adjacent.mtu == mtu;
                (adjacent.cost, adjacent.mtu, adjacent.suspect) = (cost, mtu, suspect);
                if same {
                    self.choose_anew();
                } else {
                    self.announce_links();
                }
            }
            _ => {
                let pending = BTreeMap::new();
                let adjacent =
                    Adjacent { neighbour, id, cost, mtu, suspect, pending, compare_at: now };
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

    /// The look-up: the next hop if it is well, else the alternate, else either if it carries at
    /// all; never back to where the packet came from.
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
                    if old.chosen == route.chosen && old.mtu == route.mtu {
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
mod tests {
    use super::*;

    const FIRST: LinkNumber = LinkNumber(0);
    const SECOND: LinkNumber = LinkNumber(1);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn named(name: &str) -> NodeName {
        NodeName::new(name).unwrap()
    }

    fn id(name: &str) -> NodeId {
        NodeId::of(&named(name))
    }

    /// Whoever tests speaks for the neighbours.
    fn router() -> Router {
        Router::new(RouterConfig::new(named("own"), Incarnation(1)), at(1000))
    }

    fn up(neighbour: &str, cost: u16) -> LinkStatus {
        let neighbour = Neighbour { node: named(neighbour), incarnation: Incarnation(1) };
        LinkStatus { neighbour, health: Health::Up, cost, mtu: 1400 }
    }

    fn advertisement(node: &str, sequence: u32, edges: &[(&str, u16)]) -> Advertisement {
        let stamp = Stamp { origin: id(node), incarnation: Incarnation(1), sequence };
        let edge = |(to, cost): &(&str, u16)| Edge { to: id(to), cost: *cost, mtu: 1400 };
        Advertisement { stamp, node: named(node), edges: edges.iter().map(edge).collect() }
    }

    fn tell(router: &mut Router, link: LinkNumber, told: Advertisement, now: u64) {
        router.handle_routing(link, Routing::Announce(vec![told]).encode(), at(now));
    }

    fn outputs(router: &mut Router, now: u64) -> Vec<RouterOutput> {
        router.handle_timeout(at(now));
        std::iter::from_fn(|| router.poll_output()).collect()
    }

    fn without_routing(outputs: Vec<RouterOutput>) -> Vec<RouterOutput> {
        outputs.into_iter().filter(|o| !matches!(o, RouterOutput::Routing { .. })).collect()
    }

    fn announced(outputs: &[RouterOutput], link: LinkNumber) -> Vec<Advertisement> {
        let bytes = outputs.iter().filter_map(|output| match output {
            RouterOutput::Routing { link: on, bytes } if *on == link => Some(bytes.clone()),
            _ => None,
        });
        bytes
            .filter_map(|bytes| match Routing::decode(bytes) {
                Ok(Routing::Announce(told)) => Some(told),
                _ => None,
            })
            .flatten()
            .collect()
    }

    /// Two ways to `far`, over `left` and over `right`; `left` is cheaper.
    fn between_two() -> Router {
        let mut router = router();
        router.handle_link(FIRST, up("left", 1), at(1000));
        router.handle_link(SECOND, up("right", 5), at(1000));
        tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1), ("far", 1)]), 1000);
        tell(&mut router, SECOND, advertisement("right", 1, &[("own", 5), ("far", 1)]), 1000);
        tell(&mut router, FIRST, advertisement("far", 1, &[("left", 1), ("right", 1)]), 1000);
        let reached = without_routing(outputs(&mut router, 1010));
        assert_eq!(reached.len(), 3, "{reached:?}");
        router
    }

    fn packet_to(destination: &str, hops: u8) -> Packet {
        let payload = Payload::Segment(Bytes::from_static(b"segment"));
        let (destination, source) = (id(destination), id("source"));
        Packet { class: Class::Data, hops, destination, source, payload }
    }

    fn over(output: Option<RouterOutput>) -> Option<LinkNumber> {
        match output {
            Some(RouterOutput::Packet { link, .. }) => Some(link),
            _ => None,
        }
    }

    #[test]
    fn the_alternate_is_known_ahead_and_taken_without_any_computation() {
        let mut router = between_two();
        let route = router.route(id("far")).unwrap();
        assert_eq!((route.next, route.alternate, route.cost), (FIRST, Some(SECOND), 2));
        let segment = || Bytes::from_static(b"segment");
        router.handle_segment(id("far"), Class::Data, segment());
        assert_eq!(over(router.poll_output()), Some(FIRST));

        let suspect = LinkStatus { health: Health::Suspect, ..up("left", 1) };
        router.handle_link(FIRST, suspect, at(1020));

        let changed = RouterOutput::PathChanged { node: id("far"), mtu: 1389 };
        let told: Vec<_> = std::iter::from_fn(|| router.poll_output()).collect();
        assert!(told.contains(&changed), "{told:?}");
        router.handle_segment(id("far"), Class::Data, segment());
        assert_eq!(over(router.poll_output()), Some(SECOND));
    }

    #[test]
    fn a_way_that_would_lead_back_is_no_alternate() {
        let mut router = router();
        router.handle_link(FIRST, up("left", 1), at(1000));
        router.handle_link(SECOND, up("right", 1), at(1000));
        // What `right` sends to `left` it sends through us.
        tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1)]), 1000);
        tell(&mut router, SECOND, advertisement("right", 1, &[("own", 1)]), 1000);
        outputs(&mut router, 1010);

        assert_eq!(router.route(id("left")).unwrap().alternate, None);
    }

    #[test]
    fn an_edge_counts_only_if_both_ends_announce_it() {
        let mut router = router();
        router.handle_link(FIRST, up("left", 1), at(1000));
        tell(&mut router, FIRST, advertisement("left", 1, &[("own", 1), ("far", 1)]), 1000);
        tell(&mut router, FIRST, advertisement("far", 1, &[]), 1000);
        outputs(&mut router, 1010);
        assert!(router.route(id("far")).is_none());

        tell(&mut router, FIRST, advertisement("far", 2, &[("left", 1)]), 1020);
        let told = without_routing(outputs(&mut router, 1030));

        assert!(
            matches!(&told[..], [RouterOutput::Reachable { node, .. }] if *node == named("far"))
        );
    }

    #[test]
    fn a_packet_is_passed_on_with_one_hop_less_and_never_back() {
        let mut router = between_two();

        router.handle_packet(SECOND, packet_to("far", 3).encode(), at(1020));
        let Some(RouterOutput::Packet { link: FIRST, packet }) = router.poll_output() else {
            panic!("it goes on over the cheaper way");
        };
        assert_eq!(Packet::decode(packet).unwrap().hops, 2);

        router.handle_packet(FIRST, packet_to("far", 3).encode(), at(1020));
        assert_eq!(over(router.poll_output()), Some(SECOND), "never back to where it came from");
    }

    #[test]
    fn what_cannot_be_delivered_comes_back_with_the_reason() {
        let mut router = between_two();
        // The source is the node called right.
        let from_right = |destination, hops| {
            let packet = Packet { source: id("right"), ..packet_to(destination, hops) };
            packet.encode()
        };
        let check = |router: &mut Router, expected| {
            let Some(RouterOutput::Packet { packet, .. }) = router.poll_output() else {
                panic!("nothing came back");
            };
            let Ok(Packet { destination, payload: Payload::Return { reason, .. }, .. }) =
                Packet::decode(packet)
            else {
                panic!("it is no return");
            };
            assert_eq!((destination, reason), (id("right"), expected));
        };

        router.handle_packet(SECOND, from_right("nowhere", 5), at(1020));
        check(&mut router, Undelivered::NoRoute);
        router.handle_packet(SECOND, from_right("far", 0), at(1020));
        check(&mut router, Undelivered::TooManyHops);
        router.handle_segment(id("nowhere"), Class::Data, Bytes::new());
        let (destination, reason) = (id("nowhere"), Undelivered::NoRoute);
        let undelivered = RouterOutput::Undelivered { destination, reason };
        assert_eq!(router.poll_output(), Some(undelivered));
        router.handle_segment(id("far"), Class::Data, Bytes::from(vec![0; 1400]));
        let (destination, reason) = (id("far"), Undelivered::TooLarge);
        let undelivered = RouterOutput::Undelivered { destination, reason };
        assert_eq!(router.poll_output(), Some(undelivered));
        // A return that cannot be delivered is not returned again.
        let payload = Payload::Return { destination: id("far"), reason: Undelivered::NoRoute };
        let returned = Packet { payload, ..packet_to("nowhere", 3) };
        router.handle_packet(SECOND, returned.encode(), at(1020));
        assert_eq!(router.poll_output(), None);
    }

    #[test]
    fn news_is_passed_on_at_once_and_repeated_until_confirmed() {
        let mut router = between_two();
        let news = advertisement("far", 2, &[("left", 1)]);

        tell(&mut router, FIRST, news.clone(), 1020);
        assert_eq!(announced(&outputs(&mut router, 1020), SECOND), [news.clone()]);
        let again = outputs(&mut router, 1065);
        assert!(announced(&again, SECOND).contains(&news));

        let stamps = vec![news.stamp];
        let confirm = Routing::Have { range: None, stamps };
        router.handle_routing(SECOND, confirm.encode(), at(1070));
        let later = outputs(&mut router, 1200);
        assert!(!announced(&later, SECOND).contains(&news));
    }

    #[test]
    fn old_news_is_answered_with_newer_news() {
        let mut router = between_two();
        tell(&mut router, FIRST, advertisement("far", 5, &[("left", 1)]), 1020);
        outputs(&mut router, 1030);

        tell(&mut router, SECOND, advertisement("far", 4, &[]), 1040);

        let answer = announced(&outputs(&mut router, 1040), SECOND);
        assert_eq!(
            answer.iter().find(|told| told.stamp.origin == id("far")).unwrap().stamp.sequence,
            5
        );
        assert!(router.refusals().stale >= 1);
    }

    #[test]
    fn what_a_neighbour_lacks_is_seen_in_its_list_and_sent() {
        let mut router = between_two();
        outputs(&mut router, 1030);

        let range = Some((NodeId(0), NodeId(u32::MAX)));
        let nothing = Routing::Have { range, stamps: vec![] };
        router.handle_routing(SECOND, nothing.encode(), at(1031));

        let sent = announced(&outputs(&mut router, 1031), SECOND);
        let mut origins: Vec<_> = sent.iter().map(|told| told.node.as_str()).collect();
        origins.sort();
        assert_eq!(origins, ["far", "left", "own", "right"]);
    }

    #[test]
    fn a_node_that_nobody_repeats_is_forgotten() {
        let mut router = between_two();
        for now in (2000..60_000).step_by(1000) {
            let sequence = now as u32;
            let left = advertisement("left", sequence, &[("own", 1), ("far", 1)]);
            let right = advertisement("right", sequence, &[("own", 5), ("far", 1)]);
            tell(&mut router, FIRST, left, now);
            tell(&mut router, SECOND, right, now);
            outputs(&mut router, now);
        }
        assert!(router.route(id("far")).is_none());
        assert!(router.route(id("left")).is_some());
    }

    #[test]
    fn a_restarted_node_is_told_with_its_new_life() {
        let mut router = between_two();
        let mut reborn = advertisement("far", 1, &[("left", 1), ("right", 1)]);
        reborn.stamp.incarnation = Incarnation(2);

        tell(&mut router, FIRST, reborn, 1020);

        let told = without_routing(outputs(&mut router, 1030));
        let (node, incarnation) = (named("far"), Incarnation(2));
        assert_eq!(told, [RouterOutput::Reachable { node, incarnation, mtu: 1389 }]);
    }

    #[test]
    fn a_router_built_anew_counts_on_and_tells_what_it_cannot_find_again() {
        let config = RouterConfig::new(named("own"), Incarnation(1));
        let reached = ["left", "gone"].map(|node| (named(node), Incarnation(1)));
        let mut router = Router::reborn(config, reached, at(1000));
        router.handle_link(FIRST, up("left", 1), at(1000));

        // The neighbour still holds what the old router said.
        tell(&mut router, FIRST, advertisement("own", 57, &[("left", 1)]), 1001);

        let told = announced(&outputs(&mut router, 1010), FIRST);
        assert_eq!(told.last().unwrap().stamp.sequence, 58);
        let lost = without_routing(outputs(&mut router, 2100));
        let (node, incarnation) = (named("gone"), Incarnation(1));
        assert_eq!(lost, [RouterOutput::Lost { node, incarnation }]);
    }

    #[test]
    fn a_second_node_of_our_name_is_told_once() {
        let mut router = between_two();
        let mut usurper = advertisement("own", 1, &[]);
        usurper.stamp.incarnation = Incarnation(9);

        for now in [1020, 1030, 1040] {
            tell(&mut router, FIRST, usurper.clone(), now);
        }

        let told = without_routing(outputs(&mut router, 1050));
        assert_eq!(told, [RouterOutput::NameTaken { incarnation: Incarnation(9) }]);
    }

    #[test]
    fn a_link_that_cannot_carry_an_advertisement_is_not_used() {
        let mut router = router();
        let narrow = LinkStatus { mtu: MTU_MIN - 1, ..up("left", 1) };

        router.handle_link(FIRST, narrow, at(1000));

        assert_eq!(outputs(&mut router, 1010), []);
    }
}
