//! Where components, guards and middleware actors report exits, states and faults.

use crate::runtime::guardian;
use actix::Recipient;
use blastema_contract::reports::{DeclaredFaultCleared, Exited, FaultDeclared, StateReported};
use blastema_core::{FaultKind, ObjectName};

/// The recipients of what guards and components report. A report without a recipient is dropped.
#[derive(Clone, Default)]
pub(crate) struct FaultReports {
    pub(crate) exits: Option<Recipient<Exited>>,
    pub(crate) states: Option<Recipient<StateReported>>,
    pub(crate) faults: Option<Recipient<FaultDeclared>>,
    pub(crate) cleared: Option<Recipient<DeclaredFaultCleared>>,
}

impl FaultReports {
    /// A fault of one of the middleware's own objects.
    pub(crate) fn declare(&self, object: &str, detail: String) {
        if let (Some(faults), Ok(object)) = (&self.faults, ObjectName::new(object)) {
            let (incarnation, kind) = (guardian::alive().incarnation, FaultKind::CheckFailed);
            faults.do_send(FaultDeclared { object, incarnation, kind, detail, hold: None });
        }
    }

    /// What was [declared](Reports::declare) of one of the middleware's own objects is over.
    pub(crate) fn clear(&self, object: &str) {
        if let (Some(cleared), Ok(object)) = (&self.cleared, ObjectName::new(object)) {
            let (incarnation, kind) = (guardian::alive().incarnation, FaultKind::CheckFailed);
            cleared.do_send(DeclaredFaultCleared { object, incarnation, kind });
        }
    }
}
