//! The sessions with all other nodes, for the network's stack.

use super::fault_reporter::FaultReporter;
use crate::platform;
use crate::platform::panics;
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_core::TrafficClass;
use blastema_core::detection::NodeCondition;
use blastema_core::net::OrderingKey;
use blastema_core::net::refusal_alarms::{MANY, RefusalAlarms};
use blastema_core::net::{
    ByteRate, ByteRates, MachineSet, NodeId, Refusals, Session, SessionConfig,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{Credit, DeliveryError, FaultKind, GatherBuffer, Incarnation, NodeName};
use bytes::Bytes;
use std::time::Duration;
use tracing::warn;

/// The most peers that are remembered. Twice what a router knows at a time: robots change.
const PEERS_MAX: usize = 512;
/// A session that is built again counts on from there: more than any session needs.
const NUMBERS_PER_LIFE: u32 = 1 << 16;

/// One session per peer node.
pub(super) struct PeerSessions {
    pub(super) machines: MachineSet<NodeId, Session>,
    node: NodeName,
    incarnation: Incarnation,
    idle_timeout: Duration,
    peers: SortedMap<NodeId, Peer>,
    faults: FaultReporter,
    nodes: Option<Recipient<NodeReported>>,
    complaints: RefusalAlarms<Option<NodeId>>,
    /// What came from nodes that no route leads to.
    strangers: Refusals,
    /// The highest number of a session with a peer that was forgotten: those with a new one are
    /// above it, for it may be the same peer.
    forgotten: u32,
    /// This node ends: no session begins any more.
    closed: bool,
    rates: ByteRates<NodeId>,
}

struct Peer {
    node: NodeName,
    /// Its incarnation, and the largest segment on the way, while there is one.
    path: Option<(Incarnation, usize)>,
    /// Sessions are numbered above this.
    number: u32,
    /// Since the last look something in its name came by way of others.
    relayed: bool,
}

/// A session whose machine is gone.
pub(super) struct DiscardedSession {
    pub(super) peer: NodeId,
    /// What was not acknowledged, and whether some of it was sent.
    pub(super) held: Vec<(TrafficClass, Bytes, bool)>,
    pub(super) why: DeliveryError,
}

impl PeerSessions {
    pub(super) fn new(
        (node, incarnation): (NodeName, Incarnation),
        idle_timeout: Duration,
        (faults, nodes): (FaultReporter, Option<Recipient<NodeReported>>),
    ) -> Self {
        PeerSessions {
            machines: MachineSet::default(),
            node,
            incarnation,
            idle_timeout,
            peers: SortedMap::new(),
            faults,
            nodes,
            complaints: RefusalAlarms::default(),
            strangers: Refusals::default(),
            forgotten: 0,
            closed: false,
            rates: ByteRates::default(),
        }
    }

    fn build(&mut self, id: NodeId) {
        let Some(peer) = self.peers.get(&id).filter(|_| !self.closed) else { return };
        let (node, incarnation) = (self.node.clone(), self.incarnation);
        let config = SessionConfig::new(node, incarnation, peer.node.clone());
        let (number, idle_timeout) = (peer.number, self.idle_timeout);
        let seed = platform::random_seed();
        let config = SessionConfig { number, seed, idle_timeout, ..config };
        self.machines.insert(id, Session::new(config, platform::now()));
    }

    /// Makes the session with a node. Returns the session that made way for it, if one had to.
    pub(super) fn meet(&mut self, node: &NodeName) -> Option<DiscardedSession> {
        let id = NodeId::of(node);
        if self.peers.contains_key(&id) {
            return None;
        }
        let gone = (self.peers.len() >= PEERS_MAX).then(|| self.forget_one()).flatten();
        let (node, number) = (node.clone(), self.forgotten);
        self.peers.insert(id, Peer { node, path: None, number, relayed: false });
        self.build(id);
        gone
    }

    /// Makes room for a new peer: removes one without a path.
    fn forget_one(&mut self) -> Option<DiscardedSession> {
        let peer = self.peers.iter().find(|(_, peer)| peer.path.is_none()).map(|(id, _)| *id)?;
        let discarded = self.discard(peer);
        if let Some(gone) = self.peers.remove(&peer) {
            self.forgotten = self.forgotten.max(gone.number);
        }
        self.complaints.forget(&Some(peer));
        discarded
    }

    /// Takes a session's machine away, with all that it held.
    fn discard(&mut self, peer: NodeId) -> Option<DiscardedSession> {
        let mut machine = self.machines.remove(peer)?;
        // After a panic, what it holds is given back if it can be read at all.
        let held = panics::caught(|| machine.take_unacknowledged());
        if let Some(known) = self.peers.get_mut(&peer) {
            known.number = known.number.max(machine.number());
        }
        let (held, why) = (held.unwrap_or_default(), self.unreachable(peer));
        Some(DiscardedSession { peer, held, why })
    }

    /// Replaces the machines of all sessions, and returns the old sessions.
    pub(super) fn replace_all(&mut self) -> Vec<DiscardedSession> {
        let peers: Vec<_> = self.peers.keys().copied().collect();
        let discarded = peers.iter().filter_map(|peer| self.discard(*peer)).collect();
        self.machines = MachineSet::default();
        for id in peers {
            let Some(peer) = self.peers.get_mut(&id) else { continue };
            peer.number = peer.number.saturating_add(NUMBERS_PER_LIFE);
            let path = peer.path;
            self.build(id);
            if let (Some((incarnation, mtu)), Some(session)) = (path, self.machines.get_mut(id)) {
                session.handle_incarnation(incarnation, platform::now());
                session.handle_path(mtu, platform::now());
            }
        }
        discarded
    }

    /// The machine of this peer, if that session is the present one.
    fn present(&mut self, peer: NodeId, number: u32) -> Option<&mut Session> {
        self.machines.get_mut(peer).filter(|session| session.number() == number)
    }

    /// Sends a message, exactly once and in the order of its strand, in the session of this number:
    /// what was meant for one is never sent in the next.
    ///
    /// # Errors
    /// Why it is not sent. The message comes back.
    pub(super) fn send_reliable(
        &mut self,
        (peer, number): (NodeId, u32),
        place: (TrafficClass, OrderingKey),
        message: GatherBuffer,
        credit: Option<Credit>,
    ) -> Result<(), (DeliveryError, Bytes)> {
        match self.present(peer, number) {
            Some(session) => session.handle_send_along(place, message, credit, platform::now()),
            None => Err((self.unreachable(peer), message.into_bytes())),
        }
    }

    /// Sends a message once, if at all: of one channel the newest that arrives counts. The session
    /// keeps one of each channel.
    ///
    /// # Errors
    /// Why it is not sent. The message comes back.
    pub(super) fn send_latest(
        &mut self,
        (peer, number): (NodeId, u32),
        channel: u32,
        message: GatherBuffer,
    ) -> Result<(), (DeliveryError, Bytes)> {
        match self.present(peer, number) {
            Some(session) => session.handle_send_newest(channel, message, platform::now()),
            None => Err((self.unreachable(peer), message.into_bytes())),
        }
    }

    /// The name of a peer.
    pub(super) fn name(&self, peer: NodeId) -> Option<&NodeName> {
        self.peers.get(&peer).map(|peer| &peer.node)
    }

    pub(super) fn handle_reachable(&mut self, peer: NodeId, incarnation: Incarnation, mtu: usize) {
        if let Some(peer) = self.peers.get_mut(&peer) {
            peer.path = Some((incarnation, mtu));
        }
        if let Some(session) = self.machines.get_mut(peer) {
            session.handle_incarnation(incarnation, platform::now());
            session.handle_path(mtu, platform::now());
        }
    }

    pub(super) fn handle_path(&mut self, peer: NodeId, mtu: usize) {
        if let Some((_, old)) = self.peers.get_mut(&peer).and_then(|peer| peer.path.as_mut()) {
            *old = mtu;
        }
        if let Some(session) = self.machines.get_mut(peer) {
            session.handle_path(mtu, platform::now());
        }
    }

    pub(super) fn handle_no_path(&mut self, peer: NodeId) {
        if let Some(peer) = self.peers.get_mut(&peer) {
            peer.path = None;
        }
        if let Some(session) = self.machines.get_mut(peer) {
            session.handle_no_path(platform::now());
        }
    }

    /// Another node's session has sent this. It is authentic if no other node can have made it: it
    /// came over a link with that node itself, or that node has sealed it.
    pub(super) fn handle_segment(&mut self, source: NodeId, segment: Bytes, authentic: bool) {
        // A peer that the router has not told of yet repeats itself.
        let Some(session) = self.machines.get_mut(source) else {
            self.strangers.unexpected += 1;
            return;
        };
        session.handle_segment(segment, platform::now());
        if !authentic && let Some(peer) = self.peers.get_mut(&source) {
            peer.relayed = true;
        }
    }

    /// This node ends in order: what was sent is to be delivered, then every session ends.
    pub(super) fn close(&mut self) {
        self.closed = true;
        let peers: Vec<_> = self.peers.keys().copied().collect();
        for peer in peers {
            if let Some(session) = self.machines.get_mut(peer) {
                session.handle_close(platform::now());
            }
        }
    }

    /// Each session's peer and status, and how many bytes went each way in the last second.
    pub(super) fn rows(&self) -> impl Iterator<Item = (NodeId, &NodeName, &Session, ByteRate)> {
        let row =
            |(id, session)| Some((id, &self.peers.get(&id)?.node, session, self.rates.rate(id)));
        self.machines.iter().filter_map(row)
    }

    /// Raises an alarm for a peer whose packets are refused for seconds.
    pub(super) fn look_at_refusals(&mut self) {
        let peers = self.machines.iter().map(|(id, session)| (Some(id), session.refusals()));
        let looks: Vec<_> = peers.chain([(None, self.strangers)]).collect();
        for (peer, refusals) in looks {
            let known = peer.and_then(|id| self.peers.get_mut(&id));
            let relayed = known.is_none_or(|known| std::mem::take(&mut known.relayed));
            let alarm = self.complaints.handle_look(peer, refusals);
            let Some(since) = alarm else { continue };
            let name = peer.and_then(|id| self.peers.get(&id)).map(|peer| peer.node.to_string());
            let name = name.unwrap_or_else(|| "nodes that no route leads to".to_owned());
            let detail = format!("what comes from {name} is refused all the time: {since}");
            warn!("{detail}");
            // Nodes on the path may send in another's name. Over its own links it is itself, unless
            // an attacker replays its packets there.
            let its_own = !relayed && since.of_the_present() >= MANY;
            if let (Some(nodes), Some(peer), true) =
                (&self.nodes, peer.and_then(|id| self.peers.get(&id)), its_own)
            {
                let (node, incarnation) = (peer.node.clone(), Incarnation::default());
                let what = "it sent for seconds what had to be refused".to_owned();
                let condition = NodeCondition::Offends { what };
                nodes.do_send(NodeReported { node, incarnation, condition });
            }
            self.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
    }

    pub(super) fn look_at_rates(&mut self) {
        let carried = self.machines.iter().map(|(id, session)| {
            let counters = session.counters();
            (id, counters.bytes_sent, counters.bytes_received)
        });
        self.rates.handle_look(carried, platform::now());
    }

    fn unreachable(&self, peer: NodeId) -> DeliveryError {
        let node = self.peers.get(&peer).map_or(peer.to_string(), |peer| peer.node.to_string());
        DeliveryError::Unreachable { node }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn however_many_nodes_were_met_a_further_one_has_a_session() {
        let own = (NodeName::new("base").unwrap(), Incarnation(1));
        let told = (FaultReporter::of("stack", None, None), None);
        let mut sessions = PeerSessions::new(own, Duration::from_secs(2), told);
        for number in 0..2 * PEERS_MAX {
            let node = NodeName::new(&format!("n{number}")).unwrap();
            sessions.meet(&node);
            assert!(sessions.machines.get_mut(NodeId::of(&node)).is_some());
        }
        assert_eq!(sessions.peers.len(), PEERS_MAX);
    }
}
