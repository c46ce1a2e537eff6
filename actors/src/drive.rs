//! The generic driver between a machine and the actor that is its body.

use crate::platform;
use actix::fut::ActorFuture;
use actix::prelude::*;
use blastema_core::{Instant, Machine};
use std::pin::Pin;
use std::task::{self, Poll};

/// An actor whose logic is a machine.
///
/// A handler takes its message apart, feeds the machine, and calls [`drive`](Body::drive).
pub(crate) trait Body: Actor<Context = Context<Self>> {
    /// The logic.
    type Machine: Machine;

    /// The machine.
    fn machine(&mut self) -> &mut Self::Machine;

    /// The one timer.
    fn wake(&mut self) -> &mut Wake;

    /// Does what the machine wants done.
    fn carry_out(
        &mut self,
        output: <Self::Machine as Machine>::Output,
        context: &mut Self::Context,
    );

    /// Drives soon: after the inputs that wait already, or after a batch of them. What they lead to
    /// goes out together.
    fn drive_soon(&mut self, context: &mut Self::Context) {
        self.wake().fed += 1;
        if self.wake().fed == 1 {
            context.spawn(Soon);
        } else if self.wake().fed >= BATCH {
            self.drive(context);
        }
    }

    /// Carries out all outputs, and sees that the machine is woken in time.
    fn drive(&mut self, context: &mut Self::Context) {
        if self.wake().fed > 0 {
            self.wake().fed = 1;
        }
        while let Some(output) = self.machine().poll_output() {
            self.carry_out(output, context);
        }
        let Some(due) = self.machine().poll_timeout() else { return };
        // A timer that fires too early is left standing and re-checked, so that inputs which only
        // push the deadline out, such as heartbeats, arm nothing.
        if self.wake().armed.is_some_and(|armed| armed <= due) {
            return;
        }
        if let Some(handle) = self.wake().handle.take() {
            context.cancel_future(handle);
        }
        let timer = tokio::time::sleep_until(platform::timer_at(due));
        let handle = context.spawn(actix::fut::wrap_future::<_, Self>(timer).map(
            |(), body: &mut Self, context: &mut Self::Context| {
                (body.wake().armed, body.wake().handle) = (None, None);
                body.machine().handle_timeout(platform::now());
                body.drive(context);
            },
        ));
        (self.wake().armed, self.wake().handle) = (Some(due), Some(handle));
    }
}

/// The one timer of a [`Body`]. A body that begins anew begins with a fresh one.
#[derive(Default)]
pub(crate) struct Wake {
    armed: Option<Instant>,
    handle: Option<SpawnHandle>,
    /// Inputs since the machine was driven last, while a [`Soon`] waits.
    fed: usize,
}

/// So many inputs may wait for [`Body::drive_soon`]: an actor whose mailbox never empties is driven too.
const BATCH: usize = 64;

/// Drives once, when the mailbox is empty.
struct Soon;

impl<B: Body> ActorFuture<B> for Soon {
    type Output = ();

    fn poll(
        self: Pin<&mut Self>,
        body: &mut B,
        context: &mut Context<B>,
        _: &mut task::Context<'_>,
    ) -> Poll<()> {
        body.drive(context);
        body.wake().fed = 0;
        Poll::Ready(())
    }
}
