//! Whether another node does harm again and again.
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
/// The period in which offences are counted.
const PERIOD: Duration = Duration::from_secs(60);

/// The latest offences of other nodes.
#[derive(Clone, Debug, Default)]
pub(super) struct OffenceHistory {
    nodes: SortedMap<NodeName, SlidingWindow<String>>,
}

impl OffenceHistory {
    /// A node has done harm. Answers what it has done, each time that it was once too often.
    pub(super) fn handle_offence(
        &mut self,
        node: &NodeName,
        what: String,
        at: Instant,
    ) -> Option<String> {
        if self.nodes.len() == NODES_MAX && !self.nodes.contains_key(node) {
            // The node of which nothing happened for the longest time is forgotten.
            let oldest = self.nodes.iter().min_by_key(|(_, offences)| offences.last());
            let oldest = oldest.map(|(node, _)| node.clone());
            oldest.map(|oldest| self.nodes.remove(&oldest));
        }
        let fresh = || SlidingWindow::new(OFFENCES, PERIOD);
        let offences = self.nodes.entry(node.clone()).or_insert_with(fresh);
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
        self.nodes.remove(node);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a good name")
    }

    fn at(second: u64) -> Instant {
        Instant::from_millis(second * 1000)
    }

    #[test]
    fn several_offences_within_the_period_are_too_many_and_spread_ones_never() {
        let mut nodes = OffenceHistory::default();
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
        let mut nodes = OffenceHistory::default();
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
    fn of_too_many_nodes_the_one_that_offended_longest_ago_is_forgotten() {
        let mut nodes = OffenceHistory::default();
        for n in 0..1000 {
            let offence = nodes.handle_offence(&node(&format!("n{n}")), "it floods".into(), at(n));
            assert_eq!(offence, None);
        }
        assert_eq!(nodes.nodes.len(), NODES_MAX);
        assert!(nodes.nodes.contains_key(&node("n999")));
    }
}
