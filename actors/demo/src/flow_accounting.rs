//! Compares the messages that the flows' sources sent with those that their sinks received.
//!
//! Dead letters and session counters state what the middleware has noticed. A message that it loses
//! or doubles without noticing is in neither; the numbers of the flows show it.

use super::machine_instant::MachineInstant;
use super::protocol::{SinkState, Snapshot, SourceState};
use super::robot::{FLOWS, Flow};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ops::Sub;

/// The accounts of all flows.
#[derive(Debug)]
pub(crate) struct FlowAccounting {
    accounts: BTreeMap<&'static str, Account>,
}

/// Losses of reliable messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct FlowLosses {
    /// Accepted and not delivered, although both processes ran: a broken promise.
    pub(crate) lost: u64,
    /// Delivered more than once: a broken promise.
    pub(crate) doubled: u64,
    /// Lost with the killed process that held them, at most.
    pub(crate) perished: u64,
    /// Accepted, not delivered, and reported as dead letters: there was no path for longer than a
    /// session waits.
    pub(crate) returned: u64,
}

impl Sub for FlowLosses {
    type Output = FlowLosses;

    /// The losses since `earlier`. A message that arrived late does not make a count negative.
    fn sub(self, earlier: FlowLosses) -> FlowLosses {
        FlowLosses {
            lost: self.lost.saturating_sub(earlier.lost),
            doubled: self.doubled.saturating_sub(earlier.doubled),
            perished: self.perished.saturating_sub(earlier.perished),
            returned: self.returned.saturating_sub(earlier.returned),
        }
    }
}

#[derive(Debug, Default)]
struct Account {
    source: SourceState,
    sink: SinkState,
    /// The losses of the sink's former processes.
    closed: FlowLosses,
    /// The last number of the source's former process.
    old_epoch_sent: u64,
    /// The dead letters of the source's former processes.
    old_epochs_returned: u64,
    /// The dead letters up to the sink's present process, which explain nothing in it.
    spent: u64,
    settling: Settling,
}

#[derive(Clone, Copy, Debug, Default)]
enum Settling {
    #[default]
    No,
    /// Waits for a report of the source that is later than this.
    Asked { since: MachineInstant },
    /// All up to this number of this epoch must have arrived.
    Until { epoch: u64, number: u64 },
}

impl Default for FlowAccounting {
    fn default() -> Self {
        FlowAccounting { accounts: FLOWS.map(|flow| (flow.name, Account::default())).into() }
    }
}

impl FlowAccounting {
    /// Handles the snapshot of one module.
    pub(crate) fn handle_snapshot(&mut self, snapshot: &Snapshot) {
        for source in &snapshot.sources {
            if let Some(account) = self.accounts.get_mut(source.flow.as_str()) {
                account.handle_source(source, snapshot.at);
            }
        }
        for sink in &snapshot.sinks {
            if let Some(account) = self.accounts.get_mut(sink.flow.as_str()) {
                account.handle_sink(sink);
            }
        }
    }

    /// From now on [`is_settled`](Self::is_settled) tells whether all that was sent up to now
    /// arrived.
    pub(crate) fn settle(&mut self, now: MachineInstant) {
        for account in self.accounts.values_mut() {
            account.settling = Settling::Asked { since: now };
        }
    }

    /// All that had been sent when it was asked has arrived.
    pub(crate) fn is_settled(&self) -> bool {
        self.accounts.values().all(Account::is_settled)
    }

    /// Every flow has delivered something of its source's present process.
    pub(crate) fn is_flowing(&self) -> bool {
        self.accounts.values().all(Account::is_flowing)
    }

    /// The sum over all flows since the start.
    pub(crate) fn losses(&self) -> FlowLosses {
        let mut sum = FlowLosses::default();
        for losses in self.accounts.values().map(Account::losses) {
            sum.lost += losses.lost;
            sum.doubled += losses.doubled;
            sum.perished += losses.perished;
            sum.returned += losses.returned;
        }
        sum
    }

    /// Messages that arrived, over all flows, as far as the sinks' present processes know.
    pub(crate) fn received(&self) -> u64 {
        self.accounts.values().map(Account::received).sum()
    }

    /// The flows that have not settled.
    pub(crate) fn unsettled(&self) -> impl Iterator<Item = &'static Flow> + '_ {
        let open = self.accounts.iter().filter(|(_, account)| !account.is_settled());
        open.filter_map(|(name, _)| Flow::from_name(name))
    }
}

impl Account {
    fn handle_source(&mut self, source: &SourceState, at: MachineInstant) {
        if source.epoch != self.source.epoch {
            self.old_epoch_sent = self.source.sent;
            self.old_epochs_returned += self.source.returned;
            // Messages of an ended process have arrived or are lost: they are not awaited.
            if let Settling::Until { .. } = self.settling {
                self.settling = Settling::Until { epoch: source.epoch, number: 0 };
            }
        }
        self.source.clone_from(source);
        if let Settling::Asked { since } = self.settling
            && at >= since
        {
            self.settling = Settling::Until { epoch: source.epoch, number: source.sent };
        }
    }

    fn handle_sink(&mut self, sink: &SinkState) {
        // Before its first message, a process gives no evidence about its predecessor.
        if sink.epoch == 0 {
            return;
        }
        let old = &self.sink;
        if old.epoch != 0 && sink.process != old.process {
            let missing = old.missing + old.missing_before;
            let returned = missing.min(self.returned());
            self.closed.lost += missing - returned;
            self.closed.returned += returned;
            self.spent += self.returned();
            self.closed.doubled += old.doubled;
            if sink.epoch == old.epoch {
                self.closed.perished += sink.first.saturating_sub(old.highest + 1);
                self.closed.doubled += (old.highest + 1).saturating_sub(sink.first);
            }
        }
        if old.epoch != 0 && sink.epoch != old.epoch {
            self.closed.perished += self.old_epoch_sent.saturating_sub(old.highest);
            // The first messages of the new source were sent to a running sink.
            self.closed.lost += sink.first.saturating_sub(1);
        }
        self.sink.clone_from(sink);
    }

    fn is_settled(&self) -> bool {
        match self.settling {
            Settling::No => true,
            Settling::Asked { .. } => false,
            Settling::Until { epoch, number } => {
                let arrived = self.sink.epoch == epoch && self.sink.highest >= number;
                number == 0 || (arrived && self.sink.missing <= self.returned())
            }
        }
    }

    fn is_flowing(&self) -> bool {
        self.source.epoch != 0 && self.sink.epoch == self.source.epoch
    }

    fn losses(&self) -> FlowLosses {
        let tail = match self.settling {
            Settling::Until { epoch, number } if epoch == self.sink.epoch => {
                number.saturating_sub(self.sink.highest)
            }
            Settling::Until { number, .. } => number,
            Settling::No | Settling::Asked { .. } => 0,
        };
        let missing = self.sink.missing + self.sink.missing_before + tail;
        let returned = missing.min(self.returned());
        FlowLosses {
            lost: self.closed.lost + missing - returned,
            doubled: self.closed.doubled + self.sink.doubled,
            perished: self.closed.perished,
            returned: self.closed.returned + returned,
        }
    }

    /// The dead letters since the sink's present process began.
    fn returned(&self) -> u64 {
        (self.old_epochs_returned + self.source.returned).saturating_sub(self.spent)
    }

    fn received(&self) -> u64 {
        let sink = &self.sink;
        (sink.highest + 1).saturating_sub(sink.first.max(1)).saturating_sub(sink.missing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FLOW: &str = "flow/2-3";

    fn source(epoch: u64, sent: u64) -> SourceState {
        SourceState { flow: FLOW.into(), epoch, sent, returned: 0 }
    }

    fn sink(process: u64, epoch: u64, first: u64, highest: u64) -> SinkState {
        SinkState { flow: FLOW.into(), process, epoch, first, highest, ..SinkState::default() }
    }

    fn report(
        accounting: &mut FlowAccounting,
        at: u64,
        sources: &[SourceState],
        sinks: &[SinkState],
    ) {
        let at = MachineInstant::from_millis(at);
        accounting.handle_snapshot(&Snapshot {
            at,
            sources: sources.to_vec(),
            sinks: sinks.to_vec(),
            ..Snapshot::default()
        });
    }

    /// The other flows stand still and are at peace.
    fn accounting() -> FlowAccounting {
        let mut accounting = FlowAccounting::default();
        accounting.accounts.retain(|name, _| *name == FLOW);
        accounting
    }

    #[test]
    fn a_flow_has_settled_when_all_that_was_sent_before_has_arrived() {
        let mut accounting = accounting();
        report(&mut accounting, 10, &[source(1, 100)], &[sink(1, 1, 1, 90)]);
        assert!(accounting.is_flowing() && accounting.is_settled());

        accounting.settle(MachineInstant::from_millis(15));
        assert!(!accounting.is_settled());
        report(&mut accounting, 14, &[source(1, 105)], &[sink(1, 1, 1, 120)]);
        assert!(!accounting.is_settled(), "the source spoke too early");
        report(&mut accounting, 16, &[source(1, 121)], &[sink(1, 1, 1, 120)]);
        assert_eq!(accounting.losses(), FlowLosses { lost: 1, ..FlowLosses::default() });
        assert_eq!(accounting.unsettled().count(), 1);
        report(&mut accounting, 20, &[source(1, 130)], &[sink(1, 1, 1, 121)]);

        assert!(accounting.is_settled());
        assert_eq!(accounting.losses(), FlowLosses::default());
        assert_eq!(accounting.received(), 121);
    }

    #[test]
    fn a_gap_is_lost_and_a_second_copy_is_doubled() {
        let mut accounting = accounting();
        let torn = SinkState { missing: 3, doubled: 2, missing_before: 1, ..sink(1, 1, 1, 50) };
        report(&mut accounting, 10, &[source(1, 50)], &[torn]);

        assert_eq!(
            accounting.losses(),
            FlowLosses { lost: 4, doubled: 2, ..FlowLosses::default() }
        );
    }

    #[test]
    fn what_was_on_its_way_to_a_killed_process_perished_and_was_not_lost() {
        let mut accounting = accounting();
        report(&mut accounting, 10, &[source(1, 100)], &[sink(1, 1, 1, 95)]);
        report(&mut accounting, 20, &[source(1, 110)], &[sink(2, 0, 0, 0)]);
        assert_eq!(accounting.losses(), FlowLosses::default());
        report(&mut accounting, 30, &[source(1, 130)], &[sink(2, 1, 111, 130)]);

        assert_eq!(accounting.losses(), FlowLosses { perished: 15, ..FlowLosses::default() });
    }

    #[test]
    fn what_an_earlier_incarnation_had_taken_is_doubled_when_it_comes_to_the_next() {
        let mut accounting = accounting();
        report(&mut accounting, 10, &[source(1, 100)], &[sink(1, 1, 1, 95)]);
        report(&mut accounting, 30, &[source(1, 130)], &[sink(2, 1, 94, 130)]);

        assert_eq!(accounting.losses(), FlowLosses { doubled: 2, ..FlowLosses::default() });
    }

    #[test]
    fn a_killed_source_begins_anew_and_takes_its_unsent_messages_along() {
        let mut accounting = accounting();
        report(&mut accounting, 10, &[source(1, 100)], &[sink(1, 1, 1, 95)]);
        report(&mut accounting, 20, &[source(2, 0)], &[]);
        assert!(!accounting.is_flowing());
        report(&mut accounting, 30, &[source(2, 9)], &[sink(1, 2, 1, 9)]);

        assert!(accounting.is_flowing());
        assert_eq!(accounting.losses(), FlowLosses { perished: 5, ..FlowLosses::default() });
    }

    #[test]
    fn what_a_killed_source_had_sent_is_not_awaited_any_more() {
        let mut accounting = accounting();
        accounting.settle(MachineInstant::from_millis(5));
        report(&mut accounting, 10, &[source(1, 100)], &[sink(1, 1, 1, 100)]);
        assert!(accounting.is_settled());
        report(&mut accounting, 20, &[source(2, 3)], &[]);
        report(&mut accounting, 30, &[source(2, 9)], &[sink(1, 2, 1, 9)]);

        assert!(accounting.is_settled());
        assert_eq!(accounting.losses(), FlowLosses::default());
    }

    #[test]
    fn a_gap_that_was_reported_as_dead_letters_is_returned_and_what_exceeds_it_is_lost() {
        let mut accounting = accounting();
        accounting.settle(MachineInstant::from_millis(5));
        let returned = SourceState { returned: 20, ..source(1, 100) };
        let gap = |missing| SinkState { missing, ..sink(1, 1, 1, 100) };

        report(&mut accounting, 10, &[source(1, 100)], &[gap(20)]);
        assert!(!accounting.is_settled());
        report(&mut accounting, 20, std::slice::from_ref(&returned), &[gap(20)]);
        assert!(accounting.is_settled());
        assert_eq!(accounting.losses(), FlowLosses { returned: 20, ..FlowLosses::default() });
        report(&mut accounting, 30, &[returned], &[gap(23)]);

        assert!(!accounting.is_settled());
        let losses = FlowLosses { lost: 3, returned: 20, ..FlowLosses::default() };
        assert_eq!(accounting.losses(), losses);
    }

    #[test]
    fn dead_letters_for_a_killed_process_excuse_no_later_loss() {
        let mut accounting = accounting();
        let returned = SourceState { returned: 15, ..source(1, 130) };
        report(&mut accounting, 10, &[source(1, 100)], &[sink(1, 1, 1, 95)]);
        report(&mut accounting, 30, &[returned], &[sink(2, 1, 111, 130)]);
        let perished = FlowLosses { perished: 15, ..FlowLosses::default() };
        assert_eq!(accounting.losses(), perished);

        let torn = SinkState { missing: 2, ..sink(2, 1, 111, 140) };
        report(&mut accounting, 40, &[], &[torn]);

        assert_eq!(accounting.losses(), FlowLosses { lost: 2, ..perished });
    }

    #[test]
    fn what_a_killed_source_had_reported_stays_reported() {
        let mut accounting = accounting();
        let returned = SourceState { returned: 4, ..source(1, 100) };
        let gap = SinkState { missing: 4, ..sink(1, 1, 1, 100) };
        report(&mut accounting, 10, &[returned], &[gap]);
        let gap = SinkState { missing_before: 4, ..sink(1, 2, 1, 9) };
        report(&mut accounting, 30, &[source(2, 9)], &[gap]);

        assert_eq!(accounting.losses(), FlowLosses { returned: 4, ..FlowLosses::default() });
    }

    #[test]
    fn only_what_came_later_counts_for_a_step() {
        let before = FlowLosses { lost: 5, doubled: 1, perished: 0, returned: 0 };
        let after = FlowLosses { lost: 3, doubled: 4, perished: 2, returned: 1 };

        let step = FlowLosses { lost: 0, doubled: 3, perished: 2, returned: 1 };
        assert_eq!(after - before, step);
    }
}
