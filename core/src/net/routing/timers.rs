//! When a router acts by itself.

use super::Router;
use crate::Instant;
use crate::timer::Timers;

/// The timers of a router. Those of links and advertisements are the earliest of all of them.
#[derive(Clone, Copy, Debug)]
pub(crate) enum RouterTimer {
    /// Floods our own advertisement again, every 10 s (OSPF: LSRefreshTime).
    RefreshOwn,
    /// Forgets an origin whose advertisement was not refreshed for 35 s (OSPF: MaxAge).
    AdvertisementExpiry,
    /// Applies a withdrawal, 50 ms after it was received (hold-down).
    WithdrawalHold,
    /// Sends again what a neighbour has not confirmed for 40 ms, 400 ms on a narrow link (OSPF:
    /// RxmtInterval).
    Retransmit,
    /// Sends the summary of the database, every second, every 10 s on a narrow link (IS-IS: CSNP
    /// interval).
    CompareDatabase,
    /// Computes the paths after a change of the topology: at once, but 5 ms after the last time at
    /// the earliest (SPF delay, RFC 8405).
    ComputeRoutes,
    /// Takes the holder of a disputed name for ended that has not defended it for a second (RFC
    /// 5227: probe wait).
    ConflictDefence,
    /// Reports the nodes that a restarted router has not found again after a second (OSPF: grace
    /// period, RFC 3623).
    RestartGrace,
    /// Clears an alarm that was not raised again for 60 s.
    AlarmClear,
}

impl Timers for Router {
    type Timer = RouterTimer;

    const TIMERS: &'static [RouterTimer] = {
        use RouterTimer::*;
        &[
            RefreshOwn,
            AdvertisementExpiry,
            WithdrawalHold,
            Retransmit,
            CompareDatabase,
            ComputeRoutes,
            ConflictDefence,
            RestartGrace,
            AlarmClear,
        ]
    };

    fn due(&self, timer: RouterTimer) -> Option<Instant> {
        let (links, known) = (self.links.values(), self.known.values());
        match timer {
            RouterTimer::RefreshOwn => Some(self.refresh_at),
            RouterTimer::AdvertisementExpiry => known.map(|known| known.expires).min(),
            RouterTimer::WithdrawalHold => {
                known.filter_map(|known| Some(known.believed.as_ref()?.1)).min()
            }
            RouterTimer::Retransmit => links.flat_map(|link| link.pending.values()).min().copied(),
            RouterTimer::CompareDatabase => links.map(|link| link.compare_at).min(),
            RouterTimer::ComputeRoutes => self.compute_at,
            RouterTimer::ConflictDefence => self.dispute_ends(),
            RouterTimer::RestartGrace => self.remembered.as_ref().map(|(until, _)| *until),
            RouterTimer::AlarmClear => self.troubles.due(),
        }
    }

    fn fire(&mut self, timer: RouterTimer, now: Instant) {
        match timer {
            RouterTimer::RefreshOwn => self.renew(),
            RouterTimer::AdvertisementExpiry | RouterTimer::WithdrawalHold => self.forget_the_old(),
            RouterTimer::Retransmit | RouterTimer::CompareDatabase => self.synchronise(now),
            RouterTimer::ComputeRoutes => self.compute(),
            RouterTimer::ConflictDefence => self.settle_disputes(),
            RouterTimer::RestartGrace => self.report_not_found_again(),
            RouterTimer::AlarmClear => self.end_troubles(),
        }
    }
}
