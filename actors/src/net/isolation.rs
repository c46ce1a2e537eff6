//! Keeps nodes out that were isolated: the body of the machine in the core.

use super::stub::PeerStubs;
use crate::registry::access::MessageOrigin;
use crate::registry::service_fn::ServiceFn;
use crate::registry::{ContractPort, Registry};
use actix::prelude::*;
use blastema_contract::monitor::NodeReported;
use blastema_contract::router::SetIsolation;
use blastema_core::detection::NodeCondition;
use blastema_core::net::isolation::{
    Isolation, IsolationAuthority, IsolationDecision, IsolationOutput, VoteRefused,
};
use blastema_core::{Incarnation, NodeName, ObjectName};
use blastema_macros::Event;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tracing::warn;

/// Under which name nodes tell each other their votes. It is no object that others can see.
const OBJECT: &str = "net/isolation";

/// One node tells another its votes. The bytes are the machine's.
#[derive(Clone, Debug, Event)]
#[contract(crate = "crate", name = "blastema/votes", version = 1, max_size = 128 * 1024)]
struct Votes {
    message: Vec<u8>,
}

/// A node is kept out from now on, or let in again.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct IsolationChanged {
    pub(super) node: NodeName,
    pub(super) isolated: bool,
}

/// Who is told of it.
pub(super) struct IsolationObservers {
    pub(super) stubs: Arc<PeerStubs>,
    pub(super) registry: Registry,
    pub(super) gateway: Recipient<IsolationChanged>,
    pub(super) router: Recipient<SetIsolation>,
    pub(super) monitor: Option<Recipient<NodeReported>>,
}

/// Who is kept out. Clones are the same.
#[derive(Clone)]
pub(crate) struct IsolationControl {
    machine: Arc<Mutex<Isolation>>,
    observers: Arc<IsolationObservers>,
}

impl IsolationControl {
    pub(super) fn new(machine: Isolation, observers: IsolationObservers) -> Self {
        let wardens = IsolationControl {
            machine: Arc::new(Mutex::new(machine)),
            observers: Arc::new(observers),
        };
        let receiver = wardens.clone();
        let take = ServiceFn::<Votes>(Arc::new(move |votes, from, answer| {
            receiver.take(&votes, from);
            answer.give(());
        }));
        let port = ContractPort::of_service_fn(take);
        let object = ObjectName::new(OBJECT).expect("a name of letters");
        wardens.observers.registry.register_hidden(object, port);
        wardens
    }

    fn lock(&self) -> MutexGuard<'_, Isolation> {
        self.machine.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Whether this node has had a session with it, or a node has voted on it.
    pub(super) fn know(&self, node: &NodeName) -> bool {
        self.lock().knows(node)
    }

    /// From now on the word of others counts.
    pub(super) fn judge_by(&self, judges: IsolationAuthority) {
        let mut machine = self.lock();
        machine.handle_authority(judges);
        self.carry_out(machine);
    }

    /// This node decides.
    pub(super) fn decide(&self, decision: IsolationDecision<'_>) -> Result<(), VoteRefused> {
        let mut machine = self.lock();
        let result = machine.handle_decision(decision);
        self.carry_out(machine);
        result
    }

    /// A strategy decides. What the others have decided already it does not make its own.
    pub(super) fn carry_decision_out(
        &self,
        decision: IsolationDecision<'_>,
    ) -> Result<(), VoteRefused> {
        if self.lock().is_isolated(decision.node) == decision.isolated {
            return Ok(());
        }
        self.decide(decision)
    }

    /// A session with this node has begun.
    pub(super) fn opened(&self, node: NodeName) {
        let mut machine = self.lock();
        machine.handle_opened(node);
        self.carry_out(machine);
    }

    /// The session with this node has ended.
    pub(super) fn ended(&self, node: &NodeName) {
        let mut machine = self.lock();
        machine.handle_ended(node);
        self.carry_out(machine);
    }

    /// Takes votes of another node. Whose they are, the session says that they come over.
    fn take(&self, votes: &Votes, from: MessageOrigin) {
        let mut machine = self.lock();
        if let Some(from) = from.peer.and_then(|peer| machine.peer(peer)) {
            machine.handle_ballot(&from, &votes.message);
        }
        self.carry_out(machine);
    }

    /// Does what the machine wants, outside of the lock.
    fn carry_out(&self, mut machine: MutexGuard<'_, Isolation>) {
        let outputs: Vec<_> = std::iter::from_fn(|| machine.poll_output()).collect();
        drop(machine);
        for output in outputs {
            match output {
                IsolationOutput::Tell { to, message } => {
                    let sender = self.observers.registry.sender::<Votes>(&format!("{to}:{OBJECT}"));
                    if let Ok(sender) = sender {
                        // Who cannot be told now is told when its session begins.
                        let _ = sender.tell(Votes { message: message.into() });
                    }
                }
                IsolationOutput::Isolate { node, isolated, reason } => {
                    self.isolate(node, isolated, reason);
                }
                IsolationOutput::Accused { node, reason } => {
                    warn!(%node, "to be isolated {reason}; more votes are needed");
                }
            }
        }
    }

    fn isolate(&self, node: NodeName, isolated: bool, reason: String) {
        warn!(%node, isolated, "isolated, or admitted again, {reason}");
        let IsolationObservers { stubs, gateway, router, monitor, .. } = &*self.observers;
        let send_state = stubs.send_state(&node);
        if isolated {
            send_state.isolate()
        } else {
            send_state.admit()
        }
        router.do_send(SetIsolation { node: node.clone(), isolated });
        gateway.do_send(IsolationChanged { node: node.clone(), isolated });
        if let Some(monitor) = monitor {
            let condition = match isolated {
                true => NodeCondition::Isolated { reason },
                false => NodeCondition::Admitted,
            };
            let incarnation = Incarnation::default();
            monitor.do_send(NodeReported { node, incarnation, condition });
        }
    }
}
