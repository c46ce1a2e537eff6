//! When the directory acts by itself.

use super::Directory;
use super::claims::OwnClaim;
use crate::timer::Timers;
use crate::{Instant, ObjectName};

/// The timers of the directory.
#[derive(Clone, Copy, Debug)]
pub(crate) enum DirectoryTimer {
    /// Ends the wait for the nodes that are expected, after the start.
    Settle,
    /// Tells the other nodes a sum over the own records: four times in each lease where this node
    /// claims names, whose leases that renews, and once in four leases where it claims none.
    Renew,
    /// Ends the claims of a node that has not renewed them.
    LeaseExpiry,
    /// Claims a name whose holder is gone, when it is this node's turn.
    Turn,
}

impl Timers for Directory {
    type Timer = DirectoryTimer;

    const TIMERS: &'static [DirectoryTimer] = {
        use DirectoryTimer::*;
        &[Settle, Renew, LeaseExpiry, Turn]
    };

    fn due(&self, timer: DirectoryTimer) -> Option<Instant> {
        match timer {
            DirectoryTimer::Settle => self.settles,
            DirectoryTimer::Renew => {
                let lease = self.config.lease;
                let interval = if self.own.is_empty() { lease * 4 } else { lease / 4 };
                let is_told = !self.table.records.is_empty() && !self.peers.is_empty();
                is_told.then_some(self.renewed_at + interval)
            }
            DirectoryTimer::LeaseExpiry => {
                let holders = self.peers.values().filter(|peer| !peer.open || peer.claims_names());
                holders.map(|peer| peer.received_at + self.config.lease).min()
            }
            DirectoryTimer::Turn => self.own.values().filter_map(|own| own.take_at).min(),
        }
    }

    fn fire(&mut self, timer: DirectoryTimer, now: Instant) {
        match timer {
            DirectoryTimer::Settle => self.settle(now),
            DirectoryTimer::Renew => self.renew(now),
            DirectoryTimer::LeaseExpiry => self.expire_leases(now),
            DirectoryTimer::Turn => {
                let is_due = |own: &OwnClaim| own.take_at.is_some_and(|at| now >= at);
                let due = self.own.iter().filter(|(_, own)| is_due(own));
                let due: Vec<ObjectName> = due.map(|(name, _)| name.clone()).collect();
                for name in due {
                    self.take(&name);
                }
            }
        }
    }
}
