//! The journal of faults as a part of the node.

use super::{NodeAssembly, named};
use crate::journal::{JOURNAL, JournalActor, JournalLock};
use crate::node::error::StartError;
use crate::platform::file_lock::{FileLock, LockError, without_links};
use actix::prelude::*;
use blastema_contract::detector::Subscribe;
use std::path::PathBuf;

impl NodeAssembly {
    /// Hears of every fault from the first on.
    pub(super) async fn keep_journal(&mut self, file: Option<PathBuf>) -> Result<(), StartError> {
        let Some(path) = file else { return Ok(()) };
        let name = named(JOURNAL);
        let reports = self.node.environment.reports.clone();
        let lock = match FileLock::acquire_after_predecessor(&path, &self.node.name).await {
            Ok(lock) => Some(JournalLock::new(lock)),
            Err(error @ LockError::InUse { .. }) => {
                return Err(StartError::of_path("journal", &path, error.to_string()));
            }
            // No permission, no folder, a full disk: nothing of that stops a robot. The journal
            // tries it again.
            Err(LockError::Io(_)) => None,
        };
        let path = without_links(&path);
        self.node.held.push(path.clone());
        let chain = &self.node.chain;
        let (node, incarnation) = (self.node.name.clone(), self.node.incarnation);
        let record = chain.monitor.clone().recipient();
        let (journal, guard) = JournalActor::new(path, lock, node, incarnation, record, reports);
        let journal = chain.guardian.start(
            name.clone(),
            chain.arbiter.as_ref(),
            |_: &mut Context<JournalActor>| journal,
        );
        chain.monitor.do_send(Subscribe(journal.clone().recipient()));
        chain.keep_journal(guard);
        self.keep(name, Some(journal.recipient()))
    }
}
