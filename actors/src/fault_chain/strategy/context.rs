//! What a strategy can do.

use super::SafeOutputs;
use crate::fault_chain::supervisor::SupervisorActor;
use crate::fault_chain::supervisor::directory::SupervisorDirectory;
use crate::messaging::sender::Sender;
use crate::registry::Registry;
use actix::prelude::*;
use blastema_contract::strategy::{EnterSafeState, IsolateNode, Reroute};
use blastema_contract::supervisor::{ChildAction, ChildRequest, GaveUp, Recovered};
use blastema_core::recovery::{
    GiveUpReason, RecoveryAction, RecoveryDone, RecoveryFailed, RecoveryOrder,
};
use blastema_core::{
    Contract, DeliveryError, Fault, FaultLocation, Incarnation, NodeName, ObjectName,
};
use std::sync::{Arc, OnceLock};

/// Where the network takes the orders of strategies.
pub(crate) struct NetworkOrders {
    pub(crate) reroute: Recipient<Reroute>,
    pub(crate) isolate: Recipient<IsolateNode>,
}

/// What a [`StrategyContext`] reaches.
pub(crate) struct StrategyTargets {
    pub(crate) node: NodeName,
    pub(crate) directory: SupervisorDirectory,
    pub(crate) registry: Registry,
    /// Empty in a node without a network. The network needs the recoverer, and the recoverer the
    /// network: that is why it is filled later.
    pub(crate) network: Arc<OnceLock<NetworkOrders>>,
    pub(crate) safe_outputs: SafeOutputs,
    pub(crate) rest_node: Recipient<EnterSafeState>,
}

/// The actions available to a [`RecoveryStrategy`](super::RecoveryStrategy): orders to the
/// supervisors, the network and the components of its node.
#[derive(Clone)]
pub struct StrategyContext(Arc<StrategyTargets>);

impl StrategyContext {
    pub(crate) fn new(targets: StrategyTargets) -> Self {
        StrategyContext(Arc::new(targets))
    }

    /// Carries out an action that needs no strategy of the application.
    pub(crate) async fn carry_out(
        &self,
        order: &RecoveryOrder,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        let RecoveryOrder { fault, action, .. } = order;
        match action {
            RecoveryAction::Reset => self.reset(&fault.location).await,
            RecoveryAction::Restart => self.restart(fault).await,
            RecoveryAction::MoveToOwnThread => self.move_to_own_thread(fault).await,
            RecoveryAction::Reroute => self.reroute(&fault.location).await,
            RecoveryAction::Isolate => {
                let (faulty, cause) = (Some(fault.incarnation), fault.as_reason());
                self.set_isolated(&fault.location, faulty, true, &cause).await
            }
            RecoveryAction::SafeStop => self.safe_stop(fault).await,
            other => Err(format!("there is no strategy {other:?}").into()),
        }
    }

    /// Where messages of contract `M` to the object of this name can be sent: what helps a
    /// component may be known to itself, or to a neighbour, alone.
    ///
    /// # Errors
    /// As [`Node::sender`](crate::Node::sender).
    pub fn sender<M: Contract>(&self, name: &str) -> Result<Sender<M>, DeliveryError> {
        self.0.registry.sender(name)
    }

    /// Replaces the faulty incarnation by the next one, and its siblings as their supervisor's
    /// strategy requires. Resolves when all of them are active.
    ///
    /// # Errors
    /// The new incarnation did not start, or the supervisor escalated.
    pub async fn restart(&self, fault: &Fault) -> Result<RecoveryDone, RecoveryFailed> {
        self.ask(&fault.location, ChildAction::Restart(Some(fault.clone()))).await.map(begun)
    }

    /// Moves a component to a thread of its own: its next incarnation runs there, with the same
    /// queue. Resolves when this incarnation is active.
    ///
    /// # Errors
    /// The component already has a thread of its own, or the whole node runs on one thread; or as
    /// [`restart`](StrategyContext::restart).
    pub async fn move_to_own_thread(&self, fault: &Fault) -> Result<RecoveryDone, RecoveryFailed> {
        self.ask(&fault.location, ChildAction::Move(Some(fault.clone()))).await.map(begun)
    }

    /// Lets an object that is in error recover by itself.
    ///
    /// # Errors
    /// It could not, or has no incarnation.
    pub async fn reset(&self, location: &FaultLocation) -> Result<RecoveryDone, RecoveryFailed> {
        // It is the same incarnation as before.
        let done = self.ask(location, ChildAction::Reset).await?;
        Ok(RecoveryDone { incarnation: None, ..done })
    }

    /// Forbids an object, or another node, to send and receive. A node is
    /// [isolated](crate::manual::networks#isolation) for this node alone.
    ///
    /// # Errors
    /// The location is a link, an object without a supervisor, or this node; or the node
    /// has no network.
    pub async fn isolate(&self, location: &FaultLocation) -> Result<RecoveryDone, RecoveryFailed> {
        self.set_isolated(location, None, true, "a recovery strategy says so").await
    }

    /// Allows an object, or another node, to send and receive again.
    ///
    /// # Errors
    /// As [`isolate`](StrategyContext::isolate).
    pub async fn admit(&self, location: &FaultLocation) -> Result<RecoveryDone, RecoveryFailed> {
        self.set_isolated(location, None, false, "a recovery strategy says so").await
    }

    /// Finds another way over the network than this link, or to this node.
    ///
    /// # Errors
    /// There is no other way, or no network.
    pub async fn reroute(&self, location: &FaultLocation) -> Result<RecoveryDone, RecoveryFailed> {
        let network = self.0.network.get().ok_or("this node has no network")?;
        match network.reroute.send(Reroute { location: location.clone() }).await {
            Ok(outcome) => outcome,
            Err(_) => Err("the router did not answer".into()),
        }
    }

    /// Applies the safe outputs, and puts the object to rest: its incarnation ends, it is isolated,
    /// and only a person brings it back. A fault that is in no object puts the whole node to rest.
    ///
    /// # Errors
    /// The object is not kept by any supervisor.
    pub async fn safe_stop(&self, fault: &Fault) -> Result<RecoveryDone, RecoveryFailed> {
        if !matches!(fault.location, FaultLocation::Object(_)) {
            self.rest_node(fault, "the plan says so");
            return Ok(RecoveryDone::default());
        }
        self.0.safe_outputs.apply(fault).await;
        self.ask(&fault.location, ChildAction::SafeStop(Some(fault.clone()))).await
    }

    /// Puts an object into the safe state whose node is in it, or ends. No sender waits for that.
    pub(crate) fn give_up_incarnation(&self, fault: &Fault) {
        // One that was removed meanwhile has no supervisor.
        if let Ok((object, supervisor)) = self.supervisor(&fault.location) {
            let action = ChildAction::SafeStop(Some(fault.clone()));
            supervisor.do_send(ChildRequest { object, action });
        }
    }

    /// Applies the safe outputs and puts the whole node to rest.
    pub(crate) fn rest_node(&self, fault: &Fault, reason: &str) {
        let (fault, reason) = (fault.clone(), reason.into());
        self.0.rest_node.do_send(EnterSafeState { fault, reason });
    }

    async fn set_isolated(
        &self,
        location: &FaultLocation,
        faulty: Option<Incarnation>,
        isolated: bool,
        cause: &str,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        if let FaultLocation::Node(node) = location {
            if *node == self.0.node {
                return Err("a node cannot isolate itself: let it enter the safe state".into());
            }
            let network = self.0.network.get().ok_or("this node has no network")?;
            let (node, cause) = (node.clone(), cause.to_owned());
            let decided = network.isolate.send(IsolateNode { node, isolated, cause }).await;
            return decided.unwrap_or_else(|_| Err("the network did not answer".into()));
        }
        let reason = cause.to_owned();
        self.ask(location, ChildAction::Isolate { faulty, isolated, reason }).await
    }

    async fn ask(
        &self,
        location: &FaultLocation,
        action: ChildAction,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        let (object, supervisor) = self.supervisor(location)?;
        match supervisor.send(ChildRequest { object, action }).await {
            Ok(Ok(Recovered { incarnation, waits, .. })) => {
                Ok(RecoveryDone { incarnation, waits, finished: false })
            }
            Ok(Err(GaveUp { object, why })) => Err(RecoveryFailed {
                reason: format!("{object}: {why}"),
                is_final: matches!(why, GiveUpReason::IntensityExceeded { .. }),
            }),
            Err(_) => Err("the supervisor did not answer".into()),
        }
    }

    /// An object, and the supervisor that keeps it.
    fn supervisor(
        &self,
        location: &FaultLocation,
    ) -> Result<(ObjectName, Addr<SupervisorActor>), RecoveryFailed> {
        let FaultLocation::Object(address) = location else {
            return Err(format!("{location} is no object").into());
        };
        if address.node != self.0.node {
            return Err(format!("{address} is an object of another node").into());
        }
        let supervisor = self.0.directory.supervisor_of(&address.object);
        let supervisor = supervisor.ok_or_else(|| format!("no supervisor keeps {address}"))?;
        Ok((address.object.clone(), supervisor))
    }
}

/// Where an incarnation was to begin, and none has, its rules do not let it.
fn begun(done: RecoveryDone) -> RecoveryDone {
    RecoveryDone { finished: done.incarnation.is_none(), ..done }
}
