//! Safe stop: safe outputs, then rest.

use super::{RecoveryStrategy, Tools};
use blastema_core::recovery::{Done, Failed, Order};

pub(super) struct SafeStop;

impl RecoveryStrategy for SafeStop {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        tools.safe_stop(&order.fault).await
    }
}
