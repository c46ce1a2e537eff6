//! Safe stop: safe outputs, then rest.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

pub(super) struct SafeStopStrategy;

impl RecoveryStrategy for SafeStopStrategy {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tools.safe_stop(&order.fault).await
    }
}
