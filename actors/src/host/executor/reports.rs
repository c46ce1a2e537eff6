//! The reports of what becomes of a component, kept until the poll is over.

use crate::component::cell::CellCore;
use actix::Recipient;
use blastema_contract::child::{ChildEvent, ChildReport};
use blastema_contract::reports::{Exited, FaultDeclared, StateReported};
use blastema_core::Incarnation;
use std::sync::Arc;

/// Reported when the poll is over, so that the replacement's first message does not wait for it.
pub(super) enum DeferredReport {
    Exited(Exited),
    State(StateReported),
    Declared(FaultDeclared),
    Child(ChildEvent, Incarnation),
}

/// The reports of one executor, in the order in which they are sent.
pub(super) struct ReportOutbox {
    reports: Vec<DeferredReport>,
    pub(super) supervisor: Arc<Recipient<ChildReport>>,
}

impl ReportOutbox {
    pub(super) fn new(supervisor: Arc<Recipient<ChildReport>>) -> Self {
        ReportOutbox { reports: Vec::new(), supervisor }
    }

    #[inline]
    pub(super) fn is_empty(&self) -> bool {
        self.reports.is_empty()
    }

    pub(super) fn push(&mut self, report: DeferredReport) {
        self.reports.push(report);
    }

    /// States that were passed through within one poll are not reported one by one.
    pub(super) fn push_state(&mut self, report: StateReported) {
        if let Some(DeferredReport::State(last)) = self.reports.last_mut()
            && last.incarnation == report.incarnation
            && last.reason.is_none()
            && report.reason.is_none()
        {
            last.state = report.state;
            return;
        }
        self.push(DeferredReport::State(report));
    }

    /// Keeps only the ends of incarnations before this one.
    pub(super) fn retain_deaths_before(&mut self, present: Incarnation) {
        self.reports.retain(
            |report| matches!(report, DeferredReport::Exited(of) if of.incarnation < present),
        );
    }

    /// Sends all reports.
    pub(super) fn send(&mut self, record: &CellCore) {
        let to = &record.environment.reports;
        // Taken, not drained: an outbox without reports keeps no memory for them.
        for report in std::mem::take(&mut self.reports) {
            match report {
                DeferredReport::Exited(exited) => {
                    to.exits.iter().for_each(|to| to.do_send(exited.clone()));
                }
                DeferredReport::State(state) => {
                    to.states.iter().for_each(|to| to.do_send(state.clone()));
                }
                DeferredReport::Declared(declared) => to.send(declared),
                DeferredReport::Child(event, incarnation) => {
                    let object = record.name.clone();
                    self.supervisor.do_send(ChildReport { object, incarnation, event });
                }
            }
        }
    }
}
