//! Restart: the next life in place of the present one.

use super::{RecoveryStrategy, Tools};
use blastema_core::recovery::{Done, Failed, Order};

pub(super) struct Restart;

impl RecoveryStrategy for Restart {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        tools.restart(&order.fault).await
    }
}
