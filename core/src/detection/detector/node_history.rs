//! Whether another node does harm again and again, or dies again and again.
//!
//! One offence is an accident: a peer that was restarted, a cable that spoils frames. Several
//! within a while are a node that cannot be recovered from here, and is better kept out.

use super::DetectorLimits;
use crate::sorted::SortedMap;
use crate::{Instant, NodeName, SlidingWindow};

/// Nodes that are remembered, at most: as many as a router knows.
const NODES_MAX: usize = 256;

/// The latest offences and restarts of other nodes.
///
/// A crash loop begins with the restart that reaches the limit within one period. It ends when the
/// node has been reachable in one incarnation for a whole period.
#[derive(Clone, Debug)]
pub(super) struct NodeHistories {
    limits: DetectorLimits,
    nodes: SortedMap<NodeName, NodeHistory>,
}

#[derive(Clone, Debug)]
struct NodeHistory {
    offences: SlidingWindow<String>,
    restarts: SlidingWindow,
    /// Since when the present incarnation is reachable; `None` while it is not.
    up_since: Option<Instant>,
    /// While a crash loop stands: how many restarts it has counted.
    in_loop: Option<u32>,
}

impl NodeHistories {
    pub(super) fn new(limits: DetectorLimits) -> Self {
        NodeHistories { limits, nodes: SortedMap::new() }
    }

    /// A node has done harm. Answers what it has done, each time that it was once too often.
    pub(super) fn handle_offence(
        &mut self,
        node: &NodeName,
        what: String,
        at: Instant,
    ) -> Option<String> {
        let offences = &mut self.of(node).offences;
        if !offences.push(what, at) {
            return None;
        }
        let mut kinds: SortedMap<&str, u32> = SortedMap::new();
        offences.events().for_each(|what| *kinds.entry(what).or_default() += 1);
        let kinds: Vec<_> =
            kinds.iter().map(|(what, times)| format!("{times} times {what}")).collect();
        Some(format!("within {:?}: {}", self.limits.offences_period, kinds.join("; ")))
    }

    /// The node is no longer isolated: its offences are forgotten.
    pub(super) fn handle_admitted(&mut self, node: &NodeName) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.offences.clear();
        }
    }

    /// The node is there in a new incarnation. Answers how many restarts the crash loop has so far,
    /// if it is in one.
    pub(super) fn handle_restarted(&mut self, node: &NodeName, at: Instant) -> Option<u32> {
        let limit = self.limits.crash_loop_restarts.max(1);
        let history = self.of(node);
        history.up_since = Some(at);
        let begins = history.restarts.push((), at).then_some(limit);
        history.in_loop = history.in_loop.map(|count| count.saturating_add(1)).or(begins);
        history.in_loop
    }

    /// The node is reachable, in the incarnation that was known before.
    pub(super) fn handle_reachable(&mut self, node: &NodeName, at: Instant) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.up_since.get_or_insert(at);
        }
    }

    /// The node cannot be reached.
    pub(super) fn handle_lost(&mut self, node: &NodeName) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.up_since = None;
        }
    }

    /// The node has ended in order, or its crash loop has: its restarts are forgotten.
    pub(super) fn forget_restarts(&mut self, node: &NodeName) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.restarts.clear();
            history.in_loop = None;
        }
    }

    /// When the next node will have been up for a whole period.
    pub(super) fn poll_timeout(&self) -> Option<Instant> {
        self.nodes.values().filter_map(|history| self.calm_at(history)).min()
    }

    /// A node whose crash loop is over by `now`.
    pub(super) fn pop_over(&mut self, now: Instant) -> Option<NodeName> {
        let mut all = self.nodes.iter();
        let calm = all.find(|(_, history)| self.calm_at(history).is_some_and(|at| at <= now));
        let node = calm?.0.clone();
        self.forget_restarts(&node);
        Some(node)
    }

    /// When the crash loop of a node will be over, if it is in one and stays up.
    fn calm_at(&self, history: &NodeHistory) -> Option<Instant> {
        history.in_loop?;
        history.up_since.map(|since| since + self.limits.crash_loop_period)
    }

    /// The history of a node. Where there is no capacity for it, the node is forgotten of which
    /// nothing happened for the longest time; one in a crash loop only where all are.
    fn of(&mut self, node: &NodeName) -> &mut NodeHistory {
        let age = |(_, history): &(&NodeName, &NodeHistory)| {
            let last = history.restarts.last().max(history.offences.last());
            (history.in_loop.is_some(), last)
        };
        if self.nodes.len() == NODES_MAX && !self.nodes.contains_key(node) {
            let oldest = self.nodes.iter().min_by_key(age).map(|(node, _)| node.clone());
            oldest.map(|oldest| self.nodes.remove(&oldest));
        }
        let limits = &self.limits;
        let (offences, restarts) = (limits.offences.max(1), limits.crash_loop_restarts.max(1));
        self.nodes.entry(node.clone()).or_insert_with(|| NodeHistory {
            offences: SlidingWindow::new(offences, limits.offences_period),
            restarts: SlidingWindow::new(restarts, limits.crash_loop_period),
            up_since: None,
            in_loop: None,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::time::Duration;

    /// Histories with these limits, each within a minute.
    fn histories(offences: u32, crash_loop_restarts: u32) -> NodeHistories {
        let limits = DetectorLimits {
            offences,
            offences_period: Duration::from_secs(60),
            crash_loop_restarts,
            crash_loop_period: Duration::from_secs(60),
            ..DetectorLimits::default()
        };
        NodeHistories::new(limits)
    }

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a good name")
    }

    fn at(second: u64) -> Instant {
        Instant::from_millis(second * 1000)
    }

    #[test]
    fn several_offences_within_the_period_are_too_many_and_spread_ones_never() {
        let mut nodes = histories(3, 3);
        let mut offends = |name: &str, second: u64| {
            nodes.handle_offence(&node(name), "it floods".into(), at(second)).is_some()
        };

        let spread: Vec<_> = [0, 40, 80, 120, 160].map(|at| offends("a", at)).into();
        assert_eq!(spread, [false; 5]);
        let dense: Vec<_> = [300, 310, 360, 365, 500].map(|at| offends("b", at)).into();
        assert_eq!(dense, [false, false, true, true, false]);
    }

    #[test]
    fn the_reason_counts_what_was_done_and_an_admitted_node_has_done_nothing() {
        let mut nodes = histories(3, 3);
        let mut offends = |what: &str| nodes.handle_offence(&node("a"), what.into(), at(1));
        assert_eq!((offends("it died"), offends("it floods")), (None, None));

        let reason = offends("it died").expect("it is the third");
        assert_eq!(reason, "within 60s: 2 times it died; 1 times it floods");

        nodes.handle_admitted(&node("a"));
        assert_eq!(nodes.handle_offence(&node("a"), "it died".into(), at(1)), None);
    }

    #[test]
    fn restarts_within_the_period_are_a_crash_loop_and_spread_ones_are_not() {
        let mut nodes = histories(3, 3);
        let mut restarted = |name: &str, second| nodes.handle_restarted(&node(name), at(second));

        let spread = [0, 40, 80, 120, 160].map(|second| restarted("a", second));
        assert_eq!(spread, [None; 5]);
        let dense = [300, 310, 320, 400].map(|second| restarted("b", second));
        assert_eq!(dense, [None, None, Some(3), Some(4)]);
    }

    #[test]
    fn a_crash_loop_ends_after_a_whole_period_in_one_incarnation() {
        let mut nodes = histories(3, 2);
        let n = node("n");
        nodes.handle_restarted(&n, at(0));
        assert_eq!(nodes.poll_timeout(), None, "one restart is no loop");
        nodes.handle_restarted(&n, at(10));
        assert_eq!(nodes.poll_timeout(), Some(at(70)));

        nodes.handle_lost(&n);
        assert_eq!((nodes.poll_timeout(), nodes.pop_over(at(1000))), (None, None));
        nodes.handle_reachable(&n, at(1000));
        nodes.handle_reachable(&n, at(1030));
        assert_eq!(nodes.pop_over(at(1059)), None);
        assert_eq!(nodes.pop_over(at(1060)), Some(n.clone()));
        assert_eq!(nodes.handle_restarted(&n, at(1061)), None, "it is a first one again");
    }

    #[test]
    fn of_too_many_nodes_one_in_a_loop_is_forgotten_last() {
        let mut nodes = histories(3, 2);
        nodes.handle_restarted(&node("looping"), at(0));
        nodes.handle_restarted(&node("looping"), at(1));
        for n in 0..1000 {
            let name = node(&format!("n{n}"));
            match n % 2 {
                0 => drop(nodes.handle_restarted(&name, at(2 + n))),
                _ => drop(nodes.handle_offence(&name, "it floods".into(), at(2 + n))),
            }
        }
        assert_eq!(nodes.nodes.len(), NODES_MAX);
        assert!(nodes.nodes.contains_key(&node("n999")));
        assert_eq!(nodes.handle_restarted(&node("looping"), at(2000)), Some(3));
    }
}
