//! The observing half of the fault chain: liveness, faults, and their report to recoverers.
//!
//! ```text
//! activity records ─► HangDetector ─┐
//! exits, states, links, answers ────┴─ Monitor ──► Detector ──► Notifier ══► recoverers
//!                                      observes    decides      reports
//! ```
//! Components are judged by the [scanner](hang), from counters that cost no message. The
//! middleware's own objects have none, and are asked by the monitor's actor.
//!
//! `──►` is a call within [`DetectionChain`], which returns when the next machine has the finding.
//! `══►` is a [`ConfirmedQueue`]: repeated until it is confirmed, given up loudly. The monitor
//! keeps the table and judges nothing. The detector keeps the lifecycle of each object, compares
//! with the list of faults, separates roots from symptoms and keeps the record. The notifier limits
//! storms. None of them decides what is done about a fault, and none of them
//! restarts anything.
//!
//! **When it is found.** An exit, an error state, a declared fault: at once. Silence of an object
//! that pushes: after `tolerance` and a half of its intervals, or when its start-up time is over.
//! Of one that is asked: after at most an interval and `tolerance` times its time to answer. Where
//! the process was not scheduled, later by as much, and by up to two more intervals: that is no
//! object's fault.
//!
//! **An actor that panics** in the middle of an input loses that input, and nothing else: its next
//! incarnation goes on with the same machines, and hands over again what is not yet confirmed.

mod chain;
mod checks;
mod confirmed_queue;
mod correlation;
mod detector;
mod entry;
mod fault_log;
mod monitor;
mod notifier;
mod observation;
mod outcome;
mod peer_table;
mod registration;
mod table;

pub mod dependencies;
pub mod hang;

pub use chain::{DetectionChain, DetectionOutput};
pub use checks::{CheckFailed, Freshness, Invariant, Range, Rate};
pub use confirmed_queue::{ConfirmedQueue, ConfirmedQueueLimits, ConfirmedQueueOutput};
pub use detector::{Detector, DetectorOutput, FAULTS_ON_RECORD};
pub use fault_log::FaultLog;
pub use monitor::{MONITOR_ROWS_MAX, Monitor};
pub use notifier::{LOCAL_HANDOVER, Notifier, REMOTE_HANDOVER, RecovererPort};
pub use observation::{
    ExitReason, Finding, LinkCondition, NodeCondition, Observation, OverloadFigures, WorkProgress,
};
pub use outcome::{
    FaultEntry, FaultNotice, FaultRecord, FaultStatus, FaultTransition, RecoveryOutcome,
};
pub use registration::{Liveness, ObjectKind, Pull, Push, Registration, RegistrationError};
pub use table::{CurrentHandler, MonitorRow, Opinion, QueueSample, RoundLateness};
