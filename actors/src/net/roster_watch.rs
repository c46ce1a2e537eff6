//! The newest roster: of the file, which may be replaced, and of what other nodes have. A thread of
//! its own reads, checks and writes.
//!
//! A roster with a higher serial number is taken at once: a node that is not in it any more loses
//! its links, one that is new gets keys. One that came from another node replaces the file. A file
//! that is refused is logged, and the node goes on with the roster that it has.

use super::keys::{NodeKeys, RefusalKind, RosterRefusal};
use crate::platform;
use crate::platform::key_files::FileStamp;
use crate::platform::replace_file::replace_file;
use crate::runtime::reports::FaultReporter;
use actix::prelude::*;
use blastema_core::{FaultKind, NodeName};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel};
use std::time::Duration;
use tracing::{error, info, warn};

/// How often the file is looked at.
const POLL_INTERVAL: Duration = Duration::from_secs(2);
/// How long a node that is listed no more may still hear why, before its links and keys go.
const FAREWELL: Duration = Duration::from_millis(250);
/// So many rosters of other nodes wait to be checked, one of each node that was asked.
const OFFERS_MAX: usize = 64;

/// There is a newer roster, which peers are to be told of before it counts here.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub(crate) struct RosterFound(pub(crate) Arc<NodeKeys>);

/// There is a newer roster.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub(crate) struct RosterChanged(pub(crate) Arc<NodeKeys>);

/// Another node has this roster.
pub(super) struct RosterOffer {
    pub(super) from: NodeName,
    pub(super) text: String,
}

/// Ends the watch when it is dropped. Nothing waits for the thread: a file system may keep it.
pub(crate) struct RosterWatch(SyncSender<RosterOffer>);

impl RosterWatch {
    /// Tells these of each newer roster, and the first, which tells other nodes, before all others.
    pub(super) fn start(
        keys: Arc<NodeKeys>,
        faults: FaultReporter,
        announce: Recipient<RosterFound>,
        told: Vec<Recipient<RosterChanged>>,
    ) -> RosterWatch {
        let (offers, offered) = sync_channel(OFFERS_MAX);
        // The file may have been replaced since the node has read it.
        let file = RosterFile { stamp: None, keys, refused: None, faults };
        // Without the thread, a new roster counts when the node starts again.
        if let Err(error) =
            platform::start_thread("roster", move || watch(file, &offered, &announce, &told))
        {
            error!("a newer roster will count at the next start only: {error}");
        }
        RosterWatch(offers)
    }

    /// Another node has a newer roster. It is dropped where too many wait.
    pub(super) fn offer(&self, offer: RosterOffer) {
        // The thread may not have started, which was told.
        let _ = self.0.try_send(offer);
    }
}

fn watch(
    mut file: RosterFile,
    offered: &Receiver<RosterOffer>,
    announce: &Recipient<RosterFound>,
    told: &[Recipient<RosterChanged>],
) {
    let mut known = file.keys.clone();
    let mut tell = |newer: Option<Arc<NodeKeys>>| {
        let Some(keys) = newer else { return };
        announce.do_send(RosterFound(keys.clone()));
        if !known.missing_in(&keys).is_empty() {
            platform::wait(FAREWELL);
        }
        told.iter().for_each(|to| to.do_send(RosterChanged(keys.clone())));
        known = keys;
    };
    loop {
        let offer = match offered.recv_timeout(POLL_INTERVAL) {
            Ok(offer) => Some(offer),
            Err(RecvTimeoutError::Timeout) => None,
            Err(RecvTimeoutError::Disconnected) => return,
        };
        // What was put beside the key counts first: it may be newer than what is offered.
        tell(file.look());
        if let Some(offer) = offer {
            tell(file.take(&offer));
        }
    }
}

struct RosterFile {
    keys: Arc<NodeKeys>,
    /// Of the file that was read last; `None` if it is to be read.
    stamp: Option<FileStamp>,
    /// Why a roster was refused, as it was logged.
    refused: Option<String>,
    faults: FaultReporter,
}

impl RosterFile {
    /// The keys with a newer roster, if the file was replaced by one.
    fn look(&mut self) -> Option<Arc<NodeKeys>> {
        let now = FileStamp::of(self.keys.roster_path());
        // A file that is gone is looked for again each time.
        if std::mem::replace(&mut self.stamp, now) == now && now.is_some() {
            return None;
        }
        let newer = self.keys.reread();
        if newer.is_err() {
            // It is tried again: what keeps it from being read may pass.
            self.stamp = None;
        }
        self.adopt(newer, |kind| kind != RefusalKind::Unreadable)
    }

    /// The keys with the roster of another node, if that is newer.
    fn take(&mut self, RosterOffer { from, text }: &RosterOffer) -> Option<Arc<NodeKeys>> {
        let newer = match self.keys.newer(text, &format!("the roster of node {from}")) {
            // It says nothing of the file.
            Ok(None) => return None,
            newer => newer,
        };
        // What the robot has not signed says nothing of this node.
        let keys = self.adopt(newer, |kind| kind == RefusalKind::Unusable)?;
        let path = keys.roster_path();
        match replace_file(path, &keys.roster_text()) {
            Ok(()) => self.stamp = FileStamp::of(path),
            Err(error) => warn!(
                "roster {} of {from} is used, and cannot be kept in {}: {error}; at the next start it is \
                 fetched again: let this user write to the folder, or copy it there",
                keys.serial(),
                path.display()
            ),
        }
        Some(keys)
    }

    /// What is no fault of this node is only logged.
    fn adopt(
        &mut self,
        newer: Result<Option<NodeKeys>, RosterRefusal>,
        is_fault: impl FnOnce(RefusalKind) -> bool,
    ) -> Option<Arc<NodeKeys>> {
        if newer.is_ok() && self.refused.is_some() {
            self.faults.clear(FaultKind::CheckFailed);
        }
        match newer {
            Ok(Some(keys)) => {
                info!(robot = %keys.robot(), serial = keys.serial(), "a newer roster");
                self.keys = Arc::new(keys);
                self.refused = None;
                Some(self.keys.clone())
            }
            Ok(None) => {
                self.refused = None;
                None
            }
            Err(RosterRefusal { reason, kind }) => {
                if self.refused.as_ref() != Some(&reason) {
                    error!("the roster is refused: {reason}");
                    if is_fault(kind) {
                        self.faults.declare(FaultKind::CheckFailed, reason.clone());
                    }
                    self.refused = Some(reason);
                }
                None
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::net::keys::tests::written;
    use crate::runtime::reports::FaultReports;
    use std::fs;

    #[test]
    fn a_file_that_is_gone_is_told_each_time_that_it_goes_and_is_read_when_it_is_back() {
        let folder = tempfile::tempdir().expect("a folder");
        let keys = Arc::new(written(folder.path()));
        let path = keys.roster_path().to_owned();
        let faults = FaultReporter::new(crate::net::named("roster"), FaultReports::default());
        let mut file = RosterFile { keys, stamp: None, refused: None, faults };
        assert!(file.look().is_none() && file.refused.is_none(), "it is the one that is known");

        for _ in 0..2 {
            let text = fs::read(&path).expect("it is there");
            fs::remove_file(&path).expect("it is ours");
            assert!(file.look().is_none());
            let refused = file.refused.clone().expect("it is gone");
            assert!(refused.contains("does not start again"), "{refused}");

            fs::write(&path, text).expect("it is ours");
            assert!(file.look().is_none());
            assert_eq!(file.refused, None);
        }
    }
}
