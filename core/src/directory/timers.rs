//! When the directory acts by itself.

use super::claims::OwnClaim;
use super::{Directory, Reachability};
use crate::timer::Timers;
use crate::{Instant, ObjectName};

/// The timers of the directory.
#[derive(Clone, Copy, Debug)]
pub(crate) enum DirectoryTimer {
    /// Ends the wait for the nodes that are expected, after the start.
    Settle,
    /// Ends the records of a node that could not be reached for a lease.
    LeaseExpiry,
    /// Claims a name whose holder is gone, when it is this node's turn.
    Turn,
}

impl Timers for Directory {
    type Timer = DirectoryTimer;

    const TIMERS: &'static [DirectoryTimer] = {
        use DirectoryTimer::*;
        &[Settle, LeaseExpiry, Turn]
    };

    fn due(&self, timer: DirectoryTimer) -> Option<Instant> {
        match timer {
            DirectoryTimer::Settle => self.settles,
            DirectoryTimer::LeaseExpiry => {
                let ends = self.peers.values().filter_map(|peer| match peer.reachability {
                    Reachability::Away { until } => Some(until),
                    Reachability::Here | Reachability::Gone => None,
                });
                ends.min()
            }
            DirectoryTimer::Turn => self.own.values().filter_map(|own| own.take_at).min(),
        }
    }

    fn fire(&mut self, timer: DirectoryTimer, now: Instant) {
        match timer {
            DirectoryTimer::Settle => self.settle(now),
            DirectoryTimer::LeaseExpiry => self.expire_leases(now),
            DirectoryTimer::Turn => {
                let is_due = |own: &OwnClaim| own.take_at.is_some_and(|at| now >= at);
                let due = self.own.iter().filter(|(_, own)| is_due(own));
                let due: Vec<ObjectName> = due.map(|(name, _)| name.clone()).collect();
                for name in due {
                    self.take(&name, now);
                }
            }
        }
    }
}
