//! The parts of a node that every component uses: fault reports, arbiters, the registry.

use crate::arbiter::pool::ArbiterPool;
use crate::liveness::sampler::SampledComponents;
use crate::messaging::dead_letters::DeadLetterLog;
use crate::registry::Registry;
use crate::runtime::reports::FaultReports;
use crate::settings::FAULT_HOLD;
use blastema_contract::reports::FaultDeclared;
use blastema_core::suggestion::nearest;
use blastema_core::{FaultKind, ObjectName};
use std::any::Any;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::AtomicU64;
use tracing::error;

/// What all components of a node share.
pub(crate) struct ComponentEnvironment {
    pub(crate) reports: FaultReports,
    pub(crate) arbiters: ArbiterPool,
    pub(crate) registry: Registry,
    pub(crate) dead_letters: DeadLetterLog,
    pub(crate) watch_list: SampledComponents,
    /// The codes of the application's own list of faults.
    pub(crate) fault_codes: Arc<BTreeSet<Arc<str>>>,
    /// What the features of the node keep for it: one value of each type.
    pub(crate) features: Vec<Box<dyn Any + Send + Sync>>,
    /// The longest `shutdown_within` of a component, in milliseconds.
    pub(crate) longest_stop_ms: AtomicU64,
    /// Incarnations that ended without the hooks of their stop.
    pub(crate) cut_short: AtomicU64,
}

impl ComponentEnvironment {
    /// What a feature keeps for the node, such as its topics or its variables.
    pub(crate) fn feature<T: Any>(&self) -> &T {
        let found = self.features.iter().find_map(|feature| feature.downcast_ref());
        found.expect("a node registers every feature before its first component")
    }

    /// Returns the detail of an application's fault, with a note if its code was not declared.
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

    /// The component on this thread has waited in vain for this one: it is a fault if they wait for
    /// each other.
    pub(crate) fn report_circle(&self, asked: &ObjectName) {
        let Some((incarnation, circle)) = self.watch_list.circle(asked) else { return };
        let object = circle[0].clone();
        let names: Vec<&str> = circle.iter().chain([&object]).map(ObjectName::as_str).collect();
        let detail = format!(
            "components wait for each other until their deadlines: {}; reply before asking, or `tell`",
            names.join(" asks ")
        );
        let (kind, hold) = (FaultKind::CheckFailed, Some(FAULT_HOLD));
        self.reports.send(FaultDeclared { object, incarnation, kind, detail, hold });
    }

    /// An environment of its own, whose components live on `arbiters`.
    pub(crate) fn new(arbiters: ArbiterPool, reports: FaultReports) -> Self {
        ComponentEnvironment {
            reports,
            arbiters,
            registry: Registry::default(),
            dead_letters: DeadLetterLog::default(),
            watch_list: SampledComponents::default(),
            fault_codes: Arc::default(),
            features: Vec::new(),
            longest_stop_ms: AtomicU64::new(0),
            cut_short: AtomicU64::new(0),
        }
    }
}
