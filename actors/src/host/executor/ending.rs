//! How hooks and incarnations end, and what follows: the next state of the life cycle, a
//! replacement on the spot, or rest.

use super::ComponentExecutor;
use super::reports::DeferredReport;
use super::service::Service;
use crate::component::cell::Blame;
use crate::component::incarnation::{DeferredCommands, IncarnationState};
use crate::component::{Component, Failure};
use crate::host::lifecycle::{EndReason, Hook, IncarnationLifecycle, LifecycleReport, StopOrder};
use crate::host::schedule::DueWork;
use crate::liveness::label;
use crate::messaging::death_watch::DownReason;
use crate::platform::panics;
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::{ExitReason, Exited, FaultDeclared, StateReported};
use blastema_core::{DeliveryError, FaultKind, Incarnation, Lifecycle};
use std::any::Any;
use std::rc::Rc;
use std::sync::atomic::Ordering::Relaxed;

impl<C: Component> ComponentExecutor<C> {
    /// What the component's own runs outside of the executor's polls has panicked: a handler or a
    /// condition at a hub. Gives the panic back where the incarnation is over already: it has one
    /// end.
    pub(crate) fn die_of(
        &mut self,
        payload: Box<dyn Any + Send>,
        during: &'static str,
    ) -> Option<Box<dyn Any + Send>> {
        if self.over {
            return Some(payload);
        }
        self.died(payload, during);
        // The hub's turn may be long: what follows in it is another's.
        self.flush();
        self.control.wake(); // The replacement begins in the executor's own poll.
        None
    }

    /// The name of what is in service, or was last.
    pub(crate) fn in_service(&self) -> &'static str {
        self.service.name()
    }

    /// This incarnation has ended by a panic. Begins the next one where the supervisor has granted
    /// that.
    #[cold]
    pub(super) fn died(&mut self, payload: Box<dyn Any + Send>, during: &'static str) {
        let panics::PanicRecord { text, at } = panics::read(payload);
        let exit = ExitReason::Panicked { text, at, during };
        if self.service.slot.activity.is_busy() {
            self.service.slot.activity.step();
        }
        if self.lifecycle.is_ending() {
            self.cell.record.environment.cut_short.fetch_add(1, Relaxed);
        }
        let incarnation = self.state.incarnation;
        self.state.token.end();
        self.lose_message();
        self.dispose_of_all(Blame::Log);
        // The grant is the present incarnation's, and not of one that was abandoned.
        let may_restart = !self.lifecycle.is_ending()
            && self.cell.queue.owner() == Some(incarnation)
            && self.cell.record.take_grant();
        let restarted_as = may_restart.then(|| incarnation.next());
        let mine = match restarted_as {
            Some(next) => self.cell.queue.pass_on(incarnation, next),
            None => self.cell.queue.leave(incarnation),
        };
        if !mine {
            return self.leave(); // It had been abandoned before: its report is not awaited.
        }
        match restarted_as {
            Some(next) => {
                self.state = Rc::new(IncarnationState::new(next, self.service.slot.activity));
                self.lifecycle = IncarnationLifecycle::new();
                self.begin_incarnation();
                self.cell.attach(false);
            }
            None => self.over = true,
        }
        self.report_exit(incarnation, exit, restarted_as);
    }

    /// What is being served ends with the incarnation: its sender is notified, and it is a dead
    /// letter.
    pub(super) fn lose_message(&mut self) {
        let Service::Message { .. } = self.service.current else { return };
        let (record, incarnation) = (&self.cell.record, self.state.incarnation);
        let contract = self.in_service();
        record.record_fatal_message(incarnation);
        let why = DeliveryError::PeerDied { incarnation };
        record.record_dead_letter(contract, &why);
    }

    /// Reports how an incarnation has ended to the monitor, the supervisor, and the watchers.
    pub(super) fn report_exit(
        &mut self,
        incarnation: Incarnation,
        exit: ExitReason,
        restarted_as: Option<Incarnation>,
    ) {
        let record = &self.cell.record;
        record.announce(|listener| match restarted_as {
            Some(_) => listener.left_work(false),
            None => listener.deactivated(),
        });
        record.tell_watchers(incarnation, DownReason::from(&exit));
        let starting = self.lifecycle.is_starting() && restarted_as.is_none();
        let event = match (&exit, self.lifecycle.take_start_failure()) {
            // One that has not come to work does not die in addition.
            (_, Some(reason)) => ChildEvent::StartFailed { reason },
            (ExitReason::Stopped | ExitReason::Fatal, None)
                if self.lifecycle.stop_order().is_some() =>
            {
                ChildEvent::Stopped
            }
            (ExitReason::Panicked { text, at, .. }, None) if starting => {
                ChildEvent::StartFailed { reason: format!("it panicked at {at}: {text}") }
            }
            _ => ChildEvent::Died { exit: exit.clone(), restarted_as },
        };
        // It is reported when the turn is over: the replacement's first reply does not wait for
        // that.
        let object = record.name.clone();
        let exited = Exited { object, incarnation, exit, restarted_as };
        self.outbox.push(DeferredReport::Exited(exited));
        self.outbox.push(DeferredReport::Child(event, incarnation));
    }

    /// The incarnation ends without a panic, its hooks done.
    pub(super) fn end(&mut self, end: EndReason) {
        let incarnation = self.state.incarnation;
        self.over = true;
        if end != EndReason::Fatal {
            // Those that it had no time to stop are cut off.
            self.cell.record.leave_work();
        }
        self.state.token.end();
        self.dispose_of_all(if end == EndReason::Fatal { Blame::Log } else { Blame::Fault });
        if self.cell.queue.owner() != Some(incarnation) {
            return self.leave(); // It was abandoned while what is the user's was dropped.
        }
        if self.lifecycle.stop_order() == Some(StopOrder::Stop) {
            self.cell.end_by(incarnation);
        } else {
            self.cell.queue.leave(incarnation);
        }
        let exit = match end {
            EndReason::Stopped => ExitReason::Stopped,
            EndReason::Returned => ExitReason::Returned,
            EndReason::Fatal => ExitReason::Fatal,
        };
        self.cell.record.set_state(Lifecycle::Finalized);
        self.report_exit(incarnation, exit, None);
    }

    /// Drops what is the user's: its `Drop` may panic, but not while unwinding and not into actix.
    pub(super) fn dispose_of_all(&mut self, blame: Blame) {
        self.service.dispose(&self.cell.record, blame);
        let record = &self.cell.record;
        let DeferredCommands { tasks, .. } = self.state.take_wishes();
        tasks.into_iter().for_each(|task| record.dispose("a task", task, blame));
        let (tasks, timers) = self.schedule.clear();
        timers.into_iter().for_each(|action| record.dispose(label::TIMER.name, action, blame));
        tasks.into_iter().for_each(|task| record.dispose("a task", task, blame));
        record.dispose("the component", self.component.take(), blame);
    }

    /// This incarnation was abandoned, and the next one begins or has begun.
    pub(super) fn is_abandoned(&self) -> bool {
        self.state.token.has_ended() && !self.over
    }

    /// Ends without a report, after having been given up. Who gave this incarnation up knows of its
    /// end, but perhaps not yet of those before it.
    pub(super) fn leave(&mut self) {
        self.over = true;
        self.dispose_of_all(Blame::Log);
        self.outbox.retain_deaths_before(self.state.incarnation);
        self.flush();
        if self.arbiter.heartbeat.is_lost() {
            self.arbiter.return_late();
        } else {
            self.arbiter.heartbeat.lift();
        }
    }

    /// The future is dropped: after its end, or because its arbiter goes away.
    pub(super) fn drop_before_the_end(&mut self) {
        if self.over {
            // It may have ended at a hub, and the arbiter goes away before the executor's next
            // turn.
            return self.flush();
        }
        // Those that stand on a lost thread have been found, and their supervisors are about to
        // give them up: that the thread returns meanwhile is no second fault.
        if self.is_abandoned() || self.arbiter.heartbeat.is_lost() {
            return self.leave();
        }
        let incarnation = self.state.incarnation;
        self.over = true;
        self.state.token.end();
        self.lose_message();
        self.dispose_of_all(Blame::Log);
        self.cell.queue.leave(incarnation);
        self.report_exit(incarnation, ExitReason::Aborted, None);
        self.flush();
    }

    pub(super) fn hook_done(&mut self, hook: Hook, result: Result<(), Failure>) {
        if hook == Hook::Execute && result.is_ok() {
            // It is a sign of life, unless a test keeps that back.
            if !self.cell.record.is_silent() {
                self.service.slot.activity.give_sign();
            }
        }
        if hook == Hook::Deactivated || result.is_err() {
            self.cell.record.announce(|listener| listener.left_work(result.is_ok()));
        }
        self.lifecycle.handle_done(hook, result);
        self.pass_reports();
    }

    /// The component leaves work: has its actuators stopped, and says whether they are at rest, and
    /// what follows may begin.
    pub(super) fn is_settled(&mut self) -> bool {
        let record = &self.cell.record;
        let settled = self.state.settled.get().unwrap_or_else(|| {
            let within = record.leave_work();
            if !within.is_zero() {
                self.schedule.limit(DueWork::SettleLimit, within);
            }
            within.is_zero()
        });
        self.state.settled.set(Some(settled));
        // An isolated component takes no command.
        settled && (!self.cell.queue.has_notices() || record.is_isolated())
    }

    /// Passes on what the lifecycle has to tell, and keeps the rest of the host in step with it.
    pub(super) fn pass_reports(&mut self) {
        if self.is_abandoned() {
            return; // What it says of the component would be said of the next incarnation.
        }
        while let Some(report) = self.lifecycle.poll_report() {
            match report {
                LifecycleReport::State(state, reason) => self.enter(state, reason),
                LifecycleReport::Unavailable { reason, retry_in } => {
                    self.schedule.limit(DueWork::Retry, retry_in);
                    self.cell.record.set_unavailable(&reason);
                    let object = self.cell.record.name.clone();
                    let (incarnation, kind) = (self.state.incarnation, FaultKind::Unavailable);
                    let declared =
                        FaultDeclared { object, incarnation, kind, detail: reason, hold: None };
                    self.outbox.push(DeferredReport::Declared(declared));
                }
                LifecycleReport::Child(event) => {
                    self.schedule.cancel_limit(DueWork::ReadyLimit);
                    self.outbox.push(DeferredReport::Child(event, self.state.incarnation));
                }
            }
        }
        if self.lifecycle.is_ending() {
            // Also of a failure, which its supervisor has not ordered to stop.
            self.schedule.limit(DueWork::StopLimit, self.cell.record.limits.shutdown_within);
        }
    }

    /// Ends what has taken longer than it may.
    pub(super) fn handle_limits(&mut self) {
        if self.schedule.take_limit(DueWork::Retry) && self.lifecycle.handle_retry() {
            self.schedule.limit(DueWork::ReadyLimit, self.cell.record.limits.ready_within);
        }
        if self.schedule.take_limit(DueWork::ReadyLimit) && self.lifecycle.is_starting() {
            self.drop_service();
            let within = self.cell.record.limits.ready_within;
            self.lifecycle.handle_fatal(format!("it was not ready within {within:?}"));
            self.pass_reports();
        }
        if self.schedule.take_limit(DueWork::SettleLimit) {
            self.state.settled.set(Some(true));
        }
        if self.schedule.take_limit(DueWork::StopLimit)
            && let Some(end) = self.lifecycle.end_reason()
        {
            let within = self.cell.record.limits.shutdown_within;
            self.cell.record.environment.cut_short.fetch_add(1, Relaxed);
            // A caller that gives it no time at all wants it cut off.
            if !within.is_zero() {
                self.lifecycle.handle_cut_off(self.in_service(), within);
                self.pass_reports();
            }
            self.drop_service();
            self.end(end);
        }
    }

    fn enter(&mut self, state: Lifecycle, reason: Option<String>) {
        self.cell.record.set_state(state);
        self.state.settled.set(None);
        self.schedule.cancel_limit(DueWork::SettleLimit);
        if matches!(state, Lifecycle::Error | Lifecycle::Fatal) {
            self.cell.record.announce(|listener| listener.left_work(false));
        }
        self.service.slot.activity.expect_signs(state == Lifecycle::Active);
        self.schedule.set_active(state == Lifecycle::Active);
        if state == Lifecycle::Active && !self.lifecycle.is_ending() {
            self.cell.record.announce(|listener| listener.activated());
        }
        let (object, incarnation) = (self.cell.record.name.clone(), self.state.incarnation);
        self.outbox.push_state(StateReported { object, incarnation, state, reason });
    }

    pub(super) fn flush(&mut self) {
        if !self.outbox.is_empty() {
            self.outbox.send(&self.cell.record);
        }
    }
}
