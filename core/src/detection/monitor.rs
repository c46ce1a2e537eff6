//! Who lives, in which life and state: the table, and what is new in it.

use super::entry::{Ending, Entry, describe};
use super::inquiry::InquiryOutput;
use super::neighbourhood::{Neighbourhood, News};
use super::{
    EnrolError, Enrolment, Exit, Finding, Handed, Handover, HandoverLimits, Inquiry, LinkCondition,
    NodeCondition, ObjectKind, Observation, Opinion, Progress, QueueSeen, Row, Verdict, Watch,
    Watchdog,
};
use crate::{
    FaultKind, Incarnation, Instant, Lifecycle, Machine, NodeName, ObjectAddress, ObjectName, Place,
};
use std::collections::{BTreeMap, VecDeque};
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
    around: Neighbourhood,
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

impl Monitor {
    /// A monitor of `node` that begins at `now` with an empty table.
    pub fn new(node: NodeName, limits: MonitorLimits, now: Instant) -> Self {
        Monitor {
            node,
            limits,
            objects: BTreeMap::new(),
            around: Neighbourhood::default(),
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
            // A guard tells every change, and may have told a later one: answers only stand in for
            // guards where there are none.
            let state = progress.state;
            if !entry.guarded && entry.state.replace(state) != Some(state) {
                let finding = Finding::State { state, reason: None };
                self.observe_object(object, progress.incarnation, finding, now);
            }
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
        entry.state = Some(if died { Lifecycle::Fatal } else { Lifecycle::Finalized });
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
        entry.guarded = true;
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
        if self.is_full() && !self.around.knows_link(&node, &link) {
            self.refused += 1;
            return;
        }
        let news = self.around.handle_link(node, link, neighbour, condition, now);
        if let Some(News { place, incarnation, finding }) = news {
            self.observe(place, incarnation, finding, now);
        }
    }

    /// The router reports how a node is. The same condition again is no news; a newer incarnation is.
    pub fn handle_node(
        &mut self,
        node: NodeName,
        incarnation: Incarnation,
        condition: NodeCondition,
        now: Instant,
    ) {
        if self.is_full() && !self.around.knows_node(&node) {
            self.refused += 1;
            return;
        }
        match self.around.handle_node(node, incarnation, condition, now) {
            Ok(Some(News { place, incarnation, finding })) => {
                self.observe(place, incarnation, finding, now);
            }
            Ok(None) => {}
            Err(_) => self.stale += 1,
        }
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
            let row = entry.row(Place::Object(address), now);
            let opinion = match row.opinion {
                Opinion::Unheard if last_sign.is_some() => Opinion::Trusted,
                other => other,
            };
            Row { last_sign: last_sign.map(|sign| now - sign), queue, opinion, ..row }
        });
        objects.chain(self.around.rows(now)).collect()
    }

    /// How often something came from a life that is over.
    pub fn stale(&self) -> u64 {
        self.stale
    }

    /// How often the monitor itself was found to have stood still.
    pub fn stalls(&self) -> u64 {
        self.watchdog.stalls()
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
        self.objects.len() + self.around.len() >= self.limits.rows
    }

    /// Sets the watchdog, or the inquiry, on an object of the table, as its entry says.
    fn watch_over(&mut self, object: &ObjectName, now: Instant) {
        let Some(entry) = self.objects.get(object) else { return };
        match entry.watch {
            Watch::Push(push) => self.watchdog.enrol(object, push, entry.incarnation, now),
            Watch::Pull(pull) => self.inquiry.enrol(object, pull, entry.incarnation, now),
            Watch::Guard => {}
        }
        // Whoever has not begun yet may have to wait for others that are started before it.
        if entry.end.is_some() || entry.incarnation == Incarnation::default() {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::detection::Current;
    use proptest::prelude::*;

    const ONE: Incarnation = Incarnation(1);
    const TWO: Incarnation = Incarnation(2);
    const THREE: Incarnation = Incarnation(3);
    const TENTH: Duration = Duration::from_millis(100);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn object(name: &str) -> ObjectName {
        ObjectName::new(name).expect("a name")
    }

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a name")
    }

    fn monitor() -> Monitor {
        Monitor::new(node("m"), MonitorLimits::default(), at(0))
    }

    fn watched(watch: Watch) -> Monitor {
        let mut monitor = monitor();
        let enrolment = Enrolment::new(object("laser")).watch(watch).incarnation(TWO);
        monitor.enrol(enrolment, at(0)).expect("there is room");
        seen(&mut monitor, 0);
        monitor
    }

    /// The name of the finding's variant.
    fn name(finding: &Finding) -> String {
        let text = format!("{finding:?}");
        text.split([' ', '(', '{']).next().unwrap_or_default().into()
    }

    /// Everything that is now to be observed, confirmed at once; asks read "ask".
    fn seen(monitor: &mut Monitor, millis: u64) -> Vec<String> {
        let mut seen = Vec::new();
        while let Some(output) = monitor.poll_output() {
            match output {
                MonitorOutput::Observe { number, observation } => {
                    seen.push(format!("{} {}", observation.place, name(&observation.finding)));
                    monitor.handle_confirmed(number, at(millis));
                }
                MonitorOutput::Ask { object } => seen.push(format!("ask {object}")),
                MonitorOutput::GivenUp { .. } => seen.push("given up".into()),
            }
        }
        seen
    }

    /// Wakes the machine exactly when it wants, up to `until`.
    fn run(monitor: &mut Monitor, until: u64) -> Vec<(u64, String)> {
        let mut told = Vec::new();
        loop {
            let now = monitor.poll_timeout().unwrap_or(at(until)).min(at(until));
            monitor.handle_timeout(now);
            let millis = now.as_nanos() / 1_000_000;
            told.extend(seen(monitor, millis).into_iter().map(|text| (millis, text)));
            if now == at(until) {
                return told;
            }
        }
    }

    fn row(monitor: &Monitor, name: &str, now: u64) -> Row {
        let is_it = |row: &Row| row.place.to_string() == name;
        monitor.read_table(at(now)).into_iter().find(is_it).expect("it has a row")
    }

    fn panicked() -> Exit {
        Exit::Panicked { text: "boom".into(), at: "laser.rs:1".into(), during: "Scan" }
    }

    #[test]
    fn nothing_is_expected_of_an_object_before_its_first_life_is_reported() {
        let pull = Watch::pull(Duration::from_millis(100), Duration::from_millis(100));
        for watch in [pull, Watch::push(Duration::from_millis(100), 3)] {
            let mut monitor = Monitor::new("m".parse().unwrap(), MonitorLimits::default(), at(0));
            let laser = object("laser");
            let enrolment = Enrolment::new(laser.clone()).incarnation(Incarnation::default());
            monitor.enrol(enrolment.watch(watch), at(0)).unwrap();
            while monitor.poll_output().is_some() {}

            monitor.handle_timeout(at(60_000));
            monitor.handle_state(&laser, ONE, Lifecycle::Created, None, at(60_000));

            let row = row(&monitor, "m:laser", 60_000);
            assert_eq!((row.incarnation, row.restarts, row.suspicions), (ONE, 0, 0), "{watch:?}");
            assert!(monitor.poll_timeout().is_some(), "from now on it is watched");
        }
    }

    #[test]
    fn silence_is_observed_once_and_so_is_its_end() {
        let mut monitor = watched(Watch::push(TENTH, 3));
        monitor.handle_heartbeat(&object("laser"), TWO, at(10));

        assert_eq!(run(&mut monitor, 3000), [(360, "m:laser Silent".to_string())]);
        assert_eq!(row(&monitor, "m:laser", 3000).opinion, Opinion::Failed);

        monitor.handle_heartbeat(&object("laser"), TWO, at(3000));
        assert_eq!(seen(&mut monitor, 3000), ["m:laser Spoke"]);
        assert_eq!(row(&monitor, "m:laser", 3001).opinion, Opinion::Trusted);
    }

    #[test]
    fn a_suspicion_is_counted_and_shown_and_nobody_else_is_told() {
        let mut monitor = watched(Watch::push(TENTH, 3));
        for beat in [0, 200, 400] {
            assert_eq!(run(&mut monitor, beat), []);
            monitor.handle_heartbeat(&object("laser"), TWO, at(beat));
        }
        run(&mut monitor, 560);

        let row = row(&monitor, "m:laser", 560);
        assert_eq!((row.opinion, row.suspicions), (Opinion::Suspect, 3));
        assert_eq!(row.last_sign, Some(Duration::from_millis(160)));
    }

    #[test]
    fn an_object_that_is_asked_shows_its_queue_with_the_age_of_the_answer() {
        let mut monitor = watched(Watch::pull(TENTH, TENTH));
        assert_eq!(run(&mut monitor, 0), [(0, "ask laser".to_string())]);

        let oldest = Duration::from_millis(7);
        let state = Lifecycle::Active;
        let answer = Progress { incarnation: TWO, state, queued: 3, oldest, long_operation: false };
        monitor.handle_alive(&object("laser"), answer, at(20));

        let row = row(&monitor, "m:laser", 50);
        let queue = QueueSeen { queued: 3, oldest, age: Duration::from_millis(30) };
        assert_eq!((row.queue, row.opinion), (Some(queue), Opinion::Trusted));
        assert_eq!(row.state, Some(Lifecycle::Active));
    }

    #[test]
    fn answers_tell_the_state_of_an_object_only_while_no_guard_does() {
        let mut monitor = watched(Watch::pull(TENTH, TENTH));
        let oldest = Duration::ZERO;
        let mut answer = |state, now| {
            let answer =
                Progress { incarnation: TWO, state, queued: 0, oldest, long_operation: false };
            monitor.handle_alive(&object("laser"), answer, at(now));
            seen(&mut monitor, now)
        };
        assert_eq!(answer(Lifecycle::Active, 1), ["m:laser State"]);
        assert_eq!(answer(Lifecycle::Active, 2), [""; 0]);
        assert_eq!(answer(Lifecycle::Error, 3), ["m:laser State"]);

        monitor.handle_state(&object("laser"), TWO, Lifecycle::Active, None, at(4));
        seen(&mut monitor, 4);
        let (state, queued) = (Lifecycle::Error, 0);
        let late = Progress { incarnation: TWO, state, queued, oldest, long_operation: false };
        monitor.handle_alive(&object("laser"), late, at(5));

        assert_eq!(seen(&mut monitor, 5), [""; 0]);
        assert_eq!(row(&monitor, "m:laser", 5).state, Some(Lifecycle::Active));
    }

    #[test]
    fn whoever_is_asked_and_answers_nothing_is_silent_and_its_work_is_another_matter() {
        let mut monitor = watched(Watch::pull(TENTH, TENTH));
        let mut told = Vec::new();
        for turn in 0..=20 {
            told.extend(run(&mut monitor, turn * 100));
            let oldest = Duration::from_millis(turn * 100);
            let state = Lifecycle::Active;
            let answer =
                Progress { incarnation: TWO, state, queued: 3, oldest, long_operation: false };
            monitor.handle_alive(&object("laser"), answer, at(turn * 100));
            told.extend(run(&mut monitor, turn * 100));
        }
        told.extend(run(&mut monitor, 5000));
        told.retain(|(_, text)| !text.starts_with("ask"));

        let texts = ["m:laser State", "m:laser Stuck", "m:laser Silent"].map(String::from);
        assert_eq!(told.iter().map(|(_, text)| text.clone()).collect::<Vec<_>>(), texts);
    }

    #[test]
    fn what_is_not_confirmed_is_repeated_and_given_up_loudly() {
        let mut monitor = monitor();
        monitor.handle_exited(&object("laser"), ONE, panicked(), None, at(0));

        let (mut sent, mut given_up) = (0, 0);
        while let Some(due) = monitor.poll_timeout() {
            monitor.handle_timeout(due);
            while let Some(output) = monitor.poll_output() {
                match output {
                    MonitorOutput::Observe { .. } => sent += 1,
                    MonitorOutput::GivenUp { tries, .. } => given_up = tries,
                    MonitorOutput::Ask { .. } => panic!("nobody is asked"),
                }
            }
        }

        assert_eq!((sent, given_up), (8, 8));
    }

    /// In which state the second life of `laser` is when something comes.
    #[derive(Clone, Copy, Debug, PartialEq)]
    enum State {
        Going,
        Finalized,
        Stopped,
        Died,
    }

    const INPUTS: [&str; 9] =
        ["beat", "alive", "died", "stopped", "state", "declared", "waits", "silent", "resumed"];

    fn feed(monitor: &mut Monitor, input: &str, life: Incarnation, now: Instant) {
        let laser = object("laser");
        match input {
            "beat" => monitor.handle_heartbeat(&laser, life, now),
            "alive" => {
                let (state, oldest) = (Lifecycle::Active, Duration::ZERO);
                let answer =
                    Progress { incarnation: life, state, queued: 0, oldest, long_operation: false };
                monitor.handle_alive(&laser, answer, now);
            }
            "died" => monitor.handle_exited(&laser, life, panicked(), None, now),
            "stopped" => monitor.handle_exited(&laser, life, Exit::Stopped, None, now),
            "state" => monitor.handle_state(&laser, life, Lifecycle::Active, None, now),
            "declared" => {
                monitor.handle_declared(&laser, life, FaultKind::CheckFailed, "1".into(), now);
            }
            "waits" => monitor.handle_waits(&laser, life, "Scan", TENTH, now),
            "silent" => monitor.handle_silent(&laser, life, TENTH, now),
            "resumed" => monitor.handle_resumed(&[laser], now),
            other => panic!("no input is called {other}"),
        }
    }

    fn in_state(state: State) -> Monitor {
        let mut monitor = watched(Watch::Guard);
        let laser = object("laser");
        match state {
            State::Going => {}
            State::Finalized => {
                monitor.handle_state(&laser, TWO, Lifecycle::Finalized, None, at(0));
            }
            State::Stopped => monitor.handle_exited(&laser, TWO, Exit::Stopped, None, at(0)),
            State::Died => monitor.handle_exited(&laser, TWO, panicked(), None, at(0)),
        }
        seen(&mut monitor, 0);
        monitor
    }

    #[test]
    fn every_input_in_every_state_says_what_it_should() {
        let states = [State::Going, State::Finalized, State::Stopped, State::Died];
        for state in states {
            for input in INPUTS {
                let mut monitor = in_state(state);

                feed(&mut monitor, input, TWO, at(5));

                let told = seen(&mut monitor, 5);
                let over = state != State::Going;
                let expected = match input {
                    "died" | "stopped" if matches!(state, State::Going | State::Finalized) => {
                        Some("Exited")
                    }
                    "state" => Some("State"),
                    "alive" if !over => Some("State"),
                    "resumed" => Some("Resumed"),
                    "declared" if !over => Some("Declared"),
                    "waits" if !over => Some("Waits"),
                    "silent" if !over => Some("Silent"),
                    _ => None,
                };
                let expected: Vec<String> =
                    expected.iter().map(|text| format!("m:laser {text}")).collect();
                assert_eq!(told, expected, "{input} while {state:?}");
            }
        }
    }

    #[test]
    fn nothing_that_an_older_life_still_says_changes_anything() {
        for state in [State::Going, State::Finalized, State::Stopped, State::Died] {
            // Who has resumed is told by the watch, which knows no lives.
            for input in INPUTS.into_iter().filter(|&input| input != "resumed") {
                let mut monitor = in_state(state);
                let before = monitor.read_table(at(5));

                feed(&mut monitor, input, ONE, at(5));

                assert_eq!(seen(&mut monitor, 5), [""; 0], "{input} while {state:?}");
                assert_eq!(monitor.read_table(at(5)), before, "{input} while {state:?}");
                assert_eq!(monitor.stale(), 1, "{input} while {state:?}");
            }
        }
    }

    #[test]
    fn whatever_a_newer_life_says_begins_a_new_history() {
        for state in [State::Going, State::Finalized, State::Stopped, State::Died] {
            for input in INPUTS.into_iter().filter(|&input| input != "resumed") {
                let mut monitor = in_state(state);

                feed(&mut monitor, input, THREE, at(5));

                let row = row(&monitor, "m:laser", 5);
                assert_eq!((row.incarnation, row.restarts), (THREE, 1), "{input} while {state:?}");
            }
        }
    }

    #[test]
    fn a_death_that_the_guard_has_mended_leaves_the_next_life_in_the_table() {
        let mut monitor = watched(Watch::push(TENTH, 3));
        monitor.handle_heartbeat(&object("laser"), TWO, at(0));
        run(&mut monitor, 200);

        monitor.handle_exited(&object("laser"), TWO, panicked(), Some(THREE), at(210));

        assert_eq!(seen(&mut monitor, 210), ["m:laser Exited"]);
        let row = row(&monitor, "m:laser", 220);
        assert_eq!((row.incarnation, row.restarts, row.suspicions), (THREE, 1, 0));
        assert_eq!((row.opinion, row.last_sign, row.state), (Opinion::Unheard, None, None));
        let told = run(&mut monitor, 9000);
        assert_eq!(told, [(5210, "m:laser Silent".to_string())]);
    }

    #[test]
    fn a_life_that_is_over_is_not_shown_in_the_state_that_it_had_before() {
        for (exit, state, opinion) in [
            (panicked(), Lifecycle::Fatal, Opinion::Failed),
            (Exit::Aborted, Lifecycle::Fatal, Opinion::Failed),
            (Exit::Stopped, Lifecycle::Finalized, Opinion::AtRest),
        ] {
            let mut monitor = watched(Watch::Guard);
            monitor.handle_state(&object("laser"), TWO, Lifecycle::Active, None, at(0));

            monitor.handle_exited(&object("laser"), TWO, exit, None, at(1));

            let row = row(&monitor, "m:laser", 1);
            assert_eq!((row.state, row.opinion), (Some(state), opinion));
        }
    }

    #[test]
    fn a_hang_makes_its_victims_suspect_and_is_observed_once() {
        let mut monitor = watched(Watch::Guard);
        monitor.enrol(Enrolment::new(object("map")), at(0)).expect("there is room");
        seen(&mut monitor, 0);
        let victims: Arc<[ObjectName]> = [object("laser"), object("map"), object("ghost")].into();

        for now in [500, 600] {
            let (laser, age) = (object("laser"), Duration::from_millis(now));
            monitor.handle_hangs(&laser, TWO, "Scan", age, victims.clone(), at(now));
        }
        assert_eq!(seen(&mut monitor, 600), ["m:laser Hangs"]);
        let current = Current { during: "Scan", age: Duration::from_millis(600) };
        assert_eq!(row(&monitor, "m:laser", 600).current, Some(current));
        assert_eq!(row(&monitor, "m:laser", 600).opinion, Opinion::Failed);
        assert_eq!(row(&monitor, "m:map", 600).opinion, Opinion::Suspect);

        monitor.handle_lost(&object("laser"), &victims, at(700));
        assert_eq!(seen(&mut monitor, 700), ["m:map Lost"]);
        assert_eq!(row(&monitor, "m:map", 700).opinion, Opinion::Failed);

        monitor.handle_resumed(&victims, at(800));
        assert_eq!(seen(&mut monitor, 800), ["m:laser Resumed", "m:map Resumed"]);
        assert_eq!(row(&monitor, "m:map", 800).opinion, Opinion::Trusted);
    }

    #[test]
    fn a_stranger_that_dies_is_not_lost_and_one_that_was_stopped_is_no_news() {
        let mut monitor = monitor();

        monitor.handle_exited(&object("a"), ONE, panicked(), None, at(0));
        monitor.handle_exited(&object("b"), ONE, Exit::Stopped, None, at(0));
        monitor.handle_state(&object("c"), ONE, Lifecycle::Finalized, None, at(0));
        monitor.handle_heartbeat(&object("d"), ONE, at(0));

        assert_eq!(seen(&mut monitor, 0), ["m:a Exited"]);
        assert_eq!(monitor.read_table(at(0)).len(), 1);
    }

    #[test]
    fn a_full_table_refuses_and_counts() {
        let limits = MonitorLimits { rows: 1, ..MonitorLimits::default() };
        let mut monitor = Monitor::new(node("m"), limits, at(0));
        monitor.enrol(Enrolment::new(object("a")), at(0)).expect("there is room");

        let refused = monitor.enrol(Enrolment::new(object("b")), at(0));
        monitor.handle_exited(&object("c"), ONE, panicked(), None, at(0));
        monitor.handle_link(node("m"), "eth".into(), None, LinkCondition::Up, at(0));
        monitor.handle_node(node("n"), ONE, NodeCondition::Reachable, at(0));

        let text = refused.unwrap_err().to_string();
        assert_eq!(text, "b is not watched: the monitor's table already has 1 rows");
        assert_eq!((monitor.refused(), monitor.read_table(at(0)).len()), (3, 1));
        monitor.enrol(Enrolment::new(object("a")), at(0)).expect("it has its row already");
    }

    #[test]
    fn whoever_is_dismissed_is_forgotten() {
        let mut monitor = watched(Watch::push(TENTH, 3));

        monitor.dismiss(&object("laser"), at(10));
        monitor.dismiss(&object("laser"), at(10));
        monitor.handle_heartbeat(&object("laser"), TWO, at(20));

        assert_eq!(seen(&mut monitor, 20), ["m:laser Dismissed"]);
        assert_eq!(run(&mut monitor, 9000), []);
        assert_eq!(monitor.read_table(at(20)), []);
    }

    #[test]
    fn isolation_is_shown_and_outlives_a_restart() {
        let mut monitor = watched(Watch::Guard);

        monitor.handle_isolation(&object("laser"), true);
        monitor.handle_state(&object("laser"), THREE, Lifecycle::Created, None, at(0));

        assert!(row(&monitor, "m:laser", 0).isolated);
    }

    #[test]
    fn a_stall_of_the_monitor_itself_condemns_nobody() {
        let mut monitor = watched(Watch::push(TENTH, 3));
        monitor.handle_heartbeat(&object("laser"), TWO, at(0));

        monitor.handle_stall(Duration::from_secs(60), at(60_000));
        monitor.handle_timeout(at(60_000));
        monitor.handle_heartbeat(&object("laser"), TWO, at(60_010));

        assert_eq!(run(&mut monitor, 60_300), []);
    }

    #[test]
    fn a_monitor_that_was_struck_keeps_its_table_and_sends_again_what_was_not_confirmed() {
        let mut monitor = watched(Watch::pull(TENTH, TENTH));
        run(&mut monitor, 0);
        monitor.handle_exited(&object("map"), ONE, panicked(), None, at(10));
        assert!(matches!(monitor.poll_output(), Some(MonitorOutput::Observe { .. })));

        let mut monitor = monitor.reborn(at(20));

        assert_eq!(monitor.read_table(at(20)).len(), 2);
        monitor.handle_timeout(at(20));
        assert_eq!(seen(&mut monitor, 20), ["ask laser", "m:map Exited"]);
    }

    proptest! {
        /// Whatever else happens, in whatever order: an object whose beats come in time is never taken
        /// for silent.
        #[test]
        fn nobody_is_silent_while_its_beats_come_in_time(
            inputs in prop::collection::vec((0..INPUTS.len(), 1..4u64, 0..350u64), 0..100)
        ) {
            let mut monitor = watched(Watch::push(TENTH, 3));
            let mut now = at(0);
            for (input, life, wait) in inputs {
                // An outsider's word that it is silent is believed; it is not what is tested here.
                if INPUTS[input] != "silent" {
                    feed(&mut monitor, INPUTS[input], Incarnation(life), now);
                }
                let life = row(&monitor, "m:laser", 0).incarnation;
                monitor.handle_heartbeat(&object("laser"), life, now);
                now = now + Duration::from_millis(wait.min(349));
                for told in run(&mut monitor, now.as_nanos() / 1_000_000) {
                    prop_assert_ne!(&told.1, "m:laser Silent");
                }
            }
        }
    }
}
