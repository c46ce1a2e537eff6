//! The fault *forbidden*: what peers may not do here, and what this node may not do at peers.

use crate::platform;
use crate::registry::access::AccessControl;
use crate::runtime::reports::FaultReporter;
use blastema_core::net::trust::access::REFUSAL_REMINDER;
use blastema_core::{DeliveryError, FaultKind, Instant};
use tracing::error;

/// The fault *forbidden* of the gateway.
#[derive(Default)]
pub(super) struct ForbiddenAlarm {
    /// It was declared, and not cleared since.
    stands: bool,
    /// When a peer was refused something for the last time, at the last look.
    last_refusal: Option<Instant>,
}

impl ForbiddenAlarm {
    /// A peer refuses a subscription of this node.
    pub(super) fn refused(&mut self, why: &DeliveryError, faults: &FaultReporter) {
        error!("no event arrives: {why}");
        self.stands = true;
        faults.declare(FaultKind::Forbidden, format!("no event arrives: {why}"));
    }

    /// Declares what was refused since the last look, and clears the fault when nothing was for a
    /// minute, and no peer refuses a subscription now.
    pub(super) fn look(
        &mut self,
        access: &AccessControl,
        is_refused: bool,
        faults: &FaultReporter,
    ) {
        if let Some(row) = access.newest_of_a_program()
            && self.last_refusal.replace(row.last) != Some(row.last)
            && !std::mem::replace(&mut self.stands, true)
        {
            let detail =
                format!("refused {} times: {}", row.times, DeliveryError::from(&row.denied));
            faults.declare(FaultKind::Forbidden, detail);
        }
        let is_over = |last: Instant| platform::now() >= last + REFUSAL_REMINDER;
        if self.stands && !is_refused && self.last_refusal.is_none_or(is_over) {
            self.stands = false;
            faults.clear(FaultKind::Forbidden);
        }
    }
}
