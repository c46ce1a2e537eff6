//! Comparing what all who carry a service were told of it.

use super::peers::Spoken;
use super::replica::ReplicaBody;
use super::words::CompareTerms;
use crate::platform;
use crate::runtime::driver::MachineActor;
use crate::runtime::guardian;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::reports::DeclaredFaultCleared;
use blastema_core::{DeliveryError, FaultKind, NodeName};
use std::time::Duration;

/// How often it is looked who else has an object of the service's name. Shorter finds out sooner
/// that two do not mean the same; each look costs little.
const LOOK_AROUND: Duration = Duration::from_millis(500);
/// How long another replica is given to say what it was told.
const ANSWER_WITHIN: Duration = Duration::from_secs(1);

impl ReplicaBody {
    /// Looks who else carries the service, now and again.
    pub(super) fn look_around(&mut self, context: &mut Context<Self>) {
        let (access, name) = (self.registry.access(), self.carried.name.clone());
        let mut carriers = self.roster.carriers(&name);
        carriers.retain(|node| access.may_claim(node, &name));
        let now = platform::now();
        self.machine.handle_claimants(|node| access.may_claim(node, &name), now);
        let reached = carriers.iter().filter(|node| self.registry.is_reachable(node));
        self.machine.handle_reached(&reached.cloned().collect::<Vec<_>>());
        self.machine.handle_carriers(&carriers, now);
        self.drive(context);
        self.show();
        context.run_later(LOOK_AROUND, Self::look_around);
    }

    /// Says what this node was told, and asks what that one was.
    pub(super) fn compare(&self, with: NodeName, context: &mut Context<Self>) {
        if !self.may_claim(&with) {
            return;
        }
        let address = format!("{with}:{}", self.carried.name);
        let Ok(sender) = self.registry.sender::<CompareTerms>(&address) else { return };
        let from = self.carried.config.own.to_string();
        let terms = CompareTerms { from, terms: self.machine.terms().into() };
        let asked = async move { sender.ask_within(terms, ANSWER_WITHIN).await };
        context.spawn(wrap_future::<_, Self>(asked).map(move |answer, body, context| {
            let now = platform::now();
            // By another roster since it was asked.
            if !body.may_claim(&with) {
                return;
            }
            match answer.map_err(|error| error.kind) {
                Ok(theirs) => body.machine.handle_terms(&with, &theirs, now),
                Err(DeliveryError::Unknown { .. } | DeliveryError::NotServed { .. }) => {
                    body.machine.handle_no_terms(&with, now)
                }
                Err(DeliveryError::Left { .. }) => body.machine.handle_left(&with, now),
                // It is asked again.
                Err(_) => {}
            }
            body.drive(context);
        }));
    }

    fn may_claim(&self, node: &NodeName) -> bool {
        self.registry.access().may_claim(node, &self.carried.name)
    }

    /// A fault of the service is over.
    pub(super) fn mend(&self, kind: FaultKind) {
        if let Some(cleared) = &self.reports.cleared {
            let (object, incarnation) = (self.carried.body.clone(), guardian::alive().incarnation);
            cleared.do_send(DeclaredFaultCleared { object, incarnation, kind });
        }
    }
}

/// Another replica says what it was told, and asks.
impl Handler<Spoken<CompareTerms>> for ReplicaBody {
    type Result = ();

    fn handle(&mut self, spoken: Spoken<CompareTerms>, context: &mut Context<Self>) {
        let Spoken { by, message, answer } = spoken;
        answer.give(self.machine.terms().into());
        match by {
            Some(from) => self.machine.handle_asked(&from, &message.terms, platform::now()),
            None => self.machine.handle_forged(),
        }
        self.drive(context);
    }
}
