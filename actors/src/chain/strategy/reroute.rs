//! Re-route: another way over the network.

use super::{RecoveryStrategy, Tools};
use blastema_core::recovery::{Done, Failed, Order};

pub(super) struct Reroute;

impl RecoveryStrategy for Reroute {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        tools.reroute(&order.fault.place).await
    }
}
