//! The safe state and the roster of this node, which peers are told, and those of peers.

use super::ObjectGateway;
use crate::net::keys::NodeKeys;
use crate::net::roster_watch::{RosterOffer, RosterWatch};
use blastema_contract::monitor::NodeReported;
use blastema_contract::recoverer::SafeStateChanged;
use blastema_core::detection::NodeCondition;
use blastema_core::net::NodeId;
use std::sync::Weak;
use tracing::warn;

impl ObjectGateway {
    /// Peers are told whether this node is in the safe state.
    pub(in crate::net) fn handle_safe_state(&mut self, message: SafeStateChanged) {
        self.exchange.handle_safe_state(match message {
            SafeStateChanged::Entered { reason } => Some(reason),
            SafeStateChanged::Left => None,
            // The peers see the node leave, and hear of the safe state when it is one.
            SafeStateChanged::Entering | SafeStateChanged::NodeEnds => return,
        });
    }

    pub(super) fn peer_rests(&self, peer: NodeId, reason: Option<String>) {
        if let (Some(nodes), Some(peer)) = (&self.wiring.nodes, self.peers.get(&peer)) {
            let (node, incarnation) = (peer.node.clone(), peer.incarnation);
            let condition = match reason {
                Some(reason) => NodeCondition::InSafeState { reason },
                None => NodeCondition::AtWork,
            };
            nodes.do_send(NodeReported { node, incarnation, condition });
        }
    }

    /// Rosters of peers are checked by this watch.
    pub(in crate::net) fn attach_roster_watch(&mut self, watch: Weak<RosterWatch>) {
        self.wiring.roster_watch = watch;
    }

    /// Peers are told of a newer roster.
    pub(in crate::net) fn announce_roster(&mut self, keys: &NodeKeys) {
        self.exchange.handle_roster(keys.serial(), keys.roster_text());
    }

    pub(super) fn offer_roster(&self, peer: NodeId, text: &[u8]) {
        let (Some(peer), Some(watch)) = (self.peers.get(&peer), self.wiring.roster_watch.upgrade())
        else {
            return;
        };
        let from = peer.node.clone();
        match str::from_utf8(text) {
            Ok(text) => watch.offer(RosterOffer { from, text: text.to_owned() }),
            Err(error) => warn!(%from, %error, "its roster is no text"),
        }
    }
}
