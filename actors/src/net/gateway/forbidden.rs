//! What peers may not do here, and what this node may not do at peers.

use super::ObjectGateway;
use crate::net::keys::NodeKeys;
use crate::platform;
use blastema_contract::session::DirectoryReport;
use blastema_core::net::NodeId;
use blastema_core::net::trust::access::REFUSAL_REMINDER;
use blastema_core::sorted::SortedSet;
use blastema_core::{DeliveryError, FaultKind, Instant};
use tracing::error;

/// The fault *forbidden* of the gateway.
#[derive(Default)]
pub(super) struct ForbiddenAlarm {
    /// It was declared, and not cleared since.
    stands: bool,
    /// When a peer was refused something for the last time, at the last look.
    last_refusal: Option<Instant>,
    /// Peers that refuse a subscription of this node.
    refused_by: SortedSet<NodeId>,
}

impl ObjectGateway {
    /// A peer refuses a subscription of this node.
    pub(super) fn subscription_forbidden(&mut self, peer: NodeId, why: &DeliveryError) {
        error!("no event arrives: {why}");
        self.forbidden.refused_by.insert(peer);
        self.forbidden.stands = true;
        self.wiring.faults.declare(FaultKind::Forbidden, format!("no event arrives: {why}"));
    }

    /// A peer refuses no subscription any more, or the session with it has ended.
    pub(super) fn forget_forbidden(&mut self, peer: NodeId) {
        self.forbidden.refused_by.remove(&peer);
    }

    /// So many refusals of one node between two looks, a second apart, are an offence of it.
    const FLOOD: u64 = 1_000;

    /// Declares what was refused since the last look, and clears the fault when nothing was for a
    /// minute.
    pub(super) fn look_at_access(&mut self) {
        for node in self.wiring.registry.access().take_floods(Self::FLOOD) {
            let what = "it asks a thousand times a second for what it may not";
            self.offends(NodeId::of(&node), what);
        }
        let alarm = &mut self.forbidden;
        if let Some(row) = self.wiring.registry.access().newest_of_a_program()
            && alarm.last_refusal.replace(row.last) != Some(row.last)
            && !std::mem::replace(&mut alarm.stands, true)
        {
            let detail =
                format!("refused {} times: {}", row.times, DeliveryError::from(&row.denied));
            self.wiring.faults.declare(FaultKind::Forbidden, detail);
        }
        let is_over = |last: Instant| platform::now() >= last + REFUSAL_REMINDER;
        if alarm.stands && alarm.refused_by.is_empty() && alarm.last_refusal.is_none_or(is_over) {
            alarm.stands = false;
            self.wiring.faults.clear(FaultKind::Forbidden);
        }
    }

    /// What peers may do here is another thing now.
    pub(in crate::net) fn handle_roster(&mut self, keys: &NodeKeys) {
        let policy = keys.access_policy();
        self.wiring.registry.access().replace(policy.clone());
        self.tell_directory(DirectoryReport::Policy(Box::new(policy.clone())));
        self.exchange.handle_access(policy);
    }
}
