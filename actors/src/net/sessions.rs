//! Looks at the sessions with all other nodes: what they refuse, and how much they carry.

use super::fault_reporter::FaultReporter;
use crate::platform;
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_core::detection::NodeCondition;
use blastema_core::net::refusal_alarms::{MANY, RefusalAlarms};
use blastema_core::net::{ByteRates, NodeId, Peers, Refusals};
use blastema_core::{FaultKind, Incarnation};
use tracing::warn;

/// What was seen at the last look.
#[derive(Default)]
pub(super) struct SessionWatch {
    complaints: RefusalAlarms<Option<NodeId>>,
    /// What came from nodes that no route leads to.
    pub(super) strangers: Refusals,
    pub(super) rates: ByteRates<NodeId>,
}

impl SessionWatch {
    /// The sessions with this peer are forgotten.
    pub(super) fn forget(&mut self, peer: NodeId) {
        self.complaints.forget(&Some(peer));
    }

    /// Raises an alarm for a peer whose packets are refused for seconds.
    pub(super) fn look_at_refusals(
        &mut self,
        peers: &mut Peers,
        faults: &FaultReporter,
        nodes: Option<&Recipient<NodeReported>>,
    ) {
        // Says whether the peer is to blame.
        let mut look = |peer, refusals, name: &str, relayed: bool| {
            let Some(since) = self.complaints.handle_look(peer, refusals) else { return false };
            let detail = format!("what comes from {name} is refused all the time: {since}");
            warn!("{detail}");
            faults.declare_passing(FaultKind::CheckFailed, detail);
            // Nodes on the path may send in another's name. Over its own links it is itself, unless
            // an attacker replays its packets there.
            !relayed && since.of_the_present() >= MANY
        };
        look(None, self.strangers, "nodes that no route leads to", true);
        for (id, peer) in peers.iter_mut() {
            let relayed = std::mem::take(&mut peer.relayed);
            let its_own = look(Some(id), peer.session.refusals(), peer.node.as_str(), relayed);
            if let (Some(nodes), true) = (nodes, its_own) {
                let what = "it sent for seconds what had to be refused".to_owned();
                let condition = NodeCondition::Offends { what };
                let (node, incarnation) = (peer.node.clone(), Incarnation::default());
                nodes.do_send(NodeReported { node, incarnation, condition });
            }
        }
    }

    pub(super) fn look_at_rates(&mut self, peers: &Peers) {
        let carried = peers.iter().map(|(id, peer)| {
            let counters = peer.session.counters();
            (id, counters.bytes_sent, counters.bytes_received)
        });
        self.rates.handle_look(carried, platform::now());
    }
}
