//! The actor around a strategy.

use super::{RecoveryStrategy, Tools};
use crate::panics;
use actix::prelude::*;
use blastema_contract::strategy::CarryOut;
use blastema_core::recovery::{Done, Failed};
use std::future::{Future, poll_fn};
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::pin;
use std::rc::Rc;

/// Hosts one strategy: a panic in it, or its silence, is a failure like any other.
pub(super) struct StrategyHost<S> {
    strategy: Rc<S>,
    tools: Tools,
}

impl<S: RecoveryStrategy> StrategyHost<S> {
    pub(super) fn new(strategy: S, tools: Tools) -> Self {
        StrategyHost { strategy: Rc::new(strategy), tools }
    }
}

impl<S: RecoveryStrategy> Actor for StrategyHost<S> {
    type Context = Context<Self>;
}

impl<S: RecoveryStrategy> Supervised for StrategyHost<S> {}

impl<S: RecoveryStrategy> Handler<CarryOut> for StrategyHost<S> {
    type Result = ResponseFuture<Result<Done, Failed>>;

    fn handle(&mut self, message: CarryOut, _: &mut Context<Self>) -> Self::Result {
        let CarryOut(order) = message;
        let (strategy, tools) = (self.strategy.clone(), self.tools.clone());
        Box::pin(async move {
            let work = guarded(strategy.carry_out(&order, &tools));
            match tokio::time::timeout(order.within, work).await {
                Ok(outcome) => outcome,
                Err(_) => Err(format!("not done within {:?}", order.within).into()),
            }
        })
    }
}

/// Polls the strategy's future so that a panic in it becomes a failure with its text and place.
async fn guarded(work: impl Future<Output = Result<Done, Failed>>) -> Result<Done, Failed> {
    let mut work = pin!(work);
    poll_fn(move |cx| {
        let polled = {
            let _guarded = panics::Guarded::enter();
            catch_unwind(AssertUnwindSafe(|| work.as_mut().poll(cx)))
        };
        polled.unwrap_or_else(|payload| {
            let (text, place) = (panics::text_of(payload), panics::take_place());
            Err(format!("the strategy panicked at {place}: {text}").into()).into()
        })
    })
    .await
}
