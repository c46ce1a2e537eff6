//! The report of a run.

use crate::faults::DemoFault;
use crate::flow_account::FlowLosses;
use crate::messages::{FILTERED, FaultReport, UNFILTERED};
use serde::{Serialize, Serializer};
use std::collections::BTreeMap;
use std::time::Duration;

/// The report of a run; `--json` prints it.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct Report {
    /// Every fault was found, named rightly and recovered, and no promise was broken.
    pub(crate) promises_kept: bool,
    /// The run was not interrupted.
    pub(crate) finished: bool,
    /// From the first process's start to the last row.
    #[serde(rename = "took_ms", serialize_with = "as_millis")]
    pub(crate) took: Duration,
    /// One row for each fault.
    pub(crate) rows: Vec<FaultRow>,
    /// Problems outside of the rows.
    pub(crate) problems: Vec<String>,
    /// Reliable messages over the whole run.
    pub(crate) messages: FlowLosses,
    /// How many of them have arrived from and at the modules' last processes.
    pub(crate) received: u64,
    /// Overloads that were found where none was injected: the computer was too busy for the robot.
    pub(crate) overloads: u64,
    /// Response times between modules, and delivery times of events within one.
    pub(crate) latencies: Vec<LatencyRow>,
    /// How the figures were taken.
    pub(crate) notes: Vec<&'static str>,
}

/// One fault and its recovery.
#[derive(Clone, Debug, Serialize)]
pub(crate) struct FaultRow {
    /// Its number in the run, from 1.
    pub(crate) number: u32,
    /// The injected fault, with its story.
    #[serde(flatten)]
    pub(crate) fault: &'static DemoFault,
    #[serde(rename = "where")]
    pub(crate) location: String,
    /// The fault as reported by the middleware.
    pub(crate) named: Option<ReportedFault>,
    /// From the fault to its detection.
    #[serde(rename = "detected_after_ms", serialize_with = "maybe_as_millis")]
    pub(crate) detected_after: Option<Duration>,
    /// From the fault, or from its repair, to the return of service.
    #[serde(rename = "recovered_after_ms", serialize_with = "maybe_as_millis")]
    pub(crate) recovered_after: Option<Duration>,
    /// The recovery is counted from the repair, without which there was none.
    pub(crate) from_repair: bool,
    /// Reliable messages that did not arrive once.
    #[serde(flatten)]
    pub(crate) losses: FlowLosses,
    /// Further faults that the modules reported as its consequences.
    pub(crate) symptoms: u64,
    /// The broken promises.
    pub(crate) problems: Vec<String>,
}

/// A fault as reported by the middleware.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct ReportedFault {
    /// The code in the fault list.
    pub(crate) code: String,
    /// The kind as text.
    pub(crate) text: String,
    #[serde(rename = "where")]
    pub(crate) location: String,
    pub(crate) detail: String,
}

impl From<&FaultReport> for ReportedFault {
    fn from(report: &FaultReport) -> Self {
        ReportedFault {
            code: report.kind.code().to_owned(),
            text: report.kind.text().to_owned(),
            location: report.location.to_string(),
            detail: report.detail.clone(),
        }
    }
}

/// What was measured of one kind of message, in milliseconds.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct LatencyRow {
    /// A request and its reply between two modules, or an event to a listener in the same module.
    pub(crate) what: &'static str,
    /// The networks between the modules.
    pub(crate) over: &'static str,
    /// The number of measured messages.
    pub(crate) count: usize,
    /// The mean, the median, what 99 of 100 did not exceed, and the longest.
    #[serde(rename = "mean_median_p99_worst_ms", serialize_with = "all_as_millis")]
    pub(crate) figures: [Option<Duration>; 4],
    /// The mean in the paper's table 1.
    pub(crate) paper_mean_ms: Option<f64>,
}

/// What is measured: by which name in the modules, what it is, the networks, and the paper's mean.
const MEASURED: [(&str, &str, &str, Option<f64>); 5] = [
    ("ask/1-2", "request module1-module2", "ethernet", Some(0.345)),
    ("ask/1-3", "request module1-module3", "ieee1394", Some(0.420)),
    ("ask/2-3", "request module2-module3", "both", Some(0.759)),
    (UNFILTERED, UNFILTERED, "", None),
    (FILTERED, FILTERED, "", None),
];

/// Returns the figures of all that was measured, given in nanoseconds by its name.
pub(crate) fn latencies(measured: &BTreeMap<String, Vec<u64>>) -> Vec<LatencyRow> {
    let row = |(name, what, over, paper_mean_ms): (&str, _, _, _)| {
        let mut nanos = measured.get(name).cloned().unwrap_or_default();
        nanos.sort_unstable();
        let count = nanos.len();
        let mean = nanos.iter().sum::<u64>().checked_div(count as u64);
        let quantile =
            |percent: usize| nanos.get((count * percent).div_ceil(100).max(1) - 1).copied();
        let figures = [mean, quantile(50), quantile(99), quantile(100)];
        let figures = figures.map(|nanos| nanos.map(Duration::from_nanos));
        LatencyRow { what, over, count, figures, paper_mean_ms }
    };
    MEASURED.into_iter().map(row).collect()
}

/// A text that begins with its mark, and whether a row of the report has that mark.
type ReportNote = (&'static str, fn(&Report) -> bool);

/// How the figures were taken, ours and the paper's, each with the rows that it belongs to.
const NOTES: [ReportNote; 7] = [
    (
        "All times in milliseconds. The clock of a row starts when the fault is injected; it is recovered when the \
         object answers again, or when messages sent after the fault arrive. A supervisor that restarts an object at \
         once is faster than the report of the fault. A cut cable is silent: its medium reports nothing. Symptoms are \
         faults that the modules reported as consequences.",
        |_| true,
    ),
    ("r  from the return of the cables.", |report| report.rows.iter().any(|row| row.from_repair)),
    ("+p  so many messages became dead letters with the killed process.", |report| {
        report.rows.iter().any(|row| row.losses.perished > 0)
    }),
    (
        "+d  so many messages became dead letters: there was no path for longer than a session waits, 2 s.",
        |report| report.rows.iter().any(|row| row.losses.returned > 0),
    ),
    (
        "a  Baek and Park 2008, table 2: from the detection of a dead object among 100, with a sign of life every 100 \
         ms, to its re-creation; mean of 1000, at most 12.",
        |report| report.has_paper('a'),
    ),
    (
        "b  Baek and Park 2008, table 2: from the detection of a cut cable, with a sign of life every 3 s, to the first \
         answer over the other network, without the 10 s of the detection; mean of 1000, at most 13.",
        |report| report.has_paper('b'),
    ),
    (
        "c  Baek and Park 2008, table 1: event and answer between two PCs (Pentium IV, 3 GHz, Windows XP), mean of \
         10,000 without the worst; worst 20 (Ethernet) and 110 (IEEE 1394). Here: a request and its reply between \
         processes on one machine, all of them, during the faults.",
        |report| !report.latencies.is_empty(),
    ),
];

impl Report {
    /// Adds the notes that belong to a row.
    pub(crate) fn with_notes(mut self) -> Report {
        let notes = NOTES.iter().filter(|(_, concerns)| concerns(&self));
        self.notes = notes.map(|(text, _)| *text).collect();
        self
    }

    fn has_paper(&self, mark: char) -> bool {
        self.rows.iter().any(|row| row.fault.paper.is_some_and(|(of, _)| of == mark))
    }
}

/// So many of them, in words that agree.
pub(crate) fn counted(number: u64, thing: &str) -> String {
    let ending = if number == 1 { "" } else { "s" };
    format!("{number} {thing}{ending}")
}

/// Milliseconds with the precision of a microsecond's tenth, for display and JSON.
pub(crate) fn millis(span: Duration) -> f64 {
    (span.as_secs_f64() * 10_000_000.0).round() / 10_000.0
}

fn as_millis<S: Serializer>(span: &Duration, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_f64(millis(*span))
}

fn maybe_as_millis<S: Serializer>(
    span: &Option<Duration>,
    serializer: S,
) -> Result<S::Ok, S::Error> {
    span.map(millis).serialize(serializer)
}

fn all_as_millis<S: Serializer>(
    spans: &[Option<Duration>; 4],
    serializer: S,
) -> Result<S::Ok, S::Error> {
    spans.map(|span| span.map(millis)).serialize(serializer)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_has_the_quantiles_of_all_that_was_measured() {
        let rows = latencies(&[("ask/1-2".to_owned(), (1..=200).rev().collect())].into());
        let figures = |row: &LatencyRow| row.figures.map(|span| span.map(|span| span.as_nanos()));

        assert_eq!((rows[0].count, figures(&rows[0])), (200, [100, 100, 198, 200].map(Some)));
        assert_eq!((rows[1].count, figures(&rows[1])), (0, [None; 4]));
    }
}
