//! Whether the file of the roster was replaced, looked at from a thread of its own.
//!
//! A roster with a higher serial number is taken at once: a node that is not in it any more loses
//! its links, one that is new gets keys. A file that is refused is logged, and the node goes on
//! with the roster that it has.

use super::keys::NodeKeys;
use crate::platform;
use crate::platform::key_files::FileStamp;
use actix::prelude::*;
use std::sync::Arc;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::time::Duration;
use tracing::{error, info};

/// How often the file is looked at.
const POLL_INTERVAL: Duration = Duration::from_secs(2);

/// There is a newer roster.
#[derive(Clone, Message)]
#[rtype(result = "()")]
pub(crate) struct RosterChanged(pub(crate) Arc<NodeKeys>);

/// Ends the watch when it is dropped. Nothing waits for the thread: a file system may keep it.
pub(crate) struct RosterWatch {
    /// Nothing is sent; the thread ends when it is gone.
    _stop: Sender<()>,
}

impl RosterWatch {
    /// Tells these of each newer roster.
    pub(crate) fn start(keys: Arc<NodeKeys>, told: Vec<Recipient<RosterChanged>>) -> RosterWatch {
        let (stop, stopped) = channel();
        let watch = move || {
            // It may have been replaced since the node has read it.
            let mut file = RosterFile { stamp: None, keys, refused: None };
            while stopped.recv_timeout(POLL_INTERVAL) == Err(RecvTimeoutError::Timeout) {
                if let Some(keys) = file.look() {
                    told.iter().for_each(|to| to.do_send(RosterChanged(keys.clone())));
                }
            }
        };
        // Without the thread, a new roster counts when the node starts again.
        if let Err(error) = platform::start_thread("roster", watch) {
            error!("a newer roster will count at the next start only: {error}");
        }
        RosterWatch { _stop: stop }
    }
}

struct RosterFile {
    keys: Arc<NodeKeys>,
    /// Of the file that was read last; `None` if it is to be read.
    stamp: Option<FileStamp>,
    /// Why it was refused, as it was logged.
    refused: Option<String>,
}

impl RosterFile {
    /// The keys with a newer roster, if the file was replaced by one.
    fn look(&mut self) -> Option<Arc<NodeKeys>> {
        let now = FileStamp::of(self.keys.roster_path());
        if now.is_none() || std::mem::replace(&mut self.stamp, now) == now {
            return None;
        }
        match self.keys.reread() {
            Ok(Some(keys)) => {
                info!(robot = %keys.robot(), serial = keys.serial(), "a newer roster");
                self.keys = Arc::new(keys);
                self.refused = None;
                Some(self.keys.clone())
            }
            Ok(None) => None,
            Err(refused) => {
                // It is tried again: what keeps it from being read may pass.
                self.stamp = None;
                if self.refused.as_ref() != Some(&refused) {
                    error!("the roster is refused: {refused}");
                    self.refused = Some(refused);
                }
                None
            }
        }
    }
}
