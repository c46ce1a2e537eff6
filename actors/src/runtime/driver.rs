//! The generic driver between a machine and its actor.

use crate::platform;
use actix::fut::ActorFuture;
use actix::prelude::*;
use blastema_core::{Instant, Machine};
use std::pin::Pin;
use std::task::{self, Poll};

/// An actor whose logic is a machine.
///
/// A handler takes its message apart, feeds the machine, and calls
/// [`drive`](MachineActor::drive).
pub(crate) trait MachineActor: Actor<Context = Context<Self>> {
    type Machine: Machine;

    /// The machine, and the one timer.
    fn driven(&mut self) -> (&mut Self::Machine, &mut WakeTimer);

    /// Does what the machine wants done.
    fn carry_out(
        &mut self,
        output: <Self::Machine as Machine>::Output,
        context: &mut Self::Context,
    );

    fn machine(&mut self) -> &mut Self::Machine {
        self.driven().0
    }

    /// The one timer.
    fn wake(&mut self) -> &mut WakeTimer {
        self.driven().1
    }

    /// Drives soon: after the inputs that wait already, or after a batch of them. What they lead to
    /// goes out together.
    fn drive_soon(&mut self, context: &mut Self::Context) {
        let wake = self.wake();
        wake.fed += 1;
        if wake.fed >= BATCH {
            self.drive(context);
        } else if !std::mem::replace(&mut wake.has_soon, true) {
            context.spawn(Soon);
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
            |(), actor: &mut Self, context: &mut Self::Context| {
                (actor.wake().armed, actor.wake().handle) = (None, None);
                actor.machine().handle_timeout(platform::now());
                actor.drive(context);
            },
        ));
        (self.wake().armed, self.wake().handle) = (Some(due), Some(handle));
    }
}

/// The one timer of a [`MachineActor`]. An actor that restarts replaces it.
#[derive(Default)]
pub(crate) struct WakeTimer {
    armed: Option<Instant>,
    handle: Option<SpawnHandle>,
    /// Inputs that are to be driven by [`Soon`].
    fed: usize,
    /// There is one.
    has_soon: bool,
}

/// So many inputs may wait for [`MachineActor::drive_soon`]: an actor whose mailbox never empties
/// is driven too.
const BATCH: usize = 64;

/// Drives when the mailbox is empty, if there were inputs. actix polls it after each batch of
/// messages; one that is spawned for each costs as much as the message, since the actor's other
/// futures are polled again with it.
struct Soon;

impl<A: MachineActor> ActorFuture<A> for Soon {
    type Output = ();

    fn poll(
        self: Pin<&mut Self>,
        actor: &mut A,
        context: &mut Context<A>,
        _: &mut task::Context<'_>,
    ) -> Poll<()> {
        if actor.wake().fed > 0 {
            actor.drive(context);
            actor.wake().fed = 0;
        }
        Poll::Pending
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::settle;
    use std::sync::{Arc, Mutex};

    /// Outputs what it was fed, in one list.
    #[derive(Default)]
    struct List(Vec<u32>);

    impl Machine for List {
        type Output = Vec<u32>;

        fn poll_output(&mut self) -> Option<Vec<u32>> {
            (!self.0.is_empty()).then(|| std::mem::take(&mut self.0))
        }

        fn poll_timeout(&self) -> Option<Instant> {
            None
        }

        fn handle_timeout(&mut self, _: Instant) {}
    }

    #[derive(Default)]
    struct Lister {
        list: List,
        wake: WakeTimer,
        outputs: Arc<Mutex<Vec<Vec<u32>>>>,
    }

    impl Actor for Lister {
        type Context = Context<Self>;
    }

    impl MachineActor for Lister {
        type Machine = List;

        fn driven(&mut self) -> (&mut List, &mut WakeTimer) {
            (&mut self.list, &mut self.wake)
        }

        fn carry_out(&mut self, output: Vec<u32>, _: &mut Context<Self>) {
            self.outputs.lock().unwrap().push(output);
        }
    }

    #[derive(Message)]
    #[rtype(result = "()")]
    struct Feed(u32);

    impl Handler<Feed> for Lister {
        type Result = ();

        fn handle(&mut self, Feed(number): Feed, context: &mut Context<Self>) {
            self.list.0.push(number);
            self.drive_soon(context);
        }
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn inputs_that_wait_together_are_driven_together_however_often_that_is() {
        let lister = Lister::default();
        let outputs = lister.outputs.clone();
        let lister = lister.start();
        let many: Vec<u32> = (10..10 + BATCH as u32 + 2).collect();

        for batch in [&[1, 2, 3][..], &[4], &[5, 6], &many] {
            batch.iter().for_each(|number| lister.do_send(Feed(*number)));
            settle().await;
        }

        let outputs = outputs.lock().unwrap();
        assert_eq!(outputs[..3], [vec![1, 2, 3], vec![4], vec![5, 6]]);
        assert_eq!((outputs[3].len(), outputs[3..].concat()), (BATCH, many));
    }
}
