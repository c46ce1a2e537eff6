//! The shortest paths through a network, and the alternates to them.

use super::{LinkHealth, MTU_MIN};
use crate::net::is_narrow;
use crate::net::link::Neighbour;
use crate::net::seal::INIT_LENGTH;
use crate::net::wire::advertisement::{Advertisement, Edge};
use crate::net::wire::frame::FRAME_HEADER;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::wire::packet::{HOPS_MAX, PACKET_HEADER, passed_length};
use crate::sorted::SortedMap;
use crate::{Incarnation, Instant, NodeName, SlidingWindow};
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Duration;

/// The way to one node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Route {
    /// The destination of the route.
    pub node: NodeName,
    /// In which incarnation.
    pub incarnation: Incarnation,
    /// The sum of the costs of the links on the shortest path.
    pub cost: u32,
    /// The link that the shortest path begins with.
    pub next: LinkId,
    /// The link to take when that one fails: its path does not lead back through this node.
    pub alternate: Option<LinkId>,
    /// The link that is taken now; `None` when none carries.
    pub chosen: Option<LinkId>,
    /// The largest frame that both paths carry, in bytes.
    pub mtu: u16,
    /// How many nodes pass a packet on along the longer of both.
    pub relays: u8,
    /// The bytes of a seal for the destination. They are kept free also where the next node is the
    /// destination, so that a detour changes no size.
    pub overhead: u8,
}

/// The routes to all nodes, and when they are computed again.
#[derive(Debug, Default)]
pub(crate) struct RouteTable {
    pub(crate) routes: SortedMap<NodeId, Route>,
    /// `None` while the routes are current.
    pub(crate) compute_at: Option<Instant>,
    computed_at: Instant,
}

impl RouteTable {
    /// The topology has changed. Returns when the routes are computed.
    pub(crate) fn outdate(&mut self, now: Instant) -> Instant {
        // A change is a burst of floods: the first is acted on at once, the others together.
        const TOGETHER: Duration = Duration::from_millis(5);
        *self.compute_at.get_or_insert(now.max(self.computed_at + TOGETHER))
    }

    /// Takes computed routes. Returns those before.
    pub(crate) fn replace(
        &mut self,
        routes: SortedMap<NodeId, Route>,
        now: Instant,
    ) -> SortedMap<NodeId, Route> {
        let table = RouteTable { routes, compute_at: None, computed_at: now };
        std::mem::replace(self, table).routes
    }
}

/// A link that carries, and what its neighbour still has to be told.
#[derive(Clone, Debug)]
pub(crate) struct Adjacency {
    pub(crate) neighbour: Neighbour,
    pub(crate) id: NodeId,
    pub(crate) cost: u16,
    pub(crate) mtu: u16,
    pub(crate) health: LinkHealth,
    /// Origins whose advertisement the neighbour has not confirmed, when to repeat it, and how long
    /// to wait after that.
    pub(crate) pending: SortedMap<NodeId, (Instant, Duration)>,
    pub(crate) compare_at: Instant,
    /// One end has keys, and the other has not, which was told.
    pub(crate) keys_differ: bool,
    /// The signatures that were checked for it.
    pub(crate) checks: SlidingWindow,
}

/// How long an answer over links with this MTU may take, where it takes so long on fast ones.
pub(crate) fn patience(mtu: u16, fast: Duration) -> Duration {
    fast * if is_narrow(segment_limit(mtu)) { 10 } else { 1 }
}

/// A path whose segments are smaller carries nothing: too many nodes pass on what fits into too
/// small frames.
pub(crate) const SEGMENT_MIN: usize = 40;

/// The bytes of a segment that fits into a frame of this size.
pub(crate) fn segment_limit(mtu: u16) -> usize {
    usize::from(mtu).saturating_sub(FRAME_HEADER + PACKET_HEADER)
}

/// The same, where so many nodes pass it on.
fn relayed_limit(mtu: u16, relays: u8) -> usize {
    const MORE: usize = 2;
    let relays = usize::from(relays.min(HOPS_MAX));
    let list = passed_length(if relays == 0 { 0 } else { relays + MORE });
    segment_limit(mtu).saturating_sub(list)
}

impl Route {
    /// The largest segment that both paths carry, with the list of those who pass it on. A way that
    /// becomes longer while it is under way adds two of them at most, or it comes back as too
    /// large.
    pub(crate) fn segment_limit(&self) -> usize {
        relayed_limit(self.mtu, self.relays).saturating_sub(self.overhead.into())
    }

    /// Whether what is under way here is to be repeated over its successor: it goes another way, in
    /// other pieces, or has become dearer, that is, has lost something further on.
    pub(crate) fn must_repeat_over(&self, next: &Route) -> bool {
        self.chosen != next.chosen
            || self.mtu != next.mtu
            || self.segment_limit() > next.segment_limit()
            || self.cost < next.cost
    }

    /// The next hop or the alternate, whichever is better off now, the next hop if both are alike;
    /// never to one of `had`.
    pub(crate) fn choose(
        &self,
        links: &SortedMap<LinkId, Adjacency>,
        had: &[NodeId],
    ) -> Option<LinkId> {
        let ways = [Some(self.next), self.alternate];
        let usable = ways.into_iter().flatten().filter_map(|link| {
            let adjacent = links.get(&link).filter(|adjacent| !had.contains(&adjacent.id))?;
            Some((adjacent.health, link))
        });
        // The first of those that are alike.
        usable.min_by_key(|(health, _)| *health).map(|(_, link)| link)
    }
}

/// The network as one node knows it.
pub(crate) struct Topology<'a> {
    here: NodeId,
    /// The bytes of a seal for a destination; 0 without keys.
    overhead: usize,
    links: &'a SortedMap<LinkId, Adjacency>,
    known: SortedMap<NodeId, &'a Advertisement>,
}

/// How far a node is from some other.
#[derive(Clone, Copy)]
struct Distance {
    cost: u32,
    mtu: u16,
    /// How many links the path has.
    links: u8,
}

/// How a packet comes to some node over a link of this one.
struct Way<'a> {
    cost: u32,
    number: LinkId,
    link: &'a Adjacency,
    mtu: u16,
    /// How many nodes pass it on.
    relays: u8,
    /// It would not come back here (RFC 5286, inequality 1).
    is_loop_free: bool,
}

impl<'a> Topology<'a> {
    pub(crate) fn new(
        here: NodeId,
        overhead: usize,
        links: &'a SortedMap<LinkId, Adjacency>,
        known: impl Iterator<Item = (NodeId, &'a Advertisement)>,
    ) -> Self {
        Topology { here, overhead, links, known: known.collect() }
    }

    pub(crate) fn routes(&self) -> SortedMap<NodeId, Route> {
        let from_here = self.distances(self.here);
        let neighbours = self.links.values().map(|adjacent| adjacent.id);
        let from_neighbours = neighbours.map(|id| (id, self.distances(id))).collect();
        from_here
            .iter()
            .filter(|(id, _)| **id != self.here)
            .filter_map(|(id, distance)| Some((*id, self.route(*id, *distance, &from_neighbours)?)))
            .collect()
    }

    fn route(
        &self,
        to: NodeId,
        from_here: Distance,
        from_neighbours: &SortedMap<NodeId, SortedMap<NodeId, Distance>>,
    ) -> Option<Route> {
        let mut ways: Vec<Way<'_>> = self
            .links
            .iter()
            .filter_map(|(&number, link)| {
                let from_neighbour = &from_neighbours[&link.id];
                let rest = from_neighbour.get(&to)?;
                let mtu = link.mtu.min(rest.mtu);
                let is_relayed = rest.links > 0 && self.overhead > 0;
                if is_relayed && relayed_limit(mtu, rest.links) < INIT_LENGTH {
                    return None;
                }
                let cost = rest.cost.saturating_add(link.cost.into());
                let back = from_neighbour.get(&self.here).map_or(0, |back| back.cost);
                let is_loop_free = rest.cost < back.saturating_add(from_here.cost);
                Some(Way { cost, number, link, mtu, relays: rest.links, is_loop_free })
            })
            .collect();
        ways.sort_by_key(|way| (way.cost, way.number));
        let (&Way { cost, number: next, link, mtu, relays, .. }, others) = ways.split_first()?;
        let alternate = others.iter().find(|way| way.link.id == link.id || way.is_loop_free);
        let (mtu, relays) =
            alternate.map_or((mtu, relays), |other| (mtu.min(other.mtu), relays.max(other.relays)));
        let alternate = alternate.map(|way| way.number);
        let (node, incarnation) = self.identity(to)?;
        let overhead = self.overhead.try_into().unwrap_or(u8::MAX);
        let mut route =
            Route { node, incarnation, cost, next, alternate, chosen: None, mtu, relays, overhead };
        if route.segment_limit() < SEGMENT_MIN {
            return None;
        }
        route.chosen = route.choose(self.links, &[]);
        Some(route)
    }

    /// A node's name and incarnation: what a link to it has heard, or its own words.
    fn identity(&self, id: NodeId) -> Option<(NodeName, Incarnation)> {
        let announced = self.known.get(&id).map(|a| (a.node.clone(), a.incarnation));
        let observed = self
            .links
            .values()
            .filter(|link| link.id == id)
            .map(|link| (link.neighbour.node.clone(), link.neighbour.incarnation));
        observed.max_by_key(|(_, incarnation)| *incarnation).or(announced)
    }

    /// Dijkstra's algorithm; ties are broken by the nodes' numbers.
    fn distances(&self, from: NodeId) -> SortedMap<NodeId, Distance> {
        let mut found = SortedMap::new();
        let mut edge_of_search = BinaryHeap::from([Reverse((0, from, Reverse(u16::MAX), 0u8))]);
        while let Some(Reverse((cost, id, Reverse(mtu), links))) = edge_of_search.pop() {
            if found.contains_key(&id) {
                continue;
            }
            found.insert(id, Distance { cost, mtu, links });
            for (to, step, limit) in self.edges(id) {
                if found.contains_key(&to) {
                    continue;
                }
                let Some((step, limit)) = self.agreed(id, to, step, limit) else { continue };
                let cost: u32 = cost;
                let mtu = Reverse(mtu.min(limit));
                let reached = (cost.saturating_add(step.into()), to, mtu, links.saturating_add(1));
                edge_of_search.push(Reverse(reached));
            }
        }
        found
    }

    /// What an edge costs and carries that both its ends announce. The dearer and the narrower word
    /// counts: no node draws traffic by boasting alone.
    fn agreed(&self, from: NodeId, to: NodeId, cost: u16, mtu: u16) -> Option<(u16, u16)> {
        let (back, mtu_back) = self.back(to, from)?;
        Some((cost.max(back), mtu.min(mtu_back)))
    }

    fn edges(&self, id: NodeId) -> Vec<(NodeId, u16, u16)> {
        if id == self.here {
            return self.links.values().map(|link| (link.id, link.cost, link.mtu)).collect();
        }
        self.announced(id).map(|edge| (edge.to, edge.cost, edge.mtu)).collect()
    }

    /// What another node says of its links; one that could not carry an announcement carries none
    /// of our traffic either, and one to another incarnation than the one that speaks does not lead
    /// to it.
    fn announced(&self, id: NodeId) -> impl Iterator<Item = &Edge> {
        let known = self.known.get(&id).map_or(&[][..], |known| &known.edges);
        known.iter().filter(|edge| {
            let announced = self.known.get(&edge.to).map(|known| known.incarnation);
            usize::from(edge.mtu) >= MTU_MIN
                && announced.is_none_or(|incarnation| {
                    Edge::incarnation_tag(incarnation) == edge.incarnation
                })
        })
    }

    /// What `id` says of its link to `other`, if it says that it has one. Of our own links their
    /// hellos have asked the other end; what they cost to there is our own word.
    fn back(&self, id: NodeId, other: NodeId) -> Option<(u16, u16)> {
        if id == self.here || other == self.here {
            let neighbour = if id == self.here { other } else { id };
            let own = self.links.values().filter(|link| link.id == neighbour);
            let cheapest = own.min_by_key(|link| link.cost)?;
            // Which of several is meant, the caller that looks at each of them knows.
            let cost = if other == self.here { 0 } else { cheapest.cost };
            return Some((cost, u16::MAX));
        }
        let edge = self.announced(id).find(|edge| edge.to == other)?;
        Some((edge.cost, edge.mtu))
    }
}
