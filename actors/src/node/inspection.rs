//! The inspection socket: a Unix socket at which other processes of the machine see the node.
//!
//! A client that connects gets one [`NodeSnapshot`](super::NodeSnapshot) as JSON, and the end of
//! the stream. One that sends a line at once, a [`ComponentOrder`](super::ComponentOrder) as JSON,
//! gets the [`OrderReply`](super::OrderReply) instead. The socket stays open in the safe state, and
//! closes with the node.

pub(crate) mod server;

use self::server::InspectionServer;
use super::{Node, NodeState, Shared};
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::reports::FaultReports;
use actix::prelude::*;
use blastema_transports::unix::{AllowedUsers, PathListener, explain};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Weak};
use tokio::sync::watch;

/// Processes of the owner may connect, and no others.
const MODE: u32 = 0o600;
/// Root may connect as well. It can read the node's memory and its files in any case.
const ROOT: u32 = 0;

/// Shows the node, once there is one.
pub(super) struct InspectionActor {
    path: Arc<Path>,
    node: Weak<Shared>,
    state: watch::Receiver<NodeState>,
    reports: FaultReports,
}

/// Opens the socket. Returns why that is not possible, and what to do.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub(super) struct StartInspection(Weak<Shared>);

impl StartInspection {
    pub(super) fn node(node: &Node) -> Self {
        StartInspection(Arc::downgrade(&node.0))
    }
}

impl InspectionActor {
    pub(super) fn new(
        path: PathBuf,
        state: watch::Receiver<NodeState>,
        reports: FaultReports,
    ) -> Self {
        InspectionActor { path: path.into(), node: Weak::new(), state, reports }
    }

    fn show(&self, listener: Option<PathListener>, context: &mut Context<Self>) {
        let (path, node, reports) = (self.path.clone(), self.node.clone(), self.reports.clone());
        let showing =
            InspectionServer::new((path, AllowedUsers::new(&[ROOT])), node, reports, listener);
        let mut state = self.state.clone();
        let until_the_end = async move {
            tokio::select! {
                () = showing.run() => {}
                // Also if the sender of the state was dropped.
                _ = state.wait_for(|state| *state == NodeState::Stopped) => {}
            }
        };
        context.spawn(until_the_end.into_actor(self));
    }
}

/// Makes the socket. Says what helps where that cannot be done.
fn open(path: &Arc<Path>) -> Result<PathListener, String> {
    PathListener::open(path, MODE).map_err(|error| explain(path, &error))
}

answers_the_monitor!(InspectionActor);

impl Actor for InspectionActor {
    type Context = Context<Self>;
}

impl Supervised for InspectionActor {
    /// What showed the node went with the panic, and the socket with it: it is made again.
    fn restarting(&mut self, context: &mut Context<Self>) {
        self.show(None, context);
    }
}

impl Handler<StartInspection> for InspectionActor {
    type Result = Result<(), String>;

    fn handle(
        &mut self,
        StartInspection(node): StartInspection,
        context: &mut Context<Self>,
    ) -> Self::Result {
        self.node = node;
        let listener = open(&self.path)?;
        self.show(Some(listener), context);
        Ok(())
    }
}
