//! Where components, guards and middleware actors report exits, states and faults.

use crate::runtime::guardian;
use actix::Recipient;
use blastema_contract::reports::{DeclaredFaultCleared, Exited, FaultDeclared, StateReported};
use blastema_core::net::QUIET;
use blastema_core::{FaultKind, ObjectName};
use std::time::Duration;

/// The recipients of what guards and components report. A report without a recipient is dropped.
#[derive(Clone, Default)]
pub(crate) struct FaultReports {
    pub(crate) exits: Option<Recipient<Exited>>,
    pub(crate) states: Option<Recipient<StateReported>>,
    pub(crate) faults: Option<Recipient<FaultDeclared>>,
    pub(crate) cleared: Option<Recipient<DeclaredFaultCleared>>,
}

impl FaultReports {
    /// An object declares a fault.
    pub(crate) fn send(&self, fault: FaultDeclared) {
        if let Some(faults) = &self.faults {
            faults.do_send(fault);
        }
    }

    /// A fault that an object had declared is over.
    pub(crate) fn send_cleared(&self, fault: DeclaredFaultCleared) {
        if let Some(cleared) = &self.cleared {
            cleared.do_send(fault);
        }
    }

    /// A failed check of one of the middleware's own objects.
    pub(crate) fn declare(&self, object: &str, detail: String) {
        if let Ok(object) = ObjectName::new(object) {
            FaultReporter::new(object, self.clone()).declare(FaultKind::CheckFailed, detail);
        }
    }

    /// What was [declared](Self::declare) of one of the middleware's own objects is over.
    pub(crate) fn clear(&self, object: &str) {
        if let Ok(object) = ObjectName::new(object) {
            FaultReporter::new(object, self.clone()).clear(FaultKind::CheckFailed);
        }
    }
}

/// Declares the faults of one of the middleware's own objects, and takes them back.
#[derive(Clone)]
pub(crate) struct FaultReporter {
    object: ObjectName,
    reports: FaultReports,
}

impl FaultReporter {
    pub(crate) fn new(object: ObjectName, reports: FaultReports) -> Self {
        FaultReporter { object, reports }
    }

    /// Something is wrong.
    pub(crate) fn declare(&self, kind: FaultKind, detail: String) {
        self.declare_for(None, kind, detail);
    }

    /// The same, where the fault ends when it was not declared for a minute.
    pub(crate) fn declare_passing(&self, kind: FaultKind, detail: String) {
        self.declare_for(Some(QUIET), kind, detail);
    }

    fn declare_for(&self, hold: Option<Duration>, kind: FaultKind, detail: String) {
        let (object, incarnation) = (self.object.clone(), guardian::alive().incarnation);
        self.reports.send(FaultDeclared { object, incarnation, kind, detail, hold });
    }

    /// All that was wrong of this kind is over.
    pub(crate) fn clear(&self, kind: FaultKind) {
        let (object, incarnation) = (self.object.clone(), guardian::alive().incarnation);
        self.reports.send_cleared(DeclaredFaultCleared { object, incarnation, kind });
    }
}
