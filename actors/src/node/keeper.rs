//! The keeper: it starts the root supervisor, ends it, and brings the whole node to safe rest.

use crate::chain::strategy::SafeOutputs;
use crate::chain::supervisor::SupervisorChild;
use crate::guardian::answers_the_monitor;
use crate::panics;
use crate::platform;
use actix::prelude::*;
use blastema_contract::child::{Child, ChildEvent, ChildReport};
use blastema_contract::strategy::RestNode;
use blastema_core::{Fault, FaultKind, Incarnation, NodeName};
use std::panic::{AssertUnwindSafe, catch_unwind};
use tokio::sync::{oneshot, watch};
use tracing::{error, info};

/// How a node is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum NodeState {
    /// Its components are being started, in order.
    Starting,
    /// All components have been started.
    Running,
    /// Something could not be contained, or was restarted more often than the root allows: the safe
    /// outputs were applied and everything was stopped.
    AtRest {
        /// Why.
        reason: String,
    },
    /// It was told to stop, and has.
    Stopped,
}

/// From the node: start the root. Answered once, when all children are at work or that has failed.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub(super) struct StartRoot(pub(super) SupervisorChild);

/// From the node: stop everything in order. Answered when that is done.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Shutdown;

pub(super) struct Keeper {
    node: NodeName,
    root: Option<SupervisorChild>,
    state: watch::Sender<NodeState>,
    started: Option<oneshot::Sender<Result<(), String>>>,
    /// Who waits for the end; as many as have called `shutdown`.
    ended: Vec<oneshot::Sender<()>>,
    /// The root's children are being stopped.
    ending: bool,
    safe_outputs: Option<SafeOutputs>,
}

impl Keeper {
    pub(super) fn new(
        node: NodeName,
        state: watch::Sender<NodeState>,
        safe_outputs: Option<SafeOutputs>,
    ) -> Self {
        let (root, started, ended) = (None, None, Vec::new());
        Keeper { node, root, state, started, ended, ending: false, safe_outputs }
    }

    fn end(&mut self) {
        if !std::mem::replace(&mut self.ending, true)
            && let Some(root) = &mut self.root
        {
            root.stop();
        }
    }

    /// The fault of a root that has given up: the detector has the particulars of each restart.
    fn storm(&self, reason: &str) -> Fault {
        let kind = FaultKind::RestartStorm;
        Fault::of_node(self.node.clone(), kind, reason.to_owned(), platform::now())
    }

    fn tell_ended(&mut self) {
        for ended in self.ended.drain(..) {
            // Who waited may have gone.
            let _ = ended.send(());
        }
    }

    fn rest(&mut self, fault: &Fault, reason: String) {
        if matches!(*self.state.borrow(), NodeState::AtRest { .. } | NodeState::Stopped) {
            return;
        }
        error!(reason, "the node comes to safe rest");
        if let Some(apply) = &self.safe_outputs {
            let _guarded = panics::Guarded::enter();
            if catch_unwind(AssertUnwindSafe(|| apply(fault))).is_err() {
                error!("the safe outputs panicked");
            }
        }
        if let Some(started) = self.started.take() {
            let _ = started.send(Err(reason.clone()));
        }
        // Listeners see the reason before the last component has stopped.
        self.state.send_replace(NodeState::AtRest { reason });
        self.end();
    }
}

answers_the_monitor!(Keeper);

impl Actor for Keeper {
    type Context = Context<Self>;
}

impl Supervised for Keeper {}

impl Handler<StartRoot> for Keeper {
    type Result = ResponseFuture<Result<(), String>>;

    fn handle(&mut self, message: StartRoot, context: &mut Context<Self>) -> Self::Result {
        let StartRoot(mut root) = message;
        let (answer, started) = oneshot::channel();
        self.started = Some(answer);
        root.start(Incarnation::FIRST, context.address().recipient());
        self.root = Some(root);
        Box::pin(async move {
            started.await.unwrap_or_else(|_| Err("the node was ended before it had started".into()))
        })
    }
}

impl Handler<ChildReport> for Keeper {
    type Result = ();

    fn handle(&mut self, report: ChildReport, _: &mut Context<Self>) {
        match report.event {
            ChildEvent::Started => {
                if matches!(*self.state.borrow(), NodeState::Starting) {
                    info!("the node runs");
                    self.state.send_replace(NodeState::Running);
                }
                if let Some(started) = self.started.take() {
                    let _ = started.send(Ok(()));
                }
            }
            ChildEvent::StartFailed { reason } | ChildEvent::Escalated { reason } => {
                // The root has ended its children by itself.
                (self.ending, self.root) = (true, None);
                self.rest(&self.storm(&reason), reason);
                self.tell_ended();
            }
            ChildEvent::Stopped => {
                if !matches!(*self.state.borrow(), NodeState::AtRest { .. }) {
                    self.state.send_replace(NodeState::Stopped);
                }
                self.root = None;
                self.tell_ended();
            }
            ChildEvent::Reset | ChildEvent::ResetFailed { .. } | ChildEvent::Died { .. } => {}
        }
    }
}

impl Handler<RestNode> for Keeper {
    type Result = ();

    fn handle(&mut self, message: RestNode, _: &mut Context<Self>) {
        let RestNode { fault, reason } = message;
        let reason = format!("{} of {}: {reason}", fault.kind, fault.place);
        self.rest(&fault, reason);
    }
}

impl Handler<Shutdown> for Keeper {
    type Result = ResponseFuture<()>;

    fn handle(&mut self, _: Shutdown, _: &mut Context<Self>) -> Self::Result {
        let over = matches!(*self.state.borrow(), NodeState::Stopped) || self.root.is_none();
        if over {
            return Box::pin(std::future::ready(()));
        }
        let (answer, ended) = oneshot::channel();
        self.ended.push(answer);
        self.end();
        Box::pin(async move { ended.await.unwrap_or(()) })
    }
}
