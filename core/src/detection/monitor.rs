//! Which objects live, in which incarnation and state: the table, and the changes in it.

use super::entry::{LastExit, MonitoredObject, NoteCause, describe};
use super::peer_table::PeerTable;
use super::{
    ExitReason, Finding, LinkCondition, MonitorRow, NodeCondition, ObjectKind, Observation,
    Registration, RegistrationError, WorkProgress,
};
use crate::fault::shortened;
use crate::sorted::SortedMap;
use crate::{
    FaultKind, FaultLocation, Incarnation, Instant, Lifecycle, Machine, NodeName, ObjectAddress,
    ObjectName,
};
use std::collections::VecDeque;
use std::sync::Arc;
use std::time::Duration;

/// Keeps the table of all monitored objects, and reports its observations to the detector.
///
/// It judges nothing. What an older incarnation still says, or one that has ended, changes nothing;
/// that it panicked is passed on. A report or an answer of a new incarnation of an object empties
/// its history.
///
/// What is reported of an object that was never registered opens a row of its own, so that a
/// component that dies before its registration arrives is not lost.
#[derive(Clone, Debug)]
pub struct Monitor {
    node: NodeName,
    rows_max: usize,
    objects: SortedMap<ObjectName, MonitoredObject>,
    peers: PeerTable,
    outputs: VecDeque<Observation>,
    /// Declared faults that end by themselves.
    holds: SortedMap<(ObjectName, FaultKind), Hold>,
    /// The node ends.
    ending: bool,
}

/// For how long a fault stands that its object does not declare again.
#[derive(Clone, Copy, Debug)]
struct Hold {
    span: Duration,
    due: Instant,
}

/// How many rows the table of a [`Monitor`] may have: a hundred thousand components are measured,
/// and a robot has hundreds. A row takes some hundred bytes.
pub const MONITOR_ROWS_MAX: usize = 128 * 1024;

impl Monitor {
    /// A monitor of `node` with an empty table.
    pub fn new(node: NodeName) -> Self {
        Monitor {
            node,
            rows_max: MONITOR_ROWS_MAX,
            objects: SortedMap::new(),
            peers: PeerTable::default(),
            outputs: VecDeque::new(),
            holds: SortedMap::new(),
            ending: false,
        }
    }

    /// Watches an object, or changes how it is watched.
    ///
    /// # Errors
    /// [`RegistrationError::TableFull`]
    pub fn register(
        &mut self,
        registration: Registration,
        now: Instant,
    ) -> Result<(), RegistrationError> {
        let Registration { object, kind, incarnation, depends_on, may_end } = registration;
        if self.is_full() && !self.objects.contains_key(&object) {
            return Err(RegistrationError::TableFull { object, limit: self.rows_max });
        }
        let fresh = || MonitoredObject::new(kind, incarnation);
        let entry = self.objects.entry(object.clone()).or_insert_with(fresh);
        if entry.incarnation < incarnation {
            entry.begin(incarnation);
        }
        (entry.kind, entry.may_end) = (kind, may_end);
        let incarnation = entry.incarnation;
        self.observe_object(&object, incarnation, Finding::Enrolled { may_end, depends_on }, now);
        Ok(())
    }

    /// Forgets an object.
    pub fn dismiss(&mut self, object: &ObjectName, now: Instant) {
        if let Some(entry) = self.objects.remove(object) {
            self.observe_object(object, entry.incarnation, Finding::Dismissed, now);
        }
    }

    /// An object has answered.
    pub fn handle_alive(&mut self, object: &ObjectName, progress: WorkProgress, now: Instant) {
        if !self.objects.contains_key(object) {
            return;
        }
        self.handle_found(object, progress.incarnation, Finding::Spoke, now);
        let is_it = |entry: &&mut MonitoredObject| {
            entry.incarnation == progress.incarnation && entry.end.is_none()
        };
        if let Some(entry) = self.objects.get_mut(object).filter(is_it) {
            // A guard reports every change, and may have reported a later one: answers only stand
            // in for guards where there are none.
            let state = progress.state;
            if !entry.guarded && entry.state.replace(state) != Some(state) {
                let finding = Finding::State { state, reason: None };
                self.observe_object(object, progress.incarnation, finding, now);
            }
        }
    }

    /// An object has not answered for so long.
    pub fn handle_unanswered(&mut self, object: &ObjectName, age: Duration, now: Instant) {
        let entry = self.objects.get(object).filter(|entry| entry.end.is_none());
        if let Some(incarnation) = entry.map(|entry| entry.incarnation) {
            self.handle_found(object, incarnation, Finding::Silent { age }, now);
        }
    }

    /// A guard has seen an incarnation end.
    pub fn handle_exited(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        exit: ExitReason,
        restarted_as: Option<Incarnation>,
        now: Instant,
    ) {
        // The orderly end of an unknown object, such as a dismissed one, is not reported.
        if exit == ExitReason::Stopped && !self.objects.contains_key(object) {
            return;
        }
        let is_older = |entry: &MonitoredObject| incarnation < entry.incarnation;
        if self.objects.get(object).is_some_and(is_older)
            && matches!(exit, ExitReason::Panicked { .. })
        {
            // That it panicked is reported all the same; of the present incarnation it says
            // nothing.
            let finding = Finding::Exited { exit, restarted_as };
            return self.observe_object(object, incarnation, finding, now);
        }
        let is_known = self.objects.contains_key(object);
        let Some(entry) = self.admit(object, incarnation) else { return };
        // Every component is registered before it begins.
        if !is_known && restarted_as.is_some() {
            entry.kind = ObjectKind::Middleware;
        }
        let is_middleware = entry.kind == ObjectKind::Middleware;
        if matches!(entry.end, Some(LastExit::Stopped | LastExit::Died)) {
            return;
        }
        let died = match exit {
            ExitReason::Stopped => false,
            ExitReason::Returned => !entry.may_end,
            ExitReason::Fatal | ExitReason::Panicked { .. } | ExitReason::Aborted => true,
        };
        entry.end = Some(if died { LastExit::Died } else { LastExit::Stopped });
        entry.state = Some(if died { Lifecycle::Fatal } else { Lifecycle::Finalized });
        entry.note(NoteCause::End, describe(&exit));
        self.observe_object(object, incarnation, Finding::Exited { exit, restarted_as }, now);
        if let Some(next) = restarted_as {
            self.admit(object, next);
            if is_middleware {
                // It has no hooks: its guard reports when it serves again.
                let progress = WorkProgress { incarnation: next, state: Lifecycle::Active };
                self.handle_alive(object, progress, now);
            }
        }
    }

    /// A guard reports the state of an incarnation.
    pub fn handle_state(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        state: Lifecycle,
        reason: Option<String>,
        now: Instant,
    ) {
        if state == Lifecycle::Finalized && !self.objects.contains_key(object) {
            return;
        }
        let Some(entry) = self.admit(object, incarnation) else { return };
        let reason = reason.as_deref().map(|reason| shortened(reason).to_owned());
        entry.guarded = true;
        entry.state = Some(state);
        entry.signs.last = Some(now);
        match &reason {
            Some(reason) => entry.note(NoteCause::State, reason.clone()),
            None => entry.erase(&NoteCause::State),
        }
        if !matches!(state, Lifecycle::Created | Lifecycle::Initialized) {
            // It waits no more, whether it is at work now or not.
            entry.erase(&NoteCause::Declared(FaultKind::Unavailable));
        }
        if state == Lifecycle::Finalized {
            entry.end.get_or_insert(LastExit::Finalized);
        }
        self.observe_object(object, incarnation, Finding::State { state, reason }, now);
    }

    /// An object declares a fault of its own; also one that has ended, for what is left of it. With a
    /// `hold` the fault ends so long after it was declared last; without one, when the object says
    /// so.
    pub fn handle_declared(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        kind: FaultKind,
        detail: String,
        hold: Option<Duration>,
        now: Instant,
    ) {
        let detail = shortened(&detail).to_owned();
        let (cause, key) = (NoteCause::Declared(kind.clone()), (object.clone(), kind.clone()));
        let is_held = self.holds.contains_key(&key);
        let Some(entry) = self.admit(object, incarnation) else { return };
        if entry.end.is_none() {
            entry.signs.last = Some(now);
        }
        // One that stands without a hold keeps standing.
        let is_latched = entry.noted(&cause).is_some() && !is_held;
        entry.note(cause, detail.clone());
        match hold.filter(|_| !is_latched).map(|span| Hold { span, due: now + span }) {
            Some(hold) => self.holds.insert(key, hold),
            None => self.holds.remove(&key),
        };
        self.observe_object(object, incarnation, Finding::Declared { kind, detail }, now);
    }

    /// A fault that an object had declared is over.
    pub fn handle_declared_fault_cleared(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        kind: FaultKind,
        now: Instant,
    ) {
        let Some(entry) = self.admit(object, incarnation) else { return };
        if entry.end.is_none() {
            entry.signs.last = Some(now);
        }
        entry.erase(&NoteCause::Declared(kind.clone()));
        self.holds.remove(&(object.clone(), kind.clone()));
        self.observe_object(object, incarnation, Finding::Cleared { kind }, now);
    }

    fn next_hold(&self) -> Option<(Instant, &(ObjectName, FaultKind))> {
        self.holds.iter().map(|(key, hold)| (hold.due, key)).min()
    }

    /// A fault was not declared again within its hold: it is over, unless its object is kept from
    /// declaring it, or has begun another incarnation meanwhile.
    fn end_hold(&mut self, object: ObjectName, kind: FaultKind, now: Instant) {
        let cause = NoteCause::Declared(kind.clone());
        let entry = self.objects.get_mut(&object).filter(|entry| entry.noted(&cause).is_some());
        let hold = self.holds.remove(&(object.clone(), kind.clone()));
        let (Some(entry), Some(Hold { span, .. })) = (entry, hold) else { return };
        let is_at_work = entry.state.is_none_or(|state| state == Lifecycle::Active);
        if entry.end.is_none() && (entry.isolated || !is_at_work) {
            self.holds.insert((object, kind), Hold { span, due: now + span });
            return;
        }
        let incarnation = entry.incarnation;
        entry.erase(&cause);
        self.observe_object(&object, incarnation, Finding::Cleared { kind }, now);
    }

    /// A link reports how it is. The same condition again is no news.
    pub fn handle_link(
        &mut self,
        node: NodeName,
        link: Arc<str>,
        neighbour: Option<NodeName>,
        condition: LinkCondition,
        now: Instant,
    ) {
        if self.is_full() && !self.peers.knows_link(&node, &link) {
            return;
        }
        let news = self.peers.handle_link(node, link, neighbour, condition, now);
        news.into_iter().for_each(|news| self.observe(news));
    }

    /// The router reports how a node is. The same condition again is no news; a newer incarnation
    /// is.
    pub fn handle_node(
        &mut self,
        node: NodeName,
        incarnation: Incarnation,
        condition: NodeCondition,
        now: Instant,
    ) {
        if self.is_full() && !self.peers.knows_node(&node) {
            return;
        }
        let news = self.peers.handle_node(node, incarnation, condition, now);
        news.into_iter().for_each(|news| self.observe(news));
    }

    /// The node ends, in order or not. Threads, links and sessions go with it: from now on only
    /// what a component says itself, or dies of, is handed to the detector.
    pub fn handle_ending(&mut self) {
        self.ending = true;
    }

    /// An object's sending and receiving was forbidden, or allowed again.
    pub fn handle_isolation(&mut self, object: &ObjectName, isolated: bool, now: Instant) {
        if let Some(entry) = self.objects.get_mut(object) {
            entry.isolated = isolated;
            let incarnation = entry.incarnation;
            self.observe_object(object, incarnation, Finding::Isolated { isolated }, now);
        }
    }

    /// The whole table: objects by name, then links, then nodes.
    pub fn read_table(&self, now: Instant) -> Vec<MonitorRow> {
        let objects = self.objects.iter().map(|(object, entry)| {
            let address = ObjectAddress::new(self.node.clone(), object.clone());
            entry.row(FaultLocation::Object(address), now)
        });
        objects.chain(self.peers.rows(now)).collect()
    }

    fn is_full(&self) -> bool {
        self.objects.len() + self.peers.len() >= self.rows_max
    }

    /// The entry of an object for news of this incarnation; none if that incarnation is over.
    fn admit(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
    ) -> Option<&mut MonitoredObject> {
        if !self.objects.contains_key(object) {
            if self.is_full() {
                return None;
            }
            self.objects
                .insert(object.clone(), MonitoredObject::new(ObjectKind::Component, incarnation));
        }
        let entry = self.objects.get_mut(object).expect("it was just put in");
        if incarnation < entry.incarnation {
            return None;
        }
        if incarnation > entry.incarnation {
            entry.begin(incarnation);
        }
        Some(entry)
    }

    /// Like [`admit`](Self::admit), for what only the living can say.
    fn alive(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
    ) -> Option<&mut MonitoredObject> {
        let ended =
            |entry: &MonitoredObject| entry.incarnation == incarnation && entry.end.is_some();
        if self.objects.get(object).is_some_and(ended) {
            return None;
        }
        self.admit(object, incarnation)
    }

    fn observe_object(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        finding: Finding,
        now: Instant,
    ) {
        let address = ObjectAddress::new(self.node.clone(), object.clone());
        let location = FaultLocation::Object(address);
        self.observe(Observation { location, incarnation, finding, seen_at: now });
    }

    fn observe(&mut self, observation: Observation) {
        if !self.ending || observation.finding.is_own_doing() {
            self.outputs.push_back(observation);
        }
    }
}

impl Machine for Monitor {
    type Output = Observation;

    /// The next observation for the detector, in the order in which things happened.
    fn poll_output(&mut self) -> Option<Observation> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.next_hold().map(|(due, _)| due)
    }

    fn handle_timeout(&mut self, now: Instant) {
        while let Some((due, (object, kind))) = self.next_hold()
            && due <= now
        {
            self.end_hold(object.clone(), kind.clone(), now);
        }
    }
}

mod reports;
#[cfg(test)]
mod tests;
