//! Answers that an actor of the middleware gives later.

use actix::dev::{MessageResponse, OneshotSender};
use actix::{Actor, Message};
use std::pin::Pin;

/// The answer to a message, once its future completes.
///
/// actix spawns a `ResponseFuture` as a task whose type has the actor and the message in it, and
/// the runtime's code for a task is compiled for each type. These all have one.
pub(crate) struct PendingAnswer<T>(Pin<Box<dyn Future<Output = T>>>);

impl<T> PendingAnswer<T> {
    pub(crate) fn new(answer: impl Future<Output = T> + 'static) -> Self {
        PendingAnswer(Box::pin(answer))
    }
}

impl<A, M, T> MessageResponse<A, M> for PendingAnswer<T>
where
    A: Actor,
    M: Message<Result = T>,
    T: 'static,
{
    fn handle(self, _: &mut A::Context, asker: Option<OneshotSender<T>>) {
        send_later(self.0, asker);
    }
}

fn send_later<T: 'static>(
    answer: Pin<Box<dyn Future<Output = T>>>,
    asker: Option<OneshotSender<T>>,
) {
    let task: Pin<Box<dyn Future<Output = ()>>> = Box::pin(async move {
        let answer = answer.await;
        if let Some(asker) = asker {
            // The asker may have stopped waiting.
            let _ = asker.send(answer);
        }
    });
    actix_rt::spawn(task);
}
