//! The gateway's record of another node.

use crate::net::stub::PeerSendState;
use blastema_core::{Incarnation, NodeName};
use std::sync::Arc;

/// Another node.
pub(super) struct GatewayPeer {
    pub(super) node: NodeName,
    pub(super) send_state: Arc<PeerSendState>,
    /// The number of the session that was opened last.
    pub(super) session: u32,
    /// The incarnation that it is with, or was.
    pub(super) incarnation: Incarnation,
    /// That incarnation has ended in order.
    pub(super) left: bool,
    /// Messages to its objects that had been accepted and did not arrive, since sessions ended.
    pub(super) lost: u64,
    /// How many of them the fault tells of.
    pub(super) lost_reported: u64,
    /// Contracts that it does not mean as this node does, in this incarnation.
    differences: Vec<String>,
}

impl GatewayPeer {
    /// More are not told: a node with so many differences was built from another source.
    const DIFFERENCES_MAX: usize = 16;

    /// One that no session was open with yet.
    pub(super) fn new(node: NodeName, send_state: Arc<PeerSendState>) -> Self {
        GatewayPeer {
            node,
            send_state,
            session: 0,
            incarnation: Incarnation::default(),
            left: false,
            lost: 0,
            lost_reported: 0,
            differences: Vec::new(),
        }
    }

    /// A session begins. Says whether that ends what differed in an earlier incarnation.
    pub(super) fn begin(&mut self, session: u32, incarnation: Incarnation) -> bool {
        let is_another = self.incarnation != incarnation;
        (self.session, self.incarnation, self.left) = (session, incarnation, false);
        is_another && !std::mem::take(&mut self.differences).is_empty()
    }

    /// A contract is not the same there. Says whether that is news, and not one too many.
    pub(super) fn differs(&mut self, difference: &str) -> bool {
        let is_known = self.differences.iter().any(|known| known == difference);
        if is_known || self.differences.len() >= Self::DIFFERENCES_MAX {
            return false;
        }
        self.differences.push(difference.to_owned());
        true
    }

    /// What was found to differ, in the order of finding.
    pub(super) fn differences(&self) -> &[String] {
        &self.differences
    }
}
