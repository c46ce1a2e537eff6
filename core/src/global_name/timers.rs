//! When the table of global names acts by itself.

use super::{GlobalNameMessage, GlobalNames, Peer};
use crate::timer::Timers;
use crate::{Instant, ObjectName};

/// The timers of the table.
#[derive(Clone, Copy, Debug)]
pub(crate) enum GlobalNamesTimer {
    /// Ends the wait for the nodes that are expected, after the start.
    Settle,
    /// Renews the leases of the own claims with the other nodes, four times in each lease.
    Renew,
    /// Ends the claims of a node that has not renewed them.
    LeaseExpiry,
    /// Claims a name whose holder is gone, when it is this node's turn.
    Turn,
}

impl Timers for GlobalNames {
    type Timer = GlobalNamesTimer;

    const TIMERS: &'static [GlobalNamesTimer] = {
        use GlobalNamesTimer::*;
        &[Settle, Renew, LeaseExpiry, Turn]
    };

    fn due(&self, timer: GlobalNamesTimer) -> Option<Instant> {
        match timer {
            GlobalNamesTimer::Settle => self.settles,
            // A node that claims nothing has nothing to renew, and costs a slow line nothing.
            GlobalNamesTimer::Renew => {
                (!self.own.is_empty() && !self.peers.is_empty()).then_some(self.alive_at)
            }
            GlobalNamesTimer::LeaseExpiry => {
                let holders =
                    self.peers.values().filter(|peer| !peer.open || !peer.claims.is_empty());
                holders.map(|peer| peer.received_at + self.config.lease).min()
            }
            GlobalNamesTimer::Turn => self.vacant.values().min().copied(),
        }
    }

    fn fire(&mut self, timer: GlobalNamesTimer, now: Instant) {
        match timer {
            GlobalNamesTimer::Settle => self.settle(now),
            GlobalNamesTimer::Renew => {
                self.alive_at = now + self.config.lease / 4;
                let sum = self.sum;
                self.tell_everybody(&GlobalNameMessage::Alive { sum });
            }
            GlobalNamesTimer::LeaseExpiry => self.expire_leases(now),
            GlobalNamesTimer::Turn => {
                let due = self.vacant.iter().filter(|(_, due)| now >= **due);
                let due: Vec<ObjectName> = due.map(|(name, _)| name.clone()).collect();
                for name in due {
                    self.take(&name);
                }
            }
        }
    }
}

impl GlobalNames {
    fn expire_leases(&mut self, now: Instant) {
        let lapsed = |peer: &Peer| now >= peer.received_at + self.config.lease;
        let gone = self.peers.iter().filter(|(_, peer)| lapsed(peer));
        let gone: Vec<_> = gone.map(|(node, peer)| (node.clone(), peer.open)).collect();
        for (node, open) in gone {
            match self.peers.get_mut(&node).filter(|_| open) {
                // It may speak again; then its sum differs, and it is asked.
                Some(peer) => {
                    peer.received_at = now;
                    self.clear(&node, now);
                }
                None => self.handle_left(&node, now),
            }
        }
    }
}
