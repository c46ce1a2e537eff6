//! What a node tells every peer of itself: whether it is in the safe state, and which roster it
//! has.
//!
//! ```text
//!  a session begins, or it changes     InSafeState or AtWork, RosterSerial
//!  the peer has a higher number        RosterRequest, which the peer answers by Roster
//! ```
//!
//! A session delivers each message once, so that none is repeated. A node in the safe state stays
//! on the network: without its word the peers would find out only by what does not come.

use super::{PeerProtocol, PeerProtocolOutput, control};
use crate::net::wire::message::PeerMessage;
use crate::net::wire::node_id::NodeId;
use bytes::Bytes;

/// The most letters of a safe state's reason that peers are told: a panic's text, shortened.
pub(super) const REASON_MAX: usize = 256;

/// What peers are told of this node.
#[derive(Debug, Default)]
pub(super) struct AnnouncedState {
    /// Why it is in the safe state, as peers are told; `None` if it never was.
    safe_state: Option<Option<String>>,
    /// The serial number of its roster, and the signed text.
    roster: Option<(u64, Bytes)>,
}

impl AnnouncedState {
    /// All that a peer is told when a session with it begins.
    pub(super) fn messages(&self) -> impl Iterator<Item = PeerMessage> {
        let safe_state = self.safe_state.clone().map(|reason| match reason {
            Some(reason) => PeerMessage::InSafeState { reason },
            None => PeerMessage::AtWork,
        });
        let roster = self.roster.as_ref().map(|(serial, _)| *serial);
        safe_state.into_iter().chain(roster.map(|serial| PeerMessage::RosterSerial { serial }))
    }
}

impl PeerProtocol {
    /// This node is in the safe state, for this reason, or has left it.
    pub fn handle_safe_state(&mut self, reason: Option<String>) {
        let shortened = reason.map(|reason| reason.chars().take(REASON_MAX).collect());
        self.own.safe_state = Some(shortened);
        self.tell_own();
    }

    /// This node uses this roster: its serial number, and its signed text.
    pub fn handle_roster(&mut self, serial: u64, text: Bytes) {
        self.own.roster = Some((serial, text));
        self.tell_own();
    }

    fn tell_own(&mut self) {
        let messages: Vec<_> = self.own.messages().collect();
        messages.iter().for_each(|message| self.tell_all(message));
    }

    /// The directory of this node says this to that of a peer.
    pub fn handle_directory(&mut self, peer: NodeId, message: Bytes) {
        self.tell(peer, &PeerMessage::Directory { message: message.into() });
    }

    /// A peer has the roster of this serial number. It is asked for it, if that is newer.
    pub(super) fn handle_serial(&mut self, peer: NodeId, serial: u64) {
        if self.own.roster.as_ref().is_some_and(|(own, _)| serial > *own) {
            self.outputs.push_back(control(peer, &PeerMessage::RosterRequest));
            self.peers.entry(peer).or_default().asked_roster = true;
        }
    }

    /// A peer sends its roster. What was not asked for is not taken.
    pub(super) fn handle_peers_roster(&mut self, peer: NodeId, text: Bytes) {
        let record = self.peers.get_mut(&peer);
        if record.is_some_and(|record| std::mem::take(&mut record.asked_roster)) {
            self.outputs.push_back(PeerProtocolOutput::Roster { peer, text });
        } else {
            self.refusals.unexpected += 1;
        }
    }

    /// A peer has an older roster.
    pub(super) fn handle_roster_request(&mut self, peer: NodeId) {
        if let Some((_, text)) = self.own.roster.clone() {
            self.outputs.push_back(control(peer, &PeerMessage::Roster { text: text.into() }));
        }
    }
}
