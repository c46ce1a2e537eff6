//! Compares the configurations of the nodes that carry a service.

use super::peers::FromReplica;
use super::replica::ReplicaActor;
use super::types::CompareConfiguration;
use crate::platform;
use crate::runtime::driver::MachineActor;
use crate::runtime::guardian;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::reports::DeclaredFaultCleared;
use blastema_core::{DeliveryError, FaultKind, NodeName};
use std::time::Duration;

/// How often the directory is polled for other nodes with an object of the service's name. A
/// shorter interval finds different configurations sooner; each poll costs little.
const DIRECTORY_POLL: Duration = Duration::from_millis(500);
/// How long another replica has to answer with its configuration.
const ANSWER_TIMEOUT: Duration = Duration::from_secs(1);

impl ReplicaActor {
    /// Gives the machine the nodes that carry the service, and schedules the next poll.
    pub(super) fn poll_directory(&mut self, context: &mut Context<Self>) {
        let (access, name) = (self.registry.access(), self.carried.name.clone());
        let may_claim = |node: &NodeName| access.may_claim(node, &name);
        let mut carriers = self.roster.carriers(&name);
        carriers.retain(|node| may_claim(node) && self.registry.is_reachable(node));
        self.machine.handle_carriers(&carriers, may_claim, platform::now());
        self.drive(context);
        self.show();
        context.run_later(DIRECTORY_POLL, Self::poll_directory);
    }

    /// Sends this node's configuration to another one, and asks for its configuration.
    pub(super) fn compare(&self, with: NodeName, context: &mut Context<Self>) {
        if !self.may_claim(&with) {
            return;
        }
        let address = format!("{with}:{}", self.carried.name);
        let Ok(sender) = self.registry.sender::<CompareConfiguration>(&address) else { return };
        let from = self.carried.config.own.to_string();
        let question =
            CompareConfiguration { from, configuration: self.machine.configuration().into() };
        let asked = async move { sender.ask_within(question, ANSWER_TIMEOUT).await };
        context.spawn(wrap_future::<_, Self>(asked).map(move |answer, actor, context| {
            // The roster may have changed since the question.
            if !actor.may_claim(&with) {
                return;
            }
            match answer.map_err(|error| error.kind) {
                Ok(theirs) => {
                    actor.machine.handle_configuration(&with, &theirs, platform::now());
                }
                Err(DeliveryError::Unknown { .. } | DeliveryError::NotServed { .. }) => {
                    actor.machine.handle_no_service(&with)
                }
                Err(DeliveryError::Left { .. }) => actor.machine.handle_left(&with),
                // The machine asks again.
                Err(_) => {}
            }
            actor.drive(context);
        }));
    }

    fn may_claim(&self, node: &NodeName) -> bool {
        self.registry.access().may_claim(node, &self.carried.name)
    }

    /// Clears a fault of the service.
    pub(super) fn clear_fault(&self, kind: FaultKind) {
        if let Some(cleared) = &self.reports.cleared {
            let (object, incarnation) = (self.carried.actor.clone(), guardian::alive().incarnation);
            cleared.do_send(DeclaredFaultCleared { object, incarnation, kind });
        }
    }
}

/// A question of another replica, with its configuration.
impl Handler<FromReplica<CompareConfiguration>> for ReplicaActor {
    type Result = ();

    fn handle(&mut self, received: FromReplica<CompareConfiguration>, context: &mut Context<Self>) {
        let FromReplica { sender, message, answer } = received;
        match sender.filter(|from| self.may_claim(from)) {
            Some(from) => {
                let theirs = &message.configuration;
                self.machine.handle_configuration(&from, theirs, platform::now());
            }
            None => self.machine.handle_forged(),
        }
        // The answer says whether this replica serves now.
        answer.give(self.machine.configuration().into());
        self.drive(context);
    }
}
