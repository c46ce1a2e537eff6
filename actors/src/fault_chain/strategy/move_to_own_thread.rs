//! Move: the next incarnation, on a thread of its own.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};

pub(super) struct MoveToOwnThread;

impl RecoveryStrategy for MoveToOwnThread {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        tools.move_to_own_thread(&order.fault).await
    }
}
