//! How the supervisor's children are moved: one step at a time, in order.

use super::child::{ChildKey, ChildPhase, ChildTarget, ReplacementCause, SupervisedChild};
use super::{
    CallId, ChildOrder, GiveUpReason, PENDING_LIMIT, Pending, Phase, Supervisor, SupervisorOutput,
};
use crate::recovery::{Restart, Strategy};
use crate::{Incarnation, Instant, ObjectName};

impl Supervisor {
    /// Takes the next step that is possible, and answers the requests that are decided.
    pub(super) fn advance(&mut self, now: Instant) {
        self.step(now);
        self.settle();
    }

    fn step(&mut self, now: Instant) {
        if let Some(&last) = self.going.last() {
            return self.ask_to_stop(last, now);
        }
        if let Phase::Ending { escalation } = &self.phase {
            let (phase, action) = match escalation.clone() {
                None => (Phase::Idle, SupervisorOutput::AllStopped),
                Some(reason) => {
                    let phase = Phase::Escalated { reason: reason.clone() };
                    (phase, SupervisorOutput::Escalate(reason))
                }
            };
            self.phase = phase;
            return self.outputs.push_back(action);
        }
        match self.coming.first() {
            Some(&first) => {
                // One further back may have begun before this one joined.
                let starting = self.timed.intersection(&self.coming).next().is_some();
                let at_work = self.at_work();
                let child = self.kept(first);
                match child.state {
                    _ if !at_work || starting || child.failed.is_some() => {}
                    ChildPhase::Down => self.start(first, now),
                    ChildPhase::AwaitsReset { .. } => self.reset(first, now),
                    _ => {}
                }
            }
            None if self.phase == Phase::Starting && self.is_up() => {
                self.phase = Phase::Serving;
                self.rules.whole_start = false;
                self.outputs.push_back(SupervisorOutput::AllStarted);
            }
            None => {}
        }
    }

    /// Every child that is to have an incarnation has one at work, or one that waits for what is
    /// not there yet.
    fn is_up(&self) -> bool {
        let up = |child: &SupervisedChild| match child.state {
            ChildPhase::Running
            | ChildPhase::AwaitsReset { .. }
            | ChildPhase::Resetting { .. }
            | ChildPhase::Unavailable => true,
            ChildPhase::Down
            | ChildPhase::Starting { .. }
            | ChildPhase::Failing { .. }
            | ChildPhase::Stopping { .. } => false,
        };
        self.children.values().all(|child| child.goal != ChildTarget::Run || up(child))
    }

    /// Answers every waiting request whose outcome is now known.
    pub(super) fn settle(&mut self) {
        if self.pending.is_empty() {
            return;
        }
        let pending = std::mem::take(&mut self.pending);
        for Pending { call, key, child, goal } in pending {
            match self.outcome(key, goal) {
                None => self.pending.push(Pending { call, key, child, goal }),
                Some(Ok(Some(incarnation))) if self.is_unavailable(key) => {
                    self.outputs.push_back(SupervisorOutput::Waits { call, child, incarnation });
                }
                Some(Ok(incarnation)) => {
                    let recovered = SupervisorOutput::Recovered { call, child, incarnation };
                    self.outputs.push_back(recovered);
                }
                Some(Err(why)) => self.answer_gave_up(call, child, why),
            }
        }
    }

    fn is_unavailable(&self, key: ChildKey) -> bool {
        self.children.get(&key).is_some_and(|child| child.state == ChildPhase::Unavailable)
    }

    fn outcome(
        &self,
        key: ChildKey,
        goal: ChildTarget,
    ) -> Option<Result<Option<Incarnation>, GiveUpReason>> {
        let Some(child) = self.children.get(&key) else { return Some(Ok(None)) };
        match goal {
            ChildTarget::Leave => None,
            ChildTarget::Rest if child.goal == ChildTarget::Leave => None,
            ChildTarget::Rest if child.goal != ChildTarget::Rest => {
                Some(Err(GiveUpReason::StartedAgain))
            }
            ChildTarget::Rest => (!child.is_alive()).then_some(Ok(None)),
            // It is answered when it is forgotten.
            ChildTarget::Run if child.joins && child.goal == ChildTarget::Leave => None,
            ChildTarget::Run | ChildTarget::Finished => {
                if let (Phase::Escalated { reason }, true) = (&self.phase, self.rules.root) {
                    return Some(Err(GiveUpReason::Escalated { reason: reason.clone() }));
                }
                match child.goal {
                    ChildTarget::Finished => return (!child.is_alive()).then_some(Ok(None)),
                    ChildTarget::Rest | ChildTarget::Leave => {
                        return Some(Err(GiveUpReason::Resting));
                    }
                    ChildTarget::Run => {}
                }
                if let Some(reason) = &child.failed {
                    let failed = || GiveUpReason::StartFailed { reason: reason.clone() };
                    // One that came to work has ended by another fault since.
                    return Some(
                        child.worked.then_some(Some(child.incarnation)).ok_or_else(failed),
                    );
                }
                let whole = match self.rules.strategy {
                    Strategy::OneForOne => !self.going.contains(&key),
                    Strategy::OneForAll | Strategy::RestForOne => {
                        self.going.is_empty() && (self.coming.is_empty() || self.is_held_up())
                    }
                };
                // One that ends with its supervisor is at work again when that is.
                let stays = self.phase != Phase::Leaving;
                let up = matches!(child.state, ChildPhase::Running | ChildPhase::Unavailable);
                (up && whole && stays).then_some(Ok(Some(child.incarnation)))
            }
        }
    }

    /// Whether the start is to be whole, and is not without this child.
    pub(super) fn start_needs(&self, key: ChildKey) -> bool {
        let needed = self.children[&key].rules.restart != Restart::Temporary;
        self.rules.whole_start && self.phase == Phase::Starting && needed
    }

    /// A child whose incarnation has ended in the meantime delays those behind it until the
    /// recoverer has decided on its fault. That may wait in turn for what is being answered here.
    /// So does a child that waits for a device that is not there yet.
    fn is_held_up(&self) -> bool {
        let first = self.coming.first().and_then(|key| self.children.get(key));
        first.is_some_and(|child| child.failed.is_some() || child.state == ChildPhase::Unavailable)
    }

    /// Replaces a child's incarnation, and those of its siblings as the strategy says; or says why
    /// that is not worth it any more.
    pub(super) fn replace(
        &mut self,
        key: ChildKey,
        cause: ReplacementCause,
        now: Instant,
    ) -> Result<(), GiveUpReason> {
        if self.kept(key).joins && cause != ReplacementCause::Asked {
            self.dismiss(key, ChildTarget::Leave, cause, now);
            return Ok(());
        }
        if self.kept(key).rules.restart == Restart::Temporary {
            self.dismiss(key, ChildTarget::Finished, cause, now);
            return Ok(());
        }
        let child = self.kept(key);
        if let ChildPhase::AwaitsReset { .. } = child.state {
            // The recoverer has gone on to its next action.
            self.set_state(key, ChildPhase::Running);
        }
        let child = self.kept(key);
        let waits = child.state == ChildPhase::Down && child.failed.is_none();
        let stops = matches!(child.state, ChildPhase::Stopping { .. }) || self.going.contains(&key);
        if stops {
            self.end_unanswering(key, cause, now);
        }
        if stops || (waits && self.coming.contains(&key)) {
            return Ok(());
        }
        let held_against = !matches!(cause, ReplacementCause::Behind | ReplacementCause::Asked);
        let is_worth_it = !held_against || self.count_restart(key, cause, now);
        // An incarnation that is stuck is not given up for nothing: it may move again before the
        // recoverer takes its next action.
        if is_worth_it || cause == ReplacementCause::Died || !self.at_work() {
            self.end_now(key, cause);
            if !self.kept(key).is_alive() {
                self.going.remove(&key);
            }
        }
        if !is_worth_it {
            return self.leave_failed(key, cause);
        }
        let child = self.kept(key);
        child.failed = None;
        let alive = child.is_alive();
        match self.rules.strategy {
            Strategy::OneForOne if alive => self.ask_to_stop(key, now),
            Strategy::OneForOne => self.after_end(key, now),
            Strategy::OneForAll => self.renew_from(0),
            Strategy::RestForOne => self.renew_from(key),
        }
        Ok(())
    }

    /// The restart of a child was one too many. Unless the whole supervisor ends, it is left to the
    /// recoverer's next action.
    fn leave_failed(&mut self, key: ChildKey, cause: ReplacementCause) -> Result<(), GiveUpReason> {
        if !self.at_work() {
            return Ok(());
        }
        let reason = self.excess_of(key, cause);
        let child = self.kept(key);
        if !child.is_alive() {
            child.failed = Some(reason.clone());
        }
        Err(GiveUpReason::IntensityExceeded { reason })
    }

    /// All children from `first` on, in start order, are to end and to start again. Temporary
    /// children only end, and one that is to be reset keeps its instance.
    pub(super) fn renew_from(&mut self, first: ChildKey) {
        let (mut finished, mut going) = (Vec::new(), Vec::new());
        for (&key, child) in self.children.range_mut(first..) {
            if child.goal != ChildTarget::Run {
                continue;
            }
            child.failed = None;
            let is_kept = matches!(child.state, ChildPhase::AwaitsReset { .. });
            if child.is_alive() && !is_kept {
                going.push(key);
            }
            if child.rules.restart == Restart::Temporary && !is_kept {
                child.goal = ChildTarget::Finished;
                self.coming.remove(&key);
                if !child.is_alive() {
                    finished.push(key);
                }
            } else {
                self.coming.insert(key);
            }
        }
        finished.into_iter().for_each(|key| self.order(key, ChildOrder::Retire));
        self.going.extend(going.iter().copied());
        self.announce_stops(going);
    }

    /// These are going to be stopped, each when those behind it have ended: until then a supervisor
    /// among them begins nothing that would have to be stopped again.
    pub(super) fn announce_stops(&mut self, going: Vec<ChildKey>) {
        for key in going {
            if self.children[&key].rules.supervises {
                self.order(key, ChildOrder::ExpectEnd);
            }
        }
    }

    /// Ends a child for good, or until it is started again on request.
    pub(super) fn dismiss(
        &mut self,
        key: ChildKey,
        goal: ChildTarget,
        cause: ReplacementCause,
        now: Instant,
    ) {
        let child = self.kept(key);
        if child.goal != ChildTarget::Leave {
            child.goal = if child.joins { ChildTarget::Leave } else { goal };
        }
        child.failed = None;
        self.coming.remove(&key);
        self.end_now(key, cause);
        if self.kept(key).is_alive() {
            self.ask_to_stop(key, now);
        } else {
            self.after_end(key, now);
        }
    }

    /// Ends one that would not answer the stop that it was sent, or is going to be sent.
    pub(super) fn end_unanswering(&mut self, key: ChildKey, cause: ReplacementCause, now: Instant) {
        let answers = matches!(cause, ReplacementCause::Faulty | ReplacementCause::Asked);
        if !answers && self.kept(key).is_alive() {
            self.end_now(key, cause);
            self.after_end(key, now);
        }
    }

    /// Ends an incarnation that need not, or cannot, be asked.
    pub(super) fn end_now(&mut self, key: ChildKey, cause: ReplacementCause) {
        if !self.kept(key).is_alive() {
            return;
        }
        match cause {
            ReplacementCause::Died => self.set_state(key, ChildPhase::Down),
            ReplacementCause::Stuck | ReplacementCause::Behind => self.abandon(key),
            ReplacementCause::Faulty | ReplacementCause::Asked => {}
        }
    }

    /// An incarnation has ended by itself, or has not come to be.
    pub(super) fn incarnation_ended(
        &mut self,
        key: ChildKey,
        in_order: bool,
        reason: String,
        now: Instant,
    ) {
        let child = self.kept(key);
        if child.state == ChildPhase::Down {
            return;
        }
        let may_end = child.may_end(in_order);
        let is_stopped = matches!(child.state, ChildPhase::Stopping { .. });
        let expected = is_stopped || self.going.contains(&key);
        self.set_state(key, ChildPhase::Down);
        let child = self.kept(key);
        if !expected && child.goal == ChildTarget::Run {
            if child.joins {
                (child.goal, child.failed) = (ChildTarget::Leave, Some(reason));
            } else if may_end {
                child.goal = ChildTarget::Finished;
                self.coming.remove(&key);
            } else if child.isolated && !child.worked {
                // What kept it from work has been answered by isolation while it was ending.
                child.goal = ChildTarget::Rest;
                self.coming.remove(&key);
            } else {
                child.failed = Some(reason);
            }
        }
        self.after_end(key, now);
    }

    /// What follows when an incarnation is over.
    pub(super) fn after_end(&mut self, key: ChildKey, now: Instant) {
        self.going.remove(&key);
        let alone = !self.coming.contains(&key) && self.at_work();
        let child = self.kept(key);
        match child.goal {
            ChildTarget::Leave => {
                let child = self.children.remove(&key).expect("this child was just looked at");
                self.index.remove(&child.name);
                self.coming.remove(&key);
                self.budget.forget(key);
                self.outputs.push_back(SupervisorOutput::Left(child.name));
                if child.joins {
                    self.answer_undone(key, child.failed);
                }
            }
            ChildTarget::Run if alone && child.failed.is_none() => match self.rules.strategy {
                Strategy::OneForOne => self.start(key, now),
                Strategy::OneForAll | Strategy::RestForOne => {
                    self.coming.insert(key);
                }
            },
            ChildTarget::Run => {}
            // However its last incarnation has ended, no other one serves what waits for it.
            ChildTarget::Rest | ChildTarget::Finished => self.order(key, ChildOrder::Retire),
        }
    }

    /// The supervisor ends: what has been added and has not come to work is no part of it.
    pub(super) fn undo_additions(&mut self, now: Instant) {
        let joins = self.children.iter().filter(|(_, child)| child.joins);
        for key in joins.map(|(&key, _)| key).collect::<Vec<_>>() {
            let child = self.kept(key);
            child.goal = ChildTarget::Leave;
            if !child.is_alive() {
                self.after_end(key, now);
            }
        }
    }

    fn answer_undone(&mut self, undone: ChildKey, failed: Option<String>) {
        let reason = failed.unwrap_or_else(|| "it was stopped before it was at work".to_owned());
        let waits =
            |pending: &mut Pending| pending.key == undone && pending.goal == ChildTarget::Run;
        for Pending { call, child, .. } in self.pending.extract_if(.., waits).collect::<Vec<_>>() {
            let reason = reason.clone();
            self.answer_gave_up(call, child, GiveUpReason::StartFailed { reason });
        }
    }

    pub(super) fn handle_overdue(&mut self, key: ChildKey, now: Instant) {
        let child = self.kept(key);
        let limit = child.rules.ready_within;
        match child.state {
            ChildPhase::Starting { .. } => {
                let (child, incarnation) = (child.name.clone(), child.incarnation);
                let overdue = SupervisorOutput::Overdue { child, incarnation, limit };
                self.outputs.push_back(overdue);
                self.incarnation_ended(key, false, format!("not at work within {limit:?}"), now);
            }
            ChildPhase::Failing { .. } => {
                self.order(key, ChildOrder::CutOff);
                self.incarnation_ended(key, false, "its last hooks took too long".into(), now);
            }
            ChildPhase::Stopping { .. } => {
                self.order(key, ChildOrder::CutOff);
                self.set_state(key, ChildPhase::Down);
                self.after_end(key, now);
            }
            ChildPhase::Resetting { call, .. } => {
                self.reset_failed(key, call, GiveUpReason::Overdue { limit });
            }
            ChildPhase::Down
            | ChildPhase::Running
            | ChildPhase::AwaitsReset { .. }
            | ChildPhase::Unavailable => {}
        }
    }

    /// Orders the reset that a child awaits.
    pub(super) fn reset(&mut self, key: ChildKey, now: Instant) {
        let child = self.kept(key);
        let ChildPhase::AwaitsReset { call } = child.state else { return };
        let due = now + child.rules.ready_within;
        self.set_state(key, ChildPhase::Resetting { due, call });
        self.order(key, ChildOrder::Reset);
    }

    /// The child stays in error. In a group those behind it wait until the recoverer has decided.
    pub(super) fn reset_failed(&mut self, key: ChildKey, call: CallId, why: GiveUpReason) {
        self.set_state(key, ChildPhase::Running);
        let holds_up = self.coming.contains(&key);
        let child = self.kept(key);
        child.failed = holds_up.then(|| why.to_string());
        let name = child.name.clone();
        self.answer_gave_up(call, name, why);
    }

    fn start(&mut self, key: ChildKey, now: Instant) {
        let child = self.kept(key);
        if child.incarnation != Incarnation::default() {
            child.restarts += 1;
        }
        child.incarnation = child.incarnation.next();
        child.worked = false;
        let (name, incarnation) = (child.name.clone(), child.incarnation);
        self.await_start(key, now);
        self.outputs.push_back(SupervisorOutput::Start { child: name, incarnation });
    }

    fn await_start(&mut self, key: ChildKey, now: Instant) {
        let due = now + self.kept(key).rules.ready_within;
        self.set_state(key, ChildPhase::Starting { due });
    }

    fn ask_to_stop(&mut self, key: ChildKey, now: Instant) {
        let child = self.kept(key);
        if matches!(child.state, ChildPhase::Stopping { .. }) {
            return;
        }
        let due = now + child.rules.shutdown_within;
        let wanted = child.goal == ChildTarget::Run;
        let again = wanted
            && match &self.phase {
                Phase::Starting | Phase::Serving | Phase::Leaving => true,
                // The parent restarts it, unless there is none.
                Phase::Ending { escalation: Some(_) } => !self.rules.root,
                Phase::Ending { escalation: None } | Phase::Idle | Phase::Escalated { .. } => false,
            };
        self.withdraw(key);
        self.set_state(key, ChildPhase::Stopping { due });
        self.order(key, ChildOrder::Stop { again });
    }

    pub(super) fn abandon(&mut self, key: ChildKey) {
        self.withdraw(key);
        self.set_state(key, ChildPhase::Down);
        self.order(key, ChildOrder::Abandon);
    }

    /// Every state change goes through here, so that no deadline and no waiting reset is forgotten.
    pub(super) fn set_state(&mut self, key: ChildKey, state: ChildPhase) {
        let child = self.kept(key);
        let before = std::mem::replace(&mut child.state, state);
        let works = matches!(state, ChildPhase::Running | ChildPhase::Unavailable);
        child.worked |= works;
        child.joins &= !works;
        let (timed, name) = (child.due().is_some(), child.name.clone());
        match (before, state) {
            (ChildPhase::Resetting { .. }, ChildPhase::Running)
            | (ChildPhase::AwaitsReset { .. }, ChildPhase::Resetting { .. }) => {}
            (ChildPhase::Resetting { call, .. } | ChildPhase::AwaitsReset { call }, _) => {
                self.answer_gave_up(call, name, GiveUpReason::NoIncarnation);
            }
            _ => {}
        }
        if timed {
            self.timed.insert(key);
        } else {
            self.timed.remove(&key);
        }
    }

    /// Counts a restart and says whether it is within the intensity. One that is not ends
    /// everything where no child can go on without this one.
    pub(super) fn count_restart(
        &mut self,
        key: ChildKey,
        cause: ReplacementCause,
        now: Instant,
    ) -> bool {
        let within = self.budget.add(key, now);
        if !within && (self.budget.is_shared() || self.kept(key).rules.essential) {
            let reason = self.excess_of(key, cause);
            self.end(Some(reason), now);
        } else if self.budget.left(key, now) == 0 {
            if self.budget.is_shared() {
                self.withdraw_all();
            } else {
                self.withdraw(key);
            }
        }
        within
    }

    pub(super) fn excess_of(&self, key: ChildKey, cause: ReplacementCause) -> String {
        self.children[&key].excess(cause, self.rules.intensity, self.rules.period)
    }

    pub(super) fn restarted_on_the_spot(&mut self, key: ChildKey, next: Incarnation, now: Instant) {
        let child = self.kept(key);
        (child.incarnation, child.granted) = (next, false);
        child.restarts += 1;
        if !matches!(child.state, ChildPhase::Down | ChildPhase::Stopping { .. }) {
            self.await_start(key, now);
        }
        if self.at_work() {
            self.count_restart(key, ReplacementCause::Died, now);
        }
    }

    /// All children are to end, in reverse order.
    pub(super) fn end(&mut self, escalation: Option<String>, now: Instant) {
        self.coming.clear();
        self.undo_additions(now);
        self.withdraw_all();
        self.going = self.living().collect();
        self.announce_stops(self.going.iter().copied().collect());
        for child in self.children.values_mut() {
            child.failed = None;
        }
        if let (Some(reason), true) = (&escalation, self.rules.root) {
            self.outputs.push_back(SupervisorOutput::GiveUp(reason.clone()));
        }
        self.phase = Phase::Ending { escalation };
    }

    pub(super) fn set_isolated(&mut self, key: ChildKey, isolated: bool) {
        let child = self.kept(key);
        if child.isolated != isolated {
            child.isolated = isolated;
            self.order(key, ChildOrder::Isolate(isolated));
        }
        if isolated {
            self.withdraw(key);
        }
    }

    /// Lets a child's guard restart it once by itself, where the rules and the budget allow it.
    pub(super) fn grant(&mut self, key: ChildKey, now: Instant) {
        let left = self.budget.left(key, now);
        let allowed = self.at_work() && self.rules.strategy == Strategy::OneForOne && left > 0;
        let going = self.going.contains(&key);
        let child = self.kept(key);
        let willing = child.state == ChildPhase::Running
            && child.rules.on_the_spot
            && child.rules.restart != Restart::Temporary
            && !child.isolated
            && !child.granted
            && !going;
        if allowed && willing {
            child.granted = true;
            self.order(key, ChildOrder::GrantRestart(true));
        }
    }

    fn withdraw(&mut self, key: ChildKey) {
        let child = self.kept(key);
        if std::mem::take(&mut child.granted) {
            self.order(key, ChildOrder::GrantRestart(false));
        }
    }

    pub(super) fn withdraw_all(&mut self) {
        self.for_each(Self::withdraw);
    }

    pub(super) fn for_each(&mut self, mut act: impl FnMut(&mut Self, ChildKey)) {
        let keys: Vec<ChildKey> = self.children.keys().copied().collect();
        keys.into_iter().for_each(|key| act(self, key));
    }

    pub(super) fn order(&mut self, key: ChildKey, order: ChildOrder) {
        let child = self.kept(key).name.clone();
        self.outputs.push_back(SupervisorOutput::Order { child, order });
    }

    /// Notes a request; what cannot even be noted is answered at once.
    pub(super) fn admit(
        &mut self,
        name: &ObjectName,
        call: CallId,
        goal: ChildTarget,
    ) -> Option<ChildKey> {
        let child = name.clone();
        let Some(&key) = self.index.get(name) else {
            self.answer_gave_up(call, child, GiveUpReason::Unknown);
            return None;
        };
        if self.pending.len() == PENDING_LIMIT {
            self.answer_gave_up(call, child, GiveUpReason::Full { limit: PENDING_LIMIT });
            return None;
        }
        self.pending.push(Pending { call, key, child, goal });
        Some(key)
    }

    /// Takes back what [`admit`](Self::admit) has just noted.
    pub(super) fn refuse(&mut self, call: CallId, why: GiveUpReason) {
        if let Some(Pending { child, .. }) = self.pending.pop() {
            self.answer_gave_up(call, child, why);
        }
    }

    pub(super) fn answer_gave_up(&mut self, call: CallId, child: ObjectName, why: GiveUpReason) {
        self.outputs.push_back(SupervisorOutput::GaveUp { call, child, why });
    }

    /// The child that a report is about, unless the report is about an earlier incarnation.
    pub(super) fn present(
        &mut self,
        name: &ObjectName,
        incarnation: Incarnation,
    ) -> Option<ChildKey> {
        let &key = self.index.get(name)?;
        let child = self.kept(key);
        let is_present = incarnation >= child.incarnation;
        child.incarnation = child.incarnation.max(incarnation);
        is_present.then_some(key)
    }

    pub(super) fn living(&self) -> impl Iterator<Item = ChildKey> + '_ {
        self.children.iter().filter(|(_, child)| child.is_alive()).map(|(&key, _)| key)
    }

    pub(super) fn at_work(&self) -> bool {
        matches!(self.phase, Phase::Starting | Phase::Serving)
    }

    pub(super) fn kept(&mut self, key: ChildKey) -> &mut SupervisedChild {
        self.children.get_mut(&key).expect("a key in use belongs to a child")
    }
}
