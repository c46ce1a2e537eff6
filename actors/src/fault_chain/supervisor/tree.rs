//! How a supervisor and everything below it stand.

use super::SupervisorActor;
use crate::platform;
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::supervisor::{ReadTree, SupervisionTree, SupervisionTreeChild};
use blastema_core::recovery::ChildStatus;
use std::time::Duration;

/// A supervisor below that does not say how it stands within this time is shown without its
/// children.
const READ_LIMIT: Duration = Duration::from_millis(500);

impl SupervisorActor {
    /// The table without what stands below supervisors.
    fn branch(&self) -> SupervisionTree {
        let leaf = |status: ChildStatus| SupervisionTreeChild {
            name: status.name,
            incarnation: status.incarnation,
            state: status.state,
            restarts: status.restarts,
            isolated: status.isolated,
            below: None,
        };
        SupervisionTree {
            name: self.name.clone(),
            incarnation: self.machine.incarnation(),
            strategy: self.machine.rules().strategy,
            restarts_left: self.machine.restarts_left(platform::now()),
            children: self.machine.children().map(leaf).collect(),
        }
    }
}

impl Handler<ReadTree> for SupervisorActor {
    type Result = PendingAnswer<SupervisionTree>;

    fn handle(&mut self, _: ReadTree, _: &mut Context<Self>) -> Self::Result {
        let mut branch = self.branch();
        let below: Vec<_> = (branch.children.iter().enumerate())
            .filter_map(|(at, leaf)| Some((at, self.neighbours.directory.supervisor(&leaf.name)?)))
            .collect();
        PendingAnswer::new(async move {
            for (at, supervisor) in below {
                let read = supervisor.send(ReadTree).timeout(READ_LIMIT).await;
                branch.children[at].below = read.ok();
            }
            branch
        })
    }
}
