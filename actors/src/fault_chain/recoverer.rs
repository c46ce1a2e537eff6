//! The recoverer's actor: it carries out its machine's orders, or has a strategy do so.

use super::strategy::{EngagedStrategy, StrategyContext, StrategyTable};
use crate::platform;
use crate::runtime::callbacks::Callbacks;
use crate::runtime::driver::{MachineActor, WakeTimer};
use crate::runtime::guardian::answers_the_monitor;
use actix::fut::wrap_future;
use actix::prelude::*;
use blastema_contract::Confirmed;
use blastema_contract::detector::FaultOutcome;
use blastema_contract::recoverer::{CancelRecovery, Recover, SafeStateChanged};
use blastema_contract::strategy::ExecuteAction;
use blastema_core::Instant;
use blastema_core::recovery::{
    self, RecovererOutput, RecoveryAction, RecoveryDone, RecoveryFailed, RecoveryOrder,
};
use blastema_core::sorted::SortedMap;
use tokio::sync::watch;
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
    /// Finds those that block.
    pub(crate) callbacks: Callbacks,
}

/// Decides what is done about a fault.
pub(crate) struct RecovererActor {
    setup: RecovererSetup,
    wake: WakeTimer,
    /// The strategies of the application that live at present.
    engaged: SortedMap<RecoveryAction, EngagedStrategy>,
}

/// What came back for one order.
enum Answer {
    Outcome(Result<RecoveryDone, RecoveryFailed>),
    /// The thread of the strategy is blocked, by this order.
    Blocked(u64),
}

impl RecovererActor {
    pub(crate) fn new(setup: RecovererSetup) -> Self {
        RecovererActor { setup, wake: WakeTimer::default(), engaged: SortedMap::new() }
    }

    /// The strategy of the application that carries an action out, if one does.
    fn strategy(
        &mut self,
        action: &RecoveryAction,
    ) -> Result<Option<&EngagedStrategy>, RecoveryFailed> {
        let RecoveryAction::Custom(name) = action else { return Ok(None) };
        if !self.engaged.get(action).is_some_and(EngagedStrategy::is_usable) {
            let RecovererSetup { strategies, context, callbacks, .. } = &self.setup;
            let strategy = strategies.make(name, context.clone(), callbacks)?;
            self.engaged.insert(action.clone(), strategy);
        }
        Ok(self.engaged.get(action))
    }

    fn have_carried_out(&mut self, order: RecoveryOrder, context: &mut Context<Self>) {
        let due = platform::now() + order.within;
        info!(location = %order.fault.location, action = %order.action, attempt = order.attempt, "recovering");
        let strategy = self.strategy(&order.action);
        let strategy = strategy.map(|strategy| {
            strategy.map(|strategy| (strategy.orders.clone(), strategy.blocked_by()))
        });
        let (given, strategy_context) = (order.clone(), self.setup.context.clone());
        let carried_out = async move {
            let (orders, blocked_by) = match strategy {
                Ok(Some(strategy)) => strategy,
                Ok(None) => {
                    let work = timeout(given.within, strategy_context.carry_out(&given)).await;
                    let overdue = |_| Err(format!("not done within {:?}", given.within).into());
                    return Answer::Outcome(work.unwrap_or_else(overdue));
                }
                Err(failed) => return Answer::Outcome(Err(failed)),
            };
            tokio::select! {
                biased;
                order = blocked(blocked_by) => Answer::Blocked(order),
                answer = orders.send(ExecuteAction(given)) => Answer::Outcome(
                    answer.unwrap_or_else(|_| Err("the strategy ended without an answer".into())),
                ),
            }
        };
        let settle = move |answer: Answer, recoverer: &mut Self, context: &mut _| {
            recoverer.handle_answer(order, due, answer, context);
        };
        context.spawn(wrap_future::<_, Self>(carried_out).map(settle));
    }

    fn handle_answer(
        &mut self,
        mut order: RecoveryOrder,
        due: Instant,
        answer: Answer,
        context: &mut Context<Self>,
    ) {
        let outcome = match answer {
            Answer::Outcome(outcome) => outcome,
            Answer::Blocked(culprit) if culprit == order.number => {
                let limit = self.setup.callbacks.limit().unwrap_or_default();
                Err(format!("the strategy {} blocked its thread for {limit:?}", order.action)
                    .into())
            }
            // It waited behind another order, which failed.
            Answer::Blocked(_) => {
                order.within = due - platform::now();
                if !order.within.is_zero() {
                    return self.have_carried_out(order, context);
                }
                Err("its strategy was blocked by another order for all of its time".into())
            }
        };
        self.setup.machine.handle_outcome(order.number, outcome, platform::now());
        self.drive(context);
    }
}

/// Completes with the order that blocks the thread of a strategy.
async fn blocked(blocked_by: Option<watch::Receiver<Option<u64>>>) -> u64 {
    if let Some(mut blocked_by) = blocked_by
        && let Ok(order) = blocked_by.wait_for(Option::is_some).await
        && let Some(order) = *order
    {
        return order;
    }
    // Its thread has ended, or it has none for itself: then its mailbox says so.
    std::future::pending().await
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
