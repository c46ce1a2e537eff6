//! Restart: the next incarnation in place of the present one.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

pub(super) struct RestartStrategy;

impl RecoveryStrategy for RestartStrategy {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tools.restart(&order.fault).await
    }
}
