//! Whether another node does harm again and again.
//!
//! One offence is an accident: a peer that was restarted, a cable that spoils frames. Several
//! within a while are a node that cannot be recovered from here, and is better kept out.

use crate::sorted::SortedMap;
use crate::{Instant, NodeName};
use std::collections::VecDeque;
use std::time::Duration;

/// Nodes whose offences are remembered, at most: as many as a router knows.
const NODES_MAX: usize = 256;

/// The offences of other nodes, in a sliding window.
#[derive(Clone, Debug)]
pub(super) struct OffenceWindow {
    limit: usize,
    period: Duration,
    offences: SortedMap<NodeName, VecDeque<(Instant, String)>>,
}

impl OffenceWindow {
    /// So many offences within one period are too many.
    pub(super) fn new(limit: u32, period: Duration) -> Self {
        OffenceWindow { limit: limit.max(1) as usize, period, offences: SortedMap::new() }
    }

    /// A node has done harm. Answers what it has done, each time that it was once too often.
    pub(super) fn handle_offence(
        &mut self,
        node: &NodeName,
        what: String,
        at: Instant,
    ) -> Option<String> {
        if !self.offences.contains_key(node) && self.offences.len() == NODES_MAX {
            // The node that offended longest ago is forgotten.
            let last = |(_, all): &(&NodeName, &VecDeque<(Instant, String)>)| {
                all.back().map(|(at, _)| *at)
            };
            let oldest = self.offences.iter().min_by_key(last).map(|(node, _)| node.clone());
            oldest.map(|oldest| self.offences.remove(&oldest));
        }
        let all = self.offences.entry(node.clone()).or_default();
        all.push_back((at, what));
        let period = self.period;
        while all.len() > self.limit || all.front().is_some_and(|(then, _)| at - *then > period) {
            all.pop_front();
        }
        if all.len() < self.limit {
            return None;
        }
        let mut kinds: SortedMap<&str, u32> = SortedMap::new();
        all.iter().for_each(|(_, what)| *kinds.entry(what).or_default() += 1);
        let kinds: Vec<_> =
            kinds.iter().map(|(what, times)| format!("{times} times {what}")).collect();
        Some(format!("within {period:?}: {}", kinds.join("; ")))
    }

    /// It was let in again, and begins with a clean sheet.
    pub(super) fn forget(&mut self, node: &NodeName) {
        self.offences.remove(node);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a good name")
    }

    #[test]
    fn several_offences_within_the_period_are_too_many_and_spread_ones_never() {
        let mut offences = OffenceWindow::new(3, Duration::from_secs(60));
        let mut offends = |who: &str, second: u64| {
            let at = Instant::from_millis(second * 1000);
            offences.handle_offence(&node(who), "it floods".into(), at).is_some()
        };

        let spread: Vec<_> = [0, 40, 80, 120, 160].map(|at| offends("a", at)).into();
        assert_eq!(spread, [false; 5]);
        let dense: Vec<_> = [300, 310, 360, 365, 500].map(|at| offends("b", at)).into();
        assert_eq!(dense, [false, false, true, true, false]);
    }

    #[test]
    fn the_reason_counts_what_was_done_and_an_admitted_node_begins_anew() {
        let mut offences = OffenceWindow::new(3, Duration::from_secs(60));
        let now = Instant::from_millis(1000);
        let mut offends = |what: &str| offences.handle_offence(&node("a"), what.into(), now);
        assert_eq!((offends("it died"), offends("it floods")), (None, None));

        let reason = offends("it died").expect("it is the third");
        assert_eq!(reason, "within 60s: 2 times it died; 1 times it floods");

        offences.forget(&node("a"));
        assert_eq!(offences.handle_offence(&node("a"), "it died".into(), now), None);
    }

    #[test]
    fn more_nodes_than_there_can_be_are_not_remembered() {
        let mut offences = OffenceWindow::new(2, Duration::from_secs(60));
        for n in 0..1000 {
            let at = Instant::from_millis(n);
            offences.handle_offence(&node(&format!("n{n}")), "it floods".into(), at);
        }
        assert_eq!(offences.offences.len(), NODES_MAX);
        assert!(offences.offences.contains_key(&node("n999")));
    }
}
