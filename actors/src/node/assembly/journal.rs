//! The journal of faults as a part of the node.

use super::{NodeAssembly, middleware, named};
use crate::journal::{JOURNAL, JournalActor, JournalLock, JournalSetup, LockError};
use crate::node::error::StartError;
use crate::platform;
use actix::prelude::*;
use blastema_contract::detector::Subscribe;
use std::path::PathBuf;
use std::time::Duration;

/// A reader of the journal holds its lock for a moment. A node that writes it holds it for good.
const LOCK_ATTEMPTS: u32 = 20;
const LOCK_PAUSE: Duration = Duration::from_millis(10);

impl NodeAssembly {
    /// Hears of every fault from the first on.
    pub(super) async fn keep_journal(&mut self, file: Option<PathBuf>) -> Result<(), StartError> {
        let Some(path) = file else { return Ok(()) };
        let name = named(JOURNAL);
        let reports = self.environment.reports.clone();
        let lock = match self.lock(&path).await {
            Ok(lock) => lock,
            Err(LockError::InUse { by }) => {
                let reason = format!(
                    "another process uses the file ({by}): end that process, or give this node another file"
                );
                return Err(StartError::Journal { file: path, reason });
            }
            Err(LockError::Io(error)) => {
                // No permission, no folder, a full disk: nothing of that stops a robot.
                self.enrolments.push(middleware(name, None));
                let path = path.display();
                let detail = format!(
                    "the journal {path} cannot be written, and the node goes on without: {error}"
                );
                reports.declare(JOURNAL, detail);
                return Ok(());
            }
        };
        let (node, incarnation) = (self.node.clone(), self.incarnation);
        let record = self.parts.chain.record.clone();
        let setup = JournalSetup { path, lock, node, incarnation, record, reports };
        let (journal, guard) = JournalActor::new(setup);
        let place = self.parts.chain.arbiter.as_ref();
        let guardian = &self.parts.guardian;
        let journal = guardian.start(name.clone(), place, |_: &mut Context<JournalActor>| journal);
        self.parts.chain.subscribe.do_send(Subscribe(journal.clone().recipient()));
        self.parts.chain.keep_journal(guard);
        self.enrolments.push(middleware(name, Some(journal.recipient())));
        Ok(())
    }

    async fn lock(&self, path: &std::path::Path) -> Result<JournalLock, LockError> {
        let mut attempts = 1;
        loop {
            match JournalLock::acquire(path, &self.node) {
                Err(LockError::InUse { .. }) if attempts < LOCK_ATTEMPTS => attempts += 1,
                answer => return answer,
            }
            platform::sleep(LOCK_PAUSE).await;
        }
    }
}
