//! Ways to one node that have as little in common as can be, for copies of one thing.
//!
//! The cheapest set of disjoint ways is a flow of least cost, found by one search of a shortest
//! path for each way (Suurballe and Tarjan, Networks 14, 1984; Bhandari, "Survivable Networks",
//! 1999). Two copies may share what they must: a node or a link that both pass costs more than any
//! detour, so that just those are shared without which the destination is not reached. No other
//! single failure then stops both.
//!
//! Ways after the second share nothing with any other, or are left out.

use super::Topology;
use crate::net::wire::link_id::LinkId;
use crate::net::wire::node_id::NodeId;
use crate::net::wire::packet::{COPIES_MAX, RELAYS_MAX};
use crate::sorted::SortedMap;
use std::cmp::Reverse;
use std::collections::BinaryHeap;

/// What sharing an edge costs: more than the longest path, which has fewer nodes than 2¹⁶ of costs
/// below 2¹⁶ each.
const SHARED_EDGE: u64 = 1 << 32;
/// What sharing a node costs: more than all edges of a path.
const SHARED_NODE: u64 = 1 << 48;
/// So many may share something.
const PAIR: usize = 2;

/// One way to a node.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) struct DisjointPath {
    /// The sum of the costs of its links.
    pub(crate) cost: u64,
    /// The link that it begins with.
    pub(crate) link: LinkId,
    /// The nodes that it passes.
    pub(crate) relays: Vec<NodeId>,
    /// The largest frame that it carries, in bytes.
    pub(crate) mtu: u16,
}

impl Topology<'_> {
    /// Ways to `to`, the cheapest first.
    pub(crate) fn ways(&self, to: NodeId) -> Vec<DisjointPath> {
        let mut flow = FlowNetwork::of(self, to);
        let mut found = 0;
        while found < COPIES_MAX {
            let Some((cost, path)) = flow.search() else { break };
            if found >= PAIR && cost >= SHARED_EDGE {
                break;
            }
            flow.add(&path);
            found += 1;
        }
        let mut ways: Vec<_> = (0..found).filter_map(|_| flow.take_way()).collect();
        ways.retain(|way| way.relays.len() <= RELAYS_MAX + 1);
        ways.sort();
        ways.dedup();
        ways
    }
}

/// One direction of what a way can take, or give back: the arc after one with an even number is its
/// reverse.
#[derive(Clone, Debug)]
struct Arc {
    to: usize,
    cost: i64,
    /// It can be taken.
    open: bool,
    /// What it stands for.
    stretch: Option<Stretch>,
}

/// A link between two nodes, of which ways are made.
#[derive(Clone, Copy, Debug)]
struct Stretch {
    /// Ours, with which a way begins.
    link: Option<LinkId>,
    cost: u16,
    mtu: u16,
}

/// Each node is two vertices, with what it costs to pass it between them: 2n for coming, 2n + 1 for
/// going.
struct FlowNetwork {
    ids: Vec<NodeId>,
    arcs: Vec<Arc>,
    /// Which arcs begin at which vertex.
    from: Vec<Vec<usize>>,
    /// How far each vertex was in the search before: with costs relative to that, none is below 0
    /// (Johnson's potentials).
    potentials: Vec<i64>,
    source: usize,
    sink: usize,
}

impl FlowNetwork {
    fn of(topology: &Topology<'_>, to: NodeId) -> FlowNetwork {
        let here = topology.here;
        let mut ids: Vec<NodeId> = topology.known.keys().copied().collect();
        ids.extend(topology.links.values().map(|link| link.id).chain([here, to]));
        ids.sort();
        ids.dedup();
        let place: SortedMap<NodeId, usize> = ids.iter().zip(0..).map(|(id, n)| (*id, n)).collect();
        let (coming, going) = (|id| 2 * place[&id], |id| 2 * place[&id] + 1);
        let vertices = 2 * ids.len();
        let mut flow = FlowNetwork {
            source: going(here),
            sink: coming(to),
            arcs: Vec::new(),
            from: vec![Vec::new(); vertices],
            potentials: vec![0; vertices],
            ids: ids.clone(),
        };
        for id in ids.into_iter().filter(|id| *id != here && *id != to) {
            flow.connect(coming(id), going(id), 0, SHARED_NODE, None);
            for (next, cost, mtu) in topology.edges(id) {
                // An edge to a node that says nothing itself leads nowhere.
                if let (Some((cost, mtu)), true) =
                    (topology.agreed(id, next, cost, mtu), next != here)
                {
                    let stretch = Stretch { link: None, cost, mtu };
                    flow.connect(going(id), coming(next), cost.into(), SHARED_EDGE, Some(stretch));
                }
            }
        }
        for (number, link) in topology.links {
            let stretch = Stretch { link: Some(*number), cost: link.cost, mtu: link.mtu };
            let cost = link.cost.into();
            flow.connect(flow.source, coming(link.id), cost, SHARED_EDGE, Some(stretch));
        }
        flow
    }

    /// Once for its cost, and once more for what sharing it costs.
    fn connect(
        &mut self,
        from: usize,
        to: usize,
        cost: u64,
        shared: u64,
        stretch: Option<Stretch>,
    ) {
        for cost in [cost, cost + shared] {
            let cost = cost.cast_signed();
            self.from[from].push(self.arcs.len());
            self.arcs.push(Arc { to, cost, open: true, stretch });
            self.from[to].push(self.arcs.len());
            self.arcs.push(Arc { to: from, cost: -cost, open: false, stretch: None });
        }
    }

    /// The cheapest path for one way more, and what it adds to the cost of all, which is never less
    /// than the one before added. Dijkstra's algorithm.
    fn search(&mut self) -> Option<(u64, Vec<usize>)> {
        const FAR: i64 = i64::MAX;
        let mut distances = vec![FAR; self.from.len()];
        let mut came_by = vec![None; self.from.len()];
        let mut open = BinaryHeap::from([Reverse((0, self.source))]);
        distances[self.source] = 0;
        while let Some(Reverse((distance, at))) = open.pop() {
            if distance > distances[at] {
                continue;
            }
            for &number in &self.from[at] {
                let arc = &self.arcs[number];
                let step = arc.cost + self.potentials[at] - self.potentials[arc.to];
                if arc.open && distance + step < distances[arc.to] {
                    distances[arc.to] = distance + step;
                    came_by[arc.to] = Some(number);
                    open.push(Reverse((distance + step, arc.to)));
                }
            }
        }
        let farthest = Some(distances[self.sink]).filter(|distance| *distance < FAR)?;
        for (potential, distance) in self.potentials.iter_mut().zip(&distances) {
            *potential += farthest.min(*distance);
        }
        let cost = self.potentials[self.sink] - self.potentials[self.source];
        let last = came_by[self.sink];
        let path = std::iter::successors(last, |number| came_by[self.arcs[number ^ 1].to]);
        Some((cost.cast_unsigned(), path.collect()))
    }

    /// What a path takes can be given back by a later one.
    fn add(&mut self, path: &[usize]) {
        for &number in path {
            (self.arcs[number].open, self.arcs[number ^ 1].open) = (false, true);
        }
    }

    /// Takes one way out of what was found. It passes no vertex twice: a circle would only cost.
    fn take_way(&mut self) -> Option<DisjointPath> {
        let mut way = DisjointPath { cost: 0, link: LinkId(0), relays: Vec::new(), mtu: u16::MAX };
        let mut at = self.source;
        while at != self.sink {
            let taken = |number: &&usize| number.is_multiple_of(2) && !self.arcs[**number].open;
            let number = *self.from[at].iter().find(taken)?;
            let arc = &mut self.arcs[number];
            arc.open = true;
            at = arc.to;
            match arc.stretch {
                Some(Stretch { link, cost, mtu }) => {
                    way.link = link.unwrap_or(way.link);
                    way.cost += u64::from(cost);
                    way.mtu = way.mtu.min(mtu);
                }
                None => way.relays.push(self.ids[at / 2]),
            }
        }
        Some(way)
    }
}

#[cfg(test)]
mod tests;
