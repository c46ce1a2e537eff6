//! What few components come to use.

use crate::component::declaration::CellListener;
use crate::liveness::lateness::LatenessHistogram;
use crate::messaging::injection::InjectionState;
use crate::platform::lock;
use blastema_core::delivery::quarantine::Quarantine;
use blastema_core::{DeliveryError, Incarnation, MessageId};
use std::sync::{Arc, Mutex, OnceLock};

/// What few components come to use. A component has it once it has used any of it.
#[derive(Default)]
pub(crate) struct ColdState {
    pub(crate) injected: InjectionState,
    /// There once the component has had a round.
    pub(crate) lateness: OnceLock<Box<LatenessHistogram>>,
    quarantine: Mutex<Quarantine>,
    listeners: Mutex<Vec<Arc<dyn CellListener>>>,
    /// The fault for which the component is isolated.
    isolated_because: Mutex<Option<String>>,
}

impl ColdState {
    /// Reports to a feature what becomes of the component.
    pub(super) fn listen(&self, listener: impl CellListener + 'static) {
        lock(&self.listeners).push(Arc::new(listener));
    }

    /// Reports to the features.
    pub(super) fn announce(&self, what: impl Fn(&(dyn CellListener + 'static))) {
        let listeners = lock(&self.listeners).clone();
        listeners.iter().for_each(|listener| what(&**listener));
    }

    /// A message has killed an incarnation. Returns whether any message is quarantined now.
    pub(super) fn record_kill(&self, id: MessageId, incarnation: Incarnation) -> bool {
        let mut quarantine = lock(&self.quarantine);
        quarantine.handle_kill(id, incarnation);
        quarantine.is_active()
    }

    /// The component is isolated from now on, or soon, for this reason.
    pub(crate) fn explain_isolation(&self, reason: Option<String>) {
        *lock(&self.isolated_because) = reason;
    }

    /// Why the component is isolated, where that is known.
    pub(super) fn isolated_because(&self) -> Option<String> {
        lock(&self.isolated_because).clone()
    }

    /// Why this message is refused, where it is quarantined.
    pub(super) fn refusal(&self, id: MessageId) -> Option<DeliveryError> {
        let kills = lock(&self.quarantine).refuses(id)?;
        Some(DeliveryError::Quarantined { kills })
    }
}
