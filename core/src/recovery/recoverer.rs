//! Which action answers a fault, and what comes next when it does not help.
//!
//! ```text
//! fault ─► case of its location ─► attempt ─► (back-off) ─► attempt ─► next rung ─► … ─► safe stop
//!                                  └─ done ─► recovered, its symptoms are judged again
//! ```
//!
//! There is one case per place at a time: a second fault of the place joins it. A symptom waits
//! until its root is settled, and is then either cleared by the detector or acted upon itself.
//! Whether a restart is still worth it is not decided here but by the supervisor.

use super::supervision::GiveUpReason;
use super::{Ladder, Plan, RecoveryAction};
use crate::detection::RecoveryOutcome;
use crate::sorted::SortedMap;
use crate::{Fault, FaultId, FaultKind, FaultLocation, Instant, Machine, NodeName};
use std::collections::VecDeque;

mod safe_state;
#[cfg(test)]
mod tests;
mod timers;
mod types;

use self::safe_state::TreatmentStop;
pub use self::types::{CASES_MAX, RecovererOutput, RecoveryDone, RecoveryFailed, RecoveryOrder};
use self::types::{GRACE, MEMORY, SYMPTOMS_MAX};

/// The detector latches by place and kind: a place with more faults than this is out of its mind.
const FAULTS_LIMIT: usize = 32;

/// One fault of a case. It is cured by orders that were given after it was known.
#[derive(Clone, Debug)]
struct Noted {
    fault: Fault,
    since: u64,
    /// It has gone by itself while an action was under way.
    over: bool,
}

#[derive(Clone, Debug)]
struct Case {
    /// Never empty, at most [`FAULTS_LIMIT`]. The first one has opened the case: its ladder is
    /// climbed while it stands.
    faults: Vec<Noted>,
    ladder: Ladder,
    rung: usize,
    attempt: u32,
    order: u64,
    /// Its order is being carried out; otherwise it waits until the next is due.
    is_acting: bool,
    /// When the order has failed, or the next is given.
    due: Instant,
    given_up: bool,
}

impl Case {
    fn known(&self) -> Vec<Fault> {
        self.faults.iter().map(|noted| noted.fault.clone()).collect()
    }
}

/// The incarnation that it struck does not answer.
fn is_stuck(fault: &Fault) -> bool {
    matches!(fault.kind, FaultKind::Hang | FaultKind::Silence)
}

/// Nothing is done about a fault but to keep it in the record.
fn observed() -> RecoveryOutcome {
    RecoveryOutcome::Decided { action: RecoveryAction::Observe.to_string() }
}

fn ids(faults: &[Fault]) -> Vec<FaultId> {
    faults.iter().map(|fault| fault.id).collect()
}

#[derive(Clone, Debug)]
struct Symptom {
    fault: Fault,
    root: FaultId,
    due: Option<Instant>,
}

/// How far up its ladder a fault had got when it was last recovered.
#[derive(Clone, Copy, Debug)]
struct LadderProgress {
    rung: usize,
    attempt: u32,
    until: Instant,
}

/// The recoverer of one node. See the [module](self).
#[derive(Debug)]
pub struct Recoverer {
    node: NodeName,
    plan: Plan,
    seed: u64,
    orders: u64,
    cases: SortedMap<FaultLocation, Case>,
    symptoms: SortedMap<FaultId, Symptom>,
    memories: SortedMap<(FaultLocation, FaultKind), LadderProgress>,
    treatment_stop: Option<TreatmentStop>,
    outputs: VecDeque<RecovererOutput>,
}

impl Recoverer {
    /// A recoverer without cases. `seed` makes the jitter of its back-off.
    pub fn new(node: NodeName, plan: Plan, seed: u64) -> Self {
        Recoverer {
            node,
            plan,
            seed,
            orders: 0,
            cases: SortedMap::new(),
            symptoms: SortedMap::new(),
            memories: SortedMap::new(),
            treatment_stop: None,
            outputs: VecDeque::new(),
        }
    }

    /// A recoverer that begins with what this one had not settled, after its actor has failed.
    #[must_use]
    pub fn restarted(&self, now: Instant) -> Self {
        let seed = self.seed.wrapping_add(1);
        let mut next = Recoverer::new(self.node.clone(), self.plan.clone(), seed);
        (next.orders, next.treatment_stop) = (self.orders, self.treatment_stop);
        let noted = self.cases.values().flat_map(|case| &case.faults).map(|noted| &noted.fault);
        for fault in noted.chain(self.symptoms.values().map(|symptom| &symptom.fault)) {
            next.handle_fault(fault.clone(), now);
        }
        next
    }

    /// A fault was found, or is reported once more.
    pub fn handle_fault(&mut self, fault: Fault, now: Instant) {
        let id = fault.id;
        if let Some(case) = self.cases.get_mut(&fault.location)
            && let Some(noted) = case.faults.iter_mut().find(|noted| noted.fault.id == id)
        {
            noted.fault.symptom_of = fault.symptom_of;
            if fault.incarnation > noted.fault.incarnation {
                *noted = Noted { fault: fault.clone(), since: self.orders, over: false };
                self.handle_struck_again(&fault, now);
            }
            return;
        }
        if !self.is_ours(&fault) {
            return self.treat(fault, now);
        }
        if self.symptoms.contains_key(&id) && fault.symptom_of.is_some() {
            return;
        }
        self.symptoms.remove(&id);
        if let Some(root) = fault.symptom_of
            && !self.stands_behind(&fault, root)
            && (self.is_open(root) || self.symptoms.contains_key(&root))
            && self.symptoms.len() < SYMPTOMS_MAX
        {
            self.symptoms.insert(fault.id, Symptom { fault, root, due: None });
            return;
        }
        self.treat(fault, now);
    }

    /// A fault has gone by itself.
    pub fn handle_stand_down(&mut self, id: FaultId, location: &FaultLocation, now: Instant) {
        if self.symptoms.remove(&id).is_some() {
            self.release_symptoms(&[id], now);
        }
        let Some(case) = self.cases.get_mut(location) else { return };
        for noted in case.faults.iter_mut().filter(|noted| noted.fault.id == id) {
            noted.over = true;
        }
        // What is under way is not interrupted: it may be what has helped.
        if !case.is_acting {
            self.drop_over(location, now);
        }
    }

    /// A strategy has answered, or has ended without an answer.
    pub fn handle_outcome(
        &mut self,
        number: u64,
        outcome: Result<RecoveryDone, RecoveryFailed>,
        now: Instant,
    ) {
        let is_its = |case: &Case| case.is_acting && case.order == number;
        let found = self.cases.iter_mut().find(|(_, case)| is_its(case));
        let Some((location, case)) = found.map(|(at, case)| (at.clone(), case)) else { return };
        match outcome {
            Ok(done) => self.settle_case(&location, done, now),
            Err(RecoveryFailed { reason, is_final }) => {
                if is_final {
                    case.attempt = case.ladder.steps()[case.rung].attempts;
                }
                self.climb(&location, reason, now);
            }
        }
    }

    /// The incarnation that an action has begun has the fault too. Where it does not answer, no
    /// other part finds out that the action has failed.
    fn handle_struck_again(&mut self, fault: &Fault, now: Instant) {
        let case = &self.cases[&fault.location];
        if is_stuck(fault) && case.is_acting {
            self.climb(&fault.location, "its next incarnation does not answer either".into(), now);
        }
    }

    /// Treats a fault. Where that opens no case, its symptoms are not kept waiting for one.
    fn treat(&mut self, fault: Fault, now: Instant) {
        let (id, is_ours) = (fault.id, self.is_ours(&fault));
        self.open_case(fault, now);
        if is_ours && !self.is_open(id) {
            self.release_symptoms(&[id], now);
        }
    }

    fn open_case(&mut self, fault: Fault, now: Instant) {
        let since = self.orders;
        let ladder = self.plan.answer(&self.node, &fault.kind, &fault.location);
        if ladder.steps()[0].action == RecoveryAction::Observe {
            return self.tell(&fault, observed());
        }
        if let (Some(treatment_stop), FaultLocation::Object(_)) =
            (self.treatment_stop, &fault.location)
        {
            return self.leave_untreated(&fault, treatment_stop);
        }
        let location = fault.location.clone();
        if let Some(case) = self.cases.get_mut(&location) {
            if case.faults.len() == FAULTS_LIMIT {
                let reason =
                    format!("{FAULTS_LIMIT} faults of {location} are being treated already");
                return self.tell(&fault, RecoveryOutcome::GaveUp { reason });
            }
            case.faults.push(Noted { fault, since, over: false });
            return;
        }
        if self.cases.len() == CASES_MAX {
            let reason = format!("{CASES_MAX} places are being treated already");
            return self.tell(&fault, RecoveryOutcome::GaveUp { reason });
        }
        let ladder = ladder.clone();
        let remembered = self.memories.remove(&(location.clone(), fault.kind.clone()));
        let (mut rung, mut attempt) = (0, 1);
        if let Some(memory) = remembered.filter(|memory| now <= memory.until) {
            (rung, attempt) = (memory.rung, memory.attempt + 1);
            if attempt > ladder.steps()[rung].attempts {
                (rung, attempt) = (rung + 1, 1);
            }
        }
        let case = Case {
            faults: vec![Noted { fault, since, over: false }],
            ladder,
            rung,
            attempt,
            order: 0,
            is_acting: false,
            due: now,
            given_up: false,
        };
        self.cases.insert(location.clone(), case);
        self.approach(&location, "it came back after it had been recovered".into(), now);
    }

    /// Forgets the faults of a case that have gone by themselves. Where its first one has, the case
    /// is closed, and each other fault begins at its own first attempt. Says whether it goes on.
    fn drop_over(&mut self, location: &FaultLocation, now: Instant) -> bool {
        let case = self.cases.get_mut(location).expect("a case that is looked through is open");
        let goes_on = !case.faults[0].over;
        let over = case.faults.extract_if(.., |noted| noted.over);
        let over: Vec<FaultId> = over.map(|noted| noted.fault.id).collect();
        self.release_symptoms(&over, now);
        let others = if goes_on { None } else { self.cases.remove(location) };
        for noted in others.into_iter().flat_map(|case| case.faults) {
            self.treat(noted.fault, now);
        }
        goes_on
    }

    /// The attempt did not help: the next one, or the next rung.
    fn climb(&mut self, location: &FaultLocation, reason: String, now: Instant) {
        if !self.drop_over(location, now) {
            return;
        }
        let case = self.cases.get_mut(location).expect("it still has its first fault");
        let action = case.ladder.steps()[case.rung].action.clone();
        case.attempt += 1;
        if case.attempt > case.ladder.steps()[case.rung].attempts {
            case.attempt = 1;
            case.rung += 1;
        }
        // At the end of its ladder the fault is given up, for this reason.
        let known = if case.rung < case.ladder.steps().len() { case.known() } else { Vec::new() };
        for fault in known {
            let (action, reason) = (action.to_string(), reason.clone());
            self.tell(&fault, RecoveryOutcome::Failed { action, reason });
        }
        self.approach(location, reason, now);
    }

    /// Waits for the next attempt, or makes it.
    fn approach(&mut self, location: &FaultLocation, reason: String, now: Instant) {
        let case = self.cases.get_mut(location).expect("a case in treatment is open");
        if case.rung == case.ladder.steps().len() && !self.fall_back(location, reason, now) {
            return;
        }
        let case = self.cases.get_mut(location).expect("a case in treatment is open");
        let step = &case.ladder.steps()[case.rung];
        if step.action == RecoveryAction::Observe {
            for fault in self.close(location, now) {
                self.tell(&fault, observed());
            }
            return;
        }
        let delay = step.backoff.delay(case.attempt, self.seed ^ self.orders);
        (case.is_acting, case.due) = (false, now + delay);
        if delay.is_zero() {
            self.give_order(location, now);
        }
    }

    /// The ladder is at its end. Safe stop is left, or, if that has been tried, the node's own
    /// rest; then the case is closed.
    fn fall_back(&mut self, location: &FaultLocation, reason: String, now: Instant) -> bool {
        let case = self.cases.get_mut(location).expect("a case in treatment is open");
        let unsent = !std::mem::replace(&mut case.given_up, true);
        let rested = case.ladder.steps().iter().any(|step| step.action == RecoveryAction::SafeStop);
        if !rested {
            case.ladder = case.ladder.clone().then(RecoveryAction::SafeStop);
        }
        if unsent {
            for fault in case.known() {
                self.tell(&fault, RecoveryOutcome::GaveUp { reason: reason.clone() });
            }
        }
        if rested {
            let first = self.close(location, now).into_iter().next();
            let fault = first.expect("a case has its first fault");
            self.outputs.push_back(RecovererOutput::LastResort { fault, reason });
        }
        !rested
    }

    /// Ends a case that has no cure.
    fn close(&mut self, location: &FaultLocation, now: Instant) -> Vec<Fault> {
        let faults = self.cases.remove(location).map(|case| case.known()).unwrap_or_default();
        self.release_symptoms(&ids(&faults), now);
        faults
    }

    fn give_order(&mut self, location: &FaultLocation, now: Instant) {
        self.orders += 1;
        let number = self.orders;
        let case = self.cases.get_mut(location).expect("a case in treatment is open");
        let step = &case.ladder.steps()[case.rung];
        let (action, attempt, within) = (step.action.clone(), case.attempt, step.within);
        case.order = number;
        (case.is_acting, case.due) = (true, now + within);
        let newest = case.faults.iter().map(|noted| noted.fault.incarnation).max();
        let of_newest = || case.faults.iter().filter(|n| Some(n.fault.incarnation) == newest);
        let telling =
            of_newest().find(|noted| is_stuck(&noted.fault)).or_else(|| of_newest().next());
        let telling = telling.expect("a case has its first fault");
        let telling = telling.fault.clone();
        for fault in case.known() {
            let action = match attempt {
                1 => action.to_string(),
                _ => format!("{action}, attempt {attempt}"),
            };
            self.tell(&fault, RecoveryOutcome::Decided { action });
        }
        let order = RecoveryOrder { number, action, fault: telling, attempt, within };
        self.outputs.push_back(RecovererOutput::CarryOut(order));
    }

    /// The action has worked: whatever it cured is settled, the rest is treated in its turn.
    fn settle_case(&mut self, location: &FaultLocation, done: RecoveryDone, now: Instant) {
        let case = self.cases.remove(location).expect("a case that is settled is open");
        let action = &case.ladder.steps()[case.rung].action;
        let kind = case.faults[0].fault.kind.clone();
        let known = case.faults.iter().filter(|noted| noted.since < case.order);
        let faulty = known.map(|noted| noted.fault.incarnation).max();
        // Isolation leaves an incarnation alone that has followed the struck one.
        let is_late = *action == RecoveryAction::Isolate && done.incarnation > faulty;
        let contained =
            !is_late && matches!(action, RecoveryAction::Isolate | RecoveryAction::SafeStop);
        let restarted = *action == RecoveryAction::Restart;
        // What came while the action was under way may already belong to the new incarnation.
        let cured = |noted: &Noted| {
            let replaced =
                done.incarnation.is_none_or(|incarnation| noted.fault.incarnation < incarnation);
            // A restart that found the struck incarnation replaced already cures nothing of the
            // present one.
            contained || if restarted || is_late { replaced } else { noted.since < case.order }
        };
        let (cured, left): (Vec<Noted>, Vec<Noted>) = case.faults.into_iter().partition(cured);
        let (over, left): (Vec<Noted>, Vec<Noted>) = left.into_iter().partition(|noted| noted.over);
        let over: Vec<FaultId> = over.into_iter().map(|noted| noted.fault.id).collect();
        let cured: Vec<Fault> = cured.into_iter().map(|noted| noted.fault).collect();
        for fault in &cured {
            let outcome = match contained {
                true => RecoveryOutcome::GaveUp {
                    reason: format!("contained by {action}; service is not restored"),
                },
                false if done.waits => RecoveryOutcome::Waits,
                false if done.finished => {
                    RecoveryOutcome::GaveUp { reason: GiveUpReason::Finished.to_string() }
                }
                false => RecoveryOutcome::Recovered,
            };
            self.tell(fault, outcome);
        }
        // Whether restarts go on is for the supervisor to say, and a route for the network.
        if !contained && !restarted && !is_late && *action != RecoveryAction::Reroute {
            self.remember((location.clone(), kind), case.rung, case.attempt, now);
        }
        self.release_symptoms(&[ids(&cured), over].concat(), now);
        for noted in left {
            self.treat(noted.fault, now);
        }
    }

    fn remember(
        &mut self,
        what: (FaultLocation, FaultKind),
        rung: usize,
        attempt: u32,
        now: Instant,
    ) {
        self.memories.retain(|_, memory| now <= memory.until);
        // More than that at once is a storm, in which single ladders do not matter.
        if self.memories.len() < CASES_MAX {
            let until = now + MEMORY;
            self.memories.insert(what, LadderProgress { rung, attempt, until });
        }
    }

    /// The symptoms of these roots get a little time to pass.
    fn release_symptoms(&mut self, roots: &[FaultId], now: Instant) {
        let due = now + GRACE;
        for symptom in self.symptoms.values_mut().filter(|one| roots.contains(&one.root)) {
            symptom.due.get_or_insert(due);
        }
    }

    fn is_open(&self, id: FaultId) -> bool {
        self.cases.values().any(|case| case.faults.iter().any(|noted| noted.fault.id == id))
    }

    /// The thread on which it lives was kept by another, and is lost: replacing that one does not
    /// free it. If both are of one group, that one's replacement even waits until this incarnation
    /// has been given up.
    fn stands_behind(&self, fault: &Fault, root: FaultId) -> bool {
        let hangs = |noted: &Noted| noted.fault.id == root && noted.fault.kind == FaultKind::Hang;
        fault.kind == FaultKind::Hang && self.cases.values().any(|c| c.faults.iter().any(hangs))
    }

    /// What another node found in itself has a number of that node's record, which says nothing
    /// here.
    fn is_ours(&self, fault: &Fault) -> bool {
        match &fault.location {
            FaultLocation::Object(address) => address.node == self.node,
            FaultLocation::Link { node, .. } => *node == self.node,
            FaultLocation::Node(_) => true,
        }
    }

    fn tell(&mut self, fault: &Fault, outcome: RecoveryOutcome) {
        if self.is_ours(fault) {
            self.outputs.push_back(RecovererOutput::Settle { fault: fault.id, outcome });
        }
    }
}

impl Machine for Recoverer {
    type Output = RecovererOutput;

    fn poll_output(&mut self) -> Option<RecovererOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        let cases = self.cases.values().map(|case| case.due);
        cases.chain(self.symptoms.values().filter_map(|symptom| symptom.due)).min()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.act_on_cases(now);
        self.treat_symptoms(now);
    }
}
