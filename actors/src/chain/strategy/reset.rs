//! Reset: the component recovers by itself, in its present life.

use super::{RecoveryStrategy, Tools};
use blastema_core::recovery::{Done, Failed, Order};

pub(super) struct Reset;

impl RecoveryStrategy for Reset {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        tools.reset(&order.fault.place).await
    }
}
