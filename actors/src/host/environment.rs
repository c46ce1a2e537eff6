//! What a node gives every component: whom its guard tells, where it lives, whom it finds.

use super::arbiters::ArbiterPool;
use super::office::DeadLetterLog;
use super::watch::SampledComponents;
use crate::claim::GlobalNameTable;
use crate::lease::ActuatorTable;
use crate::parameters::Configured;
use crate::registry::Registry;
use crate::service::Roster;
use crate::topic::Topics;
use crate::variable::VariableStore;
use actix::Recipient;
use blastema_contract::reports::{DeclaredFaultCleared, Exited, FaultDeclared, StateReported};
use blastema_core::suggestion::nearest;
use blastema_core::{FaultKind, ObjectName};
use std::collections::BTreeSet;
use std::sync::Arc;
use tracing::error;

/// Who is told what guards and components report. Whoever is not named is not told.
#[derive(Clone, Default)]
pub(crate) struct FaultReports {
    pub(crate) exits: Option<Recipient<Exited>>,
    pub(crate) states: Option<Recipient<StateReported>>,
    pub(crate) faults: Option<Recipient<FaultDeclared>>,
    pub(crate) mended: Option<Recipient<DeclaredFaultCleared>>,
}

/// What all components of a node share. Clones share it too.
#[derive(Clone)]
pub(crate) struct ComponentEnvironment {
    pub(crate) reports: FaultReports,
    pub(crate) arbiters: ArbiterPool,
    pub(crate) registry: Registry,
    pub(crate) topics: Topics,
    pub(crate) dead_letters: DeadLetterLog,
    pub(crate) watch_list: SampledComponents,
    pub(crate) variables: VariableStore,
    pub(crate) parameters: Configured,
    pub(crate) actuators: ActuatorTable,
    pub(crate) services: Roster,
    pub(crate) names: GlobalNameTable,
    /// The codes of the application's own list of faults.
    pub(crate) fault_codes: Arc<BTreeSet<Arc<str>>>,
}

impl FaultReports {
    /// A fault of one of the middleware's own objects.
    pub(crate) fn declare(&self, object: &str, detail: String) {
        if let (Some(faults), Ok(object)) = (&self.faults, ObjectName::new(object)) {
            let (incarnation, kind) =
                (crate::guardian::alive().incarnation, FaultKind::CheckFailed);
            faults.do_send(FaultDeclared { object, incarnation, kind, detail });
        }
    }

    /// What was [declared](Reports::declare) of one of the middleware's own objects is over.
    pub(crate) fn mend(&self, object: &str) {
        if let (Some(mended), Ok(object)) = (&self.mended, ObjectName::new(object)) {
            let (incarnation, kind) =
                (crate::guardian::alive().incarnation, FaultKind::CheckFailed);
            mended.do_send(DeclaredFaultCleared { object, incarnation, kind });
        }
    }
}

/// Under this name stands what is wrong with the variables' file.
pub(crate) const KEPT_VARIABLES: &str = "variables";

impl ComponentEnvironment {
    /// What is told of a fault of the application's own, and that nobody declared its code.
    pub(crate) fn checked_detail(&self, code: &str, detail: String) -> String {
        if self.fault_codes.contains(code) {
            return detail;
        }
        let known: Vec<&str> = self.fault_codes.iter().map(|known| &**known).collect();
        let listed = match known.as_slice() {
            [] => "none is declared".to_owned(),
            known => format!("declared are {}", known.join(", ")),
        };
        let hint = nearest(code, known).map(|known| format!("; did you mean {known:?}?"));
        let hint = hint.unwrap_or_default();
        let text = format!("the code {code:?} was never declared, {listed}{hint}");
        error!(code, "a fault is only observed: {text}");
        match detail.is_empty() {
            true => text,
            false => format!("{detail} ({text})"),
        }
    }

    /// What was wrong with values that were to be restored.
    pub(crate) fn declare_complaints(&self) {
        let complaints = self.variables.complaints();
        complaints.into_iter().for_each(|detail| self.reports.declare(KEPT_VARIABLES, detail));
    }

    /// An environment of its own, whose components live on `arbiters`.
    pub(crate) fn new(arbiters: ArbiterPool, reports: FaultReports) -> Self {
        let dead_letters = DeadLetterLog::default();
        let topics = Topics::new(dead_letters.clone(), reports.clone());
        ComponentEnvironment {
            reports,
            arbiters,
            registry: Registry::default(),
            topics,
            dead_letters,
            watch_list: SampledComponents::default(),
            variables: VariableStore::default(),
            parameters: Configured::default(),
            actuators: ActuatorTable::default(),
            services: Roster::default(),
            names: GlobalNameTable::default(),
            fault_codes: Arc::default(),
        }
    }
}
