//! Isolation: the object's, or the other node's, sending and receiving is forbidden.

use super::{RecoveryStrategy, Tools};
use blastema_core::recovery::{Done, Failed, Order};

pub(super) struct Isolate;

impl RecoveryStrategy for Isolate {
    async fn carry_out(&self, order: &Order, tools: &Tools) -> Result<Done, Failed> {
        tools.isolate_because(&order.fault).await
    }
}
