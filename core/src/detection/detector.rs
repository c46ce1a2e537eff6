//! What is wrong, where, and why: the judge of the fault chain.

use super::correlation::DependencyIndex;
use super::{
    FaultEntry, FaultLog, FaultNotice, FaultRecord, FaultTransition, Observation, RecoveryOutcome,
};
use crate::fault::shortened;
use crate::sorted::SortedMap;
use crate::{
    Fault, FaultId, FaultKind, FaultLocation, Incarnation, Instant, Lifecycle, Machine, NodeName,
    ObjectName,
};
use node_history::NodeHistories;
use pause::Pause;
use std::collections::VecDeque;
use std::time::Duration;

/// Follows the incarnation of every object, compares what is seen with the list of faults, and
/// keeps the record.
///
/// * **Lifecycle.** A machine per object takes the ways of [`Lifecycle::TRANSITIONS`]. A way that
///   does not exist is a fault of its own; the report is believed all the same.
/// * **One fault, one report.** A fault is latched by place and kind; seen again, it is counted. A
///   new incarnation that becomes active ends those of earlier incarnations that isolation does not
///   contain.
/// * **Roots and symptoms.** What an object suffers while something it depends on is down, or
///   behind a hang of another, is a symptom, also if its root is found only shortly afterwards.
///
/// Where the guard has already restarted a component, the fault is recorded and reported, and
/// handed to no recoverer. It is recovered when the next incarnation is active, shares what becomes
/// of a fault of that one, and is cleared when that one ends in order and none follows.
#[derive(Clone, Debug)]
pub struct Detector {
    objects: SortedMap<ObjectName, Seen>,
    needs: DependencyIndex,
    fault_log: FaultLog,
    nodes: NodeHistories,
    /// The latest pause of this node, while links and nodes may suffer from it.
    pause: Option<Pause>,
    outputs: VecDeque<DetectorOutput>,
    last_id: u64,
    /// The node ends, and its components with it.
    ending: bool,
}

/// How many faults the record holds: a day with a fault every minute and a half. An entry takes
/// some hundred bytes.
pub const FAULTS_ON_RECORD: usize = 1024;
/// How long after a symptom its root may be found. Links over wireless, the slowest, find a fault
/// within two seconds. Longer explains more, and wrongly at times.
const HINDSIGHT: Duration = Duration::from_secs(2);
/// How long the next incarnation of an object that was stopped may take to begin: a supervisor
/// starts it in milliseconds. Longer leaves faults of one that was stopped for good standing.
const NEXT_INCARNATION: Duration = Duration::from_secs(1);
/// A pause of this length is a fault: requests expire after as long, unless they say otherwise, and
/// links are down before. A shorter one is a fault only if a link or node suffers from it, up to
/// this long after it.
const PAUSE: Duration = Duration::from_secs(1);
/// The time for links and other nodes to return after a pause that is a fault. A link that has gone
/// down four times lately comes up after 48 hellos, 2.4 s; then routes and sessions follow. A link
/// or node that is still down then has a fault of its own.
const AFTER_PAUSE: Duration = Duration::from_secs(5);

/// An output of a [`Detector`].
#[derive(Clone, Debug, PartialEq)]
pub enum DetectorOutput {
    /// Tell the notifier.
    Notify {
        /// What it must know.
        notice: FaultNotice,
        /// When it was so.
        at: Instant,
    },
    /// Report to all subscribers.
    Tell {
        /// The fault, as it now stands.
        fault: Fault,
        /// When it was so.
        at: Instant,
        /// The step in the fault's history.
        turn: FaultTransition,
    },
}

/// The lifecycle machine of one object.
#[derive(Clone, Copy, Debug)]
struct Seen {
    incarnation: Incarnation,
    state: Lifecycle,
    /// It was found that this incarnation cannot go on; its end is no news.
    doomed: bool,
    /// It may end itself in order.
    may_end: bool,
    /// It may not send and receive.
    isolated: bool,
    /// The hang or overload behind which it is blocked.
    behind: Option<FaultId>,
}

impl Seen {
    fn new(incarnation: Incarnation) -> Self {
        Seen {
            incarnation,
            state: Lifecycle::Created,
            doomed: false,
            may_end: false,
            isolated: false,
            behind: None,
        }
    }

    /// An incarnation begins.
    fn begin(&mut self, incarnation: Incarnation) {
        let Seen { may_end, isolated, behind, .. } = *self;
        *self = Seen { may_end, isolated, behind, ..Seen::new(incarnation) };
    }
}

/// Where and when something was seen.
struct Scene {
    location: FaultLocation,
    incarnation: Incarnation,
    at: Instant,
}

/// What a fault may be a symptom of.
enum Cause {
    /// The fault is its own cause, whatever else is down.
    Itself,
    /// Whatever is down that it depends on.
    Above,
    /// The fault with this number.
    Known(FaultId),
    /// This one, on the same thread: reported, and handed over only if it is still open afterwards.
    Behind(FaultId),
}

impl Detector {
    /// A detector of `node` with an empty record.
    pub fn new(node: NodeName) -> Self {
        Detector {
            objects: SortedMap::new(),
            needs: DependencyIndex::new(node),
            fault_log: FaultLog::new(FAULTS_ON_RECORD),
            nodes: NodeHistories::default(),
            pause: None,
            outputs: VecDeque::new(),
            last_id: 0,
            ending: false,
        }
    }

    /// The monitor hands over what it saw.
    pub fn handle_observed(&mut self, observation: Observation) {
        let Observation { location, incarnation, finding, seen_at } = observation;
        let scene = Scene { location, incarnation, at: seen_at };
        match scene.location.clone() {
            FaultLocation::Object(address) => self.judge_object(&address.object, scene, finding),
            FaultLocation::Link { .. } => self.judge_link(scene, finding),
            FaultLocation::Node(_) => self.judge_node(scene, finding),
        }
    }

    /// The recoverer reports its progress with a fault.
    pub fn handle_outcome(&mut self, id: FaultId, at: Instant, outcome: RecoveryOutcome) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        if !entry.stands() || entry.recovered_at.is_some() {
            return;
        }
        entry.end_due = None;
        match outcome {
            RecoveryOutcome::Decided { action } => self.decide(id, at, action),
            RecoveryOutcome::Failed { action, reason } => {
                let reason = shortened(&reason).to_owned();
                self.turn(id, at, FaultTransition::Failed { action, reason }, |_| ());
            }
            RecoveryOutcome::Recovered => {
                entry.handed = false;
                self.recover(id, at);
            }
            RecoveryOutcome::Waits => self.await_next_incarnation(id, at),
            RecoveryOutcome::GaveUp { reason } => {
                self.give_up(id, at, shortened(&reason).to_owned());
            }
        }
    }

    /// The node stops: the end of a component repairs nothing from now on. Open faults stay open at
    /// the node's end.
    pub fn handle_node_end(&mut self) {
        self.ending = true;
    }

    /// The record, roots before their symptoms.
    pub fn read_record(&self) -> FaultRecord {
        self.fault_log.read()
    }

    /// A fault was seen: it is counted if it stands already, else recorded and handed over.
    fn find(&mut self, scene: &Scene, kind: FaultKind, detail: String, cause: Cause) -> FaultId {
        let detail = shortened(&detail).to_owned();
        let is_behind = matches!(cause, Cause::Behind(_));
        let known = self.fault_log.open_fault(&scene.location, &kind);
        let known = known.and_then(|id| Some((id, self.fault_log.entry(id)?.fault.incarnation)));
        let is_counted = match known {
            Some((id, _)) => self.repeat(id, scene, &detail),
            None => false,
        };
        let known = known.filter(|_| is_counted);
        let id = match known.and_then(|(id, then)| Some((self.fault_log.entry(id)?, then))) {
            Some((entry, then)) => {
                let id = entry.fault.id;
                // What is its own cause now was taken for a symptom before.
                let turns = matches!(cause, Cause::Itself) && entry.fault.symptom_of.is_some();
                if is_behind || !(turns || entry.unhanded) {
                    if entry.handed && then < scene.incarnation {
                        // What was done about it has not helped.
                        self.notify(id, scene.at);
                    }
                    return id;
                }
                // Where it was a symptom, it is none any more, or has outlived its root.
                self.explain(&[id], None, scene.at);
                id
            }
            None => self.record(scene, kind, detail, cause),
        };
        if let Some(entry) = self.fault_log.entry_mut(id) {
            entry.unhanded = is_behind;
        }
        if is_behind {
            return id;
        }
        self.notify(id, scene.at);
        self.explain_by(id, scene.at);
        id
    }

    /// A recoverer is to decide about a fault.
    fn notify(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        (entry.handed, entry.end_due) = (true, None);
        let notice = FaultNotice::Found(entry.fault.clone());
        self.outputs.push_back(DetectorOutput::Notify { notice, at });
    }

    /// Counts a fault once more, in its newest words; no, if what stands was given up in another
    /// incarnation, or was treated with success: then it is back.
    fn repeat(&mut self, id: FaultId, scene: &Scene, detail: &str) -> bool {
        let Some(entry) = self.fault_log.entry_mut(id) else { return false };
        let another = scene.incarnation != entry.fault.incarnation;
        let is_of_object = matches!(entry.fault.location, FaultLocation::Object(_));
        let is_back = is_of_object && entry.recovered_at.is_some();
        if is_back || another && entry.given_up.is_some() {
            return false;
        }
        entry.fault.count = entry.fault.count.saturating_add(1);
        entry.fault.incarnation = scene.incarnation;
        if entry.fault.detail != detail {
            let before = std::mem::replace(&mut entry.fault.detail, detail.to_owned());
            entry.first_detail.get_or_insert(before);
        }
        if entry.fault.count.is_power_of_two() {
            self.turn(id, scene.at, FaultTransition::Repeated, |_| ());
        }
        true
    }

    /// Counts the fault of this kind that stands once more, or records it.
    fn count_or_record(
        &mut self,
        scene: &Scene,
        kind: FaultKind,
        detail: String,
        cause: Cause,
    ) -> FaultId {
        let detail = shortened(&detail).to_owned();
        if let Some(id) = self.fault_log.open_fault(&scene.location, &kind)
            && self.repeat(id, scene, &detail)
        {
            return id;
        }
        self.record(scene, kind, detail, cause)
    }

    /// Puts a fault into the record and reports it.
    fn record(&mut self, scene: &Scene, kind: FaultKind, detail: String, cause: Cause) -> FaultId {
        // What stands is of an incarnation that is over.
        self.end_kind(scene, &kind);
        self.last_id += 1;
        let id = FaultId(self.last_id);
        let symptom_of = match cause {
            Cause::Itself => None,
            Cause::Known(cause) | Cause::Behind(cause) => Some(self.fault_log.root(cause)),
            Cause::Above => self.needs.root_above(&scene.location, &self.fault_log),
        };
        let fault = Fault {
            id,
            severity: kind.severity(),
            kind,
            location: scene.location.clone(),
            incarnation: scene.incarnation,
            detail,
            found_at: scene.at,
            symptom_of,
            count: 1,
        };
        self.fault_log.open(fault);
        let is_explicable = matches!(cause, Cause::Above);
        self.turn(id, scene.at, FaultTransition::Found, |entry| entry.explicable = is_explicable);
        id
    }

    /// A root was found: what was found shortly before, and is explained by it, becomes its
    /// symptom.
    fn explain_by(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry(id) else { return };
        if !entry.fault.kind.is_down() {
            return;
        }
        let location = entry.fault.location.clone();
        let root = self.fault_log.root(id);
        let since = at - (Instant::ORIGIN + HINDSIGHT);
        let is_behind = |fault: &Fault| match &fault.location {
            FaultLocation::Object(address) => self.behind(&address.object) == Some(id),
            _ => false,
        };
        let explained: Vec<FaultId> = self
            .fault_log
            .all_open_entries()
            .filter(|FaultEntry { fault, explicable, .. }| {
                fault.symptom_of.is_none()
                    && fault.id != root
                    && fault.id != id
                    && fault.found_at - Instant::ORIGIN >= since
                    && *explicable
                    && (is_behind(fault)
                        || self.needs.needs_of(&fault.location).contains(&location))
            })
            .map(|entry| entry.fault.id)
            .collect();
        self.explain(&explained, Some(root), at);
    }

    /// It has turned out what these are symptoms of, or that they are roots.
    fn explain(&mut self, faults: &[FaultId], root: Option<FaultId>, at: Instant) {
        for &id in faults {
            if self.fault_log.entry(id).is_some_and(|entry| entry.fault.symptom_of != root) {
                self.turn(id, at, FaultTransition::Explained, |e| e.fault.symptom_of = root);
            }
        }
    }

    /// Something happens to a fault: writes it down, and reports it.
    fn turn(
        &mut self,
        id: FaultId,
        at: Instant,
        turn: FaultTransition,
        change: impl FnOnce(&mut FaultEntry),
    ) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        change(entry);
        let fault = entry.fault.clone();
        self.outputs.push_back(DetectorOutput::Tell { fault, at, turn });
    }

    /// The cause of the fault of this kind at this place, if there is one, is away.
    fn end_kind(&mut self, scene: &Scene, kind: &FaultKind) {
        if let Some(id) = self.fault_log.open_fault(&scene.location, kind) {
            self.end(id, scene.at);
        }
    }

    /// The cause of a fault is away.
    fn end(&mut self, id: FaultId, at: Instant) {
        self.repair(id, at);
        self.withdraw(id, at);
    }

    /// These faults of the place that match; their causes are away, and service is restored if so.
    fn end_all_at(&mut self, scene: &Scene, is_over: impl Fn(&Fault) -> bool, restored: bool) {
        let open_fault = self.fault_log.open_faults_at(&scene.location);
        let over: Vec<FaultId> = open_fault.filter(|f| is_over(f)).map(|fault| fault.id).collect();
        for id in over {
            if restored {
                self.recover(id, scene.at);
            }
            self.end(id, scene.at);
        }
    }

    /// A fault is over, and this is not reported yet.
    fn withdraw(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        if std::mem::take(&mut entry.handed) {
            let notice = FaultNotice::Cleared { id, location: entry.fault.location.clone() };
            self.outputs.push_back(DetectorOutput::Notify { notice, at });
        }
    }

    /// Service is restored. Of an object that is the repair as well.
    fn recover(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        entry.end_due = None;
        if entry.recovered_at.is_some() || !entry.stands() {
            return;
        }
        (entry.recovered_at, entry.given_up) = (Some(at), None);
        if entry.fault.is_repaired_by_recovery() {
            self.fault_log.repair(id, at);
        }
        self.turn(id, at, FaultTransition::Recovered, |_| ());
    }

    /// The cause is away.
    fn repair(&mut self, id: FaultId, at: Instant) {
        if self.fault_log.entry(id).is_some_and(FaultEntry::stands) {
            self.fault_log.repair(id, at);
            self.turn(id, at, FaultTransition::Cleared, |_| ());
        }
    }

    /// What is done about a fault.
    fn decide(&mut self, id: FaultId, at: Instant, action: String) {
        for id in self.sharing_the_outcome_of(id) {
            let turn = FaultTransition::Decided { action: action.clone() };
            self.turn(id, at, turn, |entry| entry.decided = Some((at, action.clone())));
        }
    }

    /// Nothing more is tried. The fault stands.
    fn give_up(&mut self, id: FaultId, at: Instant, reason: String) {
        for id in self.sharing_the_outcome_of(id) {
            let root = self.fault_log.entry(id).and_then(|entry| entry.fault.symptom_of);
            let root = root.and_then(|root| self.fault_log.entry(root)).map(|root| {
                let Fault { id, kind, location, .. } = &root.fault;
                format!("; it is a symptom of fault {}, {kind} of {location}", id.0)
            });
            let reason = reason.clone() + &root.unwrap_or_default();
            let turn = FaultTransition::GaveUp { reason: reason.clone() };
            self.turn(id, at, turn, |entry| {
                (entry.end_due, entry.unhanded) = (None, false);
                entry.given_up = Some((at, reason));
            });
        }
    }

    /// This fault ends with the incarnation after it, which may have ended before the fault was
    /// told.
    fn await_next_incarnation(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        entry.unhanded = true;
        let Fault { location, incarnation, .. } = entry.fault.clone();
        let FaultLocation::Object(address) = &location else { return };
        let seen = self.objects.get(&address.object);
        match seen.filter(|seen| seen.incarnation > incarnation).map(|seen| seen.state) {
            Some(Lifecycle::Active) => {
                self.recover(id, at);
                self.withdraw(id, at);
            }
            Some(Lifecycle::Finalized) => self.end_unhanded_at(&location, at),
            _ => {
                let given_up = self.fault_log.open_faults_at(&location).find_map(|fault| {
                    let later = Some(fault.id).filter(|_| fault.incarnation > incarnation)?;
                    self.fault_log.entry(later)?.given_up.clone()
                });
                if let Some((_, reason)) = given_up {
                    self.give_up(id, at, reason);
                }
            }
        }
    }

    /// An object that ended in order takes along what only its next incarnation could have ended,
    /// unless it was stopped to be replaced: then that incarnation begins soon.
    fn end_unhanded_at(&mut self, location: &FaultLocation, at: Instant) {
        let ended: Vec<FaultId> = self.unhanded_at(location).map(|fault| fault.id).collect();
        let due = Some(at + NEXT_INCARNATION);
        for id in ended {
            if let Some(entry) = self.fault_log.entry_mut(id) {
                entry.end_due = due;
            }
        }
    }

    /// No incarnation has begun in time after the one that ended in order.
    fn end_unhanded(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        entry.end_due = None;
        let FaultLocation::Object(address) = &entry.fault.location else { return };
        let seen = self.objects.get(&address.object);
        if entry.unhanded
            && !self.ending
            && seen.is_some_and(|seen| seen.state == Lifecycle::Finalized)
        {
            self.end(id, at);
        }
    }

    /// This fault, and those that were to end with its incarnation: of the incarnations before it,
    /// or, where this one is its end, of a reset that came to wait.
    fn sharing_the_outcome_of(&self, id: FaultId) -> Vec<FaultId> {
        let Some(entry) = self.fault_log.entry(id) else { return Vec::new() };
        let (fault, ends) = (&entry.fault, entry.fault.kind.is_down());
        let shares = |other: &&Fault| {
            other.incarnation < fault.incarnation
                || ends && other.incarnation == fault.incarnation && other.id != id
        };
        let sharing = self.unhanded_at(&fault.location).filter(shares).map(|other| other.id);
        std::iter::once(id).chain(sharing).collect()
    }

    fn unhanded_at(&self, location: &FaultLocation) -> impl Iterator<Item = &Fault> {
        let open = self.fault_log.open_faults_at(location);
        open.filter(|fault| self.fault_log.entry(fault.id).is_some_and(|entry| entry.unhanded))
    }
}

impl Machine for Detector {
    type Output = DetectorOutput;

    fn poll_output(&mut self) -> Option<DetectorOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let pause = self.pause.as_ref().map(|pause| pause.until);
        let end = self.fault_log.next_end().map(|(due, _)| due);
        let calm = self.nodes.next_calm().map(|(due, _)| due);
        [end, calm, pause].into_iter().flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        while let Some((due, id)) = self.fault_log.next_end()
            && due <= now
        {
            self.end_unhanded(id, now);
        }
        while let Some((due, node)) = self.nodes.next_calm()
            && due <= now
        {
            self.end_crash_loop(&node.clone(), now);
        }
        self.end_pause(now);
    }
}

mod node_history;
mod pause;
mod rules;
#[cfg(test)]
mod tests;
