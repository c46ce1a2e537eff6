//! The part of an actor that moves bytes: polled after its mailbox, on its own arbiter.

use actix::fut::ActorFuture;
use actix::{Actor, AsyncContext, Context};
use std::pin::Pin;
use std::task::{self, Poll};

/// How many frames are moved in one turn before the mailbox, and the arbiter's other actors, come to
/// their right. 64 small datagrams take about a tenth of a millisecond.
pub(crate) const BUDGET: usize = 64;

/// An actor whose medium is polled.
pub(crate) trait Pumped: Actor<Context = Context<Self>> {
    /// Moves what can be moved, within [`BUDGET`], and leaves a waker for the rest.
    ///
    /// It is called after every message too, so that a handler need only queue what is to go out.
    fn pump(&mut self, context: &mut Context<Self>, task: &mut task::Context<'_>);

    /// To be called once, when the actor has started.
    fn start_pump(context: &mut Context<Self>) {
        context.spawn(Pump);
    }
}

/// Polls the medium for as long as the actor lives.
struct Pump;

impl<A: Pumped> ActorFuture<A> for Pump {
    type Output = ();

    fn poll(
        self: Pin<&mut Self>,
        actor: &mut A,
        context: &mut A::Context,
        task: &mut task::Context<'_>,
    ) -> Poll<()> {
        actor.pump(context, task);
        Poll::Pending
    }
}
