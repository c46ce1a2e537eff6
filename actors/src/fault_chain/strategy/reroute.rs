//! Re-route: another way over the network.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

pub(super) struct RerouteStrategy;

impl RecoveryStrategy for RerouteStrategy {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tools.reroute(&order.fault.location).await
    }
}
