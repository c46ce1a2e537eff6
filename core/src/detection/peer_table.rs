//! What this node sees of its links and of other nodes.

use super::{Finding, LinkCondition, MonitorRow, NodeCondition, ObjectKind, Observation, Opinion};
use crate::sorted::SortedMap;
use crate::{FaultLocation, Incarnation, Instant, NodeName};
use std::mem::discriminant;
use std::sync::Arc;

/// The table of links and nodes. It distinguishes a change from a repeated report.
#[derive(Clone, Debug, Default)]
pub(super) struct PeerTable {
    links: SortedMap<(NodeName, Arc<str>), LinkSeen>,
    nodes: SortedMap<NodeName, NodeSeen>,
}

#[derive(Clone, Debug)]
struct LinkSeen {
    neighbour: Option<NodeName>,
    condition: LinkCondition,
    last_sign: Option<Instant>,
}

#[derive(Clone, Debug)]
struct NodeSeen {
    incarnation: Incarnation,
    status: PeerStatus,
    last_sign: Option<Instant>,
    restarts: u32,
    /// Why this node has isolated it.
    isolated: Option<String>,
    /// Why it is in the safe state, as it says itself.
    rest: Option<String>,
    /// Its absence is no fault.
    may_be_away: bool,
}

#[derive(Clone, Debug, PartialEq, Eq)]
enum PeerStatus {
    Here,
    /// Why it is thought to be lost.
    Lost(String),
    /// It ended in order.
    Left,
    /// The roster does not list it any more.
    Removed,
}

impl NodeSeen {
    /// A node of which something is said before it was met.
    fn unmet() -> Self {
        NodeSeen {
            incarnation: Incarnation::default(),
            status: PeerStatus::Lost("it was not met yet".to_owned()),
            last_sign: None,
            restarts: 0,
            isolated: None,
            rest: None,
            may_be_away: false,
        }
    }
}

impl PeerTable {
    /// How many rows it has.
    pub(super) fn len(&self) -> usize {
        self.links.len() + self.nodes.len()
    }

    pub(super) fn knows_link(&self, node: &NodeName, link: &Arc<str>) -> bool {
        self.links.contains_key(&(node.clone(), link.clone()))
    }

    pub(super) fn knows_node(&self, node: &NodeName) -> bool {
        self.nodes.contains_key(node)
    }

    /// A link reports how it is. The same condition again, for the same reason, is no change.
    pub(super) fn handle_link(
        &mut self,
        node: NodeName,
        link: Arc<str>,
        neighbour: Option<NodeName>,
        condition: LinkCondition,
        now: Instant,
    ) -> Option<Observation> {
        let carries = !matches!(condition, LinkCondition::Down { .. });
        let before = self.links.remove(&(node.clone(), link.clone()));
        if condition == LinkCondition::Forgotten {
            let neighbour = before?.neighbour;
            let location = FaultLocation::Link { node, link, neighbour };
            return Some(seen(location, Incarnation::default(), Finding::Link(condition), now));
        }
        let known = before.as_ref().is_some_and(|seen| seen.condition == condition);
        let last_sign = if carries { Some(now) } else { before.as_ref().and_then(|b| b.last_sign) };
        // A link that is down does not report the node at its other end.
        let neighbour = neighbour.or(before.and_then(|seen| seen.neighbour));
        let location = FaultLocation::Link {
            node: node.clone(),
            link: link.clone(),
            neighbour: neighbour.clone(),
        };
        // A node that leaves takes its ends of the cables along.
        let left = neighbour.as_ref().is_some_and(|node| self.has_left(node));
        let is_change = !known && (carries || !left);
        let away = !carries && neighbour.as_ref().is_some_and(|node| self.may_be_away(node));
        let finding =
            Finding::Link(if away { LinkCondition::Forgotten } else { condition.clone() });
        self.links.insert((node, link), LinkSeen { neighbour, condition, last_sign });
        is_change.then(|| seen(location, Incarnation::default(), finding, now))
    }

    fn has_left(&self, node: &NodeName) -> bool {
        let status = self.nodes.get(node).map(|seen| &seen.status);
        matches!(status, Some(PeerStatus::Left | PeerStatus::Removed))
    }

    fn may_be_away(&self, node: &NodeName) -> bool {
        self.nodes.get(node).is_some_and(|seen| seen.may_be_away)
    }

    /// The router reports how a node is. The same condition again is no change, a newer incarnation
    /// is. A report of an incarnation that has left is none, nor is the end of an incarnation that is
    /// over, or the rest of another one than is there.
    pub(super) fn handle_node(
        &mut self,
        node: NodeName,
        incarnation: Incarnation,
        condition: NodeCondition,
        now: Instant,
    ) -> Option<Observation> {
        use NodeCondition::{Admitted, AtWork, InSafeState, Isolated, Listed, Offends, Removed};
        use NodeCondition::{InSession, MessagesLost};
        if let Offends { .. } | Isolated { .. } | Admitted = condition {
            return self.handle_offences(node, condition, now);
        }
        if let MessagesLost { .. } | InSession = condition {
            return Some(seen_of(node, incarnation, condition, now));
        }
        if let InSafeState { .. } | AtWork = condition {
            return self.handle_rest(node, incarnation, condition, now);
        }
        if let Removed = condition {
            return self.handle_removed(node, now);
        }
        if let Listed = condition {
            self.handle_listed(&node);
            return None;
        }
        if let NodeCondition::MayBeAway = condition {
            self.nodes.entry(node).or_insert_with(NodeSeen::unmet).may_be_away = true;
            return None;
        }
        let before = self.nodes.get(&node);
        // Which incarnation is there, those say who can reach it, whatever its number: the clock
        // that numbers incarnations may have been set back. That another one has ended is no
        // change.
        let here = matches!(condition, NodeCondition::Reachable | NodeCondition::Restarted);
        if let Some(seen) = before
            && !here
            && (incarnation < seen.incarnation
                || incarnation != seen.incarnation
                    && seen.incarnation != Incarnation::default()
                    && seen.status == PeerStatus::Here)
        {
            return None;
        }
        let left = before.is_some_and(|seen| seen.status == PeerStatus::Left);
        if left && before.is_some_and(|seen| seen.incarnation == incarnation) {
            return None;
        }
        let removed = before.is_some_and(|seen| seen.status == PeerStatus::Removed);
        if removed && !here {
            return None;
        }
        // The first report of a node is no restart, whatever its number is; nor is an
        // incarnation of which nothing but the loss was ever known, nor one after another that had
        // left or was not listed, nor one of a node that may be away.
        let may_be_away = self.may_be_away(&node);
        let restarted = before.is_some_and(|seen| {
            let is_other = incarnation != seen.incarnation;
            let was_met = seen.incarnation != Incarnation::default();
            is_other && was_met && !left && !removed && !may_be_away
        });
        let status = match &condition {
            NodeCondition::Lost { reason } => PeerStatus::Lost(reason.clone()),
            NodeCondition::Left => PeerStatus::Left,
            _ => PeerStatus::Here,
        };
        let condition = match condition {
            NodeCondition::Reachable | NodeCondition::Restarted if restarted => {
                NodeCondition::Restarted
            }
            NodeCondition::Reachable | NodeCondition::Restarted => NodeCondition::Reachable,
            // It goes as one that leaves in order.
            NodeCondition::Lost { .. } if may_be_away => NodeCondition::Left,
            gone => gone,
        };
        let known = before.map(|seen| discriminant(&seen.status));
        let isolated = before.and_then(|seen| seen.isolated.clone());
        // That an isolated node cannot be reached is as it should be.
        let is_change = (restarted || known != Some(discriminant(&status))) && isolated.is_none();
        let here = status == PeerStatus::Here;
        let last_sign = if here { Some(now) } else { before.and_then(|b| b.last_sign) };
        let restarts = before.map_or(0, |seen| seen.restarts) + u32::from(restarted);
        // Another incarnation is at work, until it says otherwise.
        let same = before.is_some_and(|seen| seen.incarnation == incarnation);
        let rest = before.filter(|_| same && !matches!(status, PeerStatus::Left));
        let rest = rest.and_then(|seen| seen.rest.clone());
        let seen =
            NodeSeen { incarnation, status, last_sign, restarts, isolated, rest, may_be_away };
        self.nodes.insert(node.clone(), seen);
        is_change.then(|| seen_of(node, incarnation, condition, now))
    }

    /// The roster does not list a node any more, or the node at the other end of a link.
    fn handle_removed(&mut self, node: NodeName, now: Instant) -> Option<Observation> {
        let is_neighbour =
            || self.links.values().any(|seen| seen.neighbour.as_ref() == Some(&node));
        if !self.nodes.contains_key(&node) && !is_neighbour() {
            return None;
        }
        let seen = self.nodes.entry(node.clone()).or_insert_with(NodeSeen::unmet);
        seen.rest = None;
        let before = std::mem::replace(&mut seen.status, PeerStatus::Removed);
        let incarnation = seen.incarnation;
        (before != PeerStatus::Removed)
            .then(|| seen_of(node, incarnation, NodeCondition::Removed, now))
    }

    /// The roster lists a node again. It is on its way back, or off.
    fn handle_listed(&mut self, node: &NodeName) {
        let removed = self.nodes.get_mut(node).filter(|seen| seen.status == PeerStatus::Removed);
        if let Some(seen) = removed {
            let reason = "it was not heard since the roster lists it again";
            seen.status = PeerStatus::Lost(reason.to_owned());
            // Whichever incarnation comes up is no restart.
            seen.incarnation = Incarnation::default();
        }
    }

    /// That a node is isolated here, or what it has done: whatever incarnation of it is known.
    fn handle_offences(
        &mut self,
        node: NodeName,
        condition: NodeCondition,
        now: Instant,
    ) -> Option<Observation> {
        let seen = self.nodes.entry(node.clone()).or_insert_with(NodeSeen::unmet);
        let isolated = match &condition {
            NodeCondition::Isolated { reason } => Some(reason.clone()),
            NodeCondition::Admitted => None,
            _ => seen.isolated.clone(),
        };
        let changed = isolated.is_some() != seen.isolated.is_some();
        seen.isolated = isolated;
        let is_change = changed || matches!(condition, NodeCondition::Offends { .. });
        let incarnation = seen.incarnation;
        is_change.then(|| seen_of(node, incarnation, condition, now))
    }

    /// What a node says of itself: another one, or this.
    fn handle_rest(
        &mut self,
        node: NodeName,
        incarnation: Incarnation,
        condition: NodeCondition,
        now: Instant,
    ) -> Option<Observation> {
        let rest = match &condition {
            NodeCondition::InSafeState { reason } => Some(reason.clone()),
            _ => None,
        };
        // A node that reports this is present.
        let seen = self.nodes.entry(node.clone()).or_insert_with(|| NodeSeen {
            incarnation,
            status: PeerStatus::Here,
            last_sign: Some(now),
            ..NodeSeen::unmet()
        });
        // The last report of an incarnation may arrive after the first sign of the next, and would
        // never be cleared.
        if seen.incarnation != incarnation && seen.incarnation != Incarnation::default() {
            return None;
        }
        let is_change = rest.is_some() != seen.rest.is_some();
        seen.rest = rest;
        is_change.then(|| seen_of(node, incarnation, condition, now))
    }

    /// Links, then nodes.
    pub(super) fn rows(&self, now: Instant) -> impl Iterator<Item = MonitorRow> {
        let links = self.links.iter().map(move |((node, link), seen)| {
            let (opinion, note) = match &seen.condition {
                LinkCondition::Up | LinkCondition::Forgotten => (Opinion::Trusted, None),
                LinkCondition::Degraded { reason } => (Opinion::Suspect, Some(reason)),
                LinkCondition::Down { reason } => {
                    let left = seen
                        .neighbour
                        .as_ref()
                        .is_some_and(|node| self.has_left(node) || self.may_be_away(node));
                    (if left { Opinion::Stopped } else { Opinion::Failed }, Some(reason))
                }
            };
            let (node, link, neighbour) = (node.clone(), link.clone(), seen.neighbour.clone());
            MonitorRow {
                opinion,
                note: note.cloned(),
                last_sign: seen.last_sign.map(|sign| now - sign),
                ..MonitorRow::blank(FaultLocation::Link { node, link, neighbour }, ObjectKind::Link)
            }
        });
        let nodes = self.nodes.iter().map(move |(node, seen)| {
            let (opinion, note) = match &seen.status {
                PeerStatus::Here => (Opinion::Trusted, None),
                PeerStatus::Lost(reason) if seen.may_be_away => {
                    (Opinion::Stopped, Some(format!("it may be away, and is: {reason}")))
                }
                PeerStatus::Lost(reason) => (Opinion::Failed, Some(reason.clone())),
                // It is not watched any more.
                PeerStatus::Left => (Opinion::Stopped, Some("it has left in order".to_owned())),
                PeerStatus::Removed => {
                    let note = "the robot's roster does not list it any more";
                    (Opinion::Stopped, Some(note.to_owned()))
                }
            };
            let (opinion, note) = match (&seen.status, &seen.rest) {
                (PeerStatus::Here, Some(reason)) => {
                    (Opinion::Stopped, Some(format!("in the safe state: {reason}")))
                }
                _ => (opinion, note),
            };
            let isolated = seen.isolated.as_ref().map(|reason| format!("isolated: {reason}"));
            let opinion = if isolated.is_some() { Opinion::Failed } else { opinion };
            MonitorRow {
                isolated: isolated.is_some(),
                incarnation: seen.incarnation,
                opinion,
                note: isolated.or(note),
                last_sign: seen.last_sign.map(|sign| now - sign),
                restarts: seen.restarts,
                ..MonitorRow::blank(FaultLocation::Node(node.clone()), ObjectKind::Node)
            }
        });
        links.chain(nodes)
    }
}

fn seen(
    location: FaultLocation,
    incarnation: Incarnation,
    finding: Finding,
    seen_at: Instant,
) -> Observation {
    Observation { location, incarnation, finding, seen_at }
}

fn seen_of(node: NodeName, of: Incarnation, condition: NodeCondition, now: Instant) -> Observation {
    seen(FaultLocation::Node(node), of, Finding::Node(condition), now)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{at, node};

    fn conditions() -> [LinkCondition; 5] {
        let [reason, another] = ["because", "for another reason"].map(str::to_string);
        [
            LinkCondition::Up,
            LinkCondition::Degraded { reason: reason.clone() },
            LinkCondition::Degraded { reason: another.clone() },
            LinkCondition::Down { reason },
            LinkCondition::Down { reason: another },
        ]
    }

    #[test]
    fn every_change_of_a_link_is_news_and_no_repetition_is() {
        for from in conditions() {
            for to in conditions() {
                let mut table = PeerTable::default();
                let mut report = |condition: &LinkCondition, neighbour| {
                    let condition = condition.clone();
                    table.handle_link(node("a"), "eth".into(), neighbour, condition, at(1))
                };
                assert!(report(&from, Some(node("b"))).is_some(), "the first is always news");

                let change = report(&to, None);

                assert_eq!(change.is_some(), from != to, "{from:?} to {to:?}");
                if let Some(Observation {
                    location: FaultLocation::Link { neighbour, .. }, ..
                }) = change
                {
                    assert_eq!(neighbour, Some(node("b")), "who was there is remembered");
                }
            }
        }
    }

    #[test]
    fn a_node_that_may_be_away_goes_and_comes_as_one_that_leaves_and_has_a_row_from_the_start() {
        use NodeCondition::{MayBeAway, Reachable, Restarted};
        let mut table = PeerTable::default();
        let row = |table: &PeerTable| {
            let row = table.rows(at(9)).last().expect("a row");
            (row.opinion, row.note)
        };
        let away = |why: &str| (Opinion::Stopped, Some(format!("it may be away, and is: {why}")));
        let mut report = |incarnation, condition| {
            let news = table.handle_node(node("b"), Incarnation(incarnation), condition, at(1));
            let finding = news.map(|change| change.finding);
            (finding, row(&table))
        };
        assert_eq!(report(0, MayBeAway), (None, away("it was not met yet")));
        let lost = || NodeCondition::Lost { reason: "gone".into() };
        for incarnation in [3, 3, 4] {
            let (came, _) = report(incarnation, Reachable);
            assert_eq!(came, Some(Finding::Node(Reachable)));
            let (went, row) = report(incarnation, lost());
            assert_eq!((went, row), (Some(Finding::Node(NodeCondition::Left)), away("gone")));
            assert_eq!(report(incarnation, lost()).0, None);
        }
        report(4, Reachable);
        assert_eq!(report(5, Restarted).0, None, "it was started again, as it may be");

        let mut link = |condition| {
            let news =
                table.handle_link(node("a"), "air".into(), Some(node("b")), condition, at(2));
            news.map(|change| change.finding)
        };
        let down = || LinkCondition::Down { reason: "silent".into() };
        assert_eq!(link(LinkCondition::Up), Some(Finding::Link(LinkCondition::Up)));
        assert_eq!(link(down()), Some(Finding::Link(LinkCondition::Forgotten)));
        assert_eq!(link(down()), None);
        let opinions: Vec<_> = table.rows(at(9)).map(|row| row.opinion).collect();
        assert_eq!(opinions, [Opinion::Stopped, Opinion::Trusted], "the link, then the node");
    }

    #[test]
    fn a_link_that_is_forgotten_has_no_row() {
        let mut table = PeerTable::default();
        let mut tell = |condition| {
            table
                .handle_link(node("a"), "eth/b".into(), Some(node("b")), condition, at(1))
                .is_some()
        };
        assert!(!tell(LinkCondition::Forgotten), "it was never known");
        assert!(tell(LinkCondition::Down { reason: "gone".into() }));
        assert!(tell(LinkCondition::Forgotten));
        assert_eq!(table.len(), 0);
    }

    #[test]
    fn every_condition_of_a_node_after_every_other_is_told_right() {
        use NodeCondition::{Left, Lost, Reachable, Restarted};
        let lost = || Lost { reason: "gone".into() };
        let check = |before: Option<(u64, NodeCondition)>, then: (u64, NodeCondition), reported| {
            let mut table = PeerTable::default();
            if let Some((incarnation, condition)) = before {
                let first =
                    table.handle_node(node("b"), Incarnation(incarnation), condition, at(1));
                assert!(first.is_some());
            }
            let change = table.handle_node(node("b"), Incarnation(then.0), then.1, at(2));
            let finding = change.map(|change| change.finding);
            assert_eq!(finding, reported);
        };
        let says = |condition| Some(Finding::Node(condition));

        check(None, (5, Restarted), says(Reachable));
        check(None, (5, lost()), says(lost()));
        for before in [Reachable, Restarted] {
            check(Some((5, before.clone())), (5, Reachable), None);
            check(Some((5, before.clone())), (5, Restarted), None);
            check(Some((5, before.clone())), (6, Reachable), says(Restarted));
            check(Some((5, before.clone())), (6, Restarted), says(Restarted));
            check(Some((5, before.clone())), (5, lost()), says(lost()));
            check(Some((5, before)), (4, lost()), None);
        }
        check(Some((5, lost())), (5, lost()), None);
        check(Some((5, lost())), (5, Reachable), says(Reachable));
        check(Some((5, lost())), (6, Reachable), says(Restarted));
        // Only its loss was ever known: that it now has a number is no restart.
        check(Some((0, lost())), (6, Reachable), says(Reachable));
        // A node that has left is not lost, and returns as one that joins.
        check(None, (5, Left), says(Left));
        for before in [Reachable, Restarted, lost()] {
            check(Some((5, before.clone())), (5, Left), says(Left));
            check(Some((5, before)), (4, Left), None);
        }
        for after in [lost(), Left, Reachable, Restarted] {
            check(Some((5, Left)), (5, after), None);
        }
        for after in [Reachable, Restarted] {
            check(Some((5, Left)), (6, after), says(Reachable));
        }
        check(Some((5, Left)), (6, lost()), says(lost()));
        check(Some((5, Left)), (6, Left), None);
    }

    #[test]
    fn that_an_isolated_node_is_lost_is_no_news_and_what_it_did_always_is() {
        use NodeCondition::{Admitted, Isolated, Lost, Offends, Reachable};
        let mut table = PeerTable::default();
        let mut reported = |condition: &NodeCondition| {
            let change = table.handle_node(node("b"), Incarnation(5), condition.clone(), at(1));
            let finding = change.map(|change| change.finding);
            finding
                .inspect(|finding| assert_eq!(*finding, Finding::Node(condition.clone())))
                .is_some()
        };
        let isolated = Isolated { reason: "it floods".into() };
        let offends = Offends { what: "it floods".into() };

        assert!(reported(&Reachable) && reported(&offends) && reported(&offends));
        assert!(reported(&isolated));
        assert!(!reported(&isolated), "once");
        assert!(!reported(&Lost { reason: "no path".into() }) && reported(&offends));
        assert!(reported(&Admitted) && !reported(&Admitted));
        assert!(reported(&Reachable));
    }

    /// Reports one node's incarnations; returns whether that is a change, and whether the node is
    /// at rest then.
    fn rest_reported() -> impl FnMut(u64, NodeCondition) -> (bool, bool) {
        let mut table = PeerTable::default();
        move |incarnation, condition| {
            let change = table.handle_node(node("b"), Incarnation(incarnation), condition, at(1));
            let rests = table.rows(at(1)).any(|row| row.opinion == Opinion::Stopped);
            (change.is_some(), rests)
        }
    }

    #[test]
    fn a_node_stays_in_safe_state_until_it_reports_work_or_restarts() {
        use NodeCondition::{AtWork, InSafeState, Left, Lost, Reachable};
        let mut reported = rest_reported();
        let rest = || InSafeState { reason: "it panics".into() };
        let lost = || Lost { reason: "no path".into() };

        assert_eq!(reported(5, Reachable), (true, false));
        assert_eq!(reported(5, AtWork), (false, false));
        assert_eq!(reported(5, rest()), (true, true));
        assert_eq!(reported(5, rest()), (false, true));
        assert_eq!(reported(5, lost()), (true, false), "which is worse");
        assert_eq!(reported(5, Reachable), (true, true));
        assert_eq!(reported(5, AtWork), (true, false));
        assert_eq!(reported(5, rest()), (true, true));
        assert_eq!(reported(6, Reachable), (true, false), "another incarnation");
        assert_eq!(reported(6, rest()), (true, true));
        assert_eq!(reported(6, Left), (true, true), "it has left");
        assert_eq!(reported(7, Reachable), (true, false));
    }

    #[test]
    fn that_an_incarnation_rests_which_another_one_has_followed_is_no_news() {
        use NodeCondition::{AtWork, InSafeState, Lost, Reachable};
        let mut reported = rest_reported();
        let rest = || InSafeState { reason: "it panics".into() };

        // Of an unknown incarnation.
        assert_eq!(reported(0, Lost { reason: "no path".into() }), (true, false));
        assert_eq!(reported(5, rest()), (true, false));
        assert_eq!(reported(5, AtWork), (true, false));
        assert_eq!(reported(5, Reachable), (true, false));
        assert_eq!(reported(6, Reachable), (true, false));

        assert_eq!(reported(5, rest()), (false, false));
        assert_eq!(reported(6, rest()), (true, true));
        assert_eq!(reported(5, AtWork), (false, true));
    }

    #[test]
    fn the_cables_of_a_node_that_left_go_down_without_news() {
        let mut table = PeerTable::default();
        let [up, _, _, down, _] = conditions();
        let reported = |table: &mut PeerTable, condition: &LinkCondition| {
            let (here, there) = (node("a"), Some(node("b")));
            table.handle_link(here, "eth".into(), there, condition.clone(), at(1)).is_some()
        };
        assert!(reported(&mut table, &up));
        let left = table.handle_node(node("b"), Incarnation(1), NodeCondition::Left, at(2));
        assert!(left.is_some());

        assert!(!reported(&mut table, &down));
        assert!(reported(&mut table, &up), "it returns");
        let back = table.handle_node(node("b"), Incarnation(2), NodeCondition::Reachable, at(3));
        assert!(back.is_some());

        assert!(reported(&mut table, &down), "this time it was not announced");
    }

    #[test]
    fn a_node_that_the_roster_lists_no_more_is_missed_by_none_until_it_is_listed_again() {
        let mut table = PeerTable::default();
        let [up, _, _, down, _] = conditions();
        let link = |table: &mut PeerTable, condition: &LinkCondition| {
            let (here, there) = (node("a"), Some(node("b")));
            table.handle_link(here, "eth".into(), there, condition.clone(), at(1)).is_some()
        };
        let report = |table: &mut PeerTable, condition: NodeCondition| {
            let change = table.handle_node(node("b"), Incarnation(7), condition, at(2));
            change.is_some()
        };
        let lost = || NodeCondition::Lost { reason: "no path".into() };
        assert!(!report(&mut table, NodeCondition::Removed), "it was never heard of");
        assert!(link(&mut table, &up) && report(&mut table, NodeCondition::Reachable));

        assert!(report(&mut table, NodeCondition::Removed));
        assert!(!report(&mut table, NodeCondition::Removed));
        assert!(!link(&mut table, &down) && !report(&mut table, lost()));
        assert!(table.rows(at(3)).all(|row| row.opinion == Opinion::Stopped));

        assert!(!report(&mut table, NodeCondition::Listed));
        assert!(table.rows(at(3)).all(|row| row.opinion == Opinion::Failed));
        assert!(link(&mut table, &up) && report(&mut table, NodeCondition::Reachable));
        assert!(link(&mut table, &down) && report(&mut table, lost()));
    }

    #[test]
    fn rows_show_what_is_down_and_for_how_long_nothing_was_heard() {
        let mut table = PeerTable::default();
        let [up, _, _, down, _] = conditions();
        table.handle_link(node("a"), "eth".into(), Some(node("b")), up, at(0));
        table.handle_link(node("a"), "eth".into(), None, down, at(50));
        let _ = table.handle_node(node("b"), Incarnation(7), NodeCondition::Reachable, at(60));

        let rows: Vec<MonitorRow> = table.rows(at(100)).collect();

        let shown = |row: &MonitorRow| (row.opinion, row.last_sign.map(|age| age.as_millis()));
        assert_eq!(shown(&rows[0]), (Opinion::Failed, Some(100)));
        assert_eq!(shown(&rows[1]), (Opinion::Trusted, Some(40)));
        assert_eq!((rows[0].location.to_string(), table.len()), ("a -eth- b".into(), 2));
    }
}
