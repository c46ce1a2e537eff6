//! The actor around a strategy.

use super::{RecoveryStrategy, StrategyContext};
use crate::platform::panics;
use crate::runtime::callbacks::{Callbacks, RunningCall};
use crate::runtime::pending_answer::PendingAnswer;
use actix::prelude::*;
use blastema_contract::strategy::ExecuteAction;
use blastema_core::ObjectName;
use blastema_core::recovery::{RecoveryDone, RecoveryFailed};
use std::future::poll_fn;
use std::pin::pin;
use std::rc::Rc;
use std::sync::Arc;
use std::task::Poll;
use tokio::sync::watch;

/// Hosts one strategy: a panic in it, its silence, and that it blocks are failures like any other.
pub(super) struct StrategyHost<S> {
    make: Arc<dyn Fn() -> S + Send + Sync>,
    /// Made with its first order.
    strategy: Option<Rc<S>>,
    context: StrategyContext,
    thread: Option<StrategyThread>,
}

/// The thread that a strategy has for itself.
#[derive(Clone)]
pub(super) struct StrategyThread {
    pub(super) object: ObjectName,
    pub(super) callbacks: Callbacks,
    /// The order that blocks it.
    pub(super) blocked_by: Arc<watch::Sender<Option<u64>>>,
}

impl StrategyThread {
    /// The strategy's code runs now, for this order.
    fn enter(&self, order: u64) -> Option<RunningCall> {
        let thread = self.clone();
        self.callbacks.enter(&self.object, move |limit| {
            thread.blocked_by.send_replace(Some(order));
            let detail = format!(
                "the recovery strategy {} has blocked its thread for {limit:?}: the thread is abandoned",
                thread.object.as_str().rsplit('/').next().unwrap_or_default()
            );
            thread.callbacks.declare(&thread.object, detail);
        })
    }

    /// It has returned, long after another thread took its place.
    fn end_late(&self) {
        self.callbacks.clear(&self.object);
        Arbiter::current().stop();
    }
}

impl<S: RecoveryStrategy> StrategyHost<S> {
    pub(super) fn new(
        make: Arc<dyn Fn() -> S + Send + Sync>,
        context: StrategyContext,
        thread: Option<StrategyThread>,
    ) -> Self {
        StrategyHost { make, strategy: None, context, thread }
    }

    fn strategy(&mut self, order: u64) -> Result<Rc<S>, RecoveryFailed> {
        if let Some(strategy) = &self.strategy {
            return Ok(strategy.clone());
        }
        let call = self.thread.as_ref().and_then(|thread| thread.enter(order));
        let made = panics::caught(|| (self.make)());
        if let (Some(thread), Some(false)) = (&self.thread, call.map(RunningCall::end)) {
            thread.end_late();
        }
        let strategy = made
            .map(Rc::new)
            .map_err(|panicked| RecoveryFailed::from(format!("making the strategy {panicked}")))?;
        Ok(self.strategy.insert(strategy).clone())
    }
}

impl<S: RecoveryStrategy> Actor for StrategyHost<S> {
    type Context = Context<Self>;
}

impl<S: RecoveryStrategy> Handler<ExecuteAction> for StrategyHost<S> {
    type Result = PendingAnswer<Result<RecoveryDone, RecoveryFailed>>;

    fn handle(&mut self, message: ExecuteAction, _: &mut Context<Self>) -> Self::Result {
        let ExecuteAction(order) = message;
        let strategy = match self.strategy(order.number) {
            Ok(strategy) => strategy,
            Err(failed) => return PendingAnswer::new(std::future::ready(Err(failed))),
        };
        let (context, thread) = (self.context.clone(), self.thread.clone());
        PendingAnswer::new(async move {
            let work = guarded(strategy.carry_out(&order, &context), order.number, thread);
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
    order: u64,
    thread: Option<StrategyThread>,
) -> Result<RecoveryDone, RecoveryFailed> {
    let mut work = pin!(work);
    poll_fn(move |cx| {
        let call = thread.as_ref().and_then(|thread| thread.enter(order));
        let polled = panics::caught(|| work.as_mut().poll(cx));
        if let (Some(thread), Some(false)) = (&thread, call.map(RunningCall::end)) {
            // Its order was given to a successor, or has failed: nothing more is done about it
            // here.
            thread.end_late();
            return Poll::Pending;
        }
        polled.unwrap_or_else(|panicked| Err(format!("the strategy {panicked}").into()).into())
    })
    .await
}
