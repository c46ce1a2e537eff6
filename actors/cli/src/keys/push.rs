//! `--push`: hands a changed roster over to a node that runs.

use super::files::{Existing, PUBLIC, write};
use crate::args::PushOptions;
use crate::operator::{OperatorKey, OperatorSession, roster_beside};
use crate::print;
use blastema::core::net::trust::roster::NodeRoster;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often the node is asked whether it has the roster.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// What is to be handed over to whom, as far as it can be checked before anything is changed.
pub(super) struct RosterPush<'a> {
    options: &'a PushOptions,
    key: PathBuf,
}

impl<'a> RosterPush<'a> {
    /// # Errors
    /// No key of an operator is named.
    pub(super) fn of(options: &'a PushOptions) -> Result<Option<Self>, String> {
        if options.push.is_none() {
            return Ok(None);
        }
        // It is used after the change: a mistake in it must change nothing.
        let key = OperatorKey::file_of(&options.operator)?;
        OperatorKey::read(key.clone())?;
        Ok(Some(RosterPush { options, key }))
    }

    /// Hands the roster over, and waits until the node uses it. Returns whether it does.
    ///
    /// # Errors
    /// The roster cannot be written beside the operator's key.
    pub(super) fn hand_over(
        self,
        roster: &NodeRoster,
        path: &Path,
        text: &str,
    ) -> Result<bool, String> {
        let beside = roster_beside(&self.key, &roster.robot);
        if beside != path {
            // The operator's own node uses it, and gives it to the other one.
            write(&beside, text, PUBLIC, Existing::Replace)?;
        }
        let to = self.options.push.as_ref().expect("it was checked");
        match blastema::run(self.wait(roster.serial)) {
            Ok(()) => {
                let (node, serial) = (&to.node, roster.serial);
                print(&format!("{node} has roster {serial}, and gives it to the others\n"))?;
                Ok(true)
            }
            Err(why) => {
                print(&format!(
                    "the roster was changed and signed, and was not handed over: {why}; then run \
                     `blastema keys check {}@{}`, which hands it over as well\n",
                    to.node, to.address
                ))?;
                Ok(false)
            }
        }
    }

    async fn wait(&self, serial: u64) -> Result<(), String> {
        let key = OperatorKey::read(self.key.clone())?;
        let to = self.options.push.as_ref().expect("it was checked");
        let session = OperatorSession::open(&key, to, &self.options.operator).await?;
        let until = Instant::now() + session.within;
        let outcome = loop {
            let asked = session.node.key_status_of(&to.node, session.within).await;
            match asked {
                Ok(status) if status.serial >= serial => break Ok(()),
                Ok(status) if Instant::now() >= until => {
                    break Err(format!("{} still uses roster {}", to.node, status.serial));
                }
                Ok(_) => {}
                Err(error) => break Err(error.to_string()),
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        };
        session.close().await;
        outcome
    }
}
