//! A supervisor's decisions: which children it touches, in which order, and whether a restart is
//! still worth it.
//!
//! ```text
//!  begin ─► Starting ─► Serving ──end──────────► Ending ─► Idle
//!                          └──intensity exceeded──► Ending ─► Escalated (the parent decides)
//! ```
//!
//! Restarts are counted per child, and a child that exceeds the intensity is refused its restart:
//! its recoverer then takes the next action, at last safe stop. Where the rules say so, the
//! strategy makes children depend on each other, or the child is essential, the supervisor
//! escalates instead; and it does so too if the recoverer gives a child up that cannot be started,
//! so that it is the same whether the plan or the intensity allows fewer attempts. A first start
//! that is to be whole is undone by the first child that cannot be started, on every level.
//!
//! Two sets carry all order. `going` holds the children whose present incarnation must end: only
//! the last of them in start order is stopped at a time. `coming` holds those that are to start:
//! only the first of them is started at a time, and only when `going` is empty. A group restart
//! puts children into both; whatever fails in between joins the same sets, so that nothing is lost
//! or done twice. Under one_for_one a restarted child depends on no other and passes by both.
//!
//! A child whose incarnation has ended blocks those behind it in `coming` until the recoverer has
//! said what is to be done: restart it, or put it to rest. The supervisor never restarts a
//! component on its own account; only a supervisor below that has escalated is its own to decide
//! about.

mod budget;
mod child;
mod steps;
#[cfg(test)]
mod tests;
mod types;

pub use child::{ChildState, ChildStatus, ReplacementCause};
pub use types::{CallId, ChildOrder, GiveUpReason, SupervisorOutput};

use super::{ChildRules, Strategy, SupervisorRules};
use crate::sorted::SortedMap;
use crate::{Incarnation, Instant, Machine, ObjectName};
use budget::Budget;
use child::{ChildKey, ChildPhase, ChildTarget, SupervisedChild};
use std::collections::{BTreeSet, VecDeque};

/// No supervisor keeps more: its table is read as a whole.
const CHILDREN_LIMIT: usize = 128 * 1024;
/// More requests than this wait for no supervisor: the recoverer holds fewer cases open.
const PENDING_LIMIT: usize = 16_384;

#[derive(Clone, Debug, PartialEq, Eq)]
enum Phase {
    /// It was not begun yet, or all its children have stopped or were given up.
    Idle,
    /// Its children start.
    Starting,
    /// All were started.
    Serving,
    /// Its parent is about to end this incarnation.
    Leaving,
    /// Its children stop; with a reason, it escalates when they have.
    Ending { escalation: Option<String> },
    /// It has handed its failure on, for this reason.
    Escalated { reason: String },
}

#[derive(Clone, Debug)]
struct Pending {
    call: CallId,
    key: ChildKey,
    child: ObjectName,
    goal: ChildTarget,
}

/// One supervisor. See the [module](self).
#[derive(Debug)]
pub struct Supervisor {
    rules: SupervisorRules,
    incarnation: Incarnation,
    phase: Phase,
    /// Boxed: keys rise, and leave the nodes of such a map half empty.
    children: SortedMap<ChildKey, SupervisedChild>,
    index: SortedMap<ObjectName, ChildKey>,
    next_key: ChildKey,
    going: BTreeSet<ChildKey>,
    coming: BTreeSet<ChildKey>,
    /// Those that have a deadline at present.
    timed: BTreeSet<ChildKey>,
    pending: Vec<Pending>,
    budget: Budget,
    outputs: VecDeque<SupervisorOutput>,
}

impl Supervisor {
    /// A supervisor without children that has not begun.
    pub fn new(rules: SupervisorRules) -> Self {
        Supervisor {
            rules,
            incarnation: Incarnation::default(),
            phase: Phase::Idle,
            children: SortedMap::new(),
            index: SortedMap::new(),
            next_key: 0,
            going: BTreeSet::new(),
            coming: BTreeSet::new(),
            timed: BTreeSet::new(),
            pending: Vec::new(),
            budget: Budget::new(&rules),
            outputs: VecDeque::new(),
        }
    }

    /// How it decides.
    pub fn rules(&self) -> &SupervisorRules {
        &self.rules
    }

    /// Which of its own incarnations this is.
    pub fn incarnation(&self) -> Incarnation {
        self.incarnation
    }

    /// How many more restarts it would allow at `now`, whichever child they strike.
    pub fn restarts_left(&self, now: Instant) -> u32 {
        self.budget.least(now)
    }

    /// Its children in their start order.
    pub fn children(&self) -> impl Iterator<Item = ChildStatus> + '_ {
        self.children.values().map(|child| child.status())
    }

    /// Which incarnation of this child is its present or last one, as far as is known here.
    pub fn incarnation_of(&self, name: &ObjectName) -> Option<Incarnation> {
        Some(self.children[self.index.get(name)?].incarnation)
    }

    /// Takes in one more child, behind all others; it is started if the supervisor is at work.
    ///
    /// # Errors
    /// The name is taken, or the supervisor full.
    pub fn add_child(
        &mut self,
        name: ObjectName,
        rules: ChildRules,
        now: Instant,
    ) -> Result<(), GiveUpReason> {
        if self.index.contains_key(&name) {
            return Err(GiveUpReason::NameTaken);
        }
        if self.children.len() == CHILDREN_LIMIT {
            return Err(GiveUpReason::Full { limit: CHILDREN_LIMIT });
        }
        let key = self.next_key;
        self.next_key += 1;
        self.index.insert(name.clone(), key);
        let child = SupervisedChild::new(name.clone(), rules);
        self.children.insert(key, child);
        if self.at_work() {
            self.coming.insert(key);
        } else if self.incarnation != Incarnation::default() {
            // As its siblings, it takes no messages before the next incarnation.
            self.order(key, ChildOrder::Retire);
        }
        self.advance(now);
        Ok(())
    }

    /// Takes in one more child as [`add_child`](Self::add_child) does. The request is fulfilled when
    /// the child is at work; one whose first start fails is forgotten, which is no restart.
    pub fn handle_add(&mut self, name: &ObjectName, rules: ChildRules, call: CallId, now: Instant) {
        if !self.at_work() {
            return self.answer_gave_up(call, name.clone(), GiveUpReason::NotAtWork);
        }
        if let Err(why) = self.add_child(name.clone(), rules, now) {
            return self.answer_gave_up(call, name.clone(), why);
        }
        if let Some(key) = self.admit(name, call, ChildTarget::Run) {
            self.kept(key).joins = true;
        }
    }

    /// Stops a child and forgets it.
    pub fn handle_remove(&mut self, name: &ObjectName, call: CallId, now: Instant) {
        let Some(key) = self.admit(name, call, ChildTarget::Leave) else { return };
        self.dismiss(key, ChildTarget::Leave, ReplacementCause::Faulty, now);
        self.advance(now);
    }

    /// Begins an incarnation: every child is started in order.
    pub fn handle_begin(&mut self, incarnation: Incarnation, now: Instant) {
        self.handle_forsake(now);
        self.incarnation = incarnation;
        self.phase = Phase::Starting;
        self.budget.clear();
        // Maps that grow child by child have nodes that are half empty.
        self.index = std::mem::take(&mut self.index).into_iter().collect();
        self.children = std::mem::take(&mut self.children).into_iter().collect();
        self.for_each(|supervisor, key| {
            let child = supervisor.kept(key);
            (child.goal, child.failed) = (ChildTarget::Run, None);
            supervisor.set_isolated(key, false);
            supervisor.coming.insert(key);
        });
        self.advance(now);
    }

    /// The incarnation is about to end, with others that are stopped before it: nothing is started
    /// any more.
    pub fn handle_end_expected(&mut self, now: Instant) {
        if self.at_work() {
            self.phase = Phase::Leaving;
            self.withdraw_all();
            self.undo_additions(now);
            let living: Vec<ChildKey> = self.living().collect();
            self.announce_stops(living);
            self.settle();
        }
    }

    /// Ends the incarnation: every child is stopped in reverse order.
    pub fn handle_end(&mut self, now: Instant) {
        self.end(None, now);
        self.advance(now);
    }

    /// No incarnation follows the one that has ended: answers the requests that wait for a child.
    pub fn handle_retired(&mut self) {
        let (work, others) = std::mem::take(&mut self.pending)
            .into_iter()
            .partition(|pending: &Pending| pending.goal == ChildTarget::Run);
        self.pending = others;
        let work: Vec<Pending> = work;
        for Pending { call, child, .. } in work {
            self.answer_gave_up(call, child, GiveUpReason::NotAtWork);
        }
    }

    /// Gives all children up at once.
    pub fn handle_forsake(&mut self, now: Instant) {
        self.phase = Phase::Idle;
        self.going.clear();
        self.coming.clear();
        self.undo_additions(now);
        let living: Vec<ChildKey> = self.living().collect();
        for key in living.into_iter().rev() {
            self.abandon(key);
            self.after_end(key, now);
        }
        self.settle();
    }

    /// Forbids all children to send and receive, or allows it again.
    pub fn handle_isolate_all(&mut self, isolated: bool, now: Instant) {
        self.for_each(|supervisor, key| {
            supervisor.set_isolated(key, isolated);
            supervisor.grant(key, now);
        });
    }

    /// A restart is wanted: by the recoverer for a fault of the incarnation `faulty`, or, without
    /// one, by a person, whose wish no budget counts.
    pub fn handle_restart(
        &mut self,
        name: &ObjectName,
        call: CallId,
        cause: ReplacementCause,
        faulty: Option<Incarnation>,
        now: Instant,
    ) {
        let Some(key) = self.admit(name, call, ChildTarget::Run) else { return };
        match &self.phase {
            Phase::Starting | Phase::Serving => {}
            // What becomes of it shows in the supervisor's next incarnation, if there is one.
            Phase::Leaving | Phase::Ending { .. } | Phase::Escalated { .. } if faulty.is_some() => {
                let child = self.kept(key);
                child.failed = None;
                let present = child.is_alive() && faulty >= Some(child.incarnation);
                if present && matches!(cause, ReplacementCause::Stuck | ReplacementCause::Behind) {
                    self.end_now(key, cause);
                    self.after_end(key, now);
                }
                return self.advance(now);
            }
            Phase::Leaving => return self.settle(),
            Phase::Idle | Phase::Ending { .. } | Phase::Escalated { .. } => {
                return self.refuse(call, GiveUpReason::NotAtWork);
            }
        }
        let child = self.kept(key);
        match faulty {
            None => {
                if child.goal != ChildTarget::Leave {
                    child.goal = ChildTarget::Run;
                }
                self.set_isolated(key, false);
            }
            // The guard has restarted it by itself, and its report is still under way.
            Some(incarnation) if incarnation > child.incarnation => child.incarnation = incarnation,
            // An incarnation that has been replaced already, unless its replacement has failed too.
            Some(incarnation) if incarnation < child.incarnation && child.failed.is_none() => {
                return self.settle();
            }
            Some(_) => {}
        }
        if self.kept(key).goal != ChildTarget::Run {
            self.end_unanswering(key, cause, now);
        } else if let Err(why) = self.replace(key, cause, now) {
            self.refuse(call, why);
        }
        self.advance(now);
    }

    /// A reset of a child in error is wanted: the restart of those that keep their instance. It is
    /// counted as one, and in a group the others end and start again around it.
    pub fn handle_reset(&mut self, name: &ObjectName, call: CallId, now: Instant) {
        let Some(&key) = self.index.get(name) else {
            return self.answer_gave_up(call, name.clone(), GiveUpReason::Unknown);
        };
        let child = self.kept(key);
        let name = child.name.clone();
        if child.state != ChildPhase::Running || self.going.contains(&key) {
            return self.answer_gave_up(call, name, GiveUpReason::NoIncarnation);
        }
        if self.at_work() && !self.count_restart(key, ReplacementCause::Faulty, now) {
            let reason = self.excess_of(key, ReplacementCause::Faulty);
            self.answer_gave_up(call, name, GiveUpReason::IntensityExceeded { reason });
            return self.advance(now);
        }
        self.set_state(key, ChildPhase::AwaitsReset { call });
        match self.rules.strategy {
            Strategy::OneForAll if self.at_work() => self.renew_from(0),
            Strategy::RestForOne if self.at_work() => self.renew_from(key),
            _ => self.reset(key, now),
        }
        self.advance(now);
    }

    /// The child is to be cut off, or let in again. For a fault of the incarnation `faulty`, one
    /// that has followed it is left alone.
    pub fn handle_isolate(
        &mut self,
        name: &ObjectName,
        faulty: Option<Incarnation>,
        isolated: bool,
        call: CallId,
        now: Instant,
    ) {
        let Some(&key) = self.index.get(name) else {
            return self.answer_gave_up(call, name.clone(), GiveUpReason::Unknown);
        };
        let present = self.kept(key).incarnation;
        if faulty.is_some_and(|faulty| faulty < present) {
            let (child, incarnation) = (name.clone(), Some(present));
            return self.outputs.push_back(SupervisorOutput::Recovered {
                call,
                child,
                incarnation,
            });
        }
        self.set_isolated(key, isolated);
        self.grant(key, now);
        let child = self.kept(key);
        let incarnation = child.is_alive().then_some(child.incarnation);
        if isolated && !child.is_alive() && child.goal == ChildTarget::Run {
            // The start of an isolated child is not waited for.
            self.dismiss(key, ChildTarget::Rest, ReplacementCause::Died, now);
        }
        let child = name.clone();
        self.outputs.push_back(SupervisorOutput::Recovered { call, child, incarnation });
        self.advance(now);
    }

    /// The child is to be put in the safe state.
    pub fn handle_rest(
        &mut self,
        name: &ObjectName,
        call: CallId,
        cause: ReplacementCause,
        now: Instant,
    ) {
        let Some(key) = self.admit(name, call, ChildTarget::Rest) else { return };
        self.set_isolated(key, true);
        let child = self.kept(key);
        let (essential, worked, joins) = (child.rules.essential, child.worked, child.joins);
        let why = child.failed.take().map(|why| format!(": {why}")).unwrap_or_default();
        let undone = self.start_needs(key);
        self.dismiss(key, ChildTarget::Rest, cause, now);
        if self.at_work() && cause != ReplacementCause::Asked && !joins {
            // As many restarts as the plan allows, and one too many, are the same end.
            let starts = self.phase == Phase::Starting || !worked;
            if essential {
                self.end(
                    Some(format!("{name} is essential, and was put into the safe state")),
                    now,
                );
            } else if undone || (self.rules.counts_together() && starts) {
                self.end(Some(format!("{name} could not be started{why}")), now);
            }
        }
        self.advance(now);
    }

    /// The child's new incarnation is at work.
    pub fn handle_started(&mut self, name: &ObjectName, incarnation: Incarnation, now: Instant) {
        let Some(key) = self.present(name, incarnation) else { return };
        let state = self.kept(key).state;
        if !matches!(state, ChildPhase::Starting { .. } | ChildPhase::Unavailable) {
            return;
        }
        self.set_state(key, ChildPhase::Running);
        if self.going.contains(&key) {
            return;
        }
        self.coming.remove(&key);
        self.grant(key, now);
        self.advance(now);
    }

    /// The child's incarnation waits for something that is not there yet, and tries again by
    /// itself. Where others depend on it, those behind it wait too; else they are started.
    pub fn handle_unavailable(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
        reason: String,
        now: Instant,
    ) {
        let Some(key) = self.present(name, incarnation) else { return };
        let child = self.kept(key);
        let name = child.name.clone();
        match child.state {
            ChildPhase::Down
            | ChildPhase::Failing { .. }
            | ChildPhase::Stopping { .. }
            | ChildPhase::AwaitsReset { .. } => return,
            ChildPhase::Resetting { call, .. } => {
                // It has taken its recovery into its own hands.
                self.set_state(key, ChildPhase::Running);
                let child = name;
                self.outputs.push_back(SupervisorOutput::Waits { call, child, incarnation });
            }
            ChildPhase::Starting { .. } | ChildPhase::Running | ChildPhase::Unavailable => {}
        }
        self.set_state(key, ChildPhase::Unavailable);
        if self.rules.strategy == Strategy::OneForOne {
            self.coming.remove(&key);
        } else if self.phase == Phase::Starting {
            self.outputs.push_back(SupervisorOutput::Unavailable(reason));
        }
        self.advance(now);
    }

    /// The child that was told to start has begun this incarnation: not the one that it was told,
    /// if its guard had begun that one on the spot meanwhile.
    pub fn handle_begun(&mut self, name: &ObjectName, incarnation: Incarnation) {
        self.present(name, incarnation);
    }

    /// The child's new incarnation is not going to be at work: its last hooks run, within the time
    /// of a stop.
    pub fn handle_fails_to_start(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
        now: Instant,
    ) {
        let Some(key) = self.present(name, incarnation) else { return };
        let child = self.kept(key);
        if matches!(child.state, ChildPhase::Starting { .. } | ChildPhase::Unavailable) {
            let due = now + child.rules.shutdown_within;
            self.set_state(key, ChildPhase::Failing { due });
        }
    }

    /// The child's new incarnation did not come to be.
    pub fn handle_start_failed(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
        reason: String,
        now: Instant,
    ) {
        let Some(key) = self.present(name, incarnation) else { return };
        self.incarnation_ended(key, false, reason, now);
        self.advance(now);
    }

    /// The child has ended, as it was ordered.
    pub fn handle_stopped(&mut self, name: &ObjectName, incarnation: Incarnation, now: Instant) {
        let Some(key) = self.present(name, incarnation) else { return };
        if matches!(self.kept(key).state, ChildPhase::Stopping { .. }) {
            self.set_state(key, ChildPhase::Down);
            self.after_end(key, now);
            self.advance(now);
        }
    }

    /// The child has recovered by itself, or could not.
    pub fn handle_reset_done(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
        outcome: Result<(), String>,
        now: Instant,
    ) {
        let Some(key) = self.present(name, incarnation) else { return };
        let ChildPhase::Resetting { call, .. } = self.kept(key).state else { return };
        match outcome {
            Ok(()) => {
                self.set_state(key, ChildPhase::Running);
                self.coming.remove(&key);
                self.grant(key, now);
                // It is answered when the others of its group are at work, too.
                self.admit(name, call, ChildTarget::Run);
            }
            Err(reason) => self.reset_failed(key, call, GiveUpReason::ResetFailed { reason }),
        }
        self.advance(now);
    }

    /// The child's incarnation ended unasked. With `restarted_as`, its guard has used its grant,
    /// and the restart is counted here.
    pub fn handle_died(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
        in_order: bool,
        restarted_as: Option<Incarnation>,
        now: Instant,
    ) {
        let Some(key) = self.present(name, incarnation) else { return };
        match restarted_as {
            Some(next) => self.restarted_on_the_spot(key, next, now),
            None => self.incarnation_ended(key, in_order, "it died".into(), now),
        }
        self.advance(now);
    }

    /// A child that is a supervisor has given up: this supervisor is the next authority.
    pub fn handle_escalated(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
        reason: String,
        now: Instant,
    ) {
        let Some(key) = self.present(name, incarnation) else { return };
        let undone = self.start_needs(key);
        self.incarnation_ended(key, false, reason.clone(), now);
        // It may have been about to leave, and is gone now.
        let failed = self.children.get(&key).is_some_and(|child| child.failed.is_some());
        if failed && undone {
            // Its children were tried as often as its rules allow.
            self.end(Some(format!("{name} could not be started: {reason}")), now);
        } else if failed
            && self.at_work()
            && let Err(why) = self.replace(key, ReplacementCause::Died, now)
        {
            let (child, reason) = (name.clone(), why.to_string());
            self.outputs.push_back(SupervisorOutput::Refused { child, incarnation, reason });
        }
        self.advance(now);
    }

    /// The actor that drives this machine restarted after a panic of its own: what was in progress
    /// is not known any more. Active children stay active; children between two states are
    /// abandoned and started again. Requests that waited are forgotten.
    pub fn handle_own_restart(&mut self, now: Instant) {
        self.outputs.clear();
        self.pending.clear();
        let going = std::mem::take(&mut self.going);
        let living: Vec<ChildKey> = self.living().collect();
        // Who has added them is not told, and removes them.
        self.children.values_mut().for_each(|child| child.joins = false);
        for key in living {
            let foretold = going.contains(&key) && self.kept(key).rules.supervises;
            let (state, in_group) = (self.kept(key).state, self.coming.contains(&key));
            match state {
                ChildPhase::Running if !foretold => {
                    self.coming.remove(&key);
                }
                ChildPhase::Resetting { .. } if !in_group => {
                    self.set_state(key, ChildPhase::Running);
                }
                ChildPhase::Unavailable if !foretold => {}
                ChildPhase::Starting { .. }
                | ChildPhase::Failing { .. }
                | ChildPhase::Stopping { .. }
                | ChildPhase::Down
                | ChildPhase::Running
                | ChildPhase::AwaitsReset { .. }
                | ChildPhase::Resetting { .. }
                | ChildPhase::Unavailable => {
                    self.abandon(key);
                    if self.at_work() && self.kept(key).goal == ChildTarget::Run {
                        self.coming.insert(key);
                    }
                    self.after_end(key, now);
                }
            }
        }
        if let Phase::Ending { .. } = self.phase {
            self.going = self.living().collect();
        }
        self.advance(now);
    }
}

impl Machine for Supervisor {
    type Output = SupervisorOutput;

    fn poll_output(&mut self) -> Option<SupervisorOutput> {
        self.outputs.pop_front()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.timed.iter().filter_map(|key| self.children[key].due()).min()
    }

    /// Gives up what children were asked to do and have not done in their time: to start, to end,
    /// to be reset.
    fn handle_timeout(&mut self, now: Instant) {
        let is_due = |key: &&ChildKey| self.children[*key].due().is_some_and(|due| due <= now);
        let overdue: Vec<ChildKey> = self.timed.iter().filter(is_due).copied().collect();
        overdue.into_iter().for_each(|key| self.handle_overdue(key, now));
        self.advance(now);
    }
}
