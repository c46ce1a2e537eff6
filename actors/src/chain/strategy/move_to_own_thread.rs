//! Move: the next life, on a thread of its own.

use super::{RecoveryStrategy, Tools};
use blastema_core::recovery::{Done, Failed, Order};

pub(super) struct MoveToOwnThread;

impl RecoveryStrategy for MoveToOwnThread {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        tools.move_to_own_thread(&order.fault).await
    }
}
