//! The controller: it starts the root supervisor, ends it, brings the whole node to the safe state,
//! and back.
//!
//! ```text
//!  Down ─ start ─► Up ─ stop, rest ─► Ending ─► Down ─ restart, from rest only ─► Up
//!                   └─ the root has given up ────►┘
//! ```

use crate::actuator::ActuatorTable;
use crate::component::spec_error::did_you_mean;
use crate::fault_chain::strategy::SafeOutputs;
use crate::platform;
use crate::runtime::guardian::answers_the_monitor;
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::child::{Child, ChildEvent, ChildOrder, ChildReport};
use blastema_contract::monitor::NodeReported;
use blastema_contract::recoverer::SafeStateChanged;
use blastema_contract::strategy::EnterSafeState;
use blastema_core::detection::NodeCondition;
use blastema_core::recovery::GiveUpReason;
use blastema_core::{Fault, FaultKind, Incarnation, NodeName, ObjectName};
use serde::Serialize;
use tokio::sync::{oneshot, watch};
use tracing::info;

/// How a node is.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
#[serde(tag = "state", rename_all = "snake_case")]
pub enum NodeState {
    /// Its components are being started, in order.
    Starting,
    /// All components have been started.
    Running,
    /// Something could not be contained, or was restarted more often than the root allows: the safe
    /// outputs were applied and everything was stopped. [`Node::restart`](crate::Node::restart)
    /// brings it back.
    #[serde(rename = "in safe state")]
    InSafeState {
        /// What could not be contained, or which limit was exceeded.
        reason: String,
    },
    /// It was told to stop, and has, from work or from rest.
    Stopped,
}

/// From the node: start the root. Answered once, when all children are at work, or when that has
/// failed, the safe outputs are applied and all children have ended.
#[derive(Message)]
#[rtype(result = "Result<(), String>")]
pub(super) struct StartRoot(pub(super) Box<dyn Child>);

/// From the node: start the root once more, from safe state. Answered likewise.
#[derive(Message)]
#[rtype(result = "Result<(), RestartError>")]
pub(super) struct RestartRoot;

/// Why nothing was brought back.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RestartError {
    /// Only a node in the safe state can be restarted. [`Node::restart_child`](crate::Node::restart_child) restarts a component
    /// of a running node.
    #[error("the node is not in the safe state, it is {state:?}: only from there it is restarted")]
    NotInSafeState {
        /// How it is.
        state: NodeState,
    },
    /// The node was shut down, and its threads have ended. Build a new node.
    #[error("the node was shut down: build another one")]
    ShutDown,
    /// Four components or more keep threads in handlers that never return, which cannot be ended.
    /// Restart the process.
    #[error("{count} threads hang for good: only a new process helps")]
    ThreadsHang {
        /// How many threads hang.
        count: usize,
    },
    /// The node entered the safe state again before all components were active. The record of
    /// faults names the cause.
    #[error("it entered the safe state again: {reason}")]
    GaveUp {
        /// What the last thing was.
        reason: String,
    },
    /// No supervisor of this node keeps an object of this name.
    #[error("no supervisor of this node keeps {name}{}", did_you_mean(nearest.as_ref()))]
    Unknown {
        /// The name that was given.
        name: String,
        /// The child whose name is spelt most like it.
        nearest: Option<ObjectName>,
    },
    /// The supervisor of the component is not at work, as in a node in the safe state. Restart the
    /// node, or the supervisor.
    #[error("the supervisor of {name} is not at work: restart the node, or that supervisor")]
    SupervisorRests {
        /// The component that was to be restarted.
        name: ObjectName,
    },
    /// The component's next incarnation did not come to be.
    #[error("{name} did not come back: {reason}")]
    ChildGaveUp {
        /// The component that was to be restarted.
        name: ObjectName,
        /// Why there is no next incarnation.
        reason: GiveUpReason,
    },
}

/// From the node: stop everything in order. Answered when that is done.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct Shutdown;

/// Also reports to this recipient when the node enters the safe state, and when it leaves it. As
/// many as the node has parts that want to know.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct SubscribeSafeState(pub(super) Recipient<SafeStateChanged>);

/// What the controller is made of.
pub(super) struct NodeControllerSetup {
    pub(super) node: NodeName,
    /// The node's own.
    pub(super) incarnation: Incarnation,
    pub(super) state: watch::Sender<NodeState>,
    pub(super) safe_outputs: SafeOutputs,
    /// Grants no leases in the safe state.
    pub(super) actuators: ActuatorTable,
    /// Is told of this node as of others.
    pub(super) nodes: Recipient<NodeReported>,
}

pub(super) struct NodeController {
    setup: NodeControllerSetup,
    root: Option<Box<dyn Child>>,
    /// The incarnation of the root supervisor.
    incarnation: Incarnation,
    phase: Phase,
    /// The node is in the safe state, and restarts as soon as all children have ended.
    again: bool,
    /// Why it enters the safe state: the safe outputs are being applied.
    comes_to_rest: Option<String>,
    /// It was told to stop for good.
    closed: bool,
    /// Who waits for the start; as many as have asked for it.
    started: Vec<oneshot::Sender<Result<(), String>>>,
    /// Who asked for a start that has failed, and why it has; they are answered when all children
    /// have ended.
    failed: Vec<(oneshot::Sender<Result<(), String>>, String)>,
    /// Who waits for the end; as many as have called `shutdown`.
    ended: Vec<oneshot::Sender<()>>,
    subscribers: Vec<Recipient<SafeStateChanged>>,
}

/// What the root's children do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Phase {
    /// No child runs.
    Down,
    /// They are started, or at work.
    Up,
    /// They are being stopped.
    Ending,
}

impl NodeController {
    pub(super) fn new(setup: NodeControllerSetup) -> Self {
        NodeController {
            setup,
            root: None,
            incarnation: Incarnation::default(),
            phase: Phase::Down,
            again: false,
            comes_to_rest: None,
            closed: false,
            started: Vec::new(),
            failed: Vec::new(),
            ended: Vec::new(),
            subscribers: Vec::new(),
        }
    }

    fn state(&self) -> NodeState {
        self.setup.state.borrow().clone()
    }

    fn rests(&self) -> bool {
        matches!(self.state(), NodeState::InSafeState { .. })
    }

    fn begin(&mut self, context: &mut Context<Self>) {
        let Some(root) = &mut self.root else { return };
        self.incarnation = self.incarnation.next();
        self.phase = Phase::Up;
        root.start(self.incarnation, context.address().recipient().into());
    }

    fn begin_again(&mut self, context: &mut Context<Self>) {
        info!("the node goes to work again");
        self.again = false;
        self.setup.safe_outputs.resume();
        self.setup.actuators.resume();
        self.setup.state.send_replace(NodeState::Starting);
        self.report_untreated(None);
        self.begin(context);
    }

    fn end(&mut self) {
        if self.phase == Phase::Up
            && let Some(root) = &mut self.root
        {
            self.phase = Phase::Ending;
            root.order(ChildOrder::Stop { again: false });
        }
    }

    /// All children have ended.
    fn handle_down(&mut self, context: &mut Context<Self>) {
        self.phase = Phase::Down;
        if self.closed || !(self.rests() || self.comes_to_rest.is_some()) {
            self.setup.state.send_replace(NodeState::Stopped);
        }
        // Who waited may have gone.
        for ended in self.ended.drain(..) {
            let _ = ended.send(());
        }
        self.tell_failed();
        if self.again && !self.closed {
            self.begin_again(context);
        }
    }

    /// The fault of a root that has given up: the detector has the particulars of each restart.
    fn storm(&self, reason: &str) -> Fault {
        let (node, kind) = (self.setup.node.clone(), FaultKind::RestartStorm);
        Fault::of_node(node, kind, reason.to_owned(), platform::now())
    }

    fn tell_started(&mut self, outcome: &Result<(), String>) {
        for started in self.started.drain(..) {
            let _ = started.send(outcome.clone());
        }
    }

    fn tell_failed(&mut self) {
        for (started, reason) in self.failed.drain(..) {
            let _ = started.send(Err(reason));
        }
    }

    fn tell(&self, changed: &SafeStateChanged) {
        self.subscribers.iter().for_each(|subscribers| subscribers.do_send(changed.clone()));
    }

    fn report_untreated(&self, reason: Option<&str>) {
        let reason = reason.map(str::to_owned);
        self.tell(&match reason.clone() {
            Some(reason) => SafeStateChanged::Entered { reason },
            None => SafeStateChanged::Left,
        });
        let NodeControllerSetup { node, incarnation, nodes, .. } = &self.setup;
        let (node, incarnation) = (node.clone(), *incarnation);
        let condition = match reason {
            Some(reason) => NodeCondition::InSafeState { reason },
            None => NodeCondition::AtWork,
        };
        nodes.do_send(NodeReported { node, incarnation, condition });
    }

    fn rest(&mut self, fault: &Fault, reason: String, context: &mut Context<Self>) {
        if self.comes_to_rest.is_some() || self.rests() || self.state() == NodeState::Stopped {
            return;
        }
        info!(reason, "the node enters the safe state");
        self.comes_to_rest = Some(reason);
        // What cannot be restarted any more is not tried again while the outputs take their time.
        self.tell(&SafeStateChanged::Entering);
        let mut applied = self.setup.safe_outputs.rest(fault);
        self.setup.actuators.rest();
        if !matches!(applied.try_recv(), Err(oneshot::error::TryRecvError::Empty)) {
            return self.handle_safe();
        }
        // For as long as they may take at most.
        let applied = actix::fut::wrap_future::<_, Self>(applied);
        context.spawn(applied.map(|_, controller: &mut Self, _| controller.handle_safe()));
    }

    /// The safe outputs are applied, or take longer than they may.
    fn handle_safe(&mut self) {
        let Some(reason) = self.comes_to_rest.take() else { return };
        // It may have been told to stop in between.
        if self.state() != NodeState::Stopped {
            self.report_untreated(Some(&reason));
            // Listeners see the reason before the last component has stopped.
            self.setup.state.send_replace(NodeState::InSafeState { reason: reason.clone() });
            self.end();
        }
        self.failed.extend(self.started.drain(..).map(|started| (started, reason.clone())));
        if self.phase == Phase::Down {
            self.tell_failed();
        }
    }
}

answers_the_monitor!(NodeController);

impl Actor for NodeController {
    type Context = Context<Self>;
}

impl Supervised for NodeController {
    fn restarting(&mut self, _: &mut Context<Self>) {
        // What waited for the safe outputs went with the panic; they have been called.
        self.handle_safe();
    }
}

impl Handler<SubscribeSafeState> for NodeController {
    type Result = ();

    fn handle(
        &mut self,
        SubscribeSafeState(subscribers): SubscribeSafeState,
        _: &mut Context<Self>,
    ) {
        self.subscribers.push(subscribers);
    }
}

impl Handler<StartRoot> for NodeController {
    type Result = PendingAnswer<Result<(), String>>;

    fn handle(&mut self, message: StartRoot, context: &mut Context<Self>) -> Self::Result {
        let StartRoot(root) = message;
        let (answer, started) = oneshot::channel();
        self.started.push(answer);
        self.root = Some(root);
        match self.state() {
            // Something could not be contained before anything had begun.
            NodeState::InSafeState { reason } => self.tell_started(&Err(reason)),
            _ => self.begin(context),
        }
        PendingAnswer::new(async move {
            started.await.unwrap_or_else(|_| Err("the node was ended before it had started".into()))
        })
    }
}

impl Handler<RestartRoot> for NodeController {
    type Result = PendingAnswer<Result<(), RestartError>>;

    fn handle(&mut self, _: RestartRoot, context: &mut Context<Self>) -> Self::Result {
        let refused = match self.state() {
            // It is in the safe state until its last components have ended; its threads end next.
            _ if self.closed => Some(RestartError::ShutDown),
            NodeState::Stopped => Some(RestartError::ShutDown),
            NodeState::InSafeState { .. } => None,
            state => Some(RestartError::NotInSafeState { state }),
        };
        if let Some(refused) = refused {
            return PendingAnswer::new(std::future::ready(Err(refused)));
        }
        let (answer, started) = oneshot::channel();
        self.started.push(answer);
        match self.phase {
            // Who is still being stopped has its time for that.
            Phase::Up | Phase::Ending => self.again = true,
            Phase::Down => self.begin_again(context),
        }
        PendingAnswer::new(async move {
            let started = started.await.map_err(|_| RestartError::ShutDown)?;
            started.map_err(|reason| RestartError::GaveUp { reason })
        })
    }
}

impl Handler<ChildReport> for NodeController {
    type Result = ();

    fn handle(&mut self, report: ChildReport, context: &mut Context<Self>) {
        if report.incarnation != self.incarnation {
            return;
        }
        match report.event {
            // A child that waits for a device that is not there yet does not delay the start of
            // the node.
            ChildEvent::Started | ChildEvent::Unavailable { .. } => {
                if self.state() == NodeState::Starting {
                    info!("the node runs");
                    self.setup.state.send_replace(NodeState::Running);
                    // Callers of a restart wait for the next incarnation, not for this one.
                    self.tell_started(&Ok(()));
                }
            }
            ChildEvent::GivesUp { reason } => {
                // The root ends its children by itself.
                self.phase = Phase::Ending;
                self.rest(&self.storm(&reason), reason, context);
            }
            ChildEvent::StartFailed { reason } | ChildEvent::Escalated { reason } => {
                // It has ended them.
                self.phase = Phase::Down;
                self.rest(&self.storm(&reason), reason, context);
                self.handle_down(context);
            }
            ChildEvent::Stopped => self.handle_down(context),
            // A component says these, to its supervisor.
            ChildEvent::FailsToStart
            | ChildEvent::Reset
            | ChildEvent::ResetFailed { .. }
            | ChildEvent::Died { .. } => {}
        }
    }
}

impl Handler<EnterSafeState> for NodeController {
    type Result = ();

    fn handle(&mut self, message: EnterSafeState, context: &mut Context<Self>) {
        let EnterSafeState { fault, reason } = message;
        let reason = format!("{} of {}: {reason}", fault.kind, fault.location);
        self.rest(&fault, reason, context);
    }
}

impl Handler<Shutdown> for NodeController {
    type Result = PendingAnswer<()>;

    fn handle(&mut self, _: Shutdown, _: &mut Context<Self>) -> Self::Result {
        self.closed = true;
        self.tell(&SafeStateChanged::NodeEnds);
        if std::mem::take(&mut self.again) {
            // They see that they wait in vain.
            self.started.clear();
        }
        if self.phase == Phase::Down {
            self.setup.state.send_replace(NodeState::Stopped);
            return PendingAnswer::new(std::future::ready(()));
        }
        let (answer, ended) = oneshot::channel();
        self.ended.push(answer);
        self.end();
        PendingAnswer::new(async move { ended.await.unwrap_or(()) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fault_chain::tests::scripted::{Script, ScriptedReply};
    use blastema_doubles::{Probe, settle};

    /// A controller whose root starts, ends or hangs as a script says.
    struct Rig {
        controller: Addr<NodeController>,
        script: Script,
        state: watch::Receiver<NodeState>,
        _nodes: Probe<NodeReported>,
    }

    impl Rig {
        fn start(answers: &[(&str, ScriptedReply)]) -> Self {
            let (state, seen) = watch::channel(NodeState::Starting);
            let (script, nodes) = (Script::default(), Probe::<NodeReported>::start());
            let setup = NodeControllerSetup {
                node: NodeName::new("n").unwrap(),
                incarnation: Incarnation(1),
                state,
                safe_outputs: SafeOutputs::default(),
                actuators: ActuatorTable::default(),
                nodes: nodes.recipient(),
            };
            answers.iter().for_each(|(call, answer)| script.answer(call, &[*answer]));
            let controller = NodeController::new(setup).start();
            controller.do_send(StartRoot(script.child("root")));
            Rig { controller, script, state: seen, _nodes: nodes }
        }

        fn rest(&self) {
            let node = NodeName::new("n").unwrap();
            let fault = Fault::of_node(node, FaultKind::Panic, "why".into(), platform::now());
            self.controller.do_send(EnterSafeState { fault, reason: "it panics".into() });
        }

        /// The root says so, of its first incarnation.
        fn says(&self, event: ChildEvent) {
            let object = ObjectName::new("root").unwrap();
            self.controller.do_send(ChildReport { object, incarnation: Incarnation(1), event });
        }
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn a_node_that_is_told_to_stop_while_its_last_ones_end_is_not_started_once_more() {
        let rig = Rig::start(&[("stop root", ScriptedReply::Hangs)]);
        settle().await;
        rig.rest();
        let closed = tokio::task::spawn_local(rig.controller.send(Shutdown));
        settle().await;
        assert!(matches!(*rig.state.borrow(), NodeState::InSafeState { .. }), "one still ends");

        let again = tokio::task::spawn_local(rig.controller.send(RestartRoot));
        settle().await;
        rig.says(ChildEvent::Stopped);

        closed.await.unwrap().unwrap();
        assert_eq!(again.await.unwrap().unwrap(), Err(RestartError::ShutDown));
        settle().await;
        assert_eq!(rig.script.done(), ["start root", "stop root"]);
        assert_eq!(*rig.state.borrow(), NodeState::Stopped);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn who_asks_for_the_next_incarnation_is_not_told_of_the_one_before() {
        let late = [("start root", ScriptedReply::Hangs), ("stop root", ScriptedReply::Hangs)];
        let rig = Rig::start(&late);
        settle().await;
        rig.rest();
        let again = tokio::task::spawn_local(rig.controller.send(RestartRoot));
        settle().await;

        rig.says(ChildEvent::Started);
        settle().await;

        assert!(!again.is_finished(), "{:?}", rig.state.borrow());
        rig.says(ChildEvent::Stopped);
        assert_eq!(again.await.unwrap().unwrap(), Ok(()));
        assert_eq!(rig.script.done(), ["start root", "stop root", "start root"]);
        assert_eq!(*rig.state.borrow(), NodeState::Running);
    }
}
