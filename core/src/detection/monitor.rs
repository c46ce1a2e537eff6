//! Who lives, in which life and state: the table, and what is new in it.

use super::inquiry::InquiryOutput;
use super::{
    Current, Enrolment, Exit, Finding, Handed, Handover, HandoverLimits, Inquiry, LinkCondition,
    NodeCondition, ObjectKind, Observation, Opinion, Progress, QueueSeen, Row, Verdict, Watch,
    Watchdog,
};
use crate::{
    FaultKind, Incarnation, Instant, Lifecycle, Machine, NodeName, ObjectAddress, ObjectName, Place,
};
use std::collections::{BTreeMap, VecDeque};
use std::mem::discriminant;
use std::sync::Arc;
use std::time::Duration;

/// Keeps the table of everything that is watched, and hands what it sees to the detector.
///
/// It judges silence, because that is a matter of time, and nothing else. What an older life still says,
/// or one that has ended, changes nothing and is counted. Whatever begins a new life of an object
/// (a report, a heartbeat, an answer) empties its history.
///
/// What is reported of an object that was never enrolled opens a row of its own, so that a component
/// that dies before its enrolment arrives is not lost.
#[derive(Clone, Debug)]
pub struct Monitor {
    node: NodeName,
    limits: MonitorLimits,
    objects: BTreeMap<ObjectName, Entry>,
    /// Links and nodes. A link stands here without its neighbour, which may become known later.
    others: BTreeMap<Place, Entry>,
    watchdog: Watchdog,
    inquiry: Inquiry,
    handover: Handover<Observation>,
    asks: VecDeque<ObjectName>,
    stale: u64,
    refused: u64,
}

/// The bounds of a [`Monitor`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct MonitorLimits {
    /// How many rows the table may have. A row takes some hundred bytes.
    pub rows: usize,
    /// The hand-over to the detector.
    pub handover: HandoverLimits,
}

impl Default for MonitorLimits {
    fn default() -> Self {
        // Ten thousand components are measured; a robot has hundreds.
        let rows = 16 * 1024;
        // At start every object is enrolled at once, and some of them have more to tell.
        MonitorLimits {
            rows,
            handover: HandoverLimits { capacity: 4 * rows, ..Default::default() },
        }
    }
}

/// What a [`Monitor`] wants done.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum MonitorOutput {
    /// Ask this object whether it is alive, and bring the answer to [`Monitor::handle_alive`].
    Ask {
        /// Whom.
        object: ObjectName,
    },
    /// Hand this to the detector, and bring its confirmation to [`Monitor::handle_confirmed`].
    Observe {
        /// The number under which it is confirmed.
        number: u64,
        /// What was seen.
        observation: Observation,
    },
    /// The detector never confirmed this: tell a person.
    GivenUp {
        /// What was seen.
        observation: Observation,
        /// How often it was sent.
        tries: u32,
    },
}

/// Why an object is not watched.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum EnrolError {
    /// Dismiss what is no longer needed, or raise the limit.
    #[error("{object} is not watched: the monitor's table already has {limit} rows")]
    TableFull {
        /// Who was to be enrolled.
        object: ObjectName,
        /// How many rows there may be.
        limit: usize,
    },
    /// Give `Enrol::inquiries`, or watch the object in another way.
    #[error("{object} is to be asked for signs of life, but nothing says where it answers")]
    NowhereToAsk {
        /// Who was to be enrolled.
        object: ObjectName,
    },
}

#[derive(Clone, Debug)]
struct Entry {
    kind: ObjectKind,
    watch: Watch,
    incarnation: Incarnation,
    state: Option<Lifecycle>,
    last_sign: Option<Instant>,
    restarts: u32,
    suspicions: u32,
    /// A sign of life is overdue, or it stands behind somebody else's hang.
    suspect: bool,
    /// Silence was observed and not yet broken.
    silent: bool,
    /// What it has been doing for too long, and since when.
    current: Option<(&'static str, Instant)>,
    end: Option<Ending>,
    isolated: bool,
    note: Option<String>,
    neighbour: Option<NodeName>,
    link: Option<LinkCondition>,
    condition: Option<NodeCondition>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Ending {
    /// It reached `Finalized`; its guard has not yet said how it ended.
    Finalized,
    /// Its guard saw it end as it was told.
    Stopped,
    /// Its guard saw it die.
    Died,
}

impl Entry {
    fn new(kind: ObjectKind, incarnation: Incarnation) -> Self {
        Entry {
            kind,
            watch: Watch::Guard,
            incarnation,
            state: None,
            last_sign: None,
            restarts: 0,
            suspicions: 0,
            suspect: false,
            silent: false,
            current: None,
            end: None,
            isolated: false,
            note: None,
            neighbour: None,
            link: None,
            condition: None,
        }
    }

    /// Empties the history: what was known was known of another life. Isolation outlives a restart.
    fn begin(&mut self, incarnation: Incarnation) {
        let (kind, watch, isolated) = (self.kind, self.watch, self.isolated);
        let restarts = self.restarts.saturating_add(1);
        *self = Entry { watch, isolated, restarts, ..Entry::new(kind, incarnation) };
    }

    fn opinion(&self) -> Opinion {
        let down = matches!(self.link, Some(LinkCondition::Down { .. }))
            || matches!(self.condition, Some(NodeCondition::Lost { .. }));
        let suspect = self.suspect || matches!(self.link, Some(LinkCondition::Degraded { .. }));
        match self.end {
            Some(Ending::Died) => Opinion::Failed,
            Some(Ending::Stopped | Ending::Finalized) => Opinion::AtRest,
            None if self.silent || self.current.is_some() || down => Opinion::Failed,
            None if suspect => Opinion::Suspect,
            None if self.last_sign.is_none() => Opinion::Unheard,
            None => Opinion::Trusted,
        }
    }
}

impl Monitor {
    /// A monitor of `node` that begins at `now` with an empty table.
    pub fn new(node: NodeName, limits: MonitorLimits, now: Instant) -> Self {
        Monitor {
            node,
            limits,
            objects: BTreeMap::new(),
            others: BTreeMap::new(),
            watchdog: Watchdog::new(),
            inquiry: Inquiry::new(),
            handover: Handover::new(limits.handover, now.as_nanos()),
            asks: VecDeque::new(),
            stale: 0,
            refused: 0,
        }
    }

    /// Watches an object, or changes how it is watched.
    ///
    /// # Errors
    /// [`EnrolError::TableFull`]
    pub fn enrol(&mut self, enrolment: Enrolment, now: Instant) -> Result<(), EnrolError> {
        let Enrolment { object, kind, incarnation, watch, depends_on } = enrolment;
        if self.is_full() && !self.objects.contains_key(&object) {
            return Err(EnrolError::TableFull { object, limit: self.limits.rows });
        }
        let fresh = || Entry::new(kind, incarnation);
        let entry = self.objects.entry(object.clone()).or_insert_with(fresh);
        if entry.incarnation < incarnation {
            entry.begin(incarnation);
        }
        (entry.kind, entry.watch) = (kind, watch);
        let incarnation = entry.incarnation;
        match watch {
            Watch::Push(_) => self.inquiry.dismiss(&object),
            Watch::Pull(_) => self.watchdog.dismiss(&object),
            Watch::Guard => {
                self.watchdog.dismiss(&object);
                self.inquiry.dismiss(&object);
            }
        }
        self.observe_object(&object, incarnation, Finding::Enrolled { depends_on }, now);
        self.watch_over(&object, now);
        self.settle(now);
        Ok(())
    }

    /// Forgets an object.
    pub fn dismiss(&mut self, object: &ObjectName, now: Instant) {
        self.watchdog.dismiss(object);
        self.inquiry.dismiss(object);
        if let Some(entry) = self.objects.remove(object) {
            self.observe_object(object, entry.incarnation, Finding::Dismissed, now);
        }
        self.settle(now);
    }

    /// A sign of life that nobody asked for. The hottest input: in the steady state one search.
    pub fn handle_heartbeat(
        &mut self,
        source: &ObjectName,
        incarnation: Incarnation,
        now: Instant,
    ) {
        if self.watchdog.knows(source, incarnation) {
            self.watchdog.handle_heartbeat(source, incarnation, now);
        } else if self.objects.contains_key(source)
            && let Some(entry) = self.alive(source, incarnation, now)
        {
            entry.last_sign = Some(now);
            self.watchdog.handle_heartbeat(source, incarnation, now);
        }
        self.settle(now);
    }

    /// An object has answered.
    pub fn handle_alive(&mut self, object: &ObjectName, progress: Progress, now: Instant) {
        self.inquiry.handle_answer(object, progress, now);
        if self.objects.contains_key(object)
            && let Some(entry) = self.alive(object, progress.incarnation, now)
        {
            entry.last_sign = Some(now);
            // The guard tells every change; this only fills a gap, for objects without a guard.
            entry.state.get_or_insert(progress.state);
        }
        self.settle(now);
    }

    /// The question to this object will never be answered.
    pub fn handle_unanswered(&mut self, object: &ObjectName, now: Instant) {
        self.inquiry.handle_unanswered(object, now);
        self.settle(now);
    }

    /// A guard has seen a life end.
    pub fn handle_exited(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        exit: Exit,
        restarted_as: Option<Incarnation>,
        now: Instant,
    ) {
        // The orderly end of somebody unknown, such as the dismissed, is no news.
        if exit == Exit::Stopped && !self.objects.contains_key(object) {
            return;
        }
        let Some(entry) = self.admit(object, incarnation, now) else { return };
        if matches!(entry.end, Some(Ending::Stopped | Ending::Died)) {
            self.stale += 1;
            return;
        }
        let died = exit != Exit::Stopped;
        entry.end = Some(if died { Ending::Died } else { Ending::Stopped });
        entry.note = Some(describe(&exit));
        entry.suspect = false;
        self.watchdog.handle_end(object, incarnation);
        self.inquiry.handle_end(object, incarnation, now);
        self.observe_object(object, incarnation, Finding::Exited { exit, restarted_as }, now);
        if let Some(next) = restarted_as {
            self.admit(object, next, now);
        }
        self.settle(now);
    }

    /// A guard reports the state of a life.
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
        let Some(entry) = self.admit(object, incarnation, now) else { return };
        entry.state = Some(state);
        entry.last_sign = Some(now);
        if reason.is_some() {
            entry.note.clone_from(&reason);
        }
        if state == Lifecycle::Finalized {
            entry.end.get_or_insert(Ending::Finalized);
            self.watchdog.handle_end(object, incarnation);
            self.inquiry.handle_end(object, incarnation, now);
        }
        self.observe_object(object, incarnation, Finding::State { state, reason }, now);
        self.settle(now);
    }

    /// An object declares a fault of its own.
    pub fn handle_declared(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        kind: FaultKind,
        detail: String,
        now: Instant,
    ) {
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        entry.last_sign = Some(now);
        entry.note = Some(detail.clone());
        self.observe_object(object, incarnation, Finding::Declared { kind, detail }, now);
        self.settle(now);
    }

    /// The watch thread saw this object's handler keep its arbiter from turning.
    pub fn handle_hangs(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        during: &'static str,
        age: Duration,
        victims: Arc<[ObjectName]>,
        now: Instant,
    ) {
        for victim in victims.iter().filter(|&victim| victim != object) {
            if let Some(entry) = self.objects.get_mut(victim)
                && !entry.suspect
            {
                entry.suspect = true;
                entry.suspicions = entry.suspicions.saturating_add(1);
            }
        }
        let finding = Finding::Hangs { during, age, victims };
        self.handle_slow(object, incarnation, during, finding, now);
    }

    /// The watch thread saw this object's handler await something for too long.
    pub fn handle_waits(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        during: &'static str,
        age: Duration,
        now: Instant,
    ) {
        self.handle_slow(object, incarnation, during, Finding::Waits { during, age }, now);
    }

    /// The watch thread saw these move again.
    pub fn handle_resumed(&mut self, objects: &[ObjectName], now: Instant) {
        for object in objects {
            let Some(entry) = self.objects.get_mut(object) else { continue };
            entry.current = None;
            entry.suspect = false;
            entry.last_sign = Some(now);
            let incarnation = entry.incarnation;
            self.observe_object(object, incarnation, Finding::Resumed, now);
        }
        self.settle(now);
    }

    /// The watch thread gives up hope that these will move again behind `culprit`.
    pub fn handle_lost(&mut self, culprit: &ObjectName, victims: &[ObjectName], now: Instant) {
        for victim in victims.iter().filter(|&victim| victim != culprit) {
            let Some(entry) = self.objects.get_mut(victim) else { continue };
            entry.current = Some(("nothing: another object hangs", now));
            let incarnation = entry.incarnation;
            let culprit = culprit.clone();
            self.observe_object(victim, incarnation, Finding::Lost { culprit }, now);
        }
        self.settle(now);
    }

    /// Somebody who measures it elsewhere found this object silent for `age`.
    pub fn handle_silent(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        age: Duration,
        now: Instant,
    ) {
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        if !std::mem::replace(&mut entry.silent, true) {
            self.observe_object(object, incarnation, Finding::Silent { age }, now);
        }
        self.settle(now);
    }

    /// Somebody who measures it elsewhere heard this object.
    pub fn handle_spoke(&mut self, object: &ObjectName, incarnation: Incarnation, now: Instant) {
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        entry.last_sign = Some(now);
        entry.suspect = false;
        if std::mem::replace(&mut entry.silent, false) {
            self.observe_object(object, incarnation, Finding::Spoke, now);
        }
        self.settle(now);
    }

    /// The watch, or the whole process, was not scheduled for `gap`: every silence up to now is void.
    pub fn handle_stall(&mut self, gap: Duration, now: Instant) {
        self.watchdog.handle_stall(gap, now);
        self.inquiry.handle_stall(gap, now);
        self.settle(now);
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
        let seat = Place::Link { node: node.clone(), link: link.clone(), neighbour: None };
        let Some(entry) = self.admit_other(seat, ObjectKind::Link) else { return };
        entry.neighbour = neighbour.or(entry.neighbour.take());
        entry.note = match &condition {
            LinkCondition::Up => None,
            LinkCondition::Degraded { reason } | LinkCondition::Down { reason } => {
                Some(reason.clone())
            }
        };
        if !matches!(condition, LinkCondition::Down { .. }) {
            entry.last_sign = Some(now);
        }
        let known = entry.link.as_ref().map(discriminant) == Some(discriminant(&condition));
        entry.link = Some(condition.clone());
        if !known {
            let place = Place::Link { node, link, neighbour: entry.neighbour.clone() };
            let incarnation = entry.incarnation;
            self.observe(place, incarnation, Finding::Link(condition), now);
        }
        self.settle(now);
    }

    /// The router reports how a node is. The same condition again is no news; a newer incarnation is.
    pub fn handle_node(
        &mut self,
        node: NodeName,
        incarnation: Incarnation,
        condition: NodeCondition,
        now: Instant,
    ) {
        let place = Place::Node(node);
        let Some(entry) = self.admit_other(place.clone(), ObjectKind::Node) else { return };
        if incarnation < entry.incarnation {
            self.stale += 1;
            return;
        }
        let known_life = entry.incarnation != Incarnation::default();
        let restarted = known_life && incarnation > entry.incarnation;
        if restarted {
            entry.begin(incarnation);
        }
        entry.incarnation = incarnation;
        let condition = match condition {
            NodeCondition::Reachable if restarted => NodeCondition::Restarted,
            // The first that is heard of a node is no restart, whatever it is called.
            NodeCondition::Restarted if !restarted => NodeCondition::Reachable,
            other => other,
        };
        let lost = match &condition {
            NodeCondition::Lost { reason } => Some(reason.clone()),
            _ => None,
        };
        if lost.is_none() {
            entry.last_sign = Some(now);
        }
        entry.note = lost;
        let known = entry.condition.as_ref().map(discriminant) == Some(discriminant(&condition));
        entry.condition = Some(match condition {
            NodeCondition::Restarted => NodeCondition::Reachable,
            ref other => other.clone(),
        });
        if !known {
            self.observe(place, incarnation, Finding::Node(condition), now);
        }
        self.settle(now);
    }

    /// An object's sending and receiving was forbidden, or allowed again.
    pub fn handle_isolation(&mut self, object: &ObjectName, isolated: bool) {
        if let Some(entry) = self.objects.get_mut(object) {
            entry.isolated = isolated;
        }
    }

    /// The detector has confirmed an observation.
    pub fn handle_confirmed(&mut self, number: u64, now: Instant) {
        self.handover.handle_confirmed(number, now);
    }

    /// An observation is known not to have reached the detector.
    pub fn handle_failed(&mut self, number: u64, now: Instant) {
        self.handover.handle_failed(number, now);
    }

    /// The whole table: objects by name, then links, then nodes.
    pub fn read_table(&self, now: Instant) -> Vec<Row> {
        let objects = self.objects.iter().map(|(object, entry)| {
            let address = ObjectAddress::new(self.node.clone(), object.clone());
            let last_sign = entry.last_sign.max(self.watchdog.last_sign(object));
            let queue = self.inquiry.last_answer(object).map(|(then, progress)| QueueSeen {
                queued: progress.queued,
                oldest: progress.oldest,
                age: now - then,
            });
            let row = row(Place::Object(address), entry, now);
            let opinion = match row.opinion {
                Opinion::Unheard if last_sign.is_some() => Opinion::Trusted,
                other => other,
            };
            Row { last_sign: last_sign.map(|sign| now - sign), queue, opinion, ..row }
        });
        let others = self.others.iter().map(|(seat, entry)| {
            let place = match seat.clone() {
                Place::Link { node, link, .. } => {
                    Place::Link { node, link, neighbour: entry.neighbour.clone() }
                }
                place => place,
            };
            row(place, entry, now)
        });
        objects.chain(others).collect()
    }

    /// How often something came from a life that is over.
    pub fn stale(&self) -> u64 {
        self.stale
    }

    /// How many reports came from strangers for whom the table had no room.
    pub fn refused(&self) -> u64 {
        self.refused
    }

    /// A monitor that knows the same plain facts, for a body that was struck in the middle of an input.
    #[must_use]
    pub fn reborn(self, now: Instant) -> Self {
        let mut monitor = Monitor {
            watchdog: Watchdog::new(),
            inquiry: Inquiry::new(),
            handover: self.handover.reborn(now),
            asks: VecDeque::new(),
            ..self
        };
        let objects: Vec<ObjectName> = monitor.objects.keys().cloned().collect();
        for object in objects {
            monitor.watch_over(&object, now);
        }
        monitor
    }

    fn is_full(&self) -> bool {
        self.objects.len() + self.others.len() >= self.limits.rows
    }

    /// Sets the watchdog, or the inquiry, on an object of the table, as its entry says.
    fn watch_over(&mut self, object: &ObjectName, now: Instant) {
        let Some(entry) = self.objects.get(object) else { return };
        match entry.watch {
            Watch::Push(push) => self.watchdog.enrol(object, push, entry.incarnation, now),
            Watch::Pull(pull) => self.inquiry.enrol(object, pull, entry.incarnation, now),
            Watch::Guard => {}
        }
        if entry.end.is_some() {
            self.watchdog.handle_end(object, entry.incarnation);
            self.inquiry.handle_end(object, entry.incarnation, now);
        }
    }

    /// The entry of an object for news of this life; none if that life is over.
    fn admit(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        now: Instant,
    ) -> Option<&mut Entry> {
        if !self.objects.contains_key(object) {
            if self.is_full() {
                self.refused += 1;
                return None;
            }
            self.objects.insert(object.clone(), Entry::new(ObjectKind::Component, incarnation));
        }
        let entry = self.objects.get_mut(object).expect("it was just put in");
        if incarnation < entry.incarnation {
            self.stale += 1;
            return None;
        }
        if incarnation > entry.incarnation {
            entry.begin(incarnation);
            self.watchdog.handle_start(object, incarnation, now);
            self.inquiry.handle_start(object, incarnation, now);
        }
        Some(entry)
    }

    /// Like [`admit`](Self::admit), for what only the living can say.
    fn alive(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        now: Instant,
    ) -> Option<&mut Entry> {
        let ended = |entry: &Entry| entry.incarnation == incarnation && entry.end.is_some();
        if self.objects.get(object).is_some_and(ended) {
            self.stale += 1;
            return None;
        }
        self.admit(object, incarnation, now)
    }

    fn admit_other(&mut self, seat: Place, kind: ObjectKind) -> Option<&mut Entry> {
        if self.is_full() && !self.others.contains_key(&seat) {
            self.refused += 1;
            return None;
        }
        let fresh = || Entry::new(kind, Incarnation::default());
        Some(self.others.entry(seat).or_insert_with(fresh))
    }

    /// A handler that takes too long. It is news once for each handler.
    fn handle_slow(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        during: &'static str,
        finding: Finding,
        now: Instant,
    ) {
        let (Finding::Hangs { age, .. } | Finding::Waits { age, .. }) = finding else { return };
        let Some(entry) = self.alive(object, incarnation, now) else { return };
        let since = Instant::ORIGIN + (now - (Instant::ORIGIN + age));
        let known = entry.current.is_some_and(|(known, _)| known == during);
        if !known {
            entry.current = Some((during, since));
            self.observe_object(object, incarnation, finding, now);
        }
        self.settle(now);
    }

    fn observe_object(
        &mut self,
        object: &ObjectName,
        incarnation: Incarnation,
        finding: Finding,
        now: Instant,
    ) {
        let address = ObjectAddress::new(self.node.clone(), object.clone());
        self.observe(Place::Object(address), incarnation, finding, now);
    }

    fn observe(&mut self, place: Place, incarnation: Incarnation, finding: Finding, now: Instant) {
        // One rank for all: the detector is told things in the order in which they happened.
        self.handover.hand(0, Observation { place, incarnation, finding, seen_at: now }, now);
    }

    /// Acts on what the watchdog and the inquiry have found.
    fn settle(&mut self, now: Instant) {
        while let Some(verdict) = self.watchdog.poll_output() {
            self.handle_verdict(verdict, now);
        }
        while let Some(output) = self.inquiry.poll_output() {
            match output {
                InquiryOutput::Ask { object } => self.asks.push_back(object),
                InquiryOutput::Verdict(verdict) => self.handle_verdict(verdict, now),
                InquiryOutput::Stuck { object, progress } => {
                    let Progress { incarnation, oldest, queued, .. } = progress;
                    let finding = Finding::Stuck { oldest, queued };
                    self.observe_object(&object, incarnation, finding, now);
                }
                InquiryOutput::Overloaded { object, progress } => {
                    let Progress { incarnation, oldest, queued, .. } = progress;
                    let finding = Finding::Overloaded { oldest, queued };
                    self.observe_object(&object, incarnation, finding, now);
                }
                InquiryOutput::Flows { object } => {
                    if let Some(entry) = self.objects.get(&object) {
                        let incarnation = entry.incarnation;
                        self.observe_object(&object, incarnation, Finding::Flows, now);
                    }
                }
            }
        }
    }

    fn handle_verdict(&mut self, verdict: Verdict, now: Instant) {
        let Verdict { object, incarnation, opinion, silence } = verdict;
        let Some(entry) = self.objects.get_mut(&object) else { return };
        if entry.incarnation != incarnation {
            return;
        }
        match opinion {
            Opinion::Suspect => {
                entry.suspect = true;
                entry.suspicions = entry.suspicions.saturating_add(1);
            }
            Opinion::Failed => {
                if !std::mem::replace(&mut entry.silent, true) {
                    let finding = Finding::Silent { age: silence };
                    self.observe_object(&object, incarnation, finding, now);
                }
            }
            Opinion::Trusted => {
                entry.suspect = false;
                entry.last_sign = Some(now);
                if std::mem::replace(&mut entry.silent, false) {
                    self.observe_object(&object, incarnation, Finding::Spoke, now);
                }
            }
            Opinion::Unheard | Opinion::AtRest => {}
        }
    }
}

/// A row, but for what only the watchdog and the inquiry know.
fn row(place: Place, entry: &Entry, now: Instant) -> Row {
    Row {
        place,
        kind: entry.kind,
        incarnation: entry.incarnation,
        state: entry.state,
        opinion: entry.opinion(),
        last_sign: entry.last_sign.map(|sign| now - sign),
        restarts: entry.restarts,
        suspicions: entry.suspicions,
        queue: None,
        current: entry.current.map(|(during, since)| Current { during, age: now - since }),
        isolated: entry.isolated,
        note: entry.note.clone(),
    }
}

fn describe(exit: &Exit) -> String {
    match exit {
        Exit::Returned => "it ended itself".into(),
        Exit::Panicked { text, at, during } => format!("panicked in {during} at {at}: {text}"),
        Exit::Aborted => "its arbiter went away".into(),
        Exit::Stopped => "it was told to stop".into(),
    }
}

impl Machine for Monitor {
    type Output = MonitorOutput;

    fn poll_output(&mut self) -> Option<MonitorOutput> {
        if let Some(object) = self.asks.pop_front() {
            return Some(MonitorOutput::Ask { object });
        }
        self.handover.poll_output().map(|handed| match handed {
            Handed::Deliver { number, item } => {
                MonitorOutput::Observe { number, observation: item }
            }
            Handed::GivenUp { item, tries } => MonitorOutput::GivenUp { observation: item, tries },
        })
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let parts = [
            self.watchdog.poll_timeout(),
            self.inquiry.poll_timeout(),
            self.handover.poll_timeout(),
        ];
        parts.into_iter().flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.watchdog.handle_timeout(now);
        self.inquiry.handle_timeout(now);
        self.handover.handle_timeout(now);
        self.settle(now);
    }
}
