//! The strategies that each node has: one call of the tools each.

use super::{RecoveryStrategy, StrategyContext};
use blastema_core::recovery::{RecoveryAction, RecoveryDone, RecoveryFailed, RecoveryOrder};

/// Carries out each action that needs no strategy of the application.
pub(super) struct BuiltIn;

impl RecoveryStrategy for BuiltIn {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        tools: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        let RecoveryOrder { fault, action, .. } = order;
        match action {
            RecoveryAction::Reset => tools.reset(&fault.location).await,
            RecoveryAction::Restart => tools.restart(fault).await,
            RecoveryAction::MoveToOwnThread => tools.move_to_own_thread(fault).await,
            RecoveryAction::Reroute => tools.reroute(&fault.location).await,
            RecoveryAction::Isolate => tools.isolate_because(fault).await,
            RecoveryAction::SafeStop => tools.safe_stop(fault).await,
            other => Err(format!("there is no built-in strategy {other}").into()),
        }
    }
}
