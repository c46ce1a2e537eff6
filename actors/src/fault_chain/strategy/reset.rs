//! Reset: the component recovers by itself, in its present incarnation.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

pub(super) struct ResetStrategy;

impl RecoveryStrategy for ResetStrategy {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tools.reset(&order.fault.location).await
    }
}
