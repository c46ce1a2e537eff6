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

mod flooding;
mod forwarding;
mod keys;
mod names;
mod timers;
mod types;

pub mod topology;

pub use self::keys::RouterKeys;
pub use self::types::{LinkHealth, LinkStatus, RouterConfig, RouterOutput};

use self::keys::{CHECKS_MAX, CHECKS_PERIOD};
use self::names::{UnusedLink, status_of};
use super::wire::Refusals;
use super::wire::advertisement::{Advertisement, AdvertisementId, RoutingMessage};
use super::wire::link_id::LinkId;
use super::wire::node_id::NodeId;
use crate::sorted::{SortedMap, SortedSet};
use crate::timer::Timers;
use crate::{Incarnation, Instant, Machine, NodeName, SlidingWindow};
use bytes::Bytes;
use std::collections::VecDeque;
use std::time::Duration;
use topology::{Adjacency, Route, Topology};

/// The machine of a node's router.
#[derive(Debug)]
pub struct Router {
    config: RouterConfig,
    id: NodeId,
    links: SortedMap<LinkId, Adjacency>,
    /// Isolated nodes, as many as there are decisions.
    isolated: SortedSet<NodeId>,
    /// Links to them, which are not used.
    isolated_links: SortedMap<LinkId, LinkStatus>,
    known: SortedMap<NodeId, DatabaseEntry>,
    own: Advertisement,
    routes: SortedMap<NodeId, Route>,
    /// When the paths are computed again; `None` while they are current.
    compute_at: Option<Instant>,
    computed_at: Instant,
    /// When our own links were announced last, and whether they have changed since.
    announced_at: Instant,
    has_news: bool,
    /// The last reported pair, and when, so that a collision is not reported with every flood.
    reported_conflict: Option<(NodeName, NodeName, Instant)>,
    /// Which other incarnation advertises links in this node's name, how often it was outdone, and
    /// when last.
    outdone: Option<(Incarnation, u8, Instant)>,
    /// Links to another node of a name, which are not used.
    unused: SortedMap<LinkId, UnusedLink>,
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

#[derive(Debug)]
struct DatabaseEntry {
    advertisement: Advertisement,
    expires: Instant,
}

/// A link's smallest MTU in bytes: the hello of a node with the longest name fits, and half of a
/// frame and more is the message's. Only what routers tell each other is cut below the packet, by
/// the link.
pub const MTU_MIN: usize = 96;

impl Router {
    /// A router without links.
    pub fn new(config: RouterConfig, now: Instant) -> Self {
        let id = NodeId::of(&config.node);
        let sequence = AdvertisementId::first_sequence(config.incarnation) + 1;
        let own = Advertisement {
            id: AdvertisementId { origin: id, sequence },
            incarnation: config.incarnation,
            node: config.node.clone(),
            edges: Vec::new(),
            signature: None,
        };
        let wake_at = now + config.refresh;
        Router {
            config,
            id,
            links: SortedMap::new(),
            isolated: SortedSet::new(),
            isolated_links: SortedMap::new(),
            known: SortedMap::new(),
            own,
            routes: SortedMap::new(),
            compute_at: None,
            computed_at: Instant::ORIGIN,
            announced_at: now,
            has_news: false,
            reported_conflict: None,
            outdone: None,
            unused: SortedMap::new(),
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

    /// Whether a link's hellos have said that this incarnation of a node is at its other end.
    pub fn is_neighbour(&self, node: &NodeName, incarnation: Incarnation) -> bool {
        let mut neighbours = self.links.values().map(|link| &link.neighbour);
        neighbours.any(|peer| peer.node == *node && peer.incarnation == incarnation)
    }

    /// Whether a path leads to a node now, by everything that is known; `None` while all paths lead
    /// over suspect links.
    pub fn verdict(&mut self, node: NodeId, now: Instant) -> Option<bool> {
        self.now = now;
        if self.compute_at.is_some() {
            self.compute();
        }
        let Some(chosen) = self.routes.get(&node).and_then(|route| route.chosen) else {
            return Some(false);
        };
        let health = self.links.get(&chosen).map_or(LinkHealth::Down, |link| link.health);
        (health < LinkHealth::Suspect).then_some(true)
    }

    /// Every node that can be reached, with the route to it.
    pub fn routes(&self) -> impl Iterator<Item = (NodeId, &Route)> {
        self.routes.iter().map(|(node, route)| (*node, route))
    }

    /// A link's state, cost or size has changed.
    pub fn handle_link(&mut self, link: LinkId, status: LinkStatus, now: Instant) {
        self.now = now;
        let LinkStatus { neighbour, health, cost, mtu } = status;
        let id = NodeId::of(&neighbour.node);
        let known = self.known.get(&id).map(|known| &known.advertisement.node);
        if let Some(known) = known.filter(|known| **known != neighbour.node).cloned() {
            return self.tell_collision(known, neighbour.node);
        }
        self.isolated_links.remove(&link);
        if self.isolated.contains(&id) {
            self.unused.remove(&link);
            if self.links.remove(&link).is_some() {
                self.announce_links();
            }
            if health != LinkHealth::Down {
                self.isolated_links.insert(link, LinkStatus { neighbour, health, cost, mtu });
            }
            return;
        }
        if health != LinkHealth::Down && self.is_kept_out(link, &neighbour) {
            return self.set_aside(link, LinkStatus { neighbour, health, cost, mtu });
        }
        let was_unused = self.unused.remove(&link).is_some();
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
        let changed = if isolated { self.isolated.insert(id) } else { self.isolated.remove(&id) };
        if !changed || id == self.id {
            return;
        }
        self.outdate();
        if !isolated {
            for (link, status) in std::mem::take(&mut self.isolated_links) {
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
        self.isolated_links.extend(near);
    }

    /// A message of a neighbour's router was received.
    pub fn handle_routing(&mut self, link: LinkId, bytes: Bytes, now: Instant) {
        self.now = now;
        if self.isolated_links.contains_key(&link) {
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
        // A change is a burst of floods: the first is acted on at once, the others together.
        const TOGETHER: Duration = Duration::from_millis(5);
        let due = *self.compute_at.get_or_insert(self.now.max(self.computed_at + TOGETHER));
        self.wake_at = self.wake_at.min(due);
    }

    /// The same, with these links of this node.
    fn topology_over<'a>(&'a self, links: &'a SortedMap<LinkId, Adjacency>) -> Topology<'a> {
        let known = self.known.iter().filter(|(id, _)| !self.isolated.contains(id));
        let known = known.map(|(id, known)| (*id, &known.advertisement));
        let overhead = self.keys.as_ref().map_or(0, RouterKeys::overhead);
        Topology::new((self.id, overhead), links, known)
    }

    /// Computes the paths again and reports what has changed.
    fn compute(&mut self) {
        self.compute_at = None;
        self.computed_at = self.now;
        let routes = self.topology_over(&self.links).routes();
        let mut before = std::mem::replace(&mut self.routes, routes);
        let mut found = Vec::new();
        for (id, route) in &self.routes {
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
            if !self.routes.contains_key(&NodeId::of(&node)) {
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
