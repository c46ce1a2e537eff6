//! The reply slot: a request has one result, and the caller that awaits it is woken.

use crate::messaging::error::RequestError;
use crate::messaging::reply::{ReplyFuture, Responder};
use crate::{Model, bell};
use blastema::Request;
use blastema_core::{DeliveryError, Incarnation};
use loom::sync::atomic::AtomicUsize;
use loom::sync::atomic::Ordering::Relaxed;
use loom::thread;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Poll};

pub(crate) const MODELS: [Model; 4] = [
    ("reply: given or revoked, it is one of them, and the asker is woken", given_and_revoked),
    ("reply: a callee that is dropped resolves its request", dropped_by_the_callee),
    ("reply: an asker that goes is not waited for", dropped_by_the_asker),
    ("reply: a callback is called once", called_back_once),
];

#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64)]
struct Question;

const DIED: DeliveryError = DeliveryError::PeerDied { incarnation: Incarnation(1) };

fn awaited(reply: ReplyFuture<Question>) -> Result<u64, RequestError<Question>> {
    let (bell, waker) = bell();
    let mut reply = pin!(reply);
    loop {
        match reply.as_mut().poll(&mut Context::from_waker(&waker)) {
            Poll::Ready(result) => return result,
            Poll::Pending => bell.0.wait(),
        }
    }
}

fn given_and_revoked() {
    let (answer, reply) = Responder::<Question>::awaited();
    let watch = answer.revocable().expect("it is open");
    let callee = thread::spawn(move || answer.give(5));
    let supervisor = thread::spawn(move || watch.cancel(DIED));

    let result = awaited(reply).map_err(|error| error.kind);

    assert!(result == Ok(5) || result == Err(DIED), "{result:?}");
    callee.join().expect("it does not panic");
    supervisor.join().expect("it does not panic");
}

fn dropped_by_the_callee() {
    let (answer, reply) = Responder::<Question>::awaited();
    let callee = thread::spawn(move || drop(answer));

    assert_eq!(awaited(reply).map_err(|error| error.kind), Err(DeliveryError::Stopped));
    callee.join().expect("it does not panic");
}

fn dropped_by_the_asker() {
    let (answer, reply) = Responder::<Question>::awaited();
    let watch = answer.revocable().expect("it is open");
    let asker = thread::spawn(move || {
        let mut reply = Box::pin(reply);
        let _ = reply.as_mut().poll(&mut Context::from_waker(std::task::Waker::noop()));
    });
    let supervisor = thread::spawn(move || watch.cancel(DIED));
    asker.join().expect("it does not panic");

    assert!(!answer.is_wanted());
    answer.give(5);
    supervisor.join().expect("it does not panic");
}

fn called_back_once() {
    let called = Arc::new(AtomicUsize::new(0));
    let kept = called.clone();
    let callback = move |result: Result<u64, DeliveryError>| {
        assert!(result == Ok(5) || result == Err(DIED), "{result:?}");
        kept.fetch_add(1, Relaxed);
    };
    let answer = Responder::<Question>::called_back(Box::new(callback), None);
    let watch = answer.revocable().expect("it is open");
    let supervisor = thread::spawn(move || watch.cancel(DIED));

    answer.give(5);

    supervisor.join().expect("it does not panic");
    assert_eq!(called.load(Relaxed), 1);
}
