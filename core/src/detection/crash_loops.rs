//! Whether another node's process dies again and again.

use crate::sorted::SortedMap;
use crate::{Instant, NodeName};
use std::collections::VecDeque;
use std::time::Duration;

/// Nodes whose restarts are remembered, at most: as many as a router knows.
const NODES_MAX: usize = 256;

/// The restarts of other nodes in a sliding window, and which nodes are in a crash loop.
///
/// A crash loop begins with the restart that reaches the limit within one period. It ends when the
/// node has been reachable in one incarnation for a whole period.
#[derive(Clone, Debug)]
pub(super) struct CrashLoops {
    limit: usize,
    period: Duration,
    nodes: SortedMap<NodeName, Restarts>,
}

#[derive(Clone, Debug)]
struct Restarts {
    /// Those within one period, the newest last; never empty, at most `limit`.
    recent: VecDeque<Instant>,
    /// Since when the present incarnation is reachable; `None` while it is not.
    up_since: Option<Instant>,
    /// While a crash loop stands: how many restarts it has counted.
    in_loop: Option<u32>,
}

impl CrashLoops {
    /// So many restarts within one period are a crash loop.
    pub(super) fn new(limit: u32, period: Duration) -> Self {
        CrashLoops { limit: limit.max(1) as usize, period, nodes: SortedMap::new() }
    }

    /// The node is there in a new incarnation. Answers how many restarts the crash loop has so far,
    /// if it is in one.
    pub(super) fn handle_restarted(&mut self, node: &NodeName, at: Instant) -> Option<u32> {
        if !self.nodes.contains_key(node) && self.nodes.len() == NODES_MAX {
            self.forget_oldest();
        }
        let fresh = || Restarts { recent: VecDeque::new(), up_since: None, in_loop: None };
        let restarts = self.nodes.entry(node.clone()).or_insert_with(fresh);
        restarts.up_since = Some(at);
        restarts.recent.push_back(at);
        let (limit, period) = (self.limit, self.period);
        let recent = &mut restarts.recent;
        while recent.len() > limit || recent.front().is_some_and(|&then| at - then > period) {
            recent.pop_front();
        }
        restarts.in_loop = match restarts.in_loop {
            Some(count) => Some(count.saturating_add(1)),
            None if recent.len() == limit => u32::try_from(limit).ok(),
            None => None,
        };
        restarts.in_loop
    }

    /// The node is reachable, in the incarnation that was known before.
    pub(super) fn handle_reachable(&mut self, node: &NodeName, at: Instant) {
        if let Some(restarts) = self.nodes.get_mut(node) {
            restarts.up_since.get_or_insert(at);
        }
    }

    /// The node cannot be reached.
    pub(super) fn handle_lost(&mut self, node: &NodeName) {
        if let Some(restarts) = self.nodes.get_mut(node) {
            restarts.up_since = None;
        }
    }

    /// The node has ended in order.
    pub(super) fn forget(&mut self, node: &NodeName) {
        self.nodes.remove(node);
    }

    /// When the next node will have been up for a whole period.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.nodes.values().filter_map(|restarts| restarts.calm_at(self.period)).min()
    }

    /// A node whose crash loop is over by `now`.
    pub(super) fn pop_over(&mut self, now: Instant) -> Option<NodeName> {
        let calm = |(_, restarts): &(&NodeName, &Restarts)| {
            restarts.calm_at(self.period).is_some_and(|at| at <= now)
        };
        let node = self.nodes.iter().find(calm)?.0.clone();
        self.nodes.remove(&node);
        Some(node)
    }

    /// A node in a crash loop is forgotten only where all are.
    fn forget_oldest(&mut self) {
        let age = |(_, restarts): &(&NodeName, &Restarts)| {
            (restarts.in_loop.is_some(), restarts.recent.back().copied())
        };
        let oldest = self.nodes.iter().min_by_key(age).map(|(node, _)| node.clone());
        oldest.map(|oldest| self.nodes.remove(&oldest));
    }
}

impl Restarts {
    /// When its crash loop will be over, if it is in one and stays up.
    fn calm_at(&self, period: Duration) -> Option<Instant> {
        self.in_loop?;
        self.up_since.map(|since| since + period)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Duration = Duration::from_secs(60);

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a good name")
    }

    fn at(second: u64) -> Instant {
        Instant::from_millis(second * 1000)
    }

    #[test]
    fn restarts_within_the_period_are_a_crash_loop_and_spread_ones_are_not() {
        let mut loops = CrashLoops::new(3, PERIOD);
        let mut restarted = |name: &str, second| loops.handle_restarted(&node(name), at(second));

        let spread = [0, 40, 80, 120, 160].map(|second| restarted("a", second));
        assert_eq!(spread, [None; 5]);
        let dense = [300, 310, 320, 400].map(|second| restarted("b", second));
        assert_eq!(dense, [None, None, Some(3), Some(4)]);
    }

    #[test]
    fn a_crash_loop_ends_after_a_whole_period_in_one_incarnation() {
        let mut loops = CrashLoops::new(2, PERIOD);
        let n = node("n");
        loops.handle_restarted(&n, at(0));
        assert_eq!(loops.poll_timeout(), None, "one restart is no loop");
        loops.handle_restarted(&n, at(10));
        assert_eq!(loops.poll_timeout(), Some(at(70)));

        loops.handle_lost(&n);
        assert_eq!((loops.poll_timeout(), loops.pop_over(at(1000))), (None, None));
        loops.handle_reachable(&n, at(1000));
        loops.handle_reachable(&n, at(1030));
        assert_eq!(loops.pop_over(at(1059)), None);
        assert_eq!(loops.pop_over(at(1060)), Some(n.clone()));
        assert_eq!(loops.handle_restarted(&n, at(1061)), None, "it is a first one again");
    }

    #[test]
    fn of_too_many_nodes_one_in_a_loop_is_forgotten_last() {
        let mut loops = CrashLoops::new(2, PERIOD);
        loops.handle_restarted(&node("looping"), at(0));
        loops.handle_restarted(&node("looping"), at(1));
        for n in 0..1000 {
            loops.handle_restarted(&node(&format!("n{n}")), at(2 + n));
        }
        assert_eq!(loops.nodes.len(), NODES_MAX);
        assert_eq!(loops.handle_restarted(&node("looping"), at(2000)), Some(3));
    }
}
