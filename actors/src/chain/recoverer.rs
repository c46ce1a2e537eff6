//! The recoverer's body: it has its machine's orders carried out by strategies.

use super::strategy::{StrategyTable, Tools};
use crate::drive::{Body, Wake};
use crate::guardian::{Guardian, answers_the_monitor};
use crate::platform;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::FaultOutcome;
use blastema_contract::recoverer::{NodeRests, Recover, StandDown};
use blastema_contract::strategy::CarryOut;
use blastema_core::detection::Outcome;
use blastema_core::recovery::{self, Done, Failed, Measure, Order, RecovererAction, Settled};
use std::collections::BTreeMap;
use tracing::info;

/// What a recoverer is made of.
pub(crate) struct RecovererSetup {
    /// The logic, with the plan.
    pub(crate) machine: recovery::Recoverer,
    /// How to make strategies.
    pub(crate) strategies: StrategyTable,
    /// What strategies are given.
    pub(crate) tools: Tools,
    /// Is told what becomes of every fault.
    pub(crate) detector: Recipient<FaultOutcome>,
    /// Keeps the strategies alive.
    pub(crate) guardian: Guardian,
}

/// Decides what is done about a fault.
pub(crate) struct Recoverer {
    machine: recovery::Recoverer,
    wake: Wake,
    strategies: StrategyTable,
    tools: Tools,
    detector: Recipient<FaultOutcome>,
    guardian: Guardian,
    /// The strategies that live at present; a released one ends with its last address.
    engaged: BTreeMap<Measure, Recipient<CarryOut>>,
}

impl Recoverer {
    pub(crate) fn new(setup: RecovererSetup) -> Self {
        let RecovererSetup { machine, strategies, tools, detector, guardian } = setup;
        let engaged = BTreeMap::new();
        Recoverer { machine, wake: Wake::default(), strategies, tools, detector, guardian, engaged }
    }

    fn strategy(&mut self, measure: &Measure) -> Result<Recipient<CarryOut>, Failed> {
        if let Some(strategy) = self.engaged.get(measure).filter(|strategy| strategy.connected()) {
            return Ok(strategy.clone());
        }
        let strategy = self.strategies.make(measure, &self.guardian, self.tools.clone())?;
        self.engaged.insert(measure.clone(), strategy.clone());
        Ok(strategy)
    }

    fn have_carried_out(&mut self, order: Order, context: &mut Context<Self>) {
        let (number, place) = (order.number, order.fault.place.clone());
        info!(%place, measure = %order.measure, attempt = order.attempt, "recovering");
        let strategy = self.strategy(&order.measure);
        let carried_out = async move {
            let answer = strategy?.send(CarryOut(order)).await;
            answer.unwrap_or_else(|_| Err("the strategy ended without an answer".into()))
        };
        let settle = move |outcome: Result<Done, Failed>, recoverer: &mut Self, context: &mut _| {
            recoverer.machine.handle_outcome(number, outcome, platform::now());
            recoverer.drive(context);
        };
        context.spawn(wrap_future::<_, Self>(carried_out).map(settle));
    }
}

/// What the detector's record says about a fault; `None` where the detector has to find out itself.
fn outcome_of(settled: Settled) -> Option<Outcome> {
    Some(match settled {
        Settled::Decided { measure, attempt: 1 } => {
            Outcome::Decided { measure: measure.to_string() }
        }
        Settled::Decided { measure, attempt } => {
            Outcome::Decided { measure: format!("{measure}, attempt {attempt}") }
        }
        Settled::Observed => Outcome::Decided { measure: Measure::Observe.to_string() },
        Settled::Recovered { .. } => Outcome::Recovered,
        Settled::GaveUp { reason } => Outcome::GaveUp { reason },
        Settled::Contained { measure } => {
            Outcome::GaveUp { reason: format!("contained by {measure}; service is not restored") }
        }
        _ => return None,
    })
}

impl Body for Recoverer {
    type Machine = recovery::Recoverer;

    fn machine(&mut self) -> &mut recovery::Recoverer {
        &mut self.machine
    }

    fn wake(&mut self) -> &mut Wake {
        &mut self.wake
    }

    fn carry_out(&mut self, action: RecovererAction, context: &mut Context<Self>) {
        match action {
            RecovererAction::CarryOut(order) => self.have_carried_out(order, context),
            RecovererAction::Settle { fault, settled, .. } => {
                if let Some(what) = outcome_of(settled) {
                    self.detector.do_send(FaultOutcome { id: fault, at: platform::now(), what });
                }
            }
            RecovererAction::Release { measure } => {
                self.engaged.remove(&measure);
            }
            RecovererAction::LastResort { fault, reason } => {
                info!(place = %fault.place, kind = %fault.kind, reason, "the node comes to rest");
                self.tools.rest_node(&fault, &reason);
            }
        }
    }
}

answers_the_monitor!(Recoverer);

impl Actor for Recoverer {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.drive(context);
    }
}

impl Supervised for Recoverer {
    fn restarting(&mut self, _: &mut Context<Self>) {
        self.wake = Wake::default();
        self.engaged.clear();
        self.machine = self.machine.begun_anew(platform::now());
    }
}

impl Handler<Recover> for Recoverer {
    type Result = Confirmed;

    fn handle(&mut self, message: Recover, context: &mut Context<Self>) -> Confirmed {
        let Recover { fault } = message;
        self.machine.handle_fault(fault, platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<StandDown> for Recoverer {
    type Result = Confirmed;

    fn handle(&mut self, message: StandDown, context: &mut Context<Self>) -> Confirmed {
        let StandDown { id, place } = message;
        self.machine.handle_stand_down(id, &place, platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<NodeRests> for Recoverer {
    type Result = ();

    fn handle(&mut self, message: NodeRests, context: &mut Context<Self>) {
        match message.reason {
            Some(_) => self.machine.handle_rest(platform::now()),
            None => self.machine.handle_work(),
        }
        self.drive(context);
    }
}

#[cfg(test)]
mod tests;
