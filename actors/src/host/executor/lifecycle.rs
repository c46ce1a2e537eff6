//! The end of a hook, or of its time: the next state of the life cycle, and its reports.

use super::ComponentExecutor;
use super::outbox::DeferredReport;
use crate::component::{Component, Failure};
use crate::host::lifecycle::{Hook, LifecycleReport};
use crate::host::schedule::DueWork;
use blastema_contract::reports::{FaultDeclared, StateReported};
use blastema_core::{FaultKind, Lifecycle};
use std::sync::atomic::Ordering::Relaxed;

impl<C: Component> ComponentExecutor<C> {
    pub(super) fn hook_done(&mut self, hook: Hook, result: Result<(), Failure>) {
        if hook == Hook::Execute && result.is_ok() {
            // It is a sign of life, unless a test keeps that back.
            if !self.cell.record.is_silent() {
                self.slot.activity.give_sign();
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
        self.slot.activity.expect_signs(state == Lifecycle::Active);
        self.schedule.set_active(state == Lifecycle::Active);
        if state == Lifecycle::Active && !self.lifecycle.is_ending() {
            self.cell.record.announce(|listener| listener.activated());
        }
        let incarnation = self.state.incarnation;
        // States that were passed through within one poll are not reported one by one.
        if let Some(DeferredReport::State(last)) = self.outbox.last_mut()
            && last.incarnation == incarnation
            && last.reason.is_none()
            && reason.is_none()
        {
            last.state = state;
            return;
        }
        let object = self.cell.record.name.clone();
        self.outbox.push(DeferredReport::State(StateReported {
            object,
            incarnation,
            state,
            reason,
        }));
    }
}
