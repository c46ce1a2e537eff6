//! The reflex that keeps the middleware's own actors alive.
//!
//! Components are hosted; the objects of the middleware itself are plain actors, and the guardian
//! stands between their panics and actix. A panic is caught around each poll, so that actix never
//! sees it: the actor restarts in [`Supervised::restarting`], and keeps its address and its
//! mailbox. Only the message that it was serving is lost.

use crate::messaging::death_watch::{Deaths, DownReason};
use crate::platform;
use crate::platform::panics::{self, PanicRecord};
use actix::dev::{ContextFut, channel};
use actix::prelude::*;
use blastema_contract::reports::{Alive, ExitReason, Exited};
use blastema_core::{Incarnation, Lifecycle, ObjectName, SlidingWindow};
use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::pin::Pin;
use std::sync::{Arc, OnceLock};
use std::task::{self, Poll};
use std::time::Duration;
use tokio::runtime::Handle;

/// More restarts than this within [`PERIOD`], and the reflex gives up: an actor of the middleware
/// that cannot stay alive is a matter for the whole node.
const TIMES: u32 = 20;
/// The sliding window in which restarts are counted.
const PERIOD: Duration = Duration::from_secs(10);
/// Requests that may wait on the mailbox before a sender notices; `do_send` knows no bound.
const MAILBOX: usize = 1024;

thread_local! {
    static LIFE: Cell<Incarnation> = const { Cell::new(Incarnation::FIRST) };
}

/// The answer of the guarded actor that is running now to "are you alive?".
pub(crate) fn alive() -> Alive {
    Alive { incarnation: LIFE.get(), state: Lifecycle::Active }
}

/// Lets a guarded actor answer the monitor.
macro_rules! answers_the_monitor {
    ($actor:ty) => {
        impl actix::Handler<blastema_contract::reports::AreYouAlive> for $actor {
            type Result = blastema_contract::reports::Alive;

            fn handle(
                &mut self,
                _: blastema_contract::reports::AreYouAlive,
                _: &mut Self::Context,
            ) -> Self::Result {
                crate::runtime::guardian::alive()
            }
        }
    };
}
pub(crate) use answers_the_monitor;

/// Runs actors that must not die. They restart, in their own `restarting`, from their
/// configuration.
#[derive(Clone, Default)]
pub(crate) struct Guardian {
    deaths: Arc<OnceLock<Recipient<Exited>>>,
    watched: Deaths,
}

impl Guardian {
    /// A guardian whose reports go to `deaths` from the beginning.
    #[cfg(test)]
    pub(crate) fn reporting_to(deaths: Recipient<Exited>) -> Self {
        let guardian = Guardian::default();
        guardian.report_to(deaths);
        guardian
    }

    /// From now on every death, survived or not, is reported to `deaths`. The monitor, which is
    /// told, is itself guarded: that is why this cannot be said when the guardian is made.
    pub(crate) fn report_to(&self, deaths: Recipient<Exited>) {
        // A second monitor would be a second master; the first stays.
        let _ = self.deaths.set(deaths);
    }

    /// Where the incarnations of its actors can be watched.
    pub(crate) fn watched(&self) -> Deaths {
        self.watched.clone()
    }

    /// Starts an actor on `arbiter`, or here.
    pub(crate) fn start<A>(
        &self,
        name: ObjectName,
        arbiter: Option<&ArbiterHandle>,
        make: impl FnOnce(&mut Context<A>) -> A + Send + 'static,
    ) -> Addr<A>
    where
        A: Actor<Context = Context<A>> + Supervised,
    {
        panics::install_hook();
        let (sender, receiver) = channel::channel(MAILBOX);
        let (deaths, watched) = (self.deaths.clone(), self.watched());
        watched.begin(&name, Incarnation::FIRST);
        let enter = move || {
            let mut context = Context::with_receiver(receiver);
            let actor = make(&mut context);
            let future: Box<dyn Restartable> = Box::new(context.into_future(actor));
            let (future, runtime) = (Some(future), Handle::current());
            let past = SlidingWindow::new(TIMES, PERIOD);
            let incarnation = Incarnation::FIRST;
            actix_rt::spawn(Ward { future, runtime, name, incarnation, past, deaths, watched });
        };
        match arbiter {
            Some(arbiter) => {
                arbiter.spawn_fn(enter);
            }
            None => enter(),
        }
        Addr::new(sender)
    }
}

/// An actor with its mailbox, which can be restarted.
trait Restartable: Future<Output = ()> + Unpin {
    /// Says whether it lives again.
    fn restart(&mut self) -> bool;
}

impl<A: Actor<Context = Context<A>> + Supervised> Restartable for ContextFut<A, Context<A>> {
    fn restart(&mut self) -> bool {
        ContextFut::restart(self)
    }
}

/// One guarded actor. Its type is not a parameter: the runtime's code for a task is compiled for
/// each type of task.
struct Ward {
    /// `None` only while it is dropped.
    future: Option<Box<dyn Restartable>>,
    runtime: Handle,
    name: ObjectName,
    incarnation: Incarnation,
    past: SlidingWindow,
    deaths: Arc<OnceLock<Recipient<Exited>>>,
    watched: Deaths,
}

impl Ward {
    /// Says whether the actor lives again.
    fn revive(&mut self, panic: PanicRecord) -> bool {
        let counts = self.past.add((), platform::now());
        let restart = || self.future.as_mut().is_some_and(|future| future.restart());
        let alive = counts && catch_unwind(AssertUnwindSafe(restart)).unwrap_or(false);
        let PanicRecord { text, at } = panic;
        let exit = ExitReason::Panicked { text, at, during: "the middleware" };
        let restarted_as = alive.then(|| self.incarnation.next());
        let (object, incarnation) = (self.name.clone(), self.incarnation);
        self.watched.end(&object, DownReason::from(&exit));
        if let Some(next) = restarted_as {
            self.watched.begin(&object, next);
        }
        if let Some(deaths) = self.deaths.get() {
            deaths.do_send(Exited { object, incarnation, exit, restarted_as });
        }
        self.incarnation = self.incarnation.next();
        alive
    }
}

impl Drop for Ward {
    /// actix polls an actor once more, and may even start it, when it is dropped. As the runtime
    /// ends, that is outside of it, where a timer cannot be made.
    fn drop(&mut self) {
        let _within = self.runtime.enter();
        drop(self.future.take());
    }
}

impl Future for Ward {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, cx: &mut task::Context<'_>) -> Poll<()> {
        LIFE.set(self.incarnation);
        let Some(future) = &mut self.future else { return Poll::Ready(()) };
        let mut future = Pin::new(future);
        let caught = {
            let _guarded = panics::PanicGuard::enter();
            catch_unwind(AssertUnwindSafe(|| future.as_mut().poll(cx)))
        };
        match caught {
            Ok(Poll::Ready(())) => {
                self.watched.end(&self.name, DownReason::Stopped);
                Poll::Ready(())
            }
            Ok(Poll::Pending) => Poll::Pending,
            Err(payload) => {
                if !self.revive(panics::read(payload)) {
                    return Poll::Ready(());
                }
                // Its neighbours have their turn before it tries again.
                cx.waker().wake_by_ref();
                Poll::Pending
            }
        }
    }
}
