//! What an object of the network declares as a fault of its own, and takes back.

use crate::runtime::guardian::alive;
use actix::prelude::*;
use blastema_contract::reports::{DeclaredFaultCleared, FaultDeclared};
use blastema_core::net::QUIET;
use blastema_core::{FaultKind, ObjectName};
use std::time::Duration;

/// Reports the faults of one object of the network. Without recipients, reports are dropped.
#[derive(Clone)]
pub(crate) struct FaultReporter {
    object: ObjectName,
    declared: Option<Recipient<FaultDeclared>>,
    cleared: Option<Recipient<DeclaredFaultCleared>>,
}

impl FaultReporter {
    /// Of the object with this name within the network.
    pub(crate) fn of(
        object: &str,
        declared: Option<Recipient<FaultDeclared>>,
        cleared: Option<Recipient<DeclaredFaultCleared>>,
    ) -> Self {
        FaultReporter { object: super::named(object), declared, cleared }
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
        if let Some(declared) = &self.declared {
            let (object, incarnation) = (self.object.clone(), alive().incarnation);
            declared.do_send(FaultDeclared { object, incarnation, kind, detail, hold });
        }
    }

    /// All that was wrong of this kind is over.
    pub(crate) fn clear(&self, kind: FaultKind) {
        if let Some(cleared) = &self.cleared {
            let (object, incarnation) = (self.object.clone(), alive().incarnation);
            cleared.do_send(DeclaredFaultCleared { object, incarnation, kind });
        }
    }
}
