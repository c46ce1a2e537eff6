//! Compares the messages of a flow that were sent with those that were received.
//!
//! Dead letters state what the middleware has noticed. A message that it loses or doubles without
//! noticing is no dead letter; the numbers of the flow show it.

use crate::messages::{SinkReport, SourceReport};
use serde::Serialize;
use std::iter::Sum;
use std::ops::{Add, Sub};

/// Losses of reliable messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub(crate) struct FlowLosses {
    /// Accepted and not delivered, although both processes ran: a broken promise.
    pub(crate) lost: u64,
    /// Delivered more than once: a broken promise.
    pub(crate) doubled: u64,
    /// Dead letters because the receiving process had died.
    pub(crate) perished: u64,
    /// Dead letters because there was no path for longer than a session waits.
    pub(crate) returned: u64,
}

impl FlowLosses {
    fn combined(self, other: FlowLosses, combine: fn(u64, u64) -> u64) -> FlowLosses {
        FlowLosses {
            lost: combine(self.lost, other.lost),
            doubled: combine(self.doubled, other.doubled),
            perished: combine(self.perished, other.perished),
            returned: combine(self.returned, other.returned),
        }
    }
}

impl Add for FlowLosses {
    type Output = FlowLosses;

    fn add(self, other: FlowLosses) -> FlowLosses {
        self.combined(other, u64::saturating_add)
    }
}

impl Sub for FlowLosses {
    type Output = FlowLosses;

    fn sub(self, earlier: FlowLosses) -> FlowLosses {
        self.combined(earlier, u64::saturating_sub)
    }
}

impl Sum for FlowLosses {
    fn sum<I: Iterator<Item = FlowLosses>>(all: I) -> FlowLosses {
        all.fold(FlowLosses::default(), Add::add)
    }
}

/// The account of one flow.
#[derive(Debug, Default)]
pub(crate) struct FlowAccount {
    source: SourceReport,
    source_process: u64,
    sink: SinkReport,
    sink_process: u64,
    /// The losses of the sink's former processes, and the dead letters of the source's.
    former: FlowLosses,
    former_returned: u64,
    /// The dead letters up to the sink's present process, which excuse no loss in it.
    spent: u64,
    settling: Settling,
}

#[derive(Clone, Copy, Debug, Default)]
enum Settling {
    #[default]
    No,
    /// Waits for a report of the source that is later than this.
    Asked { since: u64 },
    /// All up to this number of this process must have arrived.
    Until { source: u64, number: u64 },
}

impl FlowAccount {
    /// Handles a report of the source, made by this process at this instant.
    pub(crate) fn handle_source(&mut self, source: &SourceReport, process: u64, at: u64) {
        if process != self.source_process {
            self.former.perished += self.source.perished;
            self.former_returned += self.source.returned;
            // Messages of an ended process have arrived or are lost: they are not awaited.
            if let Settling::Until { .. } = self.settling {
                self.settling = Settling::Until { source: process, number: 0 };
            }
        }
        (self.source, self.source_process) = (source.clone(), process);
        if let Settling::Asked { since } = self.settling
            && at >= since
        {
            self.settling = Settling::Until { source: process, number: source.sent };
        }
    }

    /// Handles a report of the sink, made by this process.
    pub(crate) fn handle_sink(&mut self, sink: &SinkReport, process: u64) {
        if self.sink.source != 0 && process != self.sink_process {
            let (losses, old) = (self.losses(), &self.sink);
            let is_same = sink.source == old.source;
            let again = if is_same { (old.highest + 1).saturating_sub(sink.first) } else { 0 };
            let excused = losses.returned - self.former.returned;
            self.former = FlowLosses {
                doubled: losses.doubled + again,
                // What was given back and is not missing was on its way to the process that ended.
                perished: self.former.perished + self.excuses() - excused,
                ..losses
            };
            self.spent += self.excuses();
        }
        (self.sink, self.sink_process) = (sink.clone(), process);
    }

    /// From now on [`is_settled`](Self::is_settled) tells whether all that was sent up to now has
    /// arrived.
    pub(crate) fn settle(&mut self, now: u64) {
        self.settling = Settling::Asked { since: now };
    }

    /// Returns whether all that had been sent when it was asked has arrived or is a dead letter.
    pub(crate) fn is_settled(&self) -> bool {
        match self.settling {
            Settling::No => true,
            Settling::Asked { .. } => false,
            Settling::Until { source, number } => {
                let arrived = self.sink.source == source && self.sink.highest >= number;
                number == 0 || (arrived && self.sink.missing <= self.excuses())
            }
        }
    }

    /// Returns whether the sink has received something of the source's present process.
    pub(crate) fn is_flowing(&self) -> bool {
        self.source_process != 0 && self.sink.source == self.source_process
    }

    /// Returns the losses since the start.
    pub(crate) fn losses(&self) -> FlowLosses {
        let excused = self.sink.missing.min(self.excuses());
        FlowLosses {
            lost: self.former.lost + self.sink.missing - excused,
            doubled: self.former.doubled + self.sink.doubled,
            perished: self.former.perished + self.source.perished,
            returned: self.former.returned + excused,
        }
    }

    /// Returns how many messages have arrived from and at the present processes.
    pub(crate) fn received(&self) -> u64 {
        let SinkReport { first, highest, missing, .. } = self.sink;
        (highest + 1).saturating_sub(first.max(1)).saturating_sub(missing)
    }

    /// When the first message arrived that was sent since the instant that the sink was asked for.
    pub(crate) fn passed(&self) -> Option<u64> {
        self.sink.passed
    }

    /// The dead letters since the sink's present process began.
    fn excuses(&self) -> u64 {
        (self.former_returned + self.source.returned).saturating_sub(self.spent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn source(sent: u64, returned: u64) -> SourceReport {
        SourceReport { flow: String::new(), sent, perished: 0, returned }
    }

    fn sink(source: u64, first: u64, highest: u64, missing: u64) -> SinkReport {
        SinkReport { source, first, highest, missing, ..SinkReport::default() }
    }

    /// The source's process is 1, the sink's 5.
    fn account(source: &SourceReport, sink: &SinkReport) -> FlowAccount {
        let mut account = FlowAccount::default();
        account.settle(5);
        account.handle_source(source, 1, 10);
        account.handle_sink(sink, 5);
        account
    }

    #[test]
    fn a_flow_has_settled_when_all_that_was_sent_before_has_arrived() {
        let mut account = account(&source(100, 0), &sink(1, 1, 100, 0));
        assert!(account.is_flowing() && account.is_settled());

        account.settle(15);
        account.handle_source(&source(105, 0), 1, 14);
        assert!(!account.is_settled(), "the source spoke too early");
        account.handle_source(&source(121, 0), 1, 16);
        account.handle_sink(&sink(1, 1, 120, 0), 5);
        assert!(!account.is_settled());
        account.handle_sink(&sink(1, 1, 121, 0), 5);

        assert!(account.is_settled());
        assert_eq!((account.losses(), account.received()), (FlowLosses::default(), 121));
    }

    #[test]
    fn a_gap_is_lost_unless_it_was_reported_as_dead_letters() {
        let mut account = account(&source(100, 0), &sink(1, 1, 100, 20));
        assert!(!account.is_settled());

        account.handle_source(&source(100, 20), 1, 20);
        assert!(account.is_settled());
        assert_eq!(account.losses(), FlowLosses { returned: 20, ..FlowLosses::default() });

        account.handle_sink(&SinkReport { doubled: 2, ..sink(1, 1, 100, 23) }, 5);
        let wanted = FlowLosses { lost: 3, doubled: 2, returned: 20, perished: 0 };
        assert!(!account.is_settled());
        assert_eq!(account.losses(), wanted);
    }

    #[test]
    fn what_was_on_its_way_to_a_killed_process_has_perished_and_excuses_no_later_loss() {
        let mut account = account(&source(100, 0), &sink(1, 1, 95, 0));
        let letters = SourceReport { perished: 12, ..source(130, 3) };
        account.handle_source(&letters, 1, 20);
        account.handle_sink(&sink(1, 111, 130, 0), 6);
        let perished = FlowLosses { perished: 15, ..FlowLosses::default() };
        assert_eq!((account.losses(), account.received()), (perished, 20));

        account.handle_sink(&sink(1, 111, 140, 2), 6);
        assert_eq!(account.losses(), FlowLosses { lost: 2, ..perished });
    }

    #[test]
    fn what_an_earlier_process_had_taken_is_doubled_when_it_comes_to_the_next() {
        let mut account = account(&source(130, 0), &sink(1, 1, 95, 0));
        account.handle_sink(&sink(1, 94, 130, 0), 6);

        assert_eq!(account.losses(), FlowLosses { doubled: 2, ..FlowLosses::default() });
    }

    #[test]
    fn a_killed_source_begins_anew_and_what_it_had_sent_is_not_awaited_any_more() {
        let mut account = account(&source(100, 4), &sink(1, 1, 95, 4));
        assert!(!account.is_settled());

        account.handle_source(&source(3, 0), 2, 20);
        assert!(account.is_settled() && !account.is_flowing());
        account.handle_sink(&sink(2, 1, 3, 4), 5);

        assert!(account.is_flowing());
        assert_eq!(account.losses(), FlowLosses { returned: 4, ..FlowLosses::default() });
    }
}
