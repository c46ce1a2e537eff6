//! The recoverer's actor: it carries out its machine's orders, or has a strategy do so.

use super::strategy::{EngagedStrategy, StrategyContext, StrategyTable, StrategyThreads};
use crate::platform;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::FaultOutcome;
use blastema_contract::recoverer::{CancelRecovery, Recover, SafeStateChanged};
use blastema_contract::strategy::ExecuteAction;
use blastema_core::recovery::{
    self, RecovererOutput, RecoveryAction, RecoveryFailed, RecoveryOrder,
};
use blastema_core::sorted::SortedMap;
use std::time::Duration;
use tokio::time::timeout;
use tracing::info;

/// What a recoverer is made of.
pub(crate) struct RecovererSetup {
    /// The logic, with the plan.
    pub(crate) machine: recovery::Recoverer,
    /// How to make strategies.
    pub(crate) strategies: StrategyTable,
    /// What strategies are given.
    pub(crate) context: StrategyContext,
    /// Gets a report of what becomes of every fault.
    pub(crate) detector: Recipient<FaultOutcome>,
    /// Where strategies have threads of their own; `None` where all of the node runs on one.
    pub(crate) threads: Option<StrategyThreads>,
}

/// Decides what is done about a fault.
pub(crate) struct RecovererActor {
    setup: RecovererSetup,
    wake: WakeTimer,
    /// The strategies of the application that live at present.
    engaged: SortedMap<RecoveryAction, EngagedStrategy>,
}

/// How much later than its time a strategy that does not block its thread answers at the latest.
const ANSWER_MARGIN: Duration = Duration::from_millis(100);

impl RecovererActor {
    pub(crate) fn new(setup: RecovererSetup) -> Self {
        RecovererActor { setup, wake: WakeTimer::default(), engaged: SortedMap::new() }
    }

    /// Where the strategy of the application takes orders that carries an action out, if one does.
    fn strategy(
        &mut self,
        action: &RecoveryAction,
    ) -> Result<Option<Recipient<ExecuteAction>>, RecoveryFailed> {
        let RecoveryAction::Custom(name) = action else { return Ok(None) };
        if !self.engaged.get(action).is_some_and(|engaged| engaged.orders.connected()) {
            let RecovererSetup { strategies, context, threads, .. } = &self.setup;
            let strategy = strategies.make(name, context.clone(), threads.as_ref())?;
            self.engaged.insert(action.clone(), strategy);
        }
        Ok(self.engaged.get(action).map(|engaged| engaged.orders.clone()))
    }

    fn have_carried_out(&mut self, order: RecoveryOrder, context: &mut Context<Self>) {
        info!(location = %order.fault.location, action = %order.action, attempt = order.attempt, "recovering");
        let strategy = self.strategy(&order.action);
        let (given, strategy_context) = (order.clone(), self.setup.context.clone());
        let carried_out =
            async move {
                let within = given.within;
                let orders = match strategy {
                    Ok(Some(orders)) => orders,
                    Ok(None) => {
                        let work = timeout(within, strategy_context.carry_out(&given)).await;
                        let overdue = |_| Err(format!("not done within {within:?}").into());
                        return Ok(work.unwrap_or_else(overdue));
                    }
                    Err(failed) => return Ok(Err(failed)),
                };
                let limit = within.saturating_add(ANSWER_MARGIN);
                match timeout(limit, orders.send(ExecuteAction(given))).await {
                    Ok(answer) => Ok(answer
                        .unwrap_or_else(|_| Err("the strategy ended without an answer".into()))),
                    Err(_) => Err(orders),
                }
            };
        let settle = move |answer, recoverer: &mut Self, context: &mut _| match answer {
            Ok(outcome) => {
                recoverer.setup.machine.handle_outcome(order.number, outcome, platform::now());
                recoverer.drive(context);
            }
            Err(orders) => recoverer.give_strategy_up(&order, &orders),
        };
        context.spawn(wrap_future::<_, Self>(carried_out).map(settle));
    }

    /// The strategy has blocked its thread for all the time of this order, which has failed.
    fn give_strategy_up(&mut self, order: &RecoveryOrder, orders: &Recipient<ExecuteAction>) {
        let present = self.engaged.get(&order.action);
        // Another order may have been found to wait for the same.
        if present.is_some_and(|engaged| engaged.orders == *orders)
            && let Some(engaged) = self.engaged.remove(&order.action)
        {
            engaged.give_up(order.within);
        }
    }
}

impl MachineActor for RecovererActor {
    type Machine = recovery::Recoverer;

    fn driven(&mut self) -> (&mut recovery::Recoverer, &mut WakeTimer) {
        (&mut self.setup.machine, &mut self.wake)
    }

    fn carry_out(&mut self, action: RecovererOutput, context: &mut Context<Self>) {
        match action {
            RecovererOutput::CarryOut(order) => self.have_carried_out(order, context),
            RecovererOutput::Settle { fault: id, outcome: what } => {
                self.setup.detector.do_send(FaultOutcome { id, at: platform::now(), what });
            }
            RecovererOutput::AbandonIncarnation { fault } => {
                self.setup.context.give_up_incarnation(&fault)
            }
            RecovererOutput::LastResort { fault, reason } => {
                info!(location = %fault.location, kind = %fault.kind, reason, "the node enters the safe state");
                self.setup.context.rest_node(&fault, &reason);
            }
        }
    }
}

answers_the_monitor!(RecovererActor);

impl Actor for RecovererActor {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Context<Self>) {
        self.drive(context);
    }
}

impl Supervised for RecovererActor {
    fn restarting(&mut self, _: &mut Context<Self>) {
        self.wake = WakeTimer::default();
        self.engaged.clear();
        self.setup.machine = self.setup.machine.restarted(platform::now());
    }
}

impl Handler<Recover> for RecovererActor {
    type Result = Confirmed;

    fn handle(&mut self, message: Recover, context: &mut Context<Self>) -> Confirmed {
        let Recover { fault } = message;
        self.setup.machine.handle_fault(fault, platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<CancelRecovery> for RecovererActor {
    type Result = Confirmed;

    fn handle(&mut self, message: CancelRecovery, context: &mut Context<Self>) -> Confirmed {
        let CancelRecovery { id, location } = message;
        self.setup.machine.handle_stand_down(id, &location, platform::now());
        self.drive(context);
        Confirmed
    }
}

impl Handler<SafeStateChanged> for RecovererActor {
    type Result = ();

    fn handle(&mut self, message: SafeStateChanged, context: &mut Context<Self>) {
        match message {
            SafeStateChanged::Entering => self.setup.machine.handle_rest(platform::now()),
            SafeStateChanged::Entered { .. } => return,
            SafeStateChanged::Left => self.setup.machine.handle_work(),
            SafeStateChanged::NodeEnds => self.setup.machine.handle_node_end(platform::now()),
        }
        self.drive(context);
    }
}

#[cfg(test)]
mod tests;
