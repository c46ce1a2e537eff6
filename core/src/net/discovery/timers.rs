//! When discovery acts by itself.

use super::{Discovery, DiscoveryOutput, Origin};
use crate::Instant;
use crate::timer::Timers;

/// The timers of discovery.
#[derive(Clone, Copy, Debug)]
pub(crate) enum DiscoveryTimer {
    /// Gives up a neighbour that has not proved to be there, or forgets one that is down.
    NeighbourExpiry,
}

impl Timers for Discovery {
    type Timer = DiscoveryTimer;

    const TIMERS: &'static [DiscoveryTimer] = {
        use DiscoveryTimer::*;
        &[NeighbourExpiry]
    };

    fn due(&self, timer: DiscoveryTimer) -> Option<Instant> {
        match timer {
            DiscoveryTimer::NeighbourExpiry => {
                self.neighbours.values().filter_map(|known| self.ends(known)).min()
            }
        }
    }

    fn fire(&mut self, timer: DiscoveryTimer, now: Instant) {
        match timer {
            DiscoveryTimer::NeighbourExpiry => self.expire_neighbours(now),
        }
    }
}

impl Discovery {
    fn expire_neighbours(&mut self, now: Instant) {
        self.failed.retain(|_, until| now < *until);
        let is_over = |end: Option<Instant>| end.is_some_and(|end| now >= end);
        let gone = self.neighbours.iter().filter(|(_, known)| is_over(self.ends(known)));
        let gone: Vec<_> =
            gone.map(|(key, known)| (key.clone(), known.address.clone(), known.origin)).collect();
        for ((domain, node), address, origin) in gone {
            self.neighbours.remove(&(domain, node.clone()));
            if origin == Origin::Tried {
                self.fail(domain, address, now);
            }
            self.outputs.push_back(DiscoveryOutput::Disconnect { domain, node });
        }
    }
}
