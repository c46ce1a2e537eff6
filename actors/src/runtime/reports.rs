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

    /// A fault of one of the middleware's own objects.
    pub(crate) fn declare(&self, object: &str, detail: String) {
        if let Ok(object) = ObjectName::new(object) {
            self.declare_kind(object, FaultKind::CheckFailed, detail);
        }
    }

    /// The same, where it is of this kind.
    pub(crate) fn declare_kind(&self, object: ObjectName, kind: FaultKind, detail: String) {
        let incarnation = guardian::alive().incarnation;
        self.send(FaultDeclared { object, incarnation, kind, detail, hold: None });
    }

    /// What was [declared](Self::declare) of one of the middleware's own objects is over.
    pub(crate) fn clear(&self, object: &str) {
        if let Ok(object) = ObjectName::new(object) {
            self.clear_kind(object, FaultKind::CheckFailed);
        }
    }

    /// The same, where it was of this kind.
    pub(crate) fn clear_kind(&self, object: ObjectName, kind: FaultKind) {
        let incarnation = guardian::alive().incarnation;
        self.send_cleared(DeclaredFaultCleared { object, incarnation, kind });
    }
}
