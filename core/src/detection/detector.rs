//! What is wrong, where, and why: the judge of the fault chain.

use super::reminders::{Reminder, Reminders};
use super::symptoms::{Dependencies, is_down};
use super::{
    Chronicle, End, Exit, Finding, Handed, Handover, HandoverLimits, LinkCondition, NodeCondition,
    Notice, Observation, Outcome, Record, Turn,
};
use crate::{
    Fault, FaultId, FaultKind, Incarnation, Instant, Lifecycle, Machine, NodeName, ObjectName,
    Place,
};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Follows the life of every object, compares what is seen with the list of faults, and keeps the
/// record.
///
/// * **Lifecycle.** A machine per object takes the ways of [`Lifecycle::TRANSITIONS`]. A way that does
///   not exist is a fault of its own; the report is believed all the same.
/// * **One fault, one report.** A fault is latched by place and kind; seen again, it is counted. A new
///   life that becomes active ends the faults of the lives before it.
/// * **Roots and symptoms.** What an object suffers while something it depends on is down, or behind a
///   hang of another, is a symptom, also if its root is found only shortly afterwards.
/// * **Nothing is forgotten.** A fault on which no recoverer decides is handed over again, and in the end
///   given up loudly.
///
/// Where the guard has already restarted a component, the fault is found and recovered in one: it is
/// recorded and told, and handed to nobody.
#[derive(Clone, Debug)]
pub struct Detector {
    limits: DetectorLimits,
    objects: BTreeMap<ObjectName, Seen>,
    needs: Dependencies,
    /// Who stands still behind which hang.
    behind: BTreeMap<ObjectName, FaultId>,
    chronicle: Chronicle,
    /// Faults that may turn out to be symptoms.
    explicable: BTreeSet<FaultId>,
    /// Faults that the notifier knows of, and does not know to be over.
    handed: BTreeSet<FaultId>,
    reminders: Reminders,
    handover: Handover<Notice>,
    told: VecDeque<DetectorOutput>,
    last_number: u64,
    last_id: u64,
    stale: u64,
}

/// The bounds of a [`Detector`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DetectorLimits {
    /// How many faults the record holds. More remembers longer; an entry takes some hundred bytes.
    pub record: usize,
    /// How long after a symptom its root may be found. Longer explains more, and wrongly at times.
    pub hindsight: Duration,
    /// How long a recoverer may take to decide before it is reminded. Longer leaves a fault that was
    /// lost on the way lying; shorter repeats more to a busy recoverer.
    pub decision: Duration,
    /// How often a recoverer is reminded before the fault is given up.
    pub reminders: u32,
    /// The hand-over to the notifier.
    pub handover: HandoverLimits,
}

impl Default for DetectorLimits {
    fn default() -> Self {
        DetectorLimits {
            // A day with a fault every minute and a half.
            record: 1024,
            // The slowest built-in watch (a link's, over wireless) finds its fault within two seconds.
            hindsight: Duration::from_secs(2),
            // A recoverer decides in microseconds; a second is an outage of the recoverer itself.
            decision: Duration::from_secs(1),
            reminders: 3,
            handover: HandoverLimits::default(),
        }
    }
}

/// What a [`Detector`] wants done.
#[derive(Clone, Debug, PartialEq)]
pub enum DetectorOutput {
    /// Hand this to the notifier, and bring its confirmation to [`Detector::handle_confirmed`].
    HandOver {
        /// The number under which it is confirmed.
        number: u64,
        /// What the notifier must know.
        notice: Notice,
    },
    /// The notifier never confirmed this: tell a person.
    GivenUp {
        /// What it should have known.
        notice: Notice,
        /// How often it was sent.
        tries: u32,
    },
    /// Tell everybody who has subscribed.
    Tell {
        /// The fault, as it now stands.
        fault: Fault,
        /// When it was so.
        at: Instant,
        /// What happened.
        turn: Turn,
    },
}

/// The lifecycle machine of one object.
#[derive(Clone, Copy, Debug)]
struct Seen {
    incarnation: Incarnation,
    state: Lifecycle,
    /// It was found that this life cannot go on; its end is no news.
    doomed: bool,
}

impl Seen {
    fn new(incarnation: Incarnation) -> Self {
        Seen { incarnation, state: Lifecycle::Created, doomed: false }
    }
}

/// Where and when something was seen.
struct Scene {
    place: Place,
    incarnation: Incarnation,
    at: Instant,
}

/// What a fault may be a symptom of.
enum Cause {
    /// It is its own cause, whatever else is down.
    Itself,
    /// Whatever is down that it depends on.
    Above,
    /// This one.
    Known(FaultId),
}

impl Detector {
    /// A detector of `node` that begins at `now` with an empty record.
    pub fn new(node: NodeName, limits: DetectorLimits, now: Instant) -> Self {
        Detector {
            limits,
            objects: BTreeMap::new(),
            needs: Dependencies::new(node),
            behind: BTreeMap::new(),
            chronicle: Chronicle::new(limits.record),
            explicable: BTreeSet::new(),
            handed: BTreeSet::new(),
            reminders: Reminders::default(),
            handover: Handover::new(limits.handover, now.as_nanos()),
            told: VecDeque::new(),
            last_number: 0,
            last_id: 0,
            stale: 0,
        }
    }

    /// The monitor hands over what it saw. A repetition of the last one changes nothing; in any case
    /// it may be confirmed afterwards.
    pub fn handle_observed(&mut self, number: u64, observation: Observation, now: Instant) {
        if number <= self.last_number {
            return;
        }
        self.last_number = number;
        let Observation { place, incarnation, finding, seen_at } = observation;
        let scene = Scene { place, incarnation, at: seen_at };
        match scene.place.clone() {
            Place::Object(address) => self.judge_object(&address.object, scene, finding),
            Place::Link { .. } => self.judge_link(scene, finding),
            Place::Node(_) => self.judge_node(scene, finding),
        }
        self.handover.handle_timeout(now);
    }

    /// The recoverer tells what becomes of a fault.
    pub fn handle_outcome(&mut self, id: FaultId, at: Instant, outcome: Outcome) {
        let Some(entry) = self.chronicle.entry_mut(id) else { return };
        if matches!(entry.ended, Some((_, End::Recovered | End::Cleared))) {
            return;
        }
        self.reminders.cancel(id);
        match outcome {
            Outcome::Decided { measure } => {
                entry.decided = Some((at, measure.clone()));
                let fault = entry.fault.clone();
                self.told.push_back(DetectorOutput::Tell {
                    fault,
                    at,
                    turn: Turn::Decided { measure },
                });
            }
            Outcome::Recovered => {
                self.handed.remove(&id);
                self.end(id, at, End::Recovered);
            }
            Outcome::GaveUp { reason } => self.end(id, at, End::GaveUp { reason }),
        }
    }

    /// The notifier has confirmed a notice.
    pub fn handle_confirmed(&mut self, number: u64, now: Instant) {
        self.handover.handle_confirmed(number, now);
    }

    /// A notice is known not to have reached the notifier.
    pub fn handle_failed(&mut self, number: u64, now: Instant) {
        self.handover.handle_failed(number, now);
    }

    /// The record, roots before their symptoms.
    pub fn read_record(&self) -> Record {
        self.chronicle.read()
    }

    /// Where an object stands in its life, as the detector has followed it.
    pub fn state_of(&self, object: &ObjectName) -> Option<(Incarnation, Lifecycle)> {
        self.objects.get(object).map(|seen| (seen.incarnation, seen.state))
    }

    /// How often something was seen of a life that is over.
    pub fn stale(&self) -> u64 {
        self.stale
    }

    /// A detector that knows the same plain facts, for a body that was struck in the middle of an input.
    #[must_use]
    pub fn reborn(self, now: Instant) -> Self {
        Detector { handover: self.handover.reborn(now), ..self }
    }

    fn judge_object(&mut self, object: &ObjectName, scene: Scene, finding: Finding) {
        if let Finding::Dismissed = finding {
            self.objects.remove(object);
            self.needs.forget(object);
            self.behind.remove(object);
            return self.end_all_at(&scene, |_| true, &End::Cleared);
        }
        let fresh = Seen::new(scene.incarnation);
        let seen = self.objects.entry(object.clone()).or_insert(fresh);
        if scene.incarnation < seen.incarnation {
            self.stale += 1;
            return;
        }
        if scene.incarnation > seen.incarnation {
            *seen = fresh;
            self.behind.remove(object);
        }
        match finding {
            Finding::Enrolled { depends_on } => self.needs.declare(object, depends_on),
            Finding::Exited { exit, restarted_as } => {
                self.judge_exit(object, &scene, exit, restarted_as);
            }
            Finding::State { state, reason } => self.judge_state(object, &scene, state, reason),
            Finding::Declared { kind, detail } => {
                self.find(&scene, kind, detail, Cause::Above);
            }
            Finding::Silent { age } => {
                let detail = format!("no sign of life for {} ms", age.as_millis());
                let cause = self.cause_of_standstill(object, &scene);
                self.find(&scene, FaultKind::Silence, detail, cause);
            }
            Finding::Spoke => self.end_kind(&scene, &FaultKind::Silence),
            Finding::Hangs { during, age, victims } => {
                let detail = format!(
                    "{during} has kept its arbiter for {} ms; {} others stand still behind it",
                    age.as_millis(),
                    victims.iter().filter(|&victim| victim != object).count()
                );
                let id = self.find(&scene, FaultKind::Hang, detail, Cause::Itself);
                let known = |victim: &&ObjectName| self.objects.contains_key(*victim);
                let known: Vec<_> = victims.iter().filter(|&v| v != object).filter(known).collect();
                for victim in known {
                    self.behind.insert(victim.clone(), id);
                }
                self.explain_by(id, scene.at);
            }
            Finding::Waits { during, age } => {
                let detail = format!("{during} has been waiting for {} ms", age.as_millis());
                self.find(&scene, FaultKind::Hang, detail, Cause::Above);
            }
            Finding::Stuck { oldest, queued } => {
                let detail = format!(
                    "it answers, but has taken none of {queued} messages; the oldest is {} ms old",
                    oldest.as_millis()
                );
                self.find(&scene, FaultKind::Hang, detail, Cause::Above);
            }
            Finding::Overloaded { oldest, queued } => {
                self.end_kind(&scene, &FaultKind::Hang);
                let oldest = oldest.as_millis();
                let detail = format!("{queued} messages wait; the oldest is {oldest} ms old");
                self.find(&scene, FaultKind::Overload, detail, Cause::Above);
            }
            Finding::Flows => {
                self.end_kind(&scene, &FaultKind::Hang);
                self.end_kind(&scene, &FaultKind::Overload);
            }
            Finding::Resumed => {
                self.behind.remove(object);
                self.end_kind(&scene, &FaultKind::Hang);
            }
            Finding::Lost { culprit } => {
                let cause = self.behind.get(object).map_or(Cause::Above, |&id| Cause::Known(id));
                let detail = format!("it stands still behind {culprit}, which does not return");
                self.find(&scene, FaultKind::Hang, detail, cause);
            }
            Finding::Dismissed | Finding::Link(_) | Finding::Node(_) => {}
        }
    }

    fn judge_exit(
        &mut self,
        object: &ObjectName,
        scene: &Scene,
        exit: Exit,
        restarted_as: Option<Incarnation>,
    ) {
        let seen = self.objects.get_mut(object).expect("the caller has put it there");
        let before = seen.state;
        // A life that was already over ends in some way or other; that is no second fault.
        let over = std::mem::replace(&mut seen.doomed, exit != Exit::Stopped);
        seen.state = match exit {
            Exit::Stopped => Lifecycle::Finalized,
            _ => Lifecycle::Fatal,
        };
        let (kind, detail) = match exit {
            Exit::Panicked { text, at, during } => {
                (FaultKind::Panic, format!("{text}, at {at}, in {during}"))
            }
            Exit::Returned if !over => {
                // A life that ends itself in order is finalized before its guard says how it ended.
                (FaultKind::UnexpectedExit, "it ended itself, and nobody had told it to".into())
            }
            Exit::Aborted if !over && before != Lifecycle::Finalized => {
                (FaultKind::UnexpectedExit, format!("its arbiter went away while it was {before}"))
            }
            Exit::Returned | Exit::Aborted | Exit::Stopped => return,
        };
        let Some(next) = restarted_as else {
            self.find(scene, kind, detail, Cause::Itself);
            return;
        };
        *seen = Seen::new(next);
        let id = self.record(scene, kind, detail, Cause::Itself);
        self.end(id, scene.at, End::Recovered);
    }

    fn judge_state(
        &mut self,
        object: &ObjectName,
        scene: &Scene,
        state: Lifecycle,
        reason: Option<String>,
    ) {
        let seen = self.objects.get_mut(object).expect("the caller has put it there");
        let before = std::mem::replace(&mut seen.state, state);
        seen.doomed |= state == Lifecycle::Fatal;
        if before == state {
            return;
        }
        // A guard tells where a turn ended, not what was passed on the way.
        if !before.may_reach(state) {
            let detail = format!("it went from {before} to {state}, and no way leads there");
            self.find(scene, FaultKind::CheckFailed, detail, Cause::Itself);
        }
        let reason = reason.unwrap_or_else(|| "it gave no reason".into());
        match state {
            Lifecycle::Error => {
                self.find(scene, FaultKind::ErrorState, reason, Cause::Above);
            }
            Lifecycle::Fatal if before == Lifecycle::Created => {
                self.find(scene, FaultKind::InitializationFailed, reason, Cause::Above);
            }
            Lifecycle::Fatal => {
                self.find(scene, FaultKind::Fatal, reason, Cause::Above);
            }
            Lifecycle::Active => {
                let life = scene.incarnation;
                let is_over =
                    |fault: &Fault| fault.incarnation < life || fault.kind == FaultKind::ErrorState;
                self.end_all_at(scene, is_over, &End::Recovered);
            }
            Lifecycle::Created | Lifecycle::Initialized | Lifecycle::Finalized => {}
        }
    }

    fn judge_link(&mut self, scene: Scene, finding: Finding) {
        let Finding::Link(condition) = finding else { return };
        match condition {
            LinkCondition::Up => {
                self.end_kind(&scene, &FaultKind::LinkDown);
                self.end_kind(&scene, &FaultKind::LinkDegraded);
            }
            LinkCondition::Degraded { reason } => {
                self.end_kind(&scene, &FaultKind::LinkDown);
                self.find(&scene, FaultKind::LinkDegraded, reason, Cause::Above);
            }
            LinkCondition::Down { reason } => {
                self.end_kind(&scene, &FaultKind::LinkDegraded);
                self.find(&scene, FaultKind::LinkDown, reason, Cause::Above);
            }
        }
    }

    fn judge_node(&mut self, scene: Scene, finding: Finding) {
        let Finding::Node(condition) = finding else { return };
        match condition {
            NodeCondition::Reachable => self.end_kind(&scene, &FaultKind::NodeLost),
            NodeCondition::Lost { reason } => {
                self.find(&scene, FaultKind::NodeLost, reason, Cause::Itself);
            }
            NodeCondition::Restarted => {
                let known = self.chronicle.standing(&scene.place, &FaultKind::NodeLost);
                let id = known.unwrap_or_else(|| {
                    let detail = "its process died and began again".into();
                    self.record(&scene, FaultKind::NodeLost, detail, Cause::Itself)
                });
                self.end_by_itself(id, scene.at, End::Recovered);
            }
        }
    }

    /// Somebody who stands still does so behind a hang, or because of what else is wrong with itself,
    /// or because of what it depends on.
    fn cause_of_standstill(&self, object: &ObjectName, scene: &Scene) -> Cause {
        // Also where the culprit has been replaced elsewhere: its victims stand until they are freed.
        let hang = self.behind.get(object).copied();
        let own = || {
            let here = self.chronicle.standing_at(&scene.place);
            here.filter(|fault| is_down(fault) && fault.kind != FaultKind::Silence)
                .map(|fault| fault.id)
                .min()
        };
        hang.or_else(own).map_or(Cause::Above, Cause::Known)
    }

    /// A fault was seen: it is counted if it stands already, else recorded and handed over.
    fn find(&mut self, scene: &Scene, kind: FaultKind, detail: String, cause: Cause) -> FaultId {
        if let Some(id) = self.chronicle.standing(&scene.place, &kind)
            && self.repeat(id, scene)
        {
            return id;
        }
        let id = self.record(scene, kind, detail, cause);
        let due = scene.at + self.limits.decision;
        self.reminders.set(id, Reminder { due, sent: 0 });
        self.handed.insert(id);
        let fault = self.chronicle.entry(id).expect("it was just recorded").fault.clone();
        self.hand_over(Notice::Found(fault), scene.at);
        self.explain_by(id, scene.at);
        id
    }

    /// Counts a fault once more; no, if what stands was given up in an earlier life.
    fn repeat(&mut self, id: FaultId, scene: &Scene) -> bool {
        let Some(entry) = self.chronicle.entry_mut(id) else { return false };
        let newer = scene.incarnation > entry.fault.incarnation;
        if newer && matches!(entry.ended, Some((_, End::GaveUp { .. }))) {
            return false;
        }
        entry.fault.count = entry.fault.count.saturating_add(1);
        entry.fault.incarnation = entry.fault.incarnation.max(scene.incarnation);
        if entry.fault.count.is_power_of_two() {
            let fault = entry.fault.clone();
            let tell = DetectorOutput::Tell { fault, at: scene.at, turn: Turn::Repeated };
            self.told.push_back(tell);
        }
        true
    }

    /// Puts a fault into the record and tells it.
    fn record(&mut self, scene: &Scene, kind: FaultKind, detail: String, cause: Cause) -> FaultId {
        self.last_id += 1;
        let id = FaultId(self.last_id);
        let symptom_of = match cause {
            Cause::Itself => None,
            Cause::Known(cause) => Some(self.chronicle.root(cause)),
            Cause::Above => {
                self.explicable.insert(id);
                self.needs.root_above(&scene.place, &self.chronicle)
            }
        };
        let fault = Fault {
            id,
            severity: kind.severity(),
            kind,
            place: scene.place.clone(),
            incarnation: scene.incarnation,
            detail,
            found_at: scene.at,
            symptom_of,
            count: 1,
        };
        if let Some(dropped) = self.chronicle.open(fault.clone()) {
            self.explicable.remove(&dropped);
            self.handed.remove(&dropped);
            self.reminders.cancel(dropped);
        }
        self.told.push_back(DetectorOutput::Tell { fault, at: scene.at, turn: Turn::Found });
        id
    }

    /// A root was found: what was found shortly before, and is explained by it, becomes its symptom.
    fn explain_by(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.chronicle.entry(id) else { return };
        if !is_down(&entry.fault) {
            return;
        }
        let place = entry.fault.place.clone();
        let root = self.chronicle.root(id);
        let since = at - (Instant::ORIGIN + self.limits.hindsight);
        let is_behind = |fault: &Fault| match &fault.place {
            Place::Object(address) => self.behind.get(&address.object) == Some(&id),
            _ => false,
        };
        let users = self.needs.users_of(&place);
        let explained: Vec<FaultId> = self
            .chronicle
            .all_standing()
            .filter(|fault| {
                fault.symptom_of.is_none()
                    && fault.id != root
                    && fault.id != id
                    && fault.found_at - Instant::ORIGIN >= since
                    && self.explicable.contains(&fault.id)
                    && (is_behind(fault) || users.contain(&fault.place))
            })
            .map(|fault| fault.id)
            .collect();
        for symptom in explained {
            let entry = self.chronicle.entry_mut(symptom).expect("it was just found there");
            entry.fault.symptom_of = Some(root);
            let fault = entry.fault.clone();
            self.told.push_back(DetectorOutput::Tell { fault, at, turn: Turn::Explained });
        }
    }

    /// The fault of this kind at this place, if there is one, has gone by itself.
    fn end_kind(&mut self, scene: &Scene, kind: &FaultKind) {
        if let Some(id) = self.chronicle.standing(&scene.place, kind) {
            self.end_by_itself(id, scene.at, End::Cleared);
        }
    }

    fn end_all_at(&mut self, scene: &Scene, is_over: impl Fn(&Fault) -> bool, end: &End) {
        let standing = self.chronicle.standing_at(&scene.place);
        let over: Vec<FaultId> = standing.filter(|f| is_over(f)).map(|fault| fault.id).collect();
        for id in over {
            self.end_by_itself(id, scene.at, end.clone());
        }
    }

    /// A fault is over, and those who were told of it do not know yet.
    fn end_by_itself(&mut self, id: FaultId, at: Instant, end: End) {
        self.end(id, at, end);
        let Some(entry) = self.chronicle.entry(id) else { return };
        let place = entry.fault.place.clone();
        let waits = |notice: &Notice| notice.id() == id;
        if self.handed.remove(&id) && self.handover.withdraw(waits).is_none() {
            self.hand_over(Notice::Cleared { id, place }, at);
        }
    }

    fn end(&mut self, id: FaultId, at: Instant, end: End) {
        self.reminders.cancel(id);
        if !matches!(end, End::GaveUp { .. }) {
            self.explicable.remove(&id);
        }
        self.chronicle.end(id, at, end.clone());
        if let Some(entry) = self.chronicle.entry(id) {
            let fault = entry.fault.clone();
            let turn = match end {
                End::Recovered => Turn::Recovered,
                End::Cleared => Turn::Cleared,
                End::GaveUp { reason } => Turn::GaveUp { reason },
            };
            self.told.push_back(DetectorOutput::Tell { fault, at, turn });
        }
    }

    fn hand_over(&mut self, notice: Notice, now: Instant) {
        self.handover.hand(notice.rank(), notice, now);
    }

    /// Nobody has decided about this fault. That is as it should be for a symptom whose root stands.
    fn remind(&mut self, id: FaultId, reminder: Reminder, now: Instant) {
        let Some(entry) = self.chronicle.entry(id) else { return };
        let fault = entry.fault.clone();
        let next = Reminder { due: now + self.limits.decision, ..reminder };
        if fault.symptom_of.is_some_and(|root| self.chronicle.stands(root)) {
            self.reminders.set(id, next);
        } else if reminder.sent < self.limits.reminders {
            self.reminders.set(id, Reminder { sent: reminder.sent + 1, ..next });
            self.handover.withdraw(|notice| notice.id() == id);
            self.hand_over(Notice::Found(fault), now);
        } else {
            let reason = "no recoverer has decided about it".into();
            self.end(id, now, End::GaveUp { reason });
        }
    }
}

impl Machine for Detector {
    type Output = DetectorOutput;

    fn poll_output(&mut self) -> Option<DetectorOutput> {
        if let Some(told) = self.told.pop_front() {
            return Some(told);
        }
        self.handover.poll_output().map(|handed| match handed {
            Handed::Deliver { number, item } => DetectorOutput::HandOver { number, notice: item },
            Handed::GivenUp { item, tries } => DetectorOutput::GivenUp { notice: item, tries },
        })
    }

    fn poll_timeout(&self) -> Option<Instant> {
        [self.handover.poll_timeout(), self.reminders.next()].into_iter().flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.handover.handle_timeout(now);
        while let Some((id, reminder)) = self.reminders.pop_due(now) {
            self.remind(id, reminder, now);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ObjectAddress, Severity};
    use proptest::prelude::*;
    use std::sync::Arc;

    const ONE: Incarnation = Incarnation(1);
    const TWO: Incarnation = Incarnation(2);

    fn at(millis: u64) -> Instant {
        Instant::from_millis(millis)
    }

    fn object(name: &str) -> ObjectName {
        ObjectName::new(name).expect("a name")
    }

    fn node(name: &str) -> NodeName {
        NodeName::new(name).expect("a name")
    }

    /// A place as it is written: `arm` is an object here, `n:arm` one there, `-eth-n` a link to n, `@n`
    /// a node.
    fn place(text: &str) -> Place {
        if let Some(name) = text.strip_prefix('@') {
            return Place::Node(node(name));
        }
        if let Some((link, neighbour)) = text.strip_prefix('-').and_then(|t| t.split_once('-')) {
            return Place::Link {
                node: node("m"),
                link: link.into(),
                neighbour: Some(node(neighbour)),
            };
        }
        Place::Object(address(text))
    }

    fn address(text: &str) -> ObjectAddress {
        let local = || ObjectAddress::new(node("m"), object(text));
        text.parse().unwrap_or_else(|_| local())
    }

    /// A detector with its clock and numbering.
    struct Bench {
        detector: Detector,
        number: u64,
        now: Instant,
    }

    impl Bench {
        fn new() -> Self {
            Bench::with(DetectorLimits::default())
        }

        fn with(limits: DetectorLimits) -> Self {
            Bench { detector: Detector::new(node("m"), limits, at(0)), number: 0, now: at(0) }
        }

        fn see(&mut self, text: &str, incarnation: Incarnation, finding: Finding) {
            self.number += 1;
            let (place, seen_at) = (place(text), self.now);
            let observation = Observation { place, incarnation, finding, seen_at };
            self.detector.handle_observed(self.number, observation, self.now);
        }

        fn depend(&mut self, object: &str, on: &[&str]) {
            let depends_on: Arc<[ObjectAddress]> = on.iter().map(|text| address(text)).collect();
            self.see(object, ONE, Finding::Enrolled { depends_on });
        }

        /// What was told ("Found 1") and handed over ("+1", "-1"), all of it confirmed.
        fn said(&mut self) -> Vec<String> {
            let mut said = Vec::new();
            while let Some(output) = self.detector.poll_output() {
                match output {
                    DetectorOutput::Tell { fault, turn, .. } => {
                        let turn = format!("{turn:?}");
                        let turn = turn.split([' ', '{']).next().unwrap_or_default();
                        said.push(format!("{turn} {}", fault.id.0));
                    }
                    DetectorOutput::HandOver { number, notice } => {
                        let sign = if matches!(notice, Notice::Found(_)) { '+' } else { '-' };
                        said.push(format!("{sign}{}", notice.id().0));
                        self.detector.handle_confirmed(number, self.now);
                    }
                    DetectorOutput::GivenUp { notice, .. } => {
                        said.push(format!("given up {}", notice.id().0));
                    }
                }
            }
            said
        }

        fn run_until(&mut self, until: u64) -> Vec<String> {
            let mut said = self.said();
            while let Some(due) = self.detector.poll_timeout().filter(|&due| due <= at(until)) {
                self.now = due;
                self.detector.handle_timeout(due);
                said.extend(self.said());
            }
            self.now = at(until);
            said
        }

        fn entries(&self) -> Vec<super::super::Entry> {
            self.detector.read_record().entries
        }

        fn fault(&self, id: u64) -> Fault {
            let entry = self.detector.chronicle.entry(FaultId(id)).expect("it is recorded");
            entry.fault.clone()
        }
    }

    fn exited(exit: Exit) -> Finding {
        Finding::Exited { exit, restarted_as: None }
    }

    fn panicked() -> Exit {
        Exit::Panicked { text: "boom".into(), at: "arm.rs:7".into(), during: "Move" }
    }

    fn state(state: Lifecycle) -> Finding {
        Finding::State { state, reason: Some("why".into()) }
    }

    fn silent() -> Finding {
        Finding::Silent { age: Duration::from_millis(350) }
    }

    fn declared() -> Finding {
        Finding::Declared { kind: FaultKind::CheckFailed, detail: "speed is 9".into() }
    }

    fn down() -> Finding {
        Finding::Link(LinkCondition::Down { reason: "no hello".into() })
    }

    fn lost() -> Finding {
        Finding::Node(NodeCondition::Lost { reason: "no path".into() })
    }

    fn hangs(victims: &[&str]) -> Finding {
        let victims = victims.iter().map(|name| object(name)).collect();
        Finding::Hangs { during: "Scan", age: Duration::from_millis(500), victims }
    }

    #[test]
    fn everything_on_the_list_is_found_under_its_kind() {
        let age = Duration::from_millis(500);
        let reason = || "why".to_string();
        let cases: [(&str, Finding, FaultKind); 16] = [
            ("arm", exited(panicked()), FaultKind::Panic),
            ("arm", exited(Exit::Returned), FaultKind::UnexpectedExit),
            ("arm", exited(Exit::Aborted), FaultKind::UnexpectedExit),
            ("arm", hangs(&[]), FaultKind::Hang),
            ("arm", Finding::Waits { during: "Scan", age }, FaultKind::Hang),
            ("arm", Finding::Stuck { oldest: age, queued: 3 }, FaultKind::Hang),
            ("arm", Finding::Lost { culprit: object("a") }, FaultKind::Hang),
            ("arm", silent(), FaultKind::Silence),
            ("arm", state(Lifecycle::Error), FaultKind::ErrorState),
            ("arm", state(Lifecycle::Fatal), FaultKind::InitializationFailed),
            ("arm", declared(), FaultKind::CheckFailed),
            ("arm", Finding::Overloaded { oldest: age, queued: 3 }, FaultKind::Overload),
            ("-eth-n", down(), FaultKind::LinkDown),
            (
                "-eth-n",
                Finding::Link(LinkCondition::Degraded { reason: reason() }),
                FaultKind::LinkDegraded,
            ),
            ("@n", lost(), FaultKind::NodeLost),
            (
                "arm",
                Finding::Declared { kind: FaultKind::Custom("X1".into()), detail: reason() },
                FaultKind::Custom("X1".into()),
            ),
        ];
        for (place, finding, kind) in cases {
            let mut bench = Bench::new();

            bench.see(place, ONE, finding.clone());

            assert_eq!(bench.said(), ["Found 1", "+1"], "{finding:?}");
            let fault = bench.fault(1);
            assert_eq!((fault.kind.clone(), fault.count, fault.symptom_of), (kind, 1, None));
            assert!(!fault.detail.is_empty(), "{finding:?} says nothing");
        }
    }

    #[test]
    fn what_is_no_fault_is_not_recorded() {
        let harmless = [
            ("arm", exited(Exit::Stopped)),
            ("arm", Finding::Spoke),
            ("arm", Finding::Resumed),
            ("arm", Finding::Flows),
            ("arm", Finding::Dismissed),
            ("arm", state(Lifecycle::Initialized)),
            ("arm", state(Lifecycle::Active)),
            ("arm", state(Lifecycle::Finalized)),
            ("-eth-n", Finding::Link(LinkCondition::Up)),
            ("@n", Finding::Node(NodeCondition::Reachable)),
        ];
        for (place, finding) in harmless {
            let mut bench = Bench::new();

            bench.see(place, ONE, finding.clone());

            assert_eq!(bench.said(), [""; 0], "{finding:?}");
        }
    }

    #[test]
    fn a_life_that_ends_itself_is_missed_unless_it_was_known_to_end() {
        let cases = [
            (vec![Lifecycle::Finalized], FaultKind::UnexpectedExit),
            (vec![Lifecycle::Fatal, Lifecycle::Finalized], FaultKind::Fatal),
        ];
        for (states, kind) in cases {
            let mut bench = Bench::new();
            bench.see("arm", ONE, state(Lifecycle::Active));
            states.iter().for_each(|&to| bench.see("arm", ONE, state(to)));

            bench.see("arm", ONE, exited(Exit::Returned));

            assert_eq!(bench.said(), ["Found 1", "+1"], "{states:?}");
            assert_eq!(bench.fault(1).kind, kind);
        }
    }

    #[test]
    fn each_fault_that_goes_by_itself_is_cleared_by_what_says_so() {
        let age = Duration::from_millis(500);
        let reason = || "why".to_string();
        let cases = [
            ("arm", silent(), Finding::Spoke),
            ("arm", hangs(&[]), Finding::Resumed),
            ("arm", Finding::Waits { during: "Scan", age }, Finding::Resumed),
            ("arm", Finding::Stuck { oldest: age, queued: 3 }, Finding::Flows),
            ("arm", Finding::Overloaded { oldest: age, queued: 3 }, Finding::Flows),
            ("arm", declared(), Finding::Dismissed),
            ("-eth-n", down(), Finding::Link(LinkCondition::Up)),
            (
                "-eth-n",
                Finding::Link(LinkCondition::Degraded { reason: reason() }),
                Finding::Link(LinkCondition::Up),
            ),
            ("@n", lost(), Finding::Node(NodeCondition::Reachable)),
        ];
        for (place, fault, end) in cases {
            let mut bench = Bench::new();
            bench.see(place, ONE, fault.clone());
            bench.said();

            bench.see(place, ONE, end);

            assert_eq!(bench.said(), ["Cleared 1", "-1"], "{fault:?}");
            bench.see(place, ONE, fault.clone());
            assert_eq!(bench.said(), ["Found 2", "+2"], "{fault:?}");
        }
    }

    #[test]
    fn a_fault_that_is_over_before_it_was_handed_over_is_handed_to_nobody() {
        let mut bench = Bench::new();
        bench.see("a", ONE, silent());
        bench.see("b", ONE, silent());

        bench.see("b", ONE, Finding::Spoke);

        assert_eq!(bench.said(), ["Found 1", "Found 2", "Cleared 2", "+1"]);
    }

    #[test]
    fn the_same_fault_again_is_counted_and_told_at_powers_of_two() {
        let mut bench = Bench::new();
        for _ in 0..9 {
            bench.see("arm", ONE, declared());
        }

        assert_eq!(bench.fault(1).count, 9);
        assert_eq!(bench.said(), ["Found 1", "Repeated 1", "Repeated 1", "Repeated 1", "+1"]);
    }

    #[test]
    fn a_repetition_of_a_hand_over_is_not_a_repetition_of_the_fault() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, declared());

        bench.number -= 1;
        bench.see("arm", ONE, declared());

        assert_eq!(bench.fault(1).count, 1);
    }

    #[test]
    fn a_life_that_becomes_active_ends_the_faults_of_the_lives_before() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, exited(panicked()));
        bench.see("arm", ONE, declared());
        bench.said();

        bench.see("arm", TWO, state(Lifecycle::Initialized));
        assert_eq!(bench.said(), [""; 0]);
        bench.see("arm", TWO, state(Lifecycle::Active));

        assert_eq!(bench.said(), ["Recovered 1", "Recovered 2", "-1", "-2"]);
    }

    #[test]
    fn a_life_that_dies_before_it_is_active_is_the_same_fault_still() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, exited(panicked()));

        bench.see("arm", TWO, exited(panicked()));

        assert_eq!((bench.fault(1).count, bench.fault(1).incarnation), (2, TWO));
        assert_eq!(bench.entries().len(), 1);
    }

    #[test]
    fn a_component_that_was_reset_is_recovered_when_it_is_active_again() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Active));
        bench.see("arm", ONE, state(Lifecycle::Error));
        bench.see("arm", ONE, state(Lifecycle::Initialized));
        assert_eq!(bench.said(), ["Found 1", "+1"]);

        bench.see("arm", ONE, state(Lifecycle::Active));

        assert_eq!(bench.said(), ["Recovered 1", "-1"]);
    }

    #[test]
    fn a_death_that_the_guard_has_mended_is_recorded_and_handed_to_nobody() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Active));

        bench.see("arm", ONE, Finding::Exited { exit: panicked(), restarted_as: Some(TWO) });

        assert_eq!(bench.said(), ["Found 1", "Recovered 1"]);
        assert_eq!(bench.detector.state_of(&object("arm")), Some((TWO, Lifecycle::Created)));
        assert_eq!(bench.entries()[0].recovered_after(), Some(Duration::ZERO));
        assert_eq!(bench.run_until(60_000), [""; 0]);
    }

    #[test]
    fn what_is_seen_of_an_older_life_is_ignored_and_counted() {
        let findings =
            [exited(panicked()), silent(), declared(), state(Lifecycle::Error), hangs(&[])];
        for finding in findings {
            let mut bench = Bench::new();
            bench.see("arm", TWO, state(Lifecycle::Active));

            bench.see("arm", ONE, finding);

            assert_eq!(bench.said(), [""; 0]);
            assert_eq!(bench.detector.stale(), 1);
        }
    }

    #[test]
    fn a_life_that_was_over_already_ends_without_a_second_fault() {
        for exit in [Exit::Returned, Exit::Aborted, Exit::Stopped] {
            let mut bench = Bench::new();
            bench.see("arm", ONE, state(Lifecycle::Fatal));

            bench.see("arm", ONE, exited(exit));

            assert_eq!(bench.entries().len(), 1);
            assert_eq!(bench.fault(1).kind, FaultKind::InitializationFailed);
        }
    }

    #[test]
    fn every_way_that_does_not_exist_is_a_fault_and_every_other_is_none() {
        use Lifecycle::{Active, Created, Error, Fatal, Finalized, Initialized};
        let all = [Created, Initialized, Active, Error, Fatal, Finalized];
        for from in all {
            for to in all {
                let mut bench = Bench::new();
                bench.see("arm", ONE, state(from));

                bench.see("arm", ONE, state(to));

                let entries = bench.entries();
                let wrong = entries.iter().filter(|e| e.fault.kind == FaultKind::CheckFailed);
                let expected = from != to && !from.may_reach(to);
                assert_eq!(wrong.count(), usize::from(expected), "{from} to {to}");
                assert_eq!(bench.detector.state_of(&object("arm")), Some((ONE, to)));
            }
        }
    }

    #[test]
    fn fatal_after_initialisation_is_fatal() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, state(Lifecycle::Initialized));

        bench.see("arm", ONE, state(Lifecycle::Fatal));

        let fault = bench.fault(1);
        assert_eq!((fault.kind, fault.severity), (FaultKind::Fatal, Severity::Critical));
        assert_eq!(fault.detail, "why");
    }

    #[test]
    fn what_an_object_suffers_while_something_it_depends_on_is_down_is_a_symptom() {
        for symptom in [declared(), silent(), state(Lifecycle::Error), state(Lifecycle::Fatal)] {
            let mut bench = Bench::new();
            bench.depend("planner", &["map"]);
            bench.depend("map", &["laser"]);
            bench.see("laser", ONE, exited(panicked()));

            bench.see("planner", ONE, symptom.clone());

            assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)), "{symptom:?}");
        }
    }

    #[test]
    fn a_panic_and_a_hang_of_its_own_are_never_symptoms() {
        for own in [exited(panicked()), exited(Exit::Returned), hangs(&[])] {
            let mut bench = Bench::new();
            bench.depend("map", &["laser"]);
            bench.see("laser", ONE, exited(panicked()));

            bench.see("map", ONE, own);

            assert_eq!(bench.fault(2).symptom_of, None);
        }
    }

    #[test]
    fn a_root_that_is_found_shortly_after_its_symptom_explains_it() {
        let mut bench = Bench::new();
        bench.depend("planner", &["laser"]);
        bench.see("planner", ONE, silent());
        bench.said();

        bench.now = at(1900);
        bench.see("laser", ONE, exited(panicked()));

        assert_eq!(bench.said(), ["Found 2", "Explained 1", "+2"]);
        assert_eq!(bench.fault(1).symptom_of, Some(FaultId(2)));
        let order: Vec<u64> = bench.entries().iter().map(|entry| entry.fault.id.0).collect();
        assert_eq!(order, [2, 1]);
    }

    #[test]
    fn a_fault_that_is_found_long_after_another_does_not_explain_it() {
        let mut bench = Bench::new();
        bench.depend("planner", &["laser"]);
        bench.see("planner", ONE, silent());

        bench.now = at(2100);
        bench.see("laser", ONE, exited(panicked()));

        assert_eq!(bench.fault(1).symptom_of, None);
    }

    #[test]
    fn of_two_that_depend_on_each_other_the_first_to_fail_is_the_root() {
        let mut bench = Bench::new();
        bench.depend("a", &["b"]);
        bench.depend("b", &["a"]);

        bench.see("a", ONE, silent());
        bench.see("b", ONE, silent());

        assert_eq!(
            (bench.fault(1).symptom_of, bench.fault(2).symptom_of),
            (None, Some(FaultId(1)))
        );
    }

    #[test]
    fn links_and_what_depends_on_remote_objects_are_symptoms_of_the_lost_node() {
        let mut bench = Bench::new();
        bench.depend("planner", &["n:map"]);
        bench.see("-eth-n", Incarnation(0), down());
        bench.see("@n", Incarnation(9), lost());
        bench.see("planner", ONE, declared());
        bench.see("-usb-n", Incarnation(0), down());
        bench.see("-can-x", Incarnation(0), down());

        let symptoms = [1, 2, 3, 4, 5].map(|id| bench.fault(id).symptom_of.map(|root| root.0));
        assert_eq!(symptoms, [Some(2), None, Some(2), Some(2), None]);
        let order: Vec<u64> = bench.entries().iter().map(|entry| entry.fault.id.0).collect();
        assert_eq!(order, [2, 1, 3, 4, 5]);
    }

    #[test]
    fn the_victims_of_a_hang_are_its_symptoms_before_and_after_it_is_found() {
        let mut bench = Bench::new();
        for name in ["laser", "map", "pose"] {
            bench.depend(name, &[]);
        }
        bench.see("map", ONE, silent());
        bench.see("laser", ONE, hangs(&["laser", "map", "pose"]));
        bench.see("pose", ONE, silent());
        bench.see("laser", ONE, silent());
        bench.see("map", ONE, Finding::Lost { culprit: object("laser") });

        let symptoms = [1, 2, 3, 4, 5].map(|id| bench.fault(id).symptom_of.map(|root| root.0));
        assert_eq!(symptoms, [Some(2), None, Some(2), Some(2), Some(2)]);
    }

    #[test]
    fn a_victim_that_is_lost_is_a_symptom_also_when_the_culprit_was_replaced_long_ago() {
        let mut bench = Bench::new();
        bench.depend("map", &[]);
        bench.see("laser", ONE, hangs(&["map"]));
        bench.detector.handle_outcome(FaultId(1), at(5), Outcome::Recovered);

        bench.see("map", ONE, Finding::Lost { culprit: object("laser") });

        assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
    }

    #[test]
    fn a_victim_that_is_silent_is_a_symptom_also_when_the_culprit_was_replaced_before() {
        let mut bench = Bench::new();
        bench.depend("map", &[]);
        bench.see("laser", ONE, hangs(&["map"]));
        bench.detector.handle_outcome(FaultId(1), at(5), Outcome::Recovered);

        bench.see("map", ONE, silent());

        assert_eq!(bench.fault(2).symptom_of, Some(FaultId(1)));
    }

    #[test]
    fn the_recoverer_s_word_is_recorded_and_told() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, exited(panicked()));
        bench.said();

        let decided = Outcome::Decided { measure: "restart".into() };
        bench.detector.handle_outcome(FaultId(1), at(3), decided);
        bench.detector.handle_outcome(FaultId(1), at(8), Outcome::Recovered);
        bench.detector.handle_outcome(FaultId(1), at(9), Outcome::GaveUp { reason: "late".into() });
        bench.detector.handle_outcome(FaultId(7), at(9), Outcome::Recovered);

        assert_eq!(bench.said(), ["Decided 1", "Recovered 1"]);
        let entry = &bench.entries()[0];
        assert_eq!(entry.decided, Some((at(3), "restart".into())));
        assert_eq!(entry.recovered_after(), Some(Duration::from_millis(8)));
        bench.see("arm", TWO, exited(panicked()));
        assert_eq!(bench.said(), ["Found 2", "+2"]);
    }

    #[test]
    fn what_was_given_up_stays_latched_for_that_life_and_is_new_in_the_next() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, declared());
        bench.detector.handle_outcome(FaultId(1), at(3), Outcome::GaveUp { reason: "no".into() });
        bench.said();

        bench.see("arm", ONE, declared());
        assert_eq!(bench.said(), ["Repeated 1"]);
        bench.see("arm", TWO, declared());
        assert_eq!(bench.said(), ["Found 2", "+2"]);
    }

    #[test]
    fn a_fault_on_which_nobody_decides_is_handed_over_again_and_in_the_end_given_up_loudly() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, exited(panicked()));

        let said = bench.run_until(60_000);

        assert_eq!(said, ["Found 1", "+1", "+1", "+1", "+1", "GaveUp 1"]);
    }

    #[test]
    fn nobody_is_reminded_of_a_symptom_while_its_root_stands() {
        let mut bench = Bench::new();
        bench.depend("map", &["laser"]);
        bench.see("laser", ONE, exited(panicked()));
        let decided = Outcome::Decided { measure: "restart".into() };
        bench.detector.handle_outcome(FaultId(1), at(0), decided);
        bench.see("map", ONE, silent());
        bench.said();
        assert_eq!(bench.run_until(30_500), [""; 0]);

        bench.detector.handle_outcome(FaultId(1), at(30_500), Outcome::Recovered);

        assert_eq!(bench.run_until(31_500), ["Recovered 1", "+2"]);
    }

    #[test]
    fn a_node_that_died_and_began_again_unnoticed_is_found_and_recovered_in_one() {
        let mut bench = Bench::new();

        bench.see("@n", Incarnation(9), Finding::Node(NodeCondition::Restarted));
        assert_eq!(bench.said(), ["Found 1", "Recovered 1"]);

        bench.see("@n", Incarnation(9), lost());
        bench.see("@n", Incarnation(10), Finding::Node(NodeCondition::Restarted));
        assert_eq!(bench.said(), ["Found 2", "Recovered 2", "+2", "-2"]);
    }

    #[test]
    fn a_detector_that_was_struck_keeps_its_record_and_hands_over_again() {
        let mut bench = Bench::new();
        bench.see("arm", ONE, exited(panicked()));
        while bench.detector.poll_output().is_some() {}

        bench.detector = bench.detector.clone().reborn(at(1));

        assert_eq!(bench.said(), ["+1"]);
        bench.see("arm", ONE, declared());
        assert_eq!(bench.said(), ["Found 2", "+2"]);
    }

    fn any_finding() -> impl Strategy<Value = Finding> {
        let age = Duration::from_millis(500);
        prop_oneof![
            Just(exited(panicked())),
            Just(exited(Exit::Returned)),
            Just(exited(Exit::Stopped)),
            Just(Finding::Exited { exit: panicked(), restarted_as: Some(TWO) }),
            Just(silent()),
            Just(Finding::Spoke),
            Just(declared()),
            Just(hangs(&["a", "b", "c"])),
            Just(Finding::Lost { culprit: object("a") }),
            Just(Finding::Resumed),
            Just(Finding::Stuck { oldest: age, queued: 1 }),
            Just(Finding::Flows),
            Just(state(Lifecycle::Active)),
            Just(state(Lifecycle::Error)),
            Just(state(Lifecycle::Fatal)),
            Just(Finding::Dismissed),
        ]
    }

    proptest! {
        /// Whatever is seen, in whatever order: a place has at most one standing fault of a kind, roots
        /// come before their symptoms, no fault is its own cause, and the record stays bounded.
        #[test]
        fn the_record_stays_in_order_whatever_is_seen(
            seen in prop::collection::vec(
                (prop::sample::select(vec!["a", "b", "c"]), 1..4u64, any_finding(), 0..900u64), 0..120
            )
        ) {
            let mut bench = Bench::with(DetectorLimits { record: 16, ..DetectorLimits::default() });
            bench.depend("a", &["b"]);
            bench.depend("b", &["c", "n:x"]);
            bench.depend("c", &["a"]);
            let mut now = 0;
            for (object, life, finding, wait) in seen {
                bench.see(object, Incarnation(life), finding);
                now += wait;
                bench.run_until(now);

                let entries = bench.entries();
                prop_assert!(entries.len() <= 16);
                let mut standing = BTreeSet::new();
                let mut passed = BTreeSet::new();
                for entry in &entries {
                    let fault = &entry.fault;
                    if bench.detector.chronicle.stands(fault.id) {
                        let kind = fault.kind.clone();
                        prop_assert!(standing.insert((fault.place.clone(), kind)));
                    }
                    if let Some(root) = fault.symptom_of {
                        prop_assert_ne!(root, fault.id);
                        prop_assert_ne!(bench.detector.chronicle.root(root), fault.id);
                        let known = bench.detector.chronicle.entry(root).is_some();
                        prop_assert!(!known || passed.contains(&bench.detector.chronicle.root(root)));
                    }
                    passed.insert(fault.id);
                }
            }
        }
    }
}
