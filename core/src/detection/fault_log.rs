//! The record of faults, and which of them stand.

use super::{FaultEntry, FaultRecord};
use crate::sorted::SortedMap;
use crate::{Fault, FaultId, FaultKind, FaultLocation, Instant};
use std::collections::BTreeSet;

/// The record of faults: found, decided, recovered, repaired, with the instants; and the latches.
///
/// A fault is latched from when it is found until its cause is away. While it is, the same kind at
/// the same place is the same fault. One whose service is restored, or that was given up, stays
/// latched until then: it still stands.
///
/// The record is bounded. To make room, the oldest fault that is over goes first; where none is,
/// the oldest of all, with its latch, so that it would be found again.
#[derive(Clone, Debug)]
pub struct FaultLog {
    entries: SortedMap<FaultId, FaultEntry>,
    latches: SortedMap<(FaultLocation, FaultKind), FaultId>,
    capacity: usize,
    dropped: u64,
}

impl FaultLog {
    /// An empty record with room for so many faults; at least one.
    pub fn new(capacity: usize) -> Self {
        FaultLog {
            entries: SortedMap::new(),
            latches: SortedMap::new(),
            capacity: capacity.max(1),
            dropped: 0,
        }
    }

    /// Takes a fault that was found, and latches it. Where there is no capacity for it, another one
    /// is dropped.
    pub fn open(&mut self, fault: Fault) {
        if self.entries.len() >= self.capacity {
            self.drop_oldest();
        }
        let (scope, kind, id) = (scope(&fault.location), fault.kind.clone(), fault.id);
        self.latches.insert((scope, kind), id);
        self.entries.insert(id, FaultEntry::new(fault));
    }

    /// The fault of this kind that stands at this place.
    pub fn open_fault(&self, location: &FaultLocation, kind: &FaultKind) -> Option<FaultId> {
        self.latches.get(&(scope(location), kind.clone())).copied()
    }

    /// Every fault that stands at this place, in the order of their kinds.
    pub fn open_faults_at(&self, location: &FaultLocation) -> impl Iterator<Item = &Fault> {
        let scope = scope(location);
        // The first kind of the list: all latches of the place follow.
        let first = (scope.clone(), FaultKind::Panic);
        self.latches
            .range(first..)
            .take_while(move |((other, _), _)| *other == scope)
            .filter_map(|(_, &id)| Some(&self.entry(id)?.fault))
    }

    /// Every fault that stands.
    pub fn all_open(&self) -> impl Iterator<Item = &Fault> {
        self.all_open_entries().map(|entry| &entry.fault)
    }

    pub(super) fn all_open_entries(&self) -> impl Iterator<Item = &FaultEntry> {
        self.latches.values().filter_map(|&id| self.entry(id))
    }

    /// Every fault that is recorded, the latest first, whether it stands or not.
    pub(super) fn latest_first(&self) -> impl Iterator<Item = &Fault> {
        self.entries.values().rev().map(|entry| &entry.fault)
    }

    /// Whether this fault still stands, given up or not.
    pub fn stands(&self, id: FaultId) -> bool {
        self.entry(id).is_some_and(|entry| {
            self.latches.get(&(scope(&entry.fault.location), entry.fault.kind.clone())) == Some(&id)
        })
    }

    /// The entry of one fault; `None` where the log has none with this number.
    pub fn entry(&self, id: FaultId) -> Option<&FaultEntry> {
        self.entries.get(&id)
    }

    /// One fault, to write down what becomes of it. Its place and kind must not be changed.
    pub(super) fn entry_mut(&mut self, id: FaultId) -> Option<&mut FaultEntry> {
        self.entries.get_mut(&id)
    }

    /// The next fault that is over unless an incarnation begins, and when.
    pub(super) fn next_end(&self) -> Option<(Instant, FaultId)> {
        let all = self.entries.iter();
        all.filter_map(|(&id, entry)| Some((entry.end_due?, id))).min()
    }

    /// Writes down that the cause of a fault is away, and lifts its latch. Only the notifier may have
    /// to be informed yet.
    pub(super) fn repair(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.entry_mut(id) else { return };
        (entry.explicable, entry.unhanded, entry.end_due) = (false, false, None);
        entry.repaired_at = Some(at);
        let latch = (scope(&entry.fault.location), entry.fault.kind.clone());
        if self.latches.get(&latch) == Some(&id) {
            self.latches.remove(&latch);
        }
    }

    /// Follows a symptom up to its root.
    pub fn root(&self, id: FaultId) -> FaultId {
        let (mut root, mut passed) = (id, BTreeSet::new());
        while passed.insert(root)
            && let Some(above) = self.entry(root).and_then(|entry| entry.fault.symptom_of)
            && self.entries.contains_key(&above)
        {
            root = above;
        }
        root
    }

    /// The record as it is read: each root in the order in which they were found, each followed by
    /// its symptoms.
    pub fn read(&self) -> FaultRecord {
        let all = self.entries.iter();
        let mut entries: Vec<(FaultId, &FaultEntry)> =
            all.map(|(&id, entry)| (self.root(id), entry)).collect();
        entries.sort_by_key(|&(root, entry)| (root, entry.fault.id != root, entry.fault.id));
        let entries = entries.into_iter().map(|(_, entry)| entry.clone()).collect();
        FaultRecord { entries, dropped: self.dropped }
    }

    fn drop_oldest(&mut self) {
        let over = |entry: &&FaultEntry| !entry.stands();
        let oldest = self.entries.values().find(over).or(self.entries.values().next());
        let Some(id) = oldest.map(|entry| entry.fault.id) else { return };
        self.latches.retain(|_, latched| *latched != id);
        self.entries.remove(&id);
        self.dropped += 1;
    }
}

/// A place as latches know it: a link is the same whether or not its neighbour is known yet.
fn scope(location: &FaultLocation) -> FaultLocation {
    match location.clone() {
        FaultLocation::Link { node, link, .. } => {
            FaultLocation::Link { node, link, neighbour: None }
        }
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Incarnation;
    use crate::detection::FaultStatus;
    use crate::testing::node;

    fn cable(neighbour: Option<&str>) -> FaultLocation {
        FaultLocation::Link {
            node: node("a"),
            link: "cable".into(),
            neighbour: neighbour.map(node),
        }
    }

    fn fault(id: u64, location: FaultLocation, kind: FaultKind, symptom_of: Option<u64>) -> Fault {
        Fault {
            id: FaultId(id),
            severity: kind.severity(),
            kind,
            location,
            incarnation: Incarnation::FIRST,
            detail: String::new(),
            found_at: Instant::from_millis(id),
            symptom_of: symptom_of.map(FaultId),
            count: 1,
        }
    }

    fn ids(record: &FaultRecord) -> Vec<u64> {
        record.entries.iter().map(|entry| entry.fault.id.0).collect()
    }

    #[test]
    fn a_link_is_the_same_place_before_and_after_its_neighbour_is_known() {
        let mut fault_log = FaultLog::new(8);

        fault_log.open(fault(1, cable(None), FaultKind::LinkDown, None));

        let found = fault_log.open_fault(&cable(Some("b")), &FaultKind::LinkDown);
        assert_eq!(found, Some(FaultId(1)));
        assert_eq!(fault_log.open_faults_at(&cable(Some("b"))).count(), 1);
    }

    #[test]
    fn a_fault_stands_until_its_cause_is_away_though_recovered() {
        let mut fault_log = FaultLog::new(8);
        fault_log.open(fault(1, cable(None), FaultKind::LinkDown, None));
        let status = |fault_log: &FaultLog| fault_log.entry(FaultId(1)).map(FaultEntry::status);
        assert_eq!(status(&fault_log), Some(FaultStatus::Open));

        let entry = fault_log.entry_mut(FaultId(1)).expect("it is recorded");
        entry.given_up = Some((Instant::from_millis(5), "no path".into()));
        assert!(fault_log.stands(FaultId(1)));
        assert_eq!(status(&fault_log), Some(FaultStatus::GivenUp));

        let entry = fault_log.entry_mut(FaultId(1)).expect("it is recorded");
        entry.recovered_at = Some(Instant::from_millis(7));
        assert!(fault_log.stands(FaultId(1)));
        assert_eq!(status(&fault_log), Some(FaultStatus::Recovered));

        fault_log.repair(FaultId(1), Instant::from_millis(9));
        assert!(!fault_log.stands(FaultId(1)));
        assert_eq!(status(&fault_log), Some(FaultStatus::Closed));
        assert_eq!(fault_log.all_open().count(), 0);
    }

    #[test]
    fn each_root_is_read_before_its_symptoms_and_symptoms_follow_their_root() {
        let mut fault_log = FaultLog::new(8);
        let location = |name| FaultLocation::Node(node(name));
        fault_log.open(fault(1, location("symptom"), FaultKind::Silence, Some(3)));
        fault_log.open(fault(2, location("other"), FaultKind::Silence, None));
        fault_log.open(fault(3, location("root"), FaultKind::Panic, None));
        fault_log.open(fault(4, location("deeper"), FaultKind::Silence, Some(1)));

        assert_eq!(ids(&fault_log.read()), [2, 3, 1, 4]);
        assert_eq!(fault_log.root(FaultId(4)), FaultId(3));
    }

    #[test]
    fn symptoms_that_name_each_other_end_the_search_for_their_root() {
        let mut fault_log = FaultLog::new(8);
        fault_log.open(fault(1, cable(None), FaultKind::Silence, Some(2)));
        fault_log.open(fault(2, cable(None), FaultKind::Hang, Some(1)));

        assert_eq!(fault_log.read().entries.len(), 2);
    }

    #[test]
    fn the_oldest_that_has_ended_makes_room_and_is_counted() {
        let mut fault_log = FaultLog::new(2);
        fault_log.open(fault(1, FaultLocation::Node(node("a")), FaultKind::NodeLost, None));
        fault_log.open(fault(2, FaultLocation::Node(node("b")), FaultKind::NodeLost, None));
        fault_log.repair(FaultId(2), Instant::from_millis(5));

        fault_log.open(fault(3, FaultLocation::Node(node("c")), FaultKind::NodeLost, None));
        assert_eq!(ids(&fault_log.read()), [1, 3]);

        fault_log.open(fault(4, FaultLocation::Node(node("d")), FaultKind::NodeLost, None));
        assert_eq!(ids(&fault_log.read()), [3, 4]);
        assert_eq!(fault_log.read().dropped, 2);
        assert_eq!(
            fault_log.open_fault(&FaultLocation::Node(node("a")), &FaultKind::NodeLost),
            None
        );
    }
}
