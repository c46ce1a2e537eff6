//! The table of peers: which other nodes there are, in which incarnation, by which path, and in
//! which session with this node.
//!
//! What is known of a peer's name, path, session, isolation and losses stands in its row alone, and
//! goes with it.

use super::peer::{PeerRecord, PeerSession};
use crate::machine_set::MachineSet;
use crate::net::session::{Session, SessionConfig, SessionOutput};
use crate::net::wire::node_id::NodeId;
use crate::{DeliveryError, Incarnation, Instant, Machine, NodeName};
use std::time::Duration;

/// The peers of one node, driven as one machine.
pub type Peers = MachineSet<NodeId, Peer>;

/// Makes the machines of sessions.
#[derive(Debug)]
pub(super) struct SessionMaker {
    node: NodeName,
    incarnation: Incarnation,
    idle_timeout: Duration,
    /// The highest number of a session with a peer that was forgotten: those with a new one are
    /// above it, for it may be the same peer.
    pub(super) forgotten: u32,
    /// This node ends: no session begins any more.
    pub(super) closed: bool,
}

/// Another node that this one has met.
#[derive(Debug)]
pub struct Peer {
    /// The name of the node.
    pub node: NodeName,
    /// Its incarnation and the largest segment on the way there, while a path is known.
    pub path: Option<(Incarnation, usize)>,
    /// This node has isolated it.
    pub isolated: bool,
    /// The sessions with it, one after the other.
    pub session: Session,
    /// The number of the session that was opened last.
    opened: u32,
    /// The incarnation that it is with, or was.
    pub incarnation: Incarnation,
    /// That incarnation has ended in order.
    pub left: bool,
    /// Contracts that it does not mean as this node does, in the order of finding.
    differences: Vec<String>,
    /// Messages to its objects that had been accepted and did not arrive, since sessions ended.
    pub lost: u64,
    /// How many of them a fault tells of.
    pub lost_reported: u64,
    /// Since the last look something in its name came by way of others.
    pub relayed: bool,
    pub(super) record: PeerRecord,
}

impl SessionMaker {
    pub(super) fn new(node: NodeName, incarnation: Incarnation, idle_timeout: Duration) -> Self {
        SessionMaker { node, incarnation, idle_timeout, forgotten: 0, closed: false }
    }

    pub(super) fn session(&self, peer: NodeName, number: u32, seed: u64, now: Instant) -> Session {
        let config = SessionConfig::new(self.node.clone(), self.incarnation, peer);
        let idle_timeout = self.idle_timeout;
        let mut session = Session::new(SessionConfig { number, seed, idle_timeout, ..config }, now);
        if self.closed {
            session.handle_close(now);
        }
        session
    }
}

impl Peers {
    /// The numbers of all peers.
    pub fn ids(&self) -> Vec<NodeId> {
        self.iter().map(|(id, _)| id).collect()
    }

    /// The machine of the session with a peer that was opened last; `None` if that is over: what
    /// was meant for one session is never sent in the next.
    pub fn present(&mut self, peer: NodeId) -> Option<&mut Session> {
        let known = self.get_mut(peer).filter(|peer| peer.session.number() == peer.opened);
        known.map(|peer| &mut peer.session)
    }

    /// That the session with a peer is over.
    pub fn unreachable(&self, peer: NodeId) -> DeliveryError {
        DeliveryError::Unreachable { node: self.name(peer) }
    }

    /// The name of a peer, for display.
    pub fn name(&self, peer: NodeId) -> String {
        self.get(peer).map_or_else(|| peer.to_string(), |peer| peer.node.to_string())
    }

    /// What is going on in the session with a peer, if one is open.
    pub(super) fn open(&self, peer: NodeId) -> Option<&PeerSession> {
        self.get(peer)?.record.session.as_ref()
    }

    /// The same, to change it.
    pub(super) fn open_mut(&mut self, peer: NodeId) -> Option<&mut PeerSession> {
        self.get_mut(peer)?.record.session.as_mut()
    }

    /// The peers with which a session is open.
    pub(super) fn with_session(&self) -> impl Iterator<Item = (NodeId, &PeerSession)> {
        self.iter().filter_map(|(id, peer)| Some((id, peer.record.session.as_ref()?)))
    }
}

impl Peer {
    /// More are not told: a node with so many differences was built from another source.
    const DIFFERENCES_MAX: usize = 16;

    pub(super) fn new(node: NodeName, session: Session) -> Self {
        Peer {
            node,
            path: None,
            isolated: false,
            session,
            opened: 0,
            incarnation: Incarnation::default(),
            left: false,
            differences: Vec::new(),
            lost: 0,
            lost_reported: 0,
            relayed: false,
            record: PeerRecord::default(),
        }
    }

    /// A path to an incarnation of the peer is known.
    pub fn handle_reachable(&mut self, incarnation: Incarnation, mtu: usize, now: Instant) {
        self.path = Some((incarnation, mtu));
        self.session.handle_incarnation(incarnation, now);
        self.session.handle_path(mtu, now);
    }

    /// Another path leads there, or one with other segments.
    pub fn handle_path(&mut self, mtu: usize, now: Instant) {
        self.path = self.path.map(|(incarnation, _)| (incarnation, mtu));
        self.session.handle_path(mtu, now);
    }

    /// No path leads there any more; the session waits for one for a while.
    pub fn handle_no_path(&mut self, now: Instant) {
        self.path = None;
        self.session.handle_no_path(now);
    }

    /// A session begins. Says whether that ends what differed in an earlier incarnation.
    pub(super) fn begin(&mut self, session: u32, incarnation: Incarnation) -> bool {
        let is_another = self.incarnation != incarnation;
        (self.opened, self.incarnation, self.left) = (session, incarnation, false);
        is_another && !std::mem::take(&mut self.differences).is_empty()
    }

    /// A contract is not the same there. Says whether that is news, and not one too many.
    pub fn differs(&mut self, difference: &str) -> bool {
        let is_known = self.differences.iter().any(|known| known == difference);
        if is_known || self.differences.len() >= Self::DIFFERENCES_MAX {
            return false;
        }
        self.differences.push(difference.to_owned());
        true
    }

    /// What was found to differ, in the order of finding.
    pub fn differences(&self) -> &[String] {
        &self.differences
    }

    /// Whether nothing is lost when it is forgotten: no session is open, nothing is to be asked
    /// again, and each loss has been reported.
    pub(super) fn is_expendable(&self) -> bool {
        let is_idle = self.path.is_none() && self.record.session.is_none();
        let is_settled = self.record.again.is_empty() && self.lost == self.lost_reported;
        is_idle && is_settled && !self.isolated
    }
}

/// What the machine of its session does.
impl Machine for Peer {
    type Output = SessionOutput;

    fn poll_output(&mut self) -> Option<SessionOutput> {
        self.session.poll_output()
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.session.poll_timeout()
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.session.handle_timeout(now);
    }
}
