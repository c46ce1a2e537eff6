//! Whether another node does harm again and again, or dies again and again.
//!
//! One offence is an accident: a peer that was restarted, a cable that spoils frames. Several
//! within a while are a node that cannot be recovered from here, and is better kept out.

use crate::sorted::SortedMap;
use crate::{Instant, NodeName, SlidingWindow};
use std::time::Duration;

/// Nodes that are remembered, at most: as many as a router knows.
const NODES_MAX: usize = 256;
/// So many offences of another node within the period are a fault. A flood is reported every three
/// seconds. More forgives more.
const OFFENCES: u32 = 5;
/// So many restarts of another node within the period are a crash loop. An update and a second
/// attempt restart a node twice; systemd itself ceases to start a unit after five times in ten
/// seconds (systemd.unit(5), StartLimitBurst).
const RESTARTS: u32 = 3;
/// The period in which offences and restarts are counted. A node that stays up for as long has
/// ended its crash loop. systemd waits 0.1 s between two starts, a careful unit file up to 20 s.
pub(super) const PERIOD: Duration = Duration::from_secs(60);

/// The latest offences and restarts of other nodes.
#[derive(Clone, Debug, Default)]
pub(super) struct NodeHistories {
    nodes: SortedMap<NodeName, NodeHistory>,
}

#[derive(Clone, Debug)]
struct NodeHistory {
    offences: SlidingWindow<String>,
    restarts: SlidingWindow,
    /// Since when the present incarnation is reachable; `None` while it is not.
    up_since: Option<Instant>,
    /// How many restarts its crash loop has counted; zero while it is in none.
    in_loop: u32,
}

impl NodeHistory {
    /// When its crash loop will be over, if it is in one and stays up.
    fn calm_at(&self) -> Option<Instant> {
        self.up_since.filter(|_| self.in_loop > 0).map(|since| since + PERIOD)
    }
}

impl NodeHistories {
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
        Some(format!("within {PERIOD:?}: {}", kinds.join("; ")))
    }

    /// The node is no longer isolated: its offences are forgotten.
    pub(super) fn handle_admitted(&mut self, node: &NodeName) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.offences.clear();
        }
    }

    /// The node is there in a new incarnation. Answers how many restarts its crash loop has so far,
    /// if it is in one.
    pub(super) fn handle_restarted(&mut self, node: &NodeName, at: Instant) -> Option<u32> {
        let history = self.of(node);
        history.up_since = Some(at);
        let is_often = history.restarts.push((), at);
        history.in_loop = match history.in_loop {
            0 if is_often => RESTARTS,
            0 => return None,
            count => count.saturating_add(1),
        };
        Some(history.in_loop)
    }

    /// The node is reachable in the incarnation that was known before, or is not.
    pub(super) fn handle_reachable(&mut self, node: &NodeName, reachable: bool, at: Instant) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.up_since = reachable.then(|| history.up_since.unwrap_or(at));
        }
    }

    /// The node has ended in order, or its crash loop has: its restarts are forgotten.
    pub(super) fn forget_restarts(&mut self, node: &NodeName) {
        if let Some(history) = self.nodes.get_mut(node) {
            history.restarts.clear();
            history.in_loop = 0;
        }
    }

    /// The node whose crash loop is over first, if it stays up, and when.
    pub(super) fn next_calm(&self) -> Option<(Instant, &NodeName)> {
        self.nodes.iter().filter_map(|(node, history)| Some((history.calm_at()?, node))).min()
    }

    /// The history of a node. Where there is no capacity for it, the node is forgotten of which
    /// nothing happened for the longest time; one in a crash loop only where all are.
    fn of(&mut self, node: &NodeName) -> &mut NodeHistory {
        let age = |(_, history): &(&NodeName, &NodeHistory)| {
            (history.in_loop > 0, history.restarts.last().max(history.offences.last()))
        };
        if self.nodes.len() == NODES_MAX
            && !self.nodes.contains_key(node)
            && let Some(oldest) = self.nodes.iter().min_by_key(age).map(|(node, _)| node.clone())
        {
            self.nodes.remove(&oldest);
        }
        self.nodes.entry(node.clone()).or_insert_with(|| NodeHistory {
            offences: SlidingWindow::new(OFFENCES, PERIOD),
            restarts: SlidingWindow::new(RESTARTS, PERIOD),
            up_since: None,
            in_loop: 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::node;

    fn at(second: u64) -> Instant {
        Instant::from_millis(second * 1000)
    }

    #[test]
    fn several_offences_within_the_period_are_too_many_and_spread_ones_never() {
        let mut nodes = NodeHistories::default();
        let mut offends = |name: &str, second: u64| {
            nodes.handle_offence(&node(name), "it floods".into(), at(second)).is_some()
        };

        let spread: Vec<_> = [0, 20, 40, 61, 81].map(|at| offends("a", at)).into();
        assert_eq!(spread, [false; 5]);
        let dense: Vec<_> = [300, 310, 320, 330, 360, 365, 500].map(|at| offends("b", at)).into();
        assert_eq!(dense, [false, false, false, false, true, true, false]);
    }

    #[test]
    fn the_reason_counts_what_was_done_and_an_admitted_node_has_done_nothing() {
        let mut nodes = NodeHistories::default();
        let mut offends = |what: &str| nodes.handle_offence(&node("a"), what.into(), at(1));
        for _ in 0..2 {
            assert_eq!((offends("it died"), offends("it floods")), (None, None));
        }

        let reason = offends("it died").expect("it is the fifth");
        assert_eq!(reason, "within 60s: 3 times it died; 2 times it floods");

        nodes.handle_admitted(&node("a"));
        assert_eq!(nodes.handle_offence(&node("a"), "it died".into(), at(1)), None);
    }

    #[test]
    fn restarts_within_the_period_are_a_crash_loop_and_spread_ones_are_not() {
        let mut nodes = NodeHistories::default();
        let mut restarted = |name: &str, second| nodes.handle_restarted(&node(name), at(second));

        let spread = [0, 40, 80, 120, 160].map(|second| restarted("a", second));
        assert_eq!(spread, [None; 5]);
        let dense = [300, 310, 320, 400].map(|second| restarted("b", second));
        assert_eq!(dense, [None, None, Some(3), Some(4)]);
    }

    #[test]
    fn a_crash_loop_ends_after_a_whole_period_in_one_incarnation() {
        let mut nodes = NodeHistories::default();
        let n = node("n");
        nodes.handle_restarted(&n, at(0));
        nodes.handle_restarted(&n, at(5));
        assert_eq!(nodes.next_calm(), None, "two restarts are no loop");
        nodes.handle_restarted(&n, at(10));
        assert_eq!(nodes.next_calm(), Some((at(70), &n)));

        nodes.handle_reachable(&n, false, at(50));
        assert_eq!(nodes.next_calm(), None);
        nodes.handle_reachable(&n, true, at(1000));
        nodes.handle_reachable(&n, true, at(1030));
        assert_eq!(nodes.next_calm(), Some((at(1060), &n)));
        nodes.forget_restarts(&n);
        assert_eq!(nodes.next_calm(), None);
        assert_eq!(nodes.handle_restarted(&n, at(1061)), None, "it is a first one again");
    }

    #[test]
    fn of_too_many_nodes_one_in_a_loop_is_forgotten_last() {
        let mut nodes = NodeHistories::default();
        for second in 0..3 {
            nodes.handle_restarted(&node("looping"), at(second));
        }
        for n in 0..1000 {
            let name = node(&format!("n{n}"));
            match n % 2 {
                0 => assert_eq!(nodes.handle_restarted(&name, at(3 + n)), None),
                _ => assert_eq!(nodes.handle_offence(&name, "it floods".into(), at(3 + n)), None),
            }
        }
        assert_eq!(nodes.nodes.len(), NODES_MAX);
        assert!(nodes.nodes.contains_key(&node("n999")));
        assert_eq!(nodes.handle_restarted(&node("looping"), at(1100)), Some(4));
    }
}
