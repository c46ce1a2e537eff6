//! How a supervisor and everything below it stand.

use super::Supervisor;
use crate::platform;
use actix::prelude::*;
use blastema_contract::supervisor::{Branch, Leaf, ReadTree};
use blastema_core::recovery::ChildStatus;
use std::time::Duration;

/// A supervisor below that does not say how it stands within this time is shown without its children.
const READ_LIMIT: Duration = Duration::from_millis(500);

impl Supervisor {
    /// The table without what stands below supervisors.
    fn branch(&self) -> Branch {
        let leaf = |status: ChildStatus| Leaf {
            name: status.name,
            incarnation: status.incarnation,
            state: status.state,
            restarts: status.restarts,
            isolated: status.isolated,
            below: None,
        };
        Branch {
            name: self.name.clone(),
            incarnation: self.machine.incarnation(),
            strategy: self.machine.rules().strategy,
            restarts_left: self.machine.restarts_left(platform::now()),
            children: self.machine.children().map(leaf).collect(),
        }
    }
}

impl Handler<ReadTree> for Supervisor {
    type Result = ResponseFuture<Branch>;

    fn handle(&mut self, _: ReadTree, _: &mut Context<Self>) -> Self::Result {
        let mut branch = self.branch();
        let below: Vec<_> = (branch.children.iter().enumerate())
            .filter_map(|(at, leaf)| Some((at, self.directory.supervisor(&leaf.name)?)))
            .collect();
        Box::pin(async move {
            for (at, supervisor) in below {
                let read = supervisor.read.send(ReadTree).timeout(READ_LIMIT).await;
                branch.children[at].below = read.ok();
            }
            branch
        })
    }
}
