//! What is wrong, where, and why: the judge of the fault chain.

use super::correlation::{DependencyIndex, is_down};
use super::fault_log::Reminder;
use super::{
    ConfirmedQueue, ConfirmedQueueLimits, ConfirmedQueueOutput, FaultLog, FaultNotice, FaultRecord,
    FaultTransition, Observation, RecoveryOutcome,
};
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
/// * **Nothing is forgotten.** A fault on which no recoverer decides is handed over again, and in
///   the end given up loudly.
///
/// Where the guard has already restarted a component, the fault is recorded and reported, and
/// handed to no recoverer. It is recovered when the next incarnation is active, shares what becomes
/// of a fault of that one, and is cleared when that one ends in order and none follows.
#[derive(Clone, Debug)]
pub struct Detector {
    limits: DetectorLimits,
    objects: SortedMap<ObjectName, Seen>,
    needs: DependencyIndex,
    fault_log: FaultLog,
    /// The latest decision for each rank of faults: when, and about which.
    decided: SortedMap<u8, (Instant, FaultId)>,
    nodes: NodeHistories,
    /// The latest pause of this node, while links and nodes may suffer from it.
    pause: Option<Pause>,
    handover: ConfirmedQueue<FaultNotice>,
    outputs: VecDeque<DetectorOutput>,
    last_number: u64,
    last_id: u64,
    stale: u64,
    /// The node ends, and its components with it.
    ending: bool,
}

/// The bounds of a [`Detector`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DetectorLimits {
    /// How many faults the record holds. More remembers longer; an entry takes some hundred bytes.
    pub record: usize,
    /// How long after a symptom its root may be found. Longer explains more, and wrongly at times.
    pub hindsight: Duration,
    /// How long a recoverer may take to decide before it is reminded, and the next incarnation of
    /// an object that was stopped to begin. Longer leaves a fault that was lost on the way lying;
    /// shorter repeats more to a busy recoverer.
    pub decision: Duration,
    /// How often a recoverer is reminded before the fault is given up.
    pub reminders: u32,
    /// So many offences of another node within `offences_period` are a fault. More forgives more.
    pub offences: u32,
    /// See `offences`.
    pub offences_period: Duration,
    /// This many restarts of another node within `crash_loop_period` are a crash loop.
    pub crash_loop_restarts: u32,
    /// See `crash_loop_restarts`. A node that stays up for as long has ended its crash loop. Longer
    /// finds slower loops, and keeps the fault for longer.
    pub crash_loop_period: Duration,
    /// A pause of this length is a fault. A shorter one is a fault only if a link or node suffers
    /// from it, up to this long after it.
    pub pause: Duration,
    /// The time for links and other nodes to return after a pause that is a fault. A link or node
    /// that is still down then has a fault of its own.
    pub after_pause: Duration,
    /// The hand-over to the notifier.
    pub handover: ConfirmedQueueLimits,
}

impl Default for DetectorLimits {
    fn default() -> Self {
        DetectorLimits {
            // A day with a fault every minute and a half.
            record: 1024,
            // Links over wireless, the slowest, find a fault within two seconds.
            hindsight: Duration::from_secs(2),
            // A recoverer decides in microseconds; a second is an outage of the recoverer itself.
            decision: Duration::from_secs(1),
            reminders: 3,
            // A flood is reported every three seconds. A process that crashes five times in a
            // minute is expected to crash again.
            offences: 5,
            offences_period: Duration::from_secs(60),
            // An update and a second attempt restart a node twice; systemd itself ceases to start a
            // unit after five times in ten seconds (systemd.unit(5), StartLimitBurst).
            crash_loop_restarts: 3,
            // systemd waits 0.1 s between two starts, a careful unit file up to 20 s.
            crash_loop_period: Duration::from_secs(60),
            // Requests expire after as long, unless they say otherwise, and links are down before.
            pause: Duration::from_secs(1),
            // A link that has gone down four times lately comes up after 48 hellos, 2.4 s; then
            // routes and sessions follow.
            after_pause: Duration::from_secs(5),
            handover: ConfirmedQueueLimits::default(),
        }
    }
}

/// An output of a [`Detector`].
#[derive(Clone, Debug, PartialEq)]
pub enum DetectorOutput {
    /// Hand this to the notifier, and bring its confirmation to [`Detector::handle_confirmed`].
    HandOver {
        /// The number of its confirmation.
        number: u64,
        /// What the notifier must know.
        notice: FaultNotice,
    },
    /// The notifier never confirmed this: tell a person.
    GivenUp {
        /// What it should have known.
        notice: FaultNotice,
        /// How often it was sent.
        tries: u32,
    },
    /// Report to all subscribers.
    Tell {
        /// The fault, as it now stands.
        fault: Fault,
        /// When it was so.
        at: Instant,
        /// What happened.
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
    /// This one.
    Known(FaultId),
    /// This one, on the same thread: reported, and handed over only if it is still open afterwards.
    Behind(FaultId),
}

impl Detector {
    /// A detector of `node` that begins at `now` with an empty record.
    pub fn new(node: NodeName, limits: DetectorLimits, now: Instant) -> Self {
        Detector {
            limits,
            objects: SortedMap::new(),
            needs: DependencyIndex::new(node),
            fault_log: FaultLog::new(limits.record),
            decided: SortedMap::new(),
            nodes: NodeHistories::new(limits),
            pause: None,
            handover: ConfirmedQueue::new(limits.handover, now.as_nanos()),
            outputs: VecDeque::new(),
            last_number: 0,
            last_id: 0,
            stale: 0,
            ending: false,
        }
    }

    /// The monitor hands over what it saw. A repetition of the last one changes nothing; in any
    /// case it may be confirmed afterwards.
    pub fn handle_observed(&mut self, number: u64, observation: Observation, now: Instant) {
        if number <= self.last_number {
            return;
        }
        self.last_number = number;
        let Observation { location, incarnation, finding, seen_at } = observation;
        let scene = Scene { location, incarnation, at: seen_at };
        match scene.location.clone() {
            FaultLocation::Object(address) => self.judge_object(&address.object, scene, finding),
            FaultLocation::Link { .. } => self.judge_link(scene, finding),
            FaultLocation::Node(_) => self.judge_node(scene, finding),
        }
        self.handover.handle_timeout(now);
    }

    /// The recoverer reports its progress with a fault.
    pub fn handle_outcome(&mut self, id: FaultId, at: Instant, outcome: RecoveryOutcome) {
        let Some(entry) = self.fault_log.entry(id) else { return };
        if !entry.stands() || entry.recovered_at.is_some() {
            return;
        }
        let fault = entry.fault.clone();
        let rank = FaultNotice::Found(fault.clone()).rank();
        // What a recoverer says about a fault on which it has decided before is not progress.
        if self.fault_log.treat(id, |treatment| treatment.reminder = None).reminder.is_some() {
            self.decided.insert(rank, (at, id));
        }
        match outcome {
            RecoveryOutcome::Decided { action } => self.decide(id, at, action),
            RecoveryOutcome::Failed { action, reason } => {
                let turn = FaultTransition::Failed { action, reason };
                self.outputs.push_back(DetectorOutput::Tell { fault, at, turn });
            }
            RecoveryOutcome::Recovered => {
                self.fault_log.treat(id, |treatment| treatment.handed = false);
                self.recover(id, at);
            }
            RecoveryOutcome::Waits => self.await_next_incarnation(id, at),
            RecoveryOutcome::GaveUp { reason } => self.give_up(id, at, reason),
        }
    }

    /// The node stops: the end of a component repairs nothing from now on. Open faults stay open at
    /// the node's end.
    pub fn handle_node_end(&mut self) {
        self.ending = true;
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
    pub fn read_record(&self) -> FaultRecord {
        self.fault_log.read()
    }

    /// How often something was seen of an incarnation that is over.
    pub fn stale(&self) -> u64 {
        self.stale
    }

    /// The detector with the same facts, for an actor that panicked within an input.
    #[must_use]
    pub fn restarted(self, now: Instant) -> Self {
        Detector { handover: self.handover.restarted(now), ..self }
    }

    /// A fault was seen: it is counted if it stands already, else recorded and handed over.
    fn find(&mut self, scene: &Scene, kind: FaultKind, detail: String, cause: Cause) -> FaultId {
        let is_behind = matches!(cause, Cause::Behind(_));
        let known = self.fault_log.open_fault(&scene.location, &kind);
        let incarnation = known.and_then(|id| Some(self.fault_log.entry(id)?.fault.incarnation));
        let known = known.filter(|&id| self.repeat(id, scene, &detail));
        // What is its own cause now was taken for a symptom before.
        let is_own = matches!(cause, Cause::Itself);
        let is_symptom =
            |id| self.fault_log.entry(id).is_some_and(|e| e.fault.symptom_of.is_some());
        let turns = known.is_some_and(|id| is_own && is_symptom(id));
        let id = match known {
            Some(id) if is_behind || !(turns || self.fault_log.treatment(id).unhanded) => {
                let handed = self.fault_log.treatment(id).handed;
                if handed && incarnation < Some(scene.incarnation) {
                    // What was done about it has not helped.
                    self.notify(id, scene.at);
                }
                return id;
            }
            Some(id) => {
                // Where it was a symptom, it is none any more, or has outlived its root.
                self.explain(&[id], None, scene.at);
                id
            }
            None => self.record(scene, kind, detail, cause),
        };
        self.fault_log.treat(id, |treatment| treatment.unhanded = is_behind);
        if is_behind {
            return id;
        }
        self.notify(id, scene.at);
        self.explain_by(id, scene.at);
        id
    }

    /// A recoverer is to decide about a fault.
    fn notify(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry(id) else { return };
        let notice = FaultNotice::Found(entry.fault.clone());
        self.fault_log.treat(id, |treatment| treatment.handed = true);
        self.remind_after(id, self.limits.decision, 0, at);
        self.hand_over(notice, at);
    }

    /// Asks again about a fault that is not decided by then.
    fn remind_after(&mut self, id: FaultId, span: Duration, sent: u32, at: Instant) {
        let reminder = Reminder { due: at + span, sent };
        self.fault_log.treat(id, |treatment| treatment.reminder = Some(reminder));
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
            let fault = entry.fault.clone();
            let tell =
                DetectorOutput::Tell { fault, at: scene.at, turn: FaultTransition::Repeated };
            self.outputs.push_back(tell);
        }
        true
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
        self.fault_log.open(fault.clone());
        let explicable = matches!(cause, Cause::Above);
        self.fault_log.treat(id, |treatment| treatment.explicable = explicable);
        self.outputs.push_back(DetectorOutput::Tell {
            fault,
            at: scene.at,
            turn: FaultTransition::Found,
        });
        id
    }

    /// A root was found: what was found shortly before, and is explained by it, becomes its
    /// symptom.
    fn explain_by(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry(id) else { return };
        if !is_down(&entry.fault) {
            return;
        }
        let location = entry.fault.location.clone();
        let root = self.fault_log.root(id);
        let since = at - (Instant::ORIGIN + self.limits.hindsight);
        let is_behind = |fault: &Fault| match &fault.location {
            FaultLocation::Object(address) => self.behind(&address.object) == Some(id),
            _ => false,
        };
        let users = self.needs.users_of(&location);
        let explained: Vec<FaultId> = self
            .fault_log
            .all_open()
            .filter(|fault| {
                fault.symptom_of.is_none()
                    && fault.id != root
                    && fault.id != id
                    && fault.found_at - Instant::ORIGIN >= since
                    && self.fault_log.treatment(fault.id).explicable
                    && (is_behind(fault) || users.contain(&fault.location))
            })
            .map(|fault| fault.id)
            .collect();
        self.explain(&explained, Some(root), at);
    }

    /// It has turned out what these are symptoms of, or that they are roots.
    fn explain(&mut self, faults: &[FaultId], root: Option<FaultId>, at: Instant) {
        for id in faults {
            let Some(entry) = self.fault_log.entry_mut(*id) else { continue };
            if entry.fault.symptom_of == root {
                continue;
            }
            entry.fault.symptom_of = root;
            let (fault, turn) = (entry.fault.clone(), FaultTransition::Explained);
            self.outputs.push_back(DetectorOutput::Tell { fault, at, turn });
        }
    }

    /// The cause of the fault of this kind at this place, if there is one, is away.
    fn end_kind(&mut self, scene: &Scene, kind: &FaultKind) {
        if let Some(id) = self.fault_log.open_fault(&scene.location, kind) {
            self.repair(id, scene.at);
            self.withdraw(id, scene.at);
        }
    }

    /// These faults of the place that match; their causes are away, and service is restored if so.
    fn end_all_at(&mut self, scene: &Scene, is_over: impl Fn(&Fault) -> bool, restored: bool) {
        let open_fault = self.fault_log.open_faults_at(&scene.location);
        let over: Vec<FaultId> = open_fault.filter(|f| is_over(f)).map(|fault| fault.id).collect();
        for id in over {
            if restored {
                self.recover(id, scene.at);
            }
            self.repair(id, scene.at);
            self.withdraw(id, scene.at);
        }
    }

    /// A fault is over, and this is not reported yet.
    fn withdraw(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry(id) else { return };
        let location = entry.fault.location.clone();
        let waits = |notice: &FaultNotice| notice.id() == id;
        let handed = self.fault_log.treat(id, |treatment| treatment.handed = false).handed;
        if handed && self.handover.withdraw(waits).is_none() {
            self.hand_over(FaultNotice::Cleared { id, location }, at);
        }
    }

    /// Service is restored. Of an object that is the repair as well.
    fn recover(&mut self, id: FaultId, at: Instant) {
        self.fault_log.treat(id, |treatment| treatment.reminder = None);
        let Some(entry) = self.fault_log.entry_mut(id) else { return };
        if entry.recovered_at.is_some() || !entry.stands() {
            return;
        }
        (entry.recovered_at, entry.given_up) = (Some(at), None);
        let fault = entry.fault.clone();
        if fault.is_repaired_by_recovery() {
            self.fault_log.repair(id, at);
        }
        self.outputs.push_back(DetectorOutput::Tell {
            fault,
            at,
            turn: FaultTransition::Recovered,
        });
    }

    /// The cause is away.
    fn repair(&mut self, id: FaultId, at: Instant) {
        let Some(entry) = self.fault_log.entry(id).filter(|entry| entry.stands()) else { return };
        let fault = entry.fault.clone();
        self.fault_log.repair(id, at);
        self.outputs.push_back(DetectorOutput::Tell { fault, at, turn: FaultTransition::Cleared });
    }

    /// What is done about a fault.
    fn decide(&mut self, id: FaultId, at: Instant, action: String) {
        for id in self.sharing_the_outcome_of(id) {
            let Some(entry) = self.fault_log.entry_mut(id) else { continue };
            entry.decided = Some((at, action.clone()));
            let fault = entry.fault.clone();
            let turn = FaultTransition::Decided { action: action.clone() };
            self.outputs.push_back(DetectorOutput::Tell { fault, at, turn });
        }
    }

    /// Nothing more is tried. The fault stands.
    fn give_up(&mut self, id: FaultId, at: Instant, reason: String) {
        for id in self.sharing_the_outcome_of(id) {
            self.fault_log.treat(id, |treatment| {
                (treatment.reminder, treatment.unhanded) = (None, false);
            });
            let root = self.fault_log.entry(id).and_then(|entry| entry.fault.symptom_of);
            let root = root.and_then(|root| self.fault_log.entry(root)).map(|root| {
                let Fault { id, kind, location, .. } = &root.fault;
                format!("; it is a symptom of fault {}, {kind} of {location}", id.0)
            });
            let reason = reason.clone() + &root.unwrap_or_default();
            let Some(entry) = self.fault_log.entry_mut(id) else { continue };
            entry.given_up = Some((at, reason.clone()));
            let fault = entry.fault.clone();
            let turn = FaultTransition::GaveUp { reason };
            self.outputs.push_back(DetectorOutput::Tell { fault, at, turn });
        }
    }

    fn hand_over(&mut self, notice: FaultNotice, now: Instant) {
        self.handover.hand(notice.rank(), notice, now);
    }

    /// No recoverer has decided about this fault. That is as it should be for a symptom whose root
    /// is in treatment.
    fn remind(&mut self, id: FaultId, reminder: Reminder, now: Instant) {
        let before = self.fault_log.treat(id, |treatment| treatment.reminder = None);
        if before.unhanded {
            return self.end_unhanded(id, now);
        }
        let Some(entry) = self.fault_log.entry(id) else { return };
        let fault = entry.fault.clone();
        let notice = FaultNotice::Found(fault.clone());
        // When a recoverer last decided about a fault that goes before this one: since then this one
        // waits in vain. One that was overtaken is not in the queue.
        let decided = self.decided.iter().map(|(&of, &(at, last))| (at, (of, last)));
        let progress = decided.filter(|&(_, last)| last < (notice.rank(), id)).map(|(at, _)| at);
        let decision = self.limits.decision;
        if let Some(at) = progress.max().filter(|&at| at + decision > now) {
            // Its turn comes.
            return self.remind_after(id, decision, 0, at);
        }
        let in_hand = |root| {
            let root = self.fault_log.entry(root);
            root.is_some_and(|root| root.stands() && root.recovered_at.is_none())
        };
        if fault.symptom_of.is_some_and(in_hand) {
            self.remind_after(id, decision, reminder.sent, now);
        } else if reminder.sent < self.limits.reminders {
            self.remind_after(id, decision, reminder.sent + 1, now);
            self.handover.withdraw(|notice| notice.id() == id);
            self.hand_over(notice, now);
        } else {
            self.give_up(id, now, "no recoverer has decided about it".into());
        }
    }
}

impl Machine for Detector {
    type Output = DetectorOutput;

    fn poll_output(&mut self) -> Option<DetectorOutput> {
        if let Some(outputs) = self.outputs.pop_front() {
            return Some(outputs);
        }
        self.handover.poll_output().map(|handed| match handed {
            ConfirmedQueueOutput::Deliver { number, item } => {
                DetectorOutput::HandOver { number, notice: item }
            }
            ConfirmedQueueOutput::GivenUp { item, tries } => {
                DetectorOutput::GivenUp { notice: item, tries }
            }
        })
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let pause = self.pause.as_ref().map(|pause| pause.until);
        let reminder = self.fault_log.next_reminder().map(|(_, reminder)| reminder.due);
        let others = [reminder, self.nodes.poll_timeout(), pause];
        others.into_iter().chain([self.handover.poll_timeout()]).flatten().min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.handover.handle_timeout(now);
        while let Some((id, reminder)) = self.fault_log.next_reminder()
            && reminder.due <= now
        {
            self.remind(id, reminder, now);
        }
        while let Some(node) = self.nodes.pop_over(now) {
            self.end_crash_loop(node, now);
        }
        self.end_pause(now);
    }
}

mod next_incarnation;
mod node_history;
mod pause;
mod rules;
#[cfg(test)]
mod tests;
