//! The report of a run.

use super::flow_accounting::FlowLosses;
use super::protocol::FaultNote;
use super::robot::Module;
use super::robot_state::Measured;
use super::timings::Timings;
use serde::{Serialize, Serializer};
use std::time::Duration;

/// The report of a run; `--json` prints it.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct Report {
    /// Every fault was found, named rightly and recovered, and no promise was broken.
    pub(crate) promises_kept: bool,
    /// The run was not interrupted.
    pub(crate) finished: bool,
    /// The seed of the run.
    pub(crate) seed: u64,
    /// Random faults instead of the scenario.
    pub(crate) chaos: bool,
    /// From the first process's start to the last row.
    #[serde(rename = "took_ms", serialize_with = "as_millis")]
    pub(crate) took: Duration,
    /// One row for each fault.
    pub(crate) rows: Vec<FaultRow>,
    /// Rows without a problem that a long run does not list.
    pub(crate) rows_left_out: u64,
    /// Problems outside of the rows.
    pub(crate) problems: Vec<String>,
    /// Reliable messages over the whole run.
    pub(crate) messages: FlowLosses,
    /// Messages that a row counts as lost and that arrived later.
    pub(crate) late: u64,
    /// How many of them the sinks' last processes received.
    pub(crate) received: u64,
    /// Overloads that were found where none was injected: the computer was too busy for the robot.
    pub(crate) overloads: u64,
    /// ResponseTimes times between modules, ours and the paper's.
    pub(crate) responses: Vec<ResponseTimes>,
    /// DeliveryTimes of events within a module.
    pub(crate) events: Vec<DeliveryTimes>,
    /// How the figures were taken.
    pub(crate) notes: Vec<&'static str>,
}

/// One fault and its recovery.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct FaultRow {
    /// Its number in the run, from 1.
    pub(crate) number: u32,
    /// The kind of the injected fault.
    pub(crate) fault: &'static str,
    /// Where.
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
    /// Reliable messages lost.
    pub(crate) lost: u64,
    /// Reliable messages doubled.
    pub(crate) doubled: u64,
    /// Reliable messages that were lost with a killed process, at most.
    pub(crate) perished: u64,
    /// Reliable messages that became dead letters because there was no path for too long.
    pub(crate) returned: u64,
    /// Further faults that the modules reported as its consequences.
    pub(crate) symptoms: u64,
    /// The paper's figure in milliseconds, if it measured something like it.
    pub(crate) paper: Option<&'static str>,
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
    /// Where.
    #[serde(rename = "where")]
    pub(crate) location: String,
    /// The particulars.
    pub(crate) detail: String,
}

impl From<&FaultNote> for ReportedFault {
    fn from(note: &FaultNote) -> Self {
        ReportedFault {
            code: note.kind.code().to_owned(),
            text: note.kind.text().to_owned(),
            location: note.location.to_string(),
            detail: note.detail.clone(),
        }
    }
}

/// The time from a request to its reply between two modules.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct ResponseTimes {
    /// The two modules.
    pub(crate) modules: [&'static str; 2],
    /// The networks between them.
    pub(crate) over: &'static str,
    /// Ours.
    #[serde(flatten)]
    pub(crate) figures: LatencySummary,
    /// The mean in the paper's table 1, in milliseconds.
    pub(crate) paper_mean_ms: f64,
}

/// The time from a publisher to a listener in the same module.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub(crate) struct DeliveryTimes {
    /// Whether the listener gave a condition.
    pub(crate) filtered: bool,
    /// Ours.
    #[serde(flatten)]
    pub(crate) figures: LatencySummary,
}

/// Timings in figures.
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub(crate) struct LatencySummary {
    /// How many.
    pub(crate) count: u64,
    /// The mean.
    #[serde(rename = "mean_ms", serialize_with = "maybe_as_millis")]
    pub(crate) mean: Option<Duration>,
    /// Half were at most this.
    #[serde(rename = "median_ms", serialize_with = "maybe_as_millis")]
    pub(crate) median: Option<Duration>,
    /// 99 of 100 were at most this.
    #[serde(rename = "p99_ms", serialize_with = "maybe_as_millis")]
    pub(crate) p99: Option<Duration>,
    /// The shortest.
    #[serde(rename = "least_ms", serialize_with = "maybe_as_millis")]
    pub(crate) least: Option<Duration>,
    /// The longest.
    #[serde(rename = "worst_ms", serialize_with = "maybe_as_millis")]
    pub(crate) worst: Option<Duration>,
}

impl From<&Timings> for LatencySummary {
    fn from(timings: &Timings) -> Self {
        LatencySummary {
            count: timings.count(),
            mean: timings.mean(),
            median: timings.quantile(500),
            p99: timings.quantile(990),
            least: timings.least(),
            worst: timings.worst(),
        }
    }
}

/// What the paper measured for a row of ours, if it did.
pub(crate) fn paper_figure(fault: &str) -> Option<&'static str> {
    match fault {
        "panic" => Some("11.1 (at most 12)"),
        "cable cut" => Some("12 (at most 13)"),
        _ => None,
    }
}

/// How the figures were taken: ours and the paper's.
pub(crate) const NOTES: [&str; 5] = [
    "All times in milliseconds. The clock of a row starts when the fault is present; it is recovered \
     when the object answers again, or when messages sent after the fault arrive. A supervisor that \
     restarts an object at once is faster than the report of the fault. A cut cable is silent: its \
     medium reports nothing. Symptoms are faults that the modules reported as consequences.",
    "r  from the return of the cables.  +p  at most so many messages were lost with the killed process. \
     +d  so many became dead letters: there was no path for longer than a session waits, 2 s.",
    "a  Baek and Park 2008, table 2, for a panic: 11.1 (at most 12) from the detection of a dead \
     object among 100, with a sign of life every 100 ms, to its re-creation; mean of 1000.",
    "b  Ibid., for a cut cable: 12 (at most 13) from its detection, with a sign of life every 3 s, to \
     the first answer over the other network, without the 10 s of the detection; mean of 1000.",
    "c  Ibid., table 1: event and answer between two PCs (Pentium IV, 3 GHz, Windows XP), mean of \
     10,000 without the worst; worst 20 (Ethernet) and 110 (IEEE 1394). Here: a request and its reply \
     between processes on one machine, all of them, during the faults.",
];

/// The paper's mean response time between two modules, its table 1, in milliseconds.
const PAPER_RESPONSES: [([Module; 2], &str, f64); 3] = [
    ([Module::Module1, Module::Module2], "ethernet", 0.345),
    ([Module::Module1, Module::Module3], "ieee1394", 0.420),
    ([Module::Module2, Module::Module3], "both", 0.759),
];

impl Report {
    /// Fills in what was measured along the way.
    pub(crate) fn take_measured(&mut self, measured: &Measured) {
        self.responses = PAPER_RESPONSES
            .map(|([one, other], over, paper_mean_ms)| {
                let timings = measured.responses.get(&(one, other));
                let figures = timings.map(LatencySummary::from).unwrap_or_default();
                ResponseTimes { modules: [one.name(), other.name()], over, figures, paper_mean_ms }
            })
            .into();
        self.events = vec![
            DeliveryTimes { filtered: false, figures: LatencySummary::from(&measured.unfiltered) },
            DeliveryTimes { filtered: true, figures: LatencySummary::from(&measured.filtered) },
        ];
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
    match span {
        Some(span) => as_millis(span, serializer),
        None => serializer.serialize_none(),
    }
}
