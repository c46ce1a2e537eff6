//! The host: what stands between a user's component and actix.
//!
//! ```text
//!  senders ──► ComponentCell: queue, name, core  ◄── ComponentChild ◄── supervisor
//!                  │ what all incarnations share         │ start, stop, abandon …
//!  commands ──► Host (an actix actor) ◄──────────────────┘
//!                  │ owns
//!               ComponentExecutor: one incarnation after another, each under the panic guard
//!                  │ ComponentSlot, IncarnationLifecycle, ScheduledWork, ActivityRecord
//!  sampler ──► ArbiterHeartbeat of each arbiter, ActivityRecord of each component
//! ```
//!
//! The actix mailbox takes commands: the framework alone sends to it, and it is served before the
//! executor, so that a flooded component, or one that awaits, still answers and obeys. Messages of
//! the application travel in the [queue](crate::messaging::queue), which belongs to the cell.
//!
//! A handler that keeps its thread is found by the sampler, which reads what workers write and
//! never waits for them. The supervisor then abandons the incarnation: its arbiter is *fenced*, so
//! that nothing the handler still says gets out. If the handler returns within the grace time the
//! fence is lifted and its neighbours have only lost time; else the arbiter is *lost*, and they are
//! re-created elsewhere, each with its queue.

pub(crate) mod child;
pub(crate) mod executor;
pub(crate) mod lifecycle;
pub(crate) mod reference;
pub(crate) mod schedule;
pub(crate) mod spec;

#[cfg(test)]
mod tests;

use crate::component::Component;
use crate::component::control::HostCommand;
use actix::fut::{ActorFutureExt, wrap_future};
use actix::{Actor, ActorContext, AsyncContext, Context, Handler};
use executor::{ComponentExecutor, SharedExecutor};
use lifecycle::EndReason;
use std::cell::RefCell;
use std::rc::Rc;

/// The actix actor behind a component, for one placement on one arbiter.
pub(crate) struct Host<C: Component> {
    executor: Rc<RefCell<ComponentExecutor<C>>>,
    entering: Option<SharedExecutor<C>>,
}

impl<C: Component> Host<C> {
    pub(crate) fn new(executor: SharedExecutor<C>) -> Self {
        Host { executor: executor.0.clone(), entering: Some(executor) }
    }
}

impl<C: Component> Actor for Host<C> {
    type Context = Context<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        if let Some(executor) = self.entering.take() {
            let served =
                wrap_future::<_, Self>(executor).map(|(), host, context: &mut Context<Self>| {
                    host.executor.borrow().vacate();
                    context.stop();
                });
            context.spawn(served);
        }
    }
}

impl<C: Component> Handler<HostCommand> for Host<C> {
    type Result = ();

    fn handle(&mut self, control: HostCommand, _: &mut Self::Context) {
        let mut executor = self.executor.borrow_mut();
        match control {
            HostCommand::Stop => executor.stop(EndReason::Stopped),
            HostCommand::MakeWay => executor.stop(EndReason::Replaced),
            HostCommand::Reset => executor.reset(),
            HostCommand::Activate(active) => executor.activate(active),
            // Whatever arrives here, the executor is polled next.
            HostCommand::Wake => {}
            HostCommand::Panic => {
                drop(executor.die_of(Box::new("it was told to panic"), "an injected fault"));
            }
        }
    }
}
