//! The actor around a strategy.

use super::table::StrategyThread;
use super::{RecoveryStrategy, StrategyContext};
use crate::platform::panics;
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::strategy::ExecuteAction;
use blastema_core::recovery::{RecoveryDone, RecoveryFailed};
use std::future::{Future, poll_fn};
use std::pin::pin;
use std::rc::Rc;
use std::sync::Arc;

/// Hosts one strategy: a panic in it and its silence are failures like any other.
pub(super) struct StrategyHost<S> {
    make: Arc<dyn Fn() -> S + Send + Sync>,
    /// Made with its first order.
    strategy: Option<Rc<S>>,
    context: StrategyContext,
    thread: Option<StrategyThread>,
}

impl<S: RecoveryStrategy> StrategyHost<S> {
    pub(super) fn new(
        make: Arc<dyn Fn() -> S + Send + Sync>,
        context: StrategyContext,
        thread: Option<StrategyThread>,
    ) -> Self {
        StrategyHost { make, strategy: None, context, thread }
    }

    fn strategy(&mut self) -> Result<Rc<S>, RecoveryFailed> {
        if let Some(strategy) = &self.strategy {
            return Ok(strategy.clone());
        }
        let made = panics::caught(|| (self.make)());
        let strategy = made.map_err(|why| format!("making the strategy {why}"))?;
        Ok(self.strategy.insert(Rc::new(strategy)).clone())
    }
}

impl<S: RecoveryStrategy> Actor for StrategyHost<S> {
    type Context = Context<Self>;
}

impl<S> Drop for StrategyHost<S> {
    fn drop(&mut self) {
        if let Some(thread) = &self.thread {
            thread.end();
        }
    }
}

impl<S: RecoveryStrategy> Handler<ExecuteAction> for StrategyHost<S> {
    type Result = PendingAnswer<Result<RecoveryDone, RecoveryFailed>>;

    fn handle(&mut self, message: ExecuteAction, _: &mut Context<Self>) -> Self::Result {
        let ExecuteAction(order) = message;
        // The orders of a thread that was given up have failed already.
        let strategy = match self.thread.as_ref().is_some_and(StrategyThread::is_given_up) {
            true => Err("its thread was given up".into()),
            false => self.strategy(),
        };
        let strategy = match strategy {
            Ok(strategy) => strategy,
            Err(failed) => return PendingAnswer::new(std::future::ready(Err(failed))),
        };
        let context = self.context.clone();
        PendingAnswer::new(async move {
            let work = guarded(strategy.carry_out(&order, &context));
            match tokio::time::timeout(order.within, work).await {
                Ok(outcome) => outcome,
                Err(_) => Err(format!("not done within {:?}", order.within).into()),
            }
        })
    }
}

/// Polls the strategy's future so that a panic in it becomes a failure with its text and place.
async fn guarded(
    work: impl Future<Output = Result<RecoveryDone, RecoveryFailed>>,
) -> Result<RecoveryDone, RecoveryFailed> {
    let mut work = pin!(work);
    poll_fn(move |cx| {
        let polled = panics::caught(|| work.as_mut().poll(cx));
        polled.unwrap_or_else(|why| Err(format!("the strategy {why}").into()).into())
    })
    .await
}
