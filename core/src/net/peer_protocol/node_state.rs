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

use crate::net::wire::message::PeerMessage;
use bytes::Bytes;

/// The most letters of a safe state's reason that peers are told: a panic's text, shortened.
pub(super) const REASON_MAX: usize = 256;

/// What peers are told of this node.
#[derive(Debug, Default)]
pub(super) struct AnnouncedState {
    /// Why it is in the safe state, as peers are told; `None` if it never was.
    pub(super) safe_state: Option<Option<String>>,
    /// The serial number of its roster, and the signed text.
    pub(super) roster: Option<(u64, Bytes)>,
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
