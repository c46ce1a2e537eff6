//! When a router acts by itself.

use super::Router;
use super::keys::RouterKeys;
use crate::Instant;
use crate::timer::Timers;

/// The timers of a router. Those of links and advertisements are the earliest of all of them.
#[derive(Clone, Copy, Debug)]
pub(crate) enum RouterTimer {
    /// Floods our own advertisement again: every 10 s (OSPF: LSRefreshTime), or 5 ms for each link
    /// after the last time, where links have changed (OSPF: MinLSInterval).
    RefreshOwn,
    /// Forgets an origin whose advertisement was not refreshed for 35 s (OSPF: MaxAge).
    AdvertisementExpiry,
    /// Sends again what a neighbour has not confirmed for 40 ms, 80 ms and so on up to 320 ms, ten
    /// times as long on a narrow link (OSPF: RxmtInterval).
    Retransmit,
    /// Sends the summary of the database, every second, every 10 s on a narrow link (IS-IS: CSNP
    /// interval).
    CompareDatabase,
    /// Computes the paths after a change of the topology: at once, but 5 ms after the last time at
    /// the earliest (SPF delay, RFC 8405).
    ComputeRoutes,
    /// Uses the link with another incarnation of a node that was reached, 1 s after it has come, if
    /// the reached one has not answered; 10 s where a narrow link leads there.
    Challenge,
    /// Reports the nodes that a restarted router has not found again after a second (OSPF: grace
    /// period, RFC 3623).
    RestartGrace,
    /// Goes on with handshakes, as the sealer of paths wants it.
    Handshake,
}

impl Timers for Router {
    type Timer = RouterTimer;

    const TIMERS: &'static [RouterTimer] = {
        use RouterTimer::*;
        &[
            RefreshOwn,
            AdvertisementExpiry,
            Retransmit,
            CompareDatabase,
            ComputeRoutes,
            Challenge,
            RestartGrace,
            Handshake,
        ]
    };

    fn due(&self, timer: RouterTimer) -> Option<Instant> {
        let links = self.links.values();
        match timer {
            RouterTimer::RefreshOwn => Some(self.refresh_due()),
            RouterTimer::AdvertisementExpiry => self.database.expires_at(),
            RouterTimer::Retransmit => {
                links.flat_map(|link| link.pending.values()).map(|(due, _)| *due).min()
            }
            RouterTimer::CompareDatabase => links.map(|link| link.compare_at).min(),
            RouterTimer::ComputeRoutes => self.table.compute_at,
            RouterTimer::Challenge => self.names.decide_at(),
            RouterTimer::RestartGrace => self.remembered.as_ref().map(|(until, _)| *until),
            RouterTimer::Handshake => self.keys.as_ref().and_then(RouterKeys::due),
        }
    }

    fn fire(&mut self, timer: RouterTimer, now: Instant) {
        match timer {
            RouterTimer::RefreshOwn => self.renew(),
            RouterTimer::AdvertisementExpiry => self.forget_the_old(),
            RouterTimer::Retransmit | RouterTimer::CompareDatabase => self.synchronise(now),
            RouterTimer::ComputeRoutes => self.compute(),
            RouterTimer::Challenge => self.decide_challenges(),
            RouterTimer::RestartGrace => self.report_not_found_again(),
            RouterTimer::Handshake => self.handle_handshakes(),
        }
    }
}
