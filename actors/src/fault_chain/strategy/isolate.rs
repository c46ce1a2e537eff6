//! Isolation: the object's, or the other node's, sending and receiving is forbidden.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

pub(super) struct IsolateStrategy;

impl RecoveryStrategy for IsolateStrategy {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tools.isolate_because(&order.fault).await
    }
}
