//! What every transport does in the same way: live, take orders, poll its medium.

use crate::upstream::Upstream;
use actix::fut::ActorFuture;
use actix::{Actor, AsyncContext, Context, ResponseFuture, Supervised};
use blastema_contract::transport::{Adopt, Attach, Transmit, TransmitBacklog, TransportCounters};
use std::future::ready;
use std::pin::Pin;
use std::task::{self, Poll};

/// How many frames are moved in one turn before the mailbox, and the arbiter's other actors, come
/// to their right. 64 small datagrams take about a tenth of a millisecond.
pub(crate) const BUDGET: usize = 64;
/// And how many bytes: a large frame may hold hundreds of messages, each of which a component
/// serves.
const BUDGET_BYTES: usize = 128 * 1024;

/// What is left of one turn.
pub(crate) struct PollBudget {
    frames: usize,
    bytes: usize,
}

impl Default for PollBudget {
    fn default() -> Self {
        PollBudget { frames: BUDGET, bytes: BUDGET_BYTES }
    }
}

impl PollBudget {
    /// Whether another frame may be tried; the first always may.
    pub(crate) fn next(&mut self) -> bool {
        let left = self.frames > 0 && self.bytes > 0;
        self.frames = self.frames.saturating_sub(1);
        left
    }

    /// So many frames and no more.
    #[cfg(any(feature = "tcp", feature = "unix"))]
    pub(crate) fn of_frames(frames: usize) -> Self {
        PollBudget { frames, bytes: BUDGET_BYTES }
    }

    /// Whether nothing is left.
    #[cfg(any(feature = "tcp", feature = "unix"))]
    pub(crate) fn is_spent(&self) -> bool {
        self.frames == 0 || self.bytes == 0
    }

    /// So many bytes were moved.
    pub(crate) fn spend(&mut self, bytes: usize) {
        self.bytes = self.bytes.saturating_sub(bytes);
    }
}

/// An actor that owns a medium. [`transport!`] makes it one that speaks the contract.
pub(crate) trait MediumActor: Actor<Context = Context<Self>> + Supervised {
    /// Where its frames and reports go, and where it counts.
    fn upstream(&mut self) -> &mut Upstream;

    /// Tries once to open the medium, and announces what came of it.
    fn open(&mut self, context: &mut Context<Self>);

    /// Takes a frame that is to go out. It must not wait: the pump follows at once.
    fn transmit(&mut self, message: Transmit);

    /// What waits to go out. A medium that hands frames on at once has nothing.
    fn backlog(&self) -> TransmitBacklog {
        TransmitBacklog::default()
    }

    /// What was counted until now.
    fn counters(&mut self) -> ResponseFuture<TransportCounters> {
        let mut counters = self.upstream().counters;
        counters.backlog = self.backlog();
        Box::pin(ready(counters))
    }

    /// Attaches another receiver.
    fn attach(&mut self, message: Attach, _: &mut Context<Self>) {
        self.upstream().attach(message);
    }

    /// Takes whose a connection is. A medium without connections has none that could be adopted.
    fn adopt(&mut self, _: Adopt) {}

    /// Moves what can be moved, within [`BUDGET`], and leaves a waker for the rest. It is called
    /// after every message too.
    fn pump(&mut self, task: &mut task::Context<'_>);

    /// Lets go of the medium: its port is free when this returns. What waits is thrown away, for a
    /// panic may have left it half-done; what the next incarnation needs is kept.
    fn shut(&mut self);

    /// Closes the medium for good.
    fn close(&mut self) {
        self.shut();
    }
}

/// Polls the medium for as long as the actor lives.
pub(crate) struct MediumPoller;

impl MediumPoller {
    pub(crate) fn start<A: MediumActor>(context: &mut Context<A>) {
        context.spawn(MediumPoller);
    }
}

impl<A: MediumActor> ActorFuture<A> for MediumPoller {
    type Output = ();

    fn poll(
        self: Pin<&mut Self>,
        actor: &mut A,
        _: &mut A::Context,
        task: &mut task::Context<'_>,
    ) -> Poll<()> {
        actor.pump(task);
        Poll::Pending
    }
}

/// Makes an actor of a [`MediumActor`]: its beginning, its next incarnation after a panic, and its
/// orders.
macro_rules! transport {
    ($medium:ty $(, <$family:ident: $bound:ident>)?) => {
        const _: () = {
            use crate::medium::{MediumActor, MediumPoller};
            use actix::{Actor, ActorContext, Context, Handler, ResponseFuture, Supervised};
            use blastema_contract::transport as contract;

            impl$(<$family: $bound>)? Actor for $medium {
                type Context = Context<Self>;

                fn started(&mut self, context: &mut Context<Self>) {
                    MediumActor::open(self, context);
                    MediumPoller::start(context);
                }
            }

            /// The next incarnation opens at the same address and serves the receivers that were
            /// attached.
            impl$(<$family: $bound>)? Supervised for $medium {
                fn restarting(&mut self, context: &mut Context<Self>) {
                    self.shut();
                    MediumActor::upstream(self).begin_next_incarnation();
                    self.started(context);
                }
            }

            impl$(<$family: $bound>)? Handler<contract::Transmit> for $medium {
                type Result = ();

                fn handle(&mut self, message: contract::Transmit, _: &mut Context<Self>) {
                    MediumActor::transmit(self, message);
                }
            }

            impl$(<$family: $bound>)? Handler<contract::Attach> for $medium {
                type Result = ();

                fn handle(&mut self, message: contract::Attach, context: &mut Context<Self>) {
                    MediumActor::attach(self, message, context);
                }
            }

            impl$(<$family: $bound>)? Handler<contract::Adopt> for $medium {
                type Result = ();

                fn handle(&mut self, message: contract::Adopt, _: &mut Context<Self>) {
                    MediumActor::adopt(self, message);
                }
            }

            impl$(<$family: $bound>)? Handler<contract::ReadCounters> for $medium {
                type Result = ResponseFuture<contract::TransportCounters>;

                fn handle(
                    &mut self,
                    _: contract::ReadCounters,
                    _: &mut Context<Self>,
                ) -> Self::Result {
                    MediumActor::counters(self)
                }
            }

            impl$(<$family: $bound>)? Handler<contract::Close> for $medium {
                type Result = ();

                fn handle(&mut self, _: contract::Close, context: &mut Context<Self>) {
                    MediumActor::close(self);
                    MediumActor::upstream(self).announce(contract::TransportReport::Ended);
                    context.stop();
                }
            }
        };
    };
}

pub(crate) use transport;
