//! Looks at the sessions with all other nodes: what they refuse, and how much they carry.

use crate::platform;
use crate::runtime::reports::FaultReporter;
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
    alarms: RefusalAlarms<Option<NodeId>>,
    /// What came from nodes that no route leads to.
    pub(super) strangers: Refusals,
    pub(super) rates: ByteRates<NodeId>,
}

impl SessionWatch {
    /// Raises an alarm for a peer whose packets are refused for seconds.
    pub(super) fn look_at_refusals(
        &mut self,
        peers: &mut Peers,
        faults: &FaultReporter,
        nodes: Option<&Recipient<NodeReported>>,
    ) {
        let looks = peers.iter().map(|(id, peer)| (Some(id), peer.session.refusals()));
        for (id, since) in self.alarms.handle_look(looks.chain([(None, self.strangers)])) {
            let peer = id.and_then(|id| peers.get(id));
            let name = peer.map_or("nodes that no route leads to", |peer| peer.node.as_str());
            let detail = format!("what comes from {name} is refused all the time: {since}");
            warn!("{detail}");
            faults.declare_passing(FaultKind::CheckFailed, detail);
            // Nodes on the path may send in another's name. Over its own links it is itself, unless
            // an attacker replays its packets there.
            if let (Some(nodes), Some(peer)) = (nodes, peer)
                && !peer.relayed
                && since.of_the_present() >= MANY
            {
                let what = "it sent for seconds what had to be refused".to_owned();
                let condition = NodeCondition::Offends { what };
                let (node, incarnation) = (peer.node.clone(), Incarnation::default());
                nodes.do_send(NodeReported { node, incarnation, condition });
            }
        }
        peers.iter_mut().for_each(|(_, peer)| peer.relayed = false);
    }

    pub(super) fn look_at_rates(&mut self, peers: &Peers) {
        let carried = peers.iter().map(|(id, peer)| {
            let counters = peer.session.counters();
            (id, counters.bytes_sent, counters.bytes_received)
        });
        self.rates.handle_look(carried, platform::now());
    }
}
