//! What a module counts and measures. It outlives the incarnations of objects, and ends with the
//! process.

use super::messages::Numbered;
use crate::messages::SinkReport;
use blastema::platform;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{LazyLock, Mutex, MutexGuard, PoisonError};

/// Arrivals that are remembered, so that the director can look back: four seconds of the fastest
/// flow.
const RECENT_LIMIT: usize = 400;
/// Measured spans that wait for the director: ten seconds of the fastest probe.
const MEASURED_LIMIT: usize = 1_000;

static COUNTERS: LazyLock<Mutex<Counters>> = LazyLock::new(Mutex::default);

/// The counters of this process.
#[derive(Debug)]
pub(super) struct Counters {
    /// When the process began, in nanoseconds.
    pub(super) process: u64,
    /// The messages of each flow that the middleware has accepted here.
    pub(super) sent: BTreeMap<String, u64>,
    /// The flows that end here.
    pub(super) sinks: BTreeMap<String, FlowSink>,
    /// Spans in nanoseconds by their name, until they are taken.
    pub(super) measured: BTreeMap<String, Vec<u64>>,
    /// The fault after which an object answered again, and when.
    pub(super) served: Option<(u32, u64)>,
}

impl Default for Counters {
    fn default() -> Self {
        let process = platform::now().as_nanos().max(1);
        let (sent, sinks, measured) = Default::default();
        Counters { process, sent, sinks, measured, served: None }
    }
}

impl Counters {
    /// Returns the counters.
    pub(super) fn lock() -> MutexGuard<'static, Counters> {
        // A panic while the lock is held leaves valid counters.
        COUNTERS.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Keeps the span since `sent`.
    pub(super) fn measure(&mut self, name: &str, sent: u64) {
        let spans = self.measured.entry(name.to_owned()).or_default();
        if spans.len() < MEASURED_LIMIT {
            spans.push(platform::now().as_nanos().saturating_sub(sent));
        }
    }
}

/// The receiving end of a flow. Messages of one sender arrive in order, so that a number that is
/// left out is missing, and one that is not higher than the last has come too often.
#[derive(Debug, Default)]
pub(super) struct FlowSink {
    report: SinkReport,
    /// When each of the last messages was sent, and when it arrived.
    recent: VecDeque<(u64, u64)>,
}

impl FlowSink {
    /// Counts an arrival.
    pub(super) fn handle(&mut self, message: &Numbered, now: u64) {
        let Numbered { source, number, sent, .. } = *message;
        let report = &mut self.report;
        if source != report.source {
            // Of the first source that this process knows, earlier messages went to another one.
            report.missing += if report.source == 0 { 0 } else { number.saturating_sub(1) };
            (report.source, report.first) = (source, number);
            report.highest = number;
        } else if number > report.highest {
            report.missing += number - report.highest - 1;
            report.highest = number;
        } else {
            report.doubled += 1;
        }
        if self.recent.len() == RECENT_LIMIT {
            self.recent.pop_front();
        }
        self.recent.push_back((sent, now));
    }

    /// Returns the counters of this flow, and when the first message came that was sent from
    /// `since` on.
    pub(super) fn report(&self, flow: &str, since: u64) -> SinkReport {
        let passed = self.recent.iter().find(|(sent, _)| *sent >= since);
        let passed = passed.map(|(_, arrived)| *arrived);
        SinkReport { flow: flow.to_owned(), passed, ..self.report.clone() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sink(messages: &[(u64, u64)]) -> SinkReport {
        let mut sink = FlowSink::default();
        for &(source, number) in messages {
            let message = Numbered { flow: "flow".into(), source, number, sent: number * 10 };
            sink.handle(&message, number * 10 + 1);
        }
        sink.report("flow", 25)
    }

    #[test]
    fn what_is_missing_and_what_came_twice_is_counted() {
        let report = sink(&[(1, 5), (1, 6), (1, 9), (1, 9), (1, 8)]);

        assert_eq!((report.first, report.highest), (5, 9));
        assert_eq!((report.missing, report.doubled), (2, 2));
    }

    #[test]
    fn a_new_process_of_the_source_begins_at_one_and_earlier_gaps_stay_counted() {
        let report = sink(&[(1, 1), (1, 3), (2, 2), (2, 3)]);

        assert_eq!((report.source, report.first, report.highest), (2, 2, 3));
        assert_eq!((report.missing, report.doubled), (2, 0));
    }

    #[test]
    fn the_first_message_that_was_sent_since_an_instant_is_found() {
        assert_eq!(sink(&[(1, 1), (1, 2), (1, 3), (1, 4)]).passed, Some(31));
        assert_eq!(sink(&[(1, 1), (1, 2)]).passed, None);
    }
}
