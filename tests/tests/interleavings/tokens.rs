//! The token of an incarnation, which fences what it left behind in threads.

use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::queue::{BoundedQueue, Popped, WhenFull};
use crate::{Model, bell};
use blastema_core::{DeliveryError, Incarnation};
use loom::thread;
use std::sync::Arc;

pub(crate) const MODELS: [Model; 3] = [
    ("token: a party that was told of the end finds the token ended", told_of_the_end),
    ("token: an end is final, whatever is muted meanwhile", an_end_is_final),
    ("token: what follows the successor's first message is fenced", fenced_before_the_successor),
];

fn told_of_the_end() {
    let token = Arc::new(IncarnationToken::default());
    let reports = Arc::new(BoundedQueue::<u32>::new(1, WhenFull::Refuse));
    reports.begin(Incarnation::FIRST);
    let pump = {
        let (token, reports) = (token.clone(), reports.clone());
        thread::spawn(move || {
            token.end();
            reports.push_with(0, 1, |n| n).expect("there is room");
        })
    };

    let (bell, waker) = bell();
    while !matches!(reports.take(Incarnation::FIRST, &waker), Popped::Got(1)) {
        bell.0.wait();
    }

    assert_eq!(token.forbidden(), Some(DeliveryError::Fenced));
    pump.join().expect("it does not panic");
}

fn an_end_is_final() {
    let token = Arc::new(IncarnationToken::default());
    let ending = {
        let token = token.clone();
        thread::spawn(move || token.end())
    };
    let isolating = {
        let token = token.clone();
        thread::spawn(move || {
            token.mute(true);
            token.mute(false);
        })
    };

    let seen = [token.forbidden(), token.forbidden()];

    if seen[0] == Some(DeliveryError::Fenced) {
        assert_eq!(seen[1], Some(DeliveryError::Fenced));
    }
    ending.join().expect("it does not panic");
    isolating.join().expect("it does not panic");
    assert_eq!(token.forbidden(), Some(DeliveryError::Fenced));
}

/// A thread of the old incarnation that hears of anything that the new one did cannot send any
/// more.
fn fenced_before_the_successor() {
    let token = Arc::new(IncarnationToken::default());
    let (queue, out) = (queue(), queue());
    queue.push_with(0, 7, |n| n).expect("there is room");
    let supervisor = {
        let (token, queue, out) = (token.clone(), queue.clone(), out.clone());
        thread::spawn(move || {
            // As `ChildOrder::Abandon` and a start do.
            queue.leave(Incarnation(1));
            token.end();
            queue.begin(Incarnation(2));
            if let Popped::Got(n) = queue.take(Incarnation(2), std::task::Waker::noop()) {
                out.push_with(0, n, |n| n).expect("there is room");
            }
        })
    };

    // A thread that the old incarnation started, as a detached sender has it.
    let heard = matches!(out.take(Incarnation(1), std::task::Waker::noop()), Popped::Got(7));
    let refused = token.forbidden();

    assert!(!heard || refused == Some(DeliveryError::Fenced));
    supervisor.join().expect("it does not panic");
}

fn queue() -> Arc<BoundedQueue<u32>> {
    let queue = BoundedQueue::new(1, WhenFull::Refuse);
    queue.begin(Incarnation(1));
    Arc::new(queue)
}
