//! The list of faults in a file that outlives the process. Cargo feature `journal`.
//!
//! ```text
//! Detector ── every step of every fault ──► JournalActor ── bounded queue ──► thread ──► SQLite
//! ```
//!
//! [`NodeBuilder::journal`](crate::NodeBuilder::journal) names the file; [`read`] and
//! `blastema fault list --journal` read it, also while the node runs. One node writes one file.
//!
//! * A step is on the disk (WAL, `synchronous=FULL`) before the thread takes the next ones. Several
//!   that wait are written in one transaction.
//! * Nothing waits for the disk. Where the queue is full, or a write has failed, the whole record
//!   of the node is written as soon as that is possible: no fault is lost that the node itself
//!   still remembers.
//! * The last entry of a run, with the code [`NODE_ENDED`], says when and why the node ended: it
//!   was shut down or dropped, or a signal ended its process. A process that is killed leaves none.
//! * A file that cannot be written is a fault of the object `chain/journal`, and no more than that.
//!   A damaged file is set aside; one that is removed begins again.
//! * The file is bounded: see [`FAULTS_MAX`]. Faults that are over go first, the oldest of them
//!   first.
//! * The order is that of [`JournalEntry::sequence`]. Wall-clock times are shown beside it and
//!   order nothing, because the wall clock may be set; spans are measured by the monotonic clock.

mod lock;
mod reader;
mod store;
#[cfg(test)]
mod tests;
mod writer;

pub use self::reader::{JournalEntry, JournalStatus, ReadError, read};
pub use self::store::{FAULTS_MAX, NODE_ENDED};
pub use crate::platform::wall_time::WallTime;

pub(crate) use self::lock::JournalLock;
pub(crate) use self::writer::{JOURNAL, JournalActor, JournalGuard};
