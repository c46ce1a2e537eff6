//! Keeps nodes out that were isolated: the body of the machine in the core.

use super::door::Doors;
use crate::desk::Desk;
use crate::registry::{Port, Registry};
use actix::prelude::*;
use blastema_core::net::isolation::{Isolation, IsolationOutput};
use blastema_core::{NodeName, ObjectName};
use blastema_macros::Event;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use tracing::warn;

/// Under which name nodes tell each other of verdicts. It is no object that others can see.
const PLACE: &str = "net/isolation";

/// One node tells another of verdicts. The bytes are the machine's.
#[derive(Clone, Debug, Event)]
#[contract(crate = "crate", name = "blastema/verdicts", version = 1, max_size = 256 * 1024)]
struct Verdicts {
    from: String,
    message: Vec<u8>,
}

/// A node is kept out from now on, or let in again.
#[derive(Message)]
#[rtype(result = "()")]
pub(super) struct KeptOut {
    pub(super) node: NodeName,
    pub(super) isolated: bool,
}

/// Who is kept out. Clones are the same.
#[derive(Clone)]
pub(crate) struct Wardens {
    own: NodeName,
    machine: Arc<Mutex<Isolation>>,
    doors: Arc<Doors>,
    registry: Registry,
    gateway: Recipient<KeptOut>,
}

impl Wardens {
    pub(super) fn new(
        own: NodeName,
        doors: Arc<Doors>,
        registry: Registry,
        gateway: Recipient<KeptOut>,
    ) -> Self {
        let machine = Arc::new(Mutex::new(Isolation::new(own.clone())));
        let wardens = Wardens { own, machine, doors, registry, gateway };
        let hears = wardens.clone();
        let desk = Desk::<Verdicts>(Arc::new(move |told: Verdicts, answer| {
            if let Ok(from) = NodeName::new(&told.from) {
                let mut machine = hears.lock();
                machine.handle_told(&from, &told.message);
                hears.carry_out(machine);
            }
            answer.give(());
        }));
        let place = ObjectName::new(PLACE).expect("a name of letters");
        wardens.registry.hide(place, Port::of_desk(desk));
        wardens
    }

    fn lock(&self) -> MutexGuard<'_, Isolation> {
        self.machine.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// This node decides.
    pub(crate) fn decide(&self, node: &NodeName, isolated: bool) {
        let mut machine = self.lock();
        machine.handle_decision(node, isolated);
        self.carry_out(machine);
    }

    /// A session with this node has begun.
    pub(super) fn opened(&self, node: NodeName) {
        let mut machine = self.lock();
        machine.handle_opened(node);
        self.carry_out(machine);
    }

    /// The session with this node has ended.
    pub(super) fn ended(&self, node: &NodeName) {
        self.lock().handle_ended(node);
    }

    /// Does what the machine wants, outside of the lock.
    fn carry_out(&self, mut machine: MutexGuard<'_, Isolation>) {
        let outputs: Vec<_> = std::iter::from_fn(|| machine.poll_output()).collect();
        drop(machine);
        for output in outputs {
            match output {
                IsolationOutput::Tell { to, message } => {
                    let sender = self.registry.sender::<Verdicts>(&format!("{to}:{PLACE}"));
                    if let Ok(sender) = sender {
                        let from = self.own.to_string();
                        // Who cannot be told now is told when its session begins.
                        let _ = sender.tell(Verdicts { from, message: message.into() });
                    }
                }
                IsolationOutput::Isolate { node, isolated, by } => {
                    warn!(%node, isolated, %by, "a node is isolated, or admitted again");
                    self.doors.gate(&node).isolate(isolated);
                    self.gateway.do_send(KeptOut { node, isolated });
                }
            }
        }
    }
}
