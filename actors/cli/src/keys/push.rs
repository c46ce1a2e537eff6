//! `--push`: hands a changed roster over to a node that runs.

use super::files::{Existing, PUBLIC, write};
use crate::args::{NodeAddress, OperatorOptions, PushOptions};
use crate::operator::{OperatorKey, OperatorSession, roster_beside};
use crate::print;
use blastema::core::net::trust::roster::NodeRoster;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How often the node is asked whether it has the roster.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// What is to be handed over to whom, as far as it can be checked before anything is changed.
pub(super) struct RosterPush<'a> {
    to: &'a NodeAddress,
    operator: &'a OperatorOptions,
    key: PathBuf,
}

impl<'a> RosterPush<'a> {
    /// # Errors
    /// No key of an operator is named.
    pub(super) fn of(options: &'a PushOptions) -> Result<Option<Self>, String> {
        let PushOptions { push: Some(to), operator } = options else { return Ok(None) };
        // It is used after the change: a mistake in it must change nothing.
        let key = OperatorKey::of(operator)?.file;
        Ok(Some(RosterPush { to, operator, key }))
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
        let NodeAddress { node, address } = self.to;
        match self.wait(roster.serial) {
            Ok(()) => {
                let serial = roster.serial;
                print(&format!("{node} has roster {serial}, and gives it to the others\n"))?;
                Ok(true)
            }
            Err(why) => {
                print(&format!(
                    "the roster was changed and signed, and was not handed over: {why}; then run \
                     `blastema keys check {node}@{address}`, which hands it over as well\n"
                ))?;
                Ok(false)
            }
        }
    }

    fn wait(&self, serial: u64) -> Result<(), String> {
        let to = &self.to.node;
        let wait = async |session: &OperatorSession| {
            let until = Instant::now() + session.within;
            loop {
                let asked = session.node.key_status_of(to, session.within).await;
                let status = asked.map_err(|error| error.to_string())?;
                if status.serial >= serial {
                    return Ok(());
                }
                if Instant::now() >= until {
                    return Err(format!("{to} still uses roster {}", status.serial));
                }
                tokio::time::sleep(POLL_INTERVAL).await;
            }
        };
        // With the roster that is beside it now.
        let key = OperatorKey::of(self.operator)?;
        OperatorSession::run(&key, self.to, self.operator, wait)
    }
}
