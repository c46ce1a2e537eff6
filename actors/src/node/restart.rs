//! Restarting a node that is in the safe state, and its children.

use super::Node;
use super::controller::{NodeState, RestartRoot};
use crate::arbiter::pool::CULPRITS_LIMIT;
use crate::component::spec_error::did_you_mean;
use blastema_contract::supervisor::{ChildAction, ChildRequest, GaveUp, Recovered};
use blastema_core::recovery::GiveUpReason;
use blastema_core::{Incarnation, ObjectName};

/// Why nothing was brought back.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum RestartError {
    /// Only a node in the safe state can be restarted. [`Node::restart_child`] restarts a component
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
        /// How many.
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
        /// The name.
        name: String,
        /// The child whose name is spelt most like it.
        nearest: Option<ObjectName>,
    },
    /// The supervisor of the component is not at work, as in a node in the safe state. Restart the
    /// node, or the supervisor.
    #[error("the supervisor of {name} is not at work: restart the node, or that supervisor")]
    SupervisorRests {
        /// The component.
        name: ObjectName,
    },
    /// The component's next incarnation did not come to be.
    #[error("{name} did not come back: {reason}")]
    ChildGaveUp {
        /// Which.
        name: ObjectName,
        /// Why.
        reason: GiveUpReason,
    },
}

/// The state of a component after [`Node::restart_child`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum RestartedChild {
    /// The component is active in this incarnation.
    Running(Incarnation),
    /// This incarnation has begun, and waits for something that is not there yet, such as its
    /// device, or a component below waits for that. It tries again by itself, and the fault
    /// *unavailable* stands until then.
    Unavailable(Incarnation),
    /// The child is not restarted: it is temporary, or transient and ended in order.
    Finished,
}

impl RestartedChild {
    /// Returns the incarnation that has started, if one has.
    pub fn incarnation(self) -> Option<Incarnation> {
        match self {
            RestartedChild::Running(incarnation) | RestartedChild::Unavailable(incarnation) => {
                Some(incarnation)
            }
            RestartedChild::Finished => None,
        }
    }
}

impl Node {
    /// Restarts a node from the safe state within its process: all components start their next
    /// incarnations in the start order, also those that were in the safe state or isolated before.
    /// Resolves when all are active. The cause of the safe state must have been removed: this is
    /// for a person, or an application that knows better.
    ///
    /// Who still has to be stopped is waited for. Threads that were given up stay so, and are
    /// counted on.
    ///
    /// # Errors
    /// [`RestartError::NotInSafeState`] unless the node is in the safe state;
    /// [`RestartError::ThreadsHang`] where that would not help; [`RestartError::GaveUp`] where it
    /// entered the safe state again, when all components have ended.
    pub async fn restart(&self) -> Result<(), RestartError> {
        let lost = self.0.environment.arbiters.lost();
        if lost.len() >= CULPRITS_LIMIT {
            return Err(RestartError::ThreadsHang { count: lost.values().sum() });
        }
        // The controller ends with the node's threads.
        self.0.chain.controller.send(RestartRoot).await.unwrap_or(Err(RestartError::ShutDown))
    }

    /// Starts the next incarnation of a component, or of a supervisor and all below it. This ends
    /// its safe state or isolation; an active component is stopped in order first. Its siblings are
    /// restarted as their supervisor's strategy requires. Resolves when all of them are at work, or
    /// wait for what is not there yet, and says which of it is so. No budget of restarts counts it.
    ///
    /// A handler of a component that this restarts must not await it, as it would be waited for
    /// itself: it counts as hanging after [`max_wait`](crate::ChildSpec::max_wait). A component
    /// restarts itself by [`cx.stop()`](crate::Context::stop).
    ///
    /// # Errors
    /// [`RestartError::Unknown`] where no supervisor keeps it; [`RestartError::SupervisorRests`] in
    /// a node in the safe state; [`RestartError::ChildGaveUp`] where it did not come back.
    pub async fn restart_child(&self, name: &str) -> Result<RestartedChild, RestartError> {
        let unknown = || RestartError::Unknown {
            name: name.to_owned(),
            nearest: self.0.chain.directory.nearest(name),
        };
        let object = ObjectName::new(name).map_err(|_| unknown())?;
        let controller = self.0.chain.directory.supervisor_of(&object).ok_or_else(unknown)?;
        let restart = ChildRequest { object, action: ChildAction::Restart(None) };
        match controller.requests.send(restart).await {
            Ok(Ok(Recovered { incarnation, waits, .. })) => Ok(match (incarnation, waits) {
                (Some(incarnation), false) => RestartedChild::Running(incarnation),
                (Some(incarnation), true) => RestartedChild::Unavailable(incarnation),
                (None, _) => RestartedChild::Finished,
            }),
            Ok(Err(GaveUp { object: name, why: GiveUpReason::NotAtWork })) => {
                Err(RestartError::SupervisorRests { name })
            }
            Ok(Err(GaveUp { object: name, why: reason })) => {
                Err(RestartError::ChildGaveUp { name, reason })
            }
            Err(_) => Err(RestartError::ShutDown),
        }
    }
}
