//! The next hop on the path to each node, and an alternate if that fails.
//!
//! Every router advertises its links to all others (see [`advertisement`]); each computes the
//! shortest paths by itself. Beside the next hop it keeps a loop-free alternate (RFC 5286,
//! inequality 1), so that a failing link costs one look-up.
//!
//! An edge counts only if both its ends advertise it, so the last advertisement of a dead node
//! leads nowhere.
//!
//! [`advertisement`]: super::wire::advertisement

mod database;
mod keys;
mod names;
mod timers;
mod types;

pub mod topology;

pub use self::keys::RouterKeys;
pub use self::types::{LinkHealth, LinkStatus, RouterConfig, RouterOutput};

use self::database::{AdvertisementDatabase, DatabaseEntry};
use self::keys::{CHECKS_MAX, CHECKS_PERIOD, SignatureCheck};
use self::names::{NameContest, UnusedLink, status_of};
use self::topology::{Adjacency, Route, RouteTable, Topology, patience};
use super::wire::Refusals;
use super::wire::advertisement::{
    Advertisement, AdvertisementId, Edge, HAVE_HEADER, ID_LENGTH, NEIGHBOURS_MAX, RoutingMessage,
};
use super::wire::frame::FRAME_HEADER;
use super::wire::link_id::LinkId;
use super::wire::node_id::NodeId;
use super::wire::packet::{
    HOPS_MAX, PACKET_HEADER, Packet, PacketPriority, Payload, UndeliveredReason,
};
use crate::sorted::SortedMap;
use crate::timer::Timers;
use crate::{GatherBuffer, Incarnation, Instant, Machine, NodeName, SlidingWindow};
use bytes::Bytes;
use std::collections::{BTreeSet, VecDeque};
use std::time::Duration;

/// The machine of a node's router.
#[derive(Debug)]
pub struct Router {
    config: RouterConfig,
    links: SortedMap<LinkId, Adjacency>,
    isolation: IsolatedNodes,
    database: AdvertisementDatabase,
    table: RouteTable,
    names: NameContest,
    /// Signatures and seals, where nodes have keys.
    keys: Option<RouterKeys>,
    /// Nodes that the router before this one could reach, and until when they may take to be found
    /// again.
    remembered: Option<(Instant, Vec<(NodeName, Incarnation)>)>,
    /// No timer is due before. It is lowered by what starts one, and found again when it has come:
    /// inputs look at no collection of links or advertisements.
    wake_at: Instant,
    now: Instant,
    refusals: Refusals,
    outputs: VecDeque<RouterOutput>,
}

/// Nodes that nothing is accepted from and sent to, as many as there are decisions.
#[derive(Debug, Default)]
struct IsolatedNodes {
    nodes: BTreeSet<NodeId>,
    /// Links to them, which are not used.
    links: SortedMap<LinkId, LinkStatus>,
}

/// A link's smallest MTU in bytes: the hello of a node with the longest name fits, and half of a
/// frame and more is the message's. Only what routers tell each other is cut below the packet, by
/// the link.
pub const MTU_MIN: usize = 96;

impl Router {
    /// A node with news announces it at once, and again after 5 ms for each of its links: it sends
    /// its neighbours 200 announcements a second at most, however often its links change (OSPF:
    /// MinLSInterval).
    const PACE: Duration = Duration::from_millis(5);

    /// How often a node repeats what nothing has changed in.
    const REFRESH: Duration = Duration::from_secs(10);
    /// A node that was not announced for so long is forgotten: at least three refreshes.
    const LIFETIME: Duration = Duration::from_secs(35);
    /// How often neighbours compare what they know; ten times as rarely over narrow media.
    const COMPARE: Duration = Duration::from_secs(1);
    /// After how long an advertisement is repeated that a neighbour has not confirmed, then after
    /// twice that and so on up to eight times it; ten times as long over narrow media: several
    /// round trips of any medium that a robot has, and still within one hello or two.
    const RESEND: Duration = Duration::from_millis(40);

    /// A router without links.
    pub fn new(config: RouterConfig, now: Instant) -> Self {
        let wake_at = now + Self::REFRESH;
        Router {
            links: SortedMap::new(),
            isolation: IsolatedNodes::default(),
            database: AdvertisementDatabase::new(&config, now),
            table: RouteTable::default(),
            names: NameContest::default(),
            config,
            keys: None,
            remembered: None,
            wake_at,
            now,
            refusals: Refusals::default(),
            outputs: VecDeque::new(),
        }
    }

    /// A router in the place of one that failed. It learns its links and the network again; nodes
    /// that the old one could reach and this one does not find are reported as lost.
    pub fn restarted(
        config: RouterConfig,
        reached: impl IntoIterator<Item = (NodeName, Incarnation)>,
        now: Instant,
    ) -> Self {
        let mut router = Router::new(config, now);
        // Neighbours compare what they know at once, and again after this.
        let until = now + Self::COMPARE;
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
        self.table.routes.get(&node)
    }

    /// Whether a link's hellos have said that this incarnation of a node is at its other end.
    pub fn is_neighbour(&self, node: &NodeName, incarnation: Incarnation) -> bool {
        let mut neighbours = self.links.values().map(|link| &link.neighbour);
        neighbours.any(|peer| peer.node == *node && peer.incarnation == incarnation)
    }

    /// Whether a path leads to a node now, by everything that is known; `None` while all paths lead
    /// over suspect links.
    pub fn verdict(&mut self, node: NodeId, now: Instant) -> Option<bool> {
        self.now = now;
        if self.table.compute_at.is_some() {
            self.compute();
        }
        let Some(chosen) = self.table.routes.get(&node).and_then(|route| route.chosen) else {
            return Some(false);
        };
        let health = self.links.get(&chosen).map_or(LinkHealth::Down, |link| link.health);
        (health < LinkHealth::Suspect).then_some(true)
    }

    /// Every node that can be reached, with the route to it.
    pub fn routes(&self) -> impl Iterator<Item = (NodeId, &Route)> {
        self.table.routes.iter().map(|(node, route)| (*node, route))
    }

    /// A link's state, cost or size has changed.
    pub fn handle_link(&mut self, link: LinkId, status: LinkStatus, now: Instant) {
        self.now = now;
        let LinkStatus { neighbour, health, cost, mtu } = status;
        let id = NodeId::of(&neighbour.node);
        let known = self.database.newest(id).map(|known| &known.node);
        if let Some(known) = known.filter(|known| **known != neighbour.node).cloned() {
            return self.tell_collision(known, neighbour.node);
        }
        self.isolation.links.remove(&link);
        if self.isolation.nodes.contains(&id) {
            self.names.unused.remove(&link);
            if self.links.remove(&link).is_some() {
                self.announce_links();
            }
            if health != LinkHealth::Down {
                self.isolation.links.insert(link, LinkStatus { neighbour, health, cost, mtu });
            }
            return;
        }
        if health != LinkHealth::Down && self.is_kept_out(link, &neighbour) {
            return self.set_aside(link, LinkStatus { neighbour, health, cost, mtu });
        }
        let was_unused = self.names.unused.remove(&link).is_some();
        if health == LinkHealth::Down || mtu < MTU_MIN {
            if self.links.remove(&link).is_some() || was_unused {
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
                self.choose_anew();
                if !same {
                    self.announce_links();
                }
            }
            _ => {
                let pending = SortedMap::new();
                self.links.insert(
                    link,
                    Adjacency {
                        neighbour,
                        id,
                        cost,
                        mtu,
                        health,
                        pending,
                        compare_at: now,
                        keys_differ: false,
                        checks: SlidingWindow::new(CHECKS_MAX, CHECKS_PERIOD),
                    },
                );
                self.set_silent_aside(link);
                self.announce_links();
                self.compare(link);
            }
        }
    }

    /// A node is isolated: nothing is accepted from it or sent to it, its packets are not
    /// forwarded, and no path leads over it. Or it is admitted again.
    pub fn handle_isolation(&mut self, node: &NodeName, isolated: bool, now: Instant) {
        self.now = now;
        let id = NodeId::of(node);
        let changed = if isolated {
            self.isolation.nodes.insert(id)
        } else {
            self.isolation.nodes.remove(&id)
        };
        if !changed || id == self.database.id() {
            return;
        }
        self.outdate();
        if !isolated {
            for (link, status) in std::mem::take(&mut self.isolation.links) {
                self.handle_link(link, status, now);
            }
            return;
        }
        let near = self.links.iter().filter(|(_, adjacent)| adjacent.id == id);
        let near: Vec<_> = near.map(|(link, adjacent)| (*link, status_of(adjacent))).collect();
        if near.is_empty() {
            return;
        }
        self.links.retain(|_, adjacent| adjacent.id != id);
        self.choose_anew();
        self.announce_links();
        self.isolation.links.extend(near);
    }

    /// A message of a neighbour's router was received.
    pub fn handle_routing(&mut self, link: LinkId, bytes: Bytes, now: Instant) {
        self.now = now;
        if self.isolation.links.contains_key(&link) {
            self.refusals.isolated += 1;
            return;
        }
        if !self.links.contains_key(&link) {
            self.refusals.unexpected += 1;
            return self.handle_kept_out(link);
        }
        match RoutingMessage::decode(bytes) {
            Ok(RoutingMessage::Announce(advertisements)) => {
                self.handle_announce(link, advertisements)
            }
            Ok(RoutingMessage::Have { range, ids }) => self.handle_have(link, range, &ids),
            Err(error) => self.refusals.count(&error),
        }
    }

    fn outdate(&mut self) {
        self.wake_at = self.wake_at.min(self.table.outdate(self.now));
    }

    /// The network as it is known, with these links of this node.
    fn topology_over<'a>(&'a self, links: &'a SortedMap<LinkId, Adjacency>) -> Topology<'a> {
        let known = self.database.known.iter().filter(|(id, _)| !self.isolation.nodes.contains(id));
        let known = known.map(|(id, known)| (*id, &known.advertisement));
        let overhead = self.keys.as_ref().map_or(0, RouterKeys::overhead);
        Topology::new(self.database.id(), overhead, links, known)
    }

    /// Computes the paths again and reports what has changed.
    fn compute(&mut self) {
        let routes = self.topology_over(&self.links).routes();
        let mut before = self.table.replace(routes, self.now);
        let mut found = Vec::new();
        for (id, route) in &self.table.routes {
            let (mtu, incarnation) = (route.segment_limit(), route.incarnation);
            let output = match before.remove(id) {
                Some(old) if old.incarnation == incarnation => {
                    if !old.must_repeat_over(route) {
                        continue;
                    }
                    RouterOutput::PathChanged { node: *id, mtu }
                }
                _ => {
                    found.push(*id);
                    RouterOutput::Reachable { node: route.node.clone(), incarnation, mtu }
                }
            };
            self.outputs.push_back(output);
        }
        for (id, Route { node, incarnation, .. }) in before {
            self.stop_asking_for_keys(id);
            self.outputs.push_back(RouterOutput::Lost { node, incarnation });
        }
        found.into_iter().for_each(|id| self.ask_for_keys(id));
        self.collect_seals();
        self.use_links_again();
    }

    fn report_not_found_again(&mut self) {
        for (node, incarnation) in self.remembered.take().into_iter().flat_map(|(_, nodes)| nodes) {
            if !self.table.routes.contains_key(&NodeId::of(&node)) {
                self.outputs.push_back(RouterOutput::Lost { node, incarnation });
            }
        }
    }

    /// Link by link: sends again what was not confirmed, and the summary of the database.
    fn synchronise(&mut self, now: Instant) {
        let numbers: Vec<_> = self.links.keys().copied().collect();
        for link in numbers {
            let Some(adjacent) = self.links.get(&link) else { continue };
            let due = adjacent.pending.iter().filter(|(_, (again, _))| *again <= now);
            let due: Vec<_> = due.map(|(origin, _)| *origin).collect();
            let compare = adjacent.compare_at <= now;
            if !due.is_empty() {
                self.announce(link, &due);
            }
            if compare {
                self.compare(link);
            }
        }
    }

    /// When our own links are announced next.
    pub(super) fn refresh_due(&self) -> Instant {
        let links = u32::try_from(self.links.len()).unwrap_or(u32::MAX);
        let paced = Self::PACE.saturating_mul(links).min(Self::REFRESH);
        self.database.announced_at + if self.database.has_news { paced } else { Self::REFRESH }
    }

    /// Our own links have changed: all nodes must know.
    pub(super) fn announce_links(&mut self) {
        self.outdate();
        self.database.has_news = true;
        if self.database.own.edges.is_empty() || self.refresh_due() <= self.now {
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
        let challenges = self.names.unused.values().map(UnusedLink::challenge);
        self.database.own.edges =
            edges.into_values().chain(challenges).take(NEIGHBOURS_MAX).collect();
        self.database.own.id.sequence = self.database.own.id.sequence.saturating_add(1);
        self.sign();
        (self.database.announced_at, self.database.has_news) = (self.now, false);
        self.flood(self.database.id(), None);
    }

    /// Gives an origin's newest advertisement to every neighbour that has it neither from the
    /// origin itself nor from the neighbour that it came from. Among `n` nodes that are all linked
    /// to each other, one change then takes `n - 1` messages, where each node told all others.
    ///
    /// Nothing is lost for good. The origin repeats its advertisement to the neighbours in it until
    /// they confirm it. If such a link fails, the origin's next advertisement does not list it, and
    /// is passed on. If the origin fails, neighbours that compare what they know find the rest.
    pub(super) fn flood(&mut self, origin: NodeId, except: Option<LinkId>) {
        let Some(advertisement) = self.database.advertisement(origin) else { return };
        let links = advertisement.edges.iter().filter(|edge| edge.mtu != Edge::CHALLENGE);
        let told: BTreeSet<_> = links.map(|edge| (edge.to, edge.incarnation)).collect();
        let lacks = |(link, adjacent): (&LinkId, &Adjacency)| {
            let incarnation = Edge::incarnation_tag(adjacent.neighbour.incarnation);
            let has_it = origin != self.database.id() && told.contains(&(adjacent.id, incarnation));
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
        let first = patience(adjacent.mtu, Self::RESEND);
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
        for advertisement in
            origins.iter().filter_map(|origin| self.database.advertisement(*origin))
        {
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
        adjacent.compare_at = self.now + patience(adjacent.mtu, Self::COMPARE);
        self.wake_at = self.wake_at.min(adjacent.compare_at);
        let capacity = (usize::from(adjacent.mtu) - FRAME_HEADER - HAVE_HEADER) / ID_LENGTH;
        let ids = self.database.ids();
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
        let mut better = BTreeSet::new();
        for advertisement in advertisements {
            let id = advertisement.id;
            let held = self.database.advertisement(id.origin);
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
            let held = self.database.advertisement(id.origin);
            if let Some(held) = held.filter(|held| held.node != advertisement.node) {
                self.tell_collision(held.node.clone(), advertisement.node);
            } else if id.origin == self.database.id() {
                self.outdo(&advertisement);
            } else if held.is_none() && self.database.known.len() >= self.config.nodes_max {
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
        let expires = self.now + Self::LIFETIME;
        self.wake_at = self.wake_at.min(expires);
        let before = self.database.known.remove(&origin).map(|before| before.advertisement);
        let same = before.is_some_and(|before| {
            before.edges == advertisement.edges && before.incarnation == advertisement.incarnation
        });
        self.answer_challenge(&advertisement);
        self.database.known.insert(origin, DatabaseEntry { advertisement, expires });
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
            let held = self.database.advertisement(origin).map_or(nothing, |held| held.id);
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
            let listed: BTreeSet<_> = ids.iter().map(|s| s.origin).collect();
            let held = self.database.known.range(first..=last).map(|(origin, _)| *origin);
            let own = (first..=last).contains(&self.database.id()).then_some(self.database.id());
            better.extend(held.chain(own).filter(|origin| !listed.contains(origin)));
        }
        if !better.is_empty() {
            self.announce(link, &better);
        }
        self.say_have(link, wanted);
    }

    pub(super) fn tell_collision(&mut self, node: NodeName, refused: NodeName) {
        self.refusals.unexpected += 1;
        if self.names.is_new_conflict(&node, &refused, self.now) {
            self.outputs.push_back(RouterOutput::NumberTaken { node, refused });
        }
    }

    pub(super) fn forget_the_old(&mut self) {
        if self.database.expire(self.now) {
            self.outdate();
        }
    }

    /// A packet came over a link.
    pub fn handle_packet(&mut self, link: LinkId, packet: Bytes, now: Instant) {
        self.now = now;
        let packet = match Packet::decode(packet) {
            Ok(packet) => packet,
            Err(error) => return self.refusals.count(&error),
        };
        if self.isolation.links.contains_key(&link) || self.isolation.nodes.contains(&packet.source)
        {
            self.refusals.isolated += 1;
        } else if self.names.unused.contains_key(&link) {
            self.refusals.unexpected += 1;
        } else if packet.source == self.database.id() {
            // It went in a circle, as packets may while nodes hear of a change one after the other,
            // and is repeated. Or another node uses our name; then the session asks no more often
            // than it would.
            self.refusals.unexpected += 1;
            self.give_back(&packet, UndeliveredReason::TooManyHops);
        } else if packet.destination != self.database.id() {
            self.forward(packet, link);
        } else {
            match packet.payload {
                Payload::Segment(segment) => {
                    self.take_segment(link, packet.source, segment.into_bytes());
                }
                Payload::Return { destination, reason } => {
                    self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
                }
            }
        }
    }

    /// Our session with `destination` wants this sent.
    pub fn handle_segment(
        &mut self,
        destination: NodeId,
        class: PacketPriority,
        segment: GatherBuffer,
    ) {
        let Some(link) = self.choose(destination, &[]) else {
            let reason = UndeliveredReason::NoRoute;
            return self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
        };
        // Before there are keys it waits with the session, which repeats it.
        let Some(segment) = self.protect(destination, link, class, segment) else { return };
        self.originate(link, destination, class, Payload::Segment(segment));
    }

    /// Sends a copy over every link to the destination and over both next hops of its route: the
    /// first one that arrives counts. A link that is too small for it is left out.
    pub fn handle_copies(
        &mut self,
        destination: NodeId,
        class: PacketPriority,
        segment: &GatherBuffer,
    ) {
        let seal = self.keys.as_ref().map_or(0, RouterKeys::overhead);
        let fits = |adjacent: &Adjacency| {
            let seal = if adjacent.id == destination { 0 } else { seal };
            segment.len() + seal + FRAME_HEADER + PACKET_HEADER <= adjacent.mtu.into()
        };
        let route = self.table.routes.get(&destination);
        let hops = route.map(|route| [Some(route.next), route.alternate]).unwrap_or_default();
        let leads = |link: &LinkId, adjacent: &Adjacency| {
            (adjacent.id == destination || hops.contains(&Some(*link))) && fits(adjacent)
        };
        let links = self.links.iter().filter(|(link, adjacent)| leads(link, adjacent));
        let links: Vec<_> = links.map(|(link, _)| *link).collect();
        if links.is_empty() {
            // It comes back, with the reason.
            return self.handle_segment(destination, class, segment.clone());
        }
        for link in links {
            if let Some(copy) = self.protect(destination, link, class, segment.clone()) {
                self.originate(link, destination, class, Payload::Segment(copy));
            }
        }
    }

    /// Sends a packet of this node's own over a link.
    pub(super) fn originate(
        &mut self,
        link: LinkId,
        destination: NodeId,
        class: PacketPriority,
        payload: Payload,
    ) {
        let (hops, source, passed) =
            (self.config.hops.min(HOPS_MAX), self.database.id(), Vec::new());
        self.pass(link, &Packet { class, hops, destination, source, passed, payload });
    }

    /// Forwards a packet that came over a link, to no node that has had it: nodes that hear of a
    /// change one after the other may each believe that another is nearer.
    pub(super) fn forward(&mut self, mut packet: Packet, from: LinkId) {
        let here_before = packet.passed.contains(&self.database.id());
        let (false, Some(hops)) = (here_before, packet.hops.checked_sub(1)) else {
            return self.give_back(&packet, UndeliveredReason::TooManyHops);
        };
        let from = self.links.get(&from).map(|adjacent| adjacent.id);
        let had: Vec<_> =
            packet.passed.iter().copied().chain([packet.source]).chain(from).collect();
        packet.hops = hops;
        match self.choose(packet.destination, &had) {
            Some(_) if packet.passed.len() >= HOPS_MAX.into() => {
                self.give_back(&packet, UndeliveredReason::TooManyHops);
            }
            Some(link) => {
                packet.passed.push(self.database.id());
                self.pass(link, &packet);
            }
            None => self.give_back(&packet, UndeliveredReason::NoRoute),
        }
    }

    pub(super) fn pass(&mut self, link: LinkId, packet: &Packet) {
        let encoded = packet.parcel();
        let mtu = self.links.get(&link).map_or(0, |adjacent| usize::from(adjacent.mtu));
        if encoded.len() + FRAME_HEADER > mtu {
            return self.give_back(packet, UndeliveredReason::TooLarge);
        }
        self.outputs.push_back(RouterOutput::Packet { link, packet: encoded });
    }

    /// Tells a packet's source that it went no further. Nothing is said about a return.
    pub(super) fn give_back(&mut self, packet: &Packet, reason: UndeliveredReason) {
        let Payload::Segment(_) = packet.payload else { return };
        let destination = packet.destination;
        if packet.source == self.database.id() {
            self.outputs.push_back(RouterOutput::Undelivered { destination, reason });
            return;
        }
        let payload = Payload::Return { destination, reason };
        if let Some(link) = self.choose(packet.source, &[]) {
            self.originate(link, packet.source, PacketPriority::Control, payload);
        }
    }

    /// The look-up: the next hop if it is well, else the alternate, else whichever is better off;
    /// none that has had the packet.
    pub(super) fn choose(&self, destination: NodeId, had: &[NodeId]) -> Option<LinkId> {
        self.table.routes.get(&destination)?.choose(&self.links, had)
    }

    /// Links have come, gone or become suspect: some nodes are now reached another way.
    pub(super) fn choose_anew(&mut self) {
        for (node, route) in &mut self.table.routes {
            let chosen = route.choose(&self.links, &[]);
            if chosen != route.chosen {
                route.chosen = chosen;
                if chosen.is_some() {
                    let mtu = route.segment_limit();
                    self.outputs.push_back(RouterOutput::PathChanged { node: *node, mtu });
                }
            }
        }
    }
}

impl Machine for Router {
    type Output = RouterOutput;

    fn poll_output(&mut self) -> Option<RouterOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Some(self.wake_at)
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.now = now;
        self.fire_due(now);
        self.wake_at = self.next_due().unwrap_or_else(|| self.refresh_due());
    }
}

#[cfg(test)]
mod tests;
