//! When a sealer acts by itself.

use super::sealed_peer::SealedPeer;
use super::{SealCrypto, Sealer};
use crate::Instant;
use crate::net::wire::node_id::NodeId;
use crate::timer::Timers;
use std::hash::Hash;
use std::time::Duration;

/// The timers of a sealer: each is that of the peer for which it is due first.
#[derive(Clone, Copy, Debug)]
pub(crate) enum SealerTimer {
    /// Drops keys: former ones after two seconds, offers that were not accepted, and keys that are
    /// as old as keys may be.
    KeyDrop,
    /// Sends an init, a knock or a confirmation once more (WireGuard: rekey timeout).
    HandshakeRetransmit,
    /// Asks for new keys after an hour (WireGuard: rekey after time).
    KeyRenewal,
}

/// The responder asks for new keys so much later: then the initiator has failed to.
const RESPONDER_LATER: Duration = Duration::from_secs(60);

impl<C: SealCrypto, A: Clone + Eq + Hash> Sealer<C, A> {
    fn due_of(&self, timer: SealerTimer, node: NodeId, peer: &SealedPeer<C, A>) -> Option<Instant> {
        match timer {
            SealerTimer::KeyDrop => peer.channels.drop_due(&self.config.limits),
            SealerTimer::HandshakeRetransmit => Some(peer.attempt.as_ref()?.retransmit_at),
            SealerTimer::KeyRenewal => {
                let present = peer.channels.present.as_ref().filter(|_| peer.attempt.is_none())?;
                let due = present.since + self.config.limits.renew_after;
                Some(if self.is_initiator(node) { due } else { due + RESPONDER_LATER })
            }
        }
    }
}

impl<C: SealCrypto, A: Clone + Eq + Hash> Timers for Sealer<C, A> {
    type Timer = SealerTimer;

    const TIMERS: &'static [SealerTimer] = {
        use SealerTimer::*;
        &[KeyDrop, HandshakeRetransmit, KeyRenewal]
    };

    fn due(&self, timer: SealerTimer) -> Option<Instant> {
        self.peers.iter().filter_map(|(node, peer)| self.due_of(timer, *node, peer)).min()
    }

    fn fire(&mut self, timer: SealerTimer, now: Instant) {
        let is_due = |(node, peer): &(&NodeId, &SealedPeer<C, A>)| {
            self.due_of(timer, **node, peer).is_some_and(|due| due <= now)
        };
        let due: Vec<_> = self.peers.iter().filter(is_due).map(|(node, _)| *node).collect();
        for node in due {
            match timer {
                SealerTimer::KeyDrop => self.drop_keys(node, now),
                SealerTimer::HandshakeRetransmit => self.retransmit(node, now),
                SealerTimer::KeyRenewal => self.begin(node, now),
            }
        }
    }
}
