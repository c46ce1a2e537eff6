//! Ends of a component's incarnations that were not reported yet.
//!
//! They stand with the cell and not with the executor, so that they are reported also where what
//! follows an end blocks its thread: by the watch, or by the supervisor that gives the next
//! incarnation up.

use crate::platform::lock;
use crate::runtime::reports::FaultReports;
use actix::Recipient;
use blastema_contract::child::{ChildEvent, ChildReport};
use blastema_contract::reports::{ExitReason, Exited};
use blastema_core::{Incarnation, ObjectName};
use std::sync::{Arc, Mutex};

/// As many as the component's guard has restarted it in one turn, and one.
#[derive(Default)]
pub(crate) struct UntoldExits(Mutex<Untold>);

#[derive(Default)]
struct Untold {
    exits: Vec<UntoldExit>,
    /// The ends of the incarnations up to this one were reported, or are no news: one that was
    /// abandoned may end later, while others report.
    reported_until: Incarnation,
}

/// An end that was not reported yet.
struct UntoldExit {
    incarnation: Incarnation,
    exit: Arc<ExitReason>,
    restarted_as: Option<Incarnation>,
    /// The supervisor, where it is to be notified as well.
    supervisor: Option<Arc<Recipient<ChildReport>>>,
    /// What follows is decided, and nothing of the component is to be reported before it: all of
    /// the above stays as it is.
    is_settled: bool,
}

/// Which ends are reported.
#[derive(Clone, Copy, Debug)]
pub(crate) enum DueExits {
    /// Those of the incarnations up to this one.
    Until(Incarnation),
    /// Those of which it is decided what follows, and that are next.
    Settled,
}

impl UntoldExits {
    fn change(&self, incarnation: Incarnation, change: impl FnOnce(&mut UntoldExit)) {
        let mut untold = lock(&self.0);
        let exited = untold.exits.iter_mut().find(|exited| exited.incarnation == incarnation);
        if let Some(exited) = exited {
            change(exited);
        }
    }

    /// An incarnation has ended. The first report of it counts.
    pub(crate) fn keep(&self, incarnation: Incarnation, exit: impl Into<Arc<ExitReason>>) {
        let exit = exit.into();
        let (restarted_as, supervisor, is_settled) = (None, None, false);
        let exited = UntoldExit { incarnation, exit, restarted_as, supervisor, is_settled };
        let mut untold = lock(&self.0);
        let is_known = untold.exits.iter().any(|known| known.incarnation == incarnation);
        if !is_known && incarnation > untold.reported_until {
            untold.exits.push(exited);
        }
    }

    /// Its guard has begun another one in its place.
    pub(crate) fn set_restarted(&self, incarnation: Incarnation, next: Incarnation) {
        self.change(incarnation, |exited| exited.restarted_as = Some(next));
    }

    /// What follows this end is decided; the supervisor is to be notified as well, where it is
    /// given. Where it is the next report of its component, the watch may tell it.
    pub(crate) fn settle(
        &self,
        incarnation: Incarnation,
        supervisor: Option<Arc<Recipient<ChildReport>>>,
        is_next: bool,
    ) {
        self.change(incarnation, |exited| {
            (exited.supervisor, exited.is_settled) = (supervisor, is_next);
        });
    }

    /// That incarnation had been given up before it ended: its end is no news.
    pub(crate) fn forget(&self, incarnation: Incarnation) {
        lock(&self.0).exits.retain(|exited| exited.incarnation != incarnation);
    }

    /// Reports each end once to the monitor and the supervisor.
    pub(crate) fn tell(&self, which: DueExits, object: &ObjectName, reports: &FaultReports) {
        let is_reported = |exited: &mut UntoldExit| match which {
            DueExits::Until(until) => exited.incarnation <= until,
            DueExits::Settled => exited.is_settled,
        };
        let mut untold = lock(&self.0);
        let reported: Vec<UntoldExit> = untold.exits.extract_if(.., is_reported).collect();
        let last = reported.iter().map(|exited| exited.incarnation).max();
        let until = match which {
            DueExits::Until(until) => Some(until),
            DueExits::Settled => last,
        };
        untold.reported_until = untold.reported_until.max(until.unwrap_or_default());
        drop(untold);
        for UntoldExit { incarnation, exit, restarted_as, supervisor, .. } in reported {
            let exit = Arc::unwrap_or_clone(exit);
            if let Some(exits) = &reports.exits {
                let (object, exit) = (object.clone(), exit.clone());
                exits.do_send(Exited { object, incarnation, exit, restarted_as });
            }
            if let Some(supervisor) = supervisor {
                let event = ChildEvent::Died { exit, restarted_as };
                supervisor.do_send(ChildReport { object: object.clone(), incarnation, event });
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::{Probe, paused};
    use std::time::Duration;

    #[test]
    fn an_end_is_reported_once_though_the_abandoned_incarnation_ends_while_others_report() {
        paused(async {
            let probe = Probe::<Exited>::start();
            let reports =
                FaultReports { exits: Some(probe.recipient()), ..FaultReports::default() };
            let (exits, object) = (UntoldExits::default(), ObjectName::new("arm").unwrap());
            let [first, second] = [Incarnation(1), Incarnation(2)];

            exits.keep(first, ExitReason::Aborted);
            exits.tell(DueExits::Until(first), &object, &reports);
            // The thread of the first goes on, and comes here before it knows that it was abandoned.
            exits.keep(first, ExitReason::Aborted);
            exits.keep(second, ExitReason::Stopped);
            exits.tell(DueExits::Until(second), &object, &reports);
            exits.forget(first);

            let reported = [probe.expect().await.incarnation, probe.expect().await.incarnation];
            assert_eq!(reported, [first, second]);
            probe.expect_none_for(Duration::from_secs(1)).await;
        });
    }
}
