//! The data queue: nothing is lost, served twice, or served to an incarnation that does not own it.

use crate::messaging::queue::{BoundedQueue, Popped, WhenFull};
use crate::{Bell, Model, bell};
use blastema_core::{DeliveryError, Incarnation};
use loom::thread;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Waker};

pub(crate) const MODELS: [Model; 8] = [
    ("queue: what two send is taken once each, and no wake is lost", two_senders),
    (
        "queue: a message is taken by one incarnation, whichever owns the queue then",
        change_of_owner,
    ),
    (
        "queue: of an incarnation that dies and one who gives it up, one decides",
        death_and_abandonment,
    ),
    ("queue: it is taken from the incarnation that owns it, also from a replacement", eviction),
    ("queue: a sender that waits for capacity gets it", waiting_for_space),
    ("queue: room that a sender gave up is the next one's", space_given_up),
    ("queue: what a stop meets is handed out or refused", push_and_stop),
    ("queue: a notice wakes its incarnation, and reaches no other", notice_and_change_of_owner),
];

const FIRST: Incarnation = Incarnation(1);
const SECOND: Incarnation = Incarnation(2);

fn queue(capacity: usize) -> Arc<BoundedQueue<u32>> {
    let queue = BoundedQueue::new(capacity, WhenFull::Wait);
    queue.begin(FIRST);
    Arc::new(queue)
}

fn push(queue: &BoundedQueue<u32>, n: u32) -> Result<Option<u32>, (u32, DeliveryError)> {
    queue.push_with(0, n, |n| n)
}

/// Takes so many, sleeping in between; fewer where the queue has changed hands.
fn take(
    queue: &BoundedQueue<u32>,
    incarnation: Incarnation,
    many: usize,
    (bell, waker): &(Arc<Bell>, Waker),
) -> Vec<u32> {
    let mut taken = Vec::new();
    while taken.len() < many {
        match queue.take(incarnation, waker) {
            Popped::Got(n) => taken.push(n),
            Popped::Empty => bell.0.wait(),
            Popped::Retired => break,
        }
    }
    taken
}

/// As `Sender::deliver` does.
fn deliver(queue: &BoundedQueue<u32>, n: u32) {
    let (bell, waker) = bell();
    while push(queue, n).is_err() {
        let mut space = pin!(queue.space(0));
        while space.as_mut().poll(&mut Context::from_waker(&waker)).is_pending() {
            bell.0.wait();
        }
    }
}

fn two_senders() {
    let queue = queue(2);
    let senders = [1, 2].map(|n| {
        let queue = queue.clone();
        thread::spawn(move || push(&queue, n).expect("there is room for both"))
    });

    let mut taken = take(&queue, FIRST, 2, &bell());

    taken.sort_unstable();
    assert_eq!(taken, [1, 2]);
    for sender in senders {
        sender.join().expect("it does not panic");
    }
    assert!(queue.is_empty());
}

fn change_of_owner() {
    let queue = queue(2);
    push(&queue, 1).expect("there is room");
    let old = {
        let queue = queue.clone();
        thread::spawn(move || match queue.take(FIRST, Waker::noop()) {
            Popped::Got(n) => Some(n),
            Popped::Empty => panic!("it was there, and for this taker alone"),
            Popped::Retired => None,
        })
    };

    queue.begin(SECOND);
    push(&queue, 2).expect("there is room");
    let by_new = take(&queue, SECOND, 1, &bell());

    let by_old = old.join().expect("it does not panic");
    assert_eq!(by_new, if by_old == Some(1) { [2] } else { [1] });
    assert!(matches!(queue.take(FIRST, Waker::noop()), Popped::Retired));
}

fn death_and_abandonment() {
    let queue = queue(1);
    push(&queue, 7).expect("there is room");
    let dying = {
        let queue = queue.clone();
        thread::spawn(move || queue.pass_on(FIRST, SECOND))
    };

    let third = Incarnation(3);
    let given_up = queue.leave(FIRST);
    if given_up {
        queue.begin(third);
    }

    let passed_on = dying.join().expect("it does not panic");
    assert!(passed_on != given_up, "one of them");
    let owner = if passed_on { SECOND } else { third };
    assert_eq!(queue.owner(), Some(owner));
    assert_eq!(take(&queue, owner, 1, &bell()), [7]);
}

fn eviction() {
    let queue = queue(1);
    let dying = {
        let queue = queue.clone();
        thread::spawn(move || queue.pass_on(FIRST, SECOND))
    };

    let evicted = queue.evict();

    let passed_on = dying.join().expect("it does not panic");
    assert_eq!(evicted, Some(if passed_on { SECOND } else { FIRST }));
    assert_eq!(queue.owner(), None);
}

fn waiting_for_space() {
    let queue = queue(1);
    push(&queue, 1).expect("there is room");
    let sender = {
        let queue = queue.clone();
        thread::spawn(move || {
            deliver(&queue, 2);
            deliver(&queue, 3);
        })
    };

    assert_eq!(take(&queue, FIRST, 3, &bell()), [1, 2, 3]);
    sender.join().expect("it does not panic");
}

fn space_given_up() {
    let queue = queue(1);
    push(&queue, 1).expect("there is room");
    let sender = {
        let queue = queue.clone();
        thread::spawn(move || deliver(&queue, 2))
    };
    let impatient = {
        let queue = queue.clone();
        thread::spawn(move || {
            let mut space = Box::pin(queue.space(0));
            let _ = space.as_mut().poll(&mut Context::from_waker(Waker::noop()));
        })
    };

    assert_eq!(take(&queue, FIRST, 2, &bell()), [1, 2]);
    sender.join().expect("it does not panic");
    impatient.join().expect("it does not panic");
}

fn push_and_stop() {
    let queue = queue(2);
    let sender = {
        let queue = queue.clone();
        thread::spawn(move || push(&queue, 1))
    };

    let left = queue.stop();

    let refused = sender.join().expect("it does not panic") == Err((1, DeliveryError::Stopped));
    assert_eq!(left.len(), usize::from(!refused));
    assert!(queue.is_empty());
}

fn notice_and_change_of_owner() {
    let queue = queue(1);
    let watched = {
        let queue = queue.clone();
        thread::spawn(move || {
            queue.notify(FIRST, "arm", 1);
            queue.notify(SECOND, "arm", 2);
            queue.notify(SECOND, "leg", 3);
        })
    };

    let place = bell();
    let first = match queue.take(FIRST, &place.1) {
        Popped::Got(n) => Some(n),
        _ => None,
    };
    assert!(queue.pass_on(FIRST, SECOND));
    watched.join().expect("it does not panic");
    let rest: Vec<_> = std::iter::from_fn(|| match queue.take(SECOND, &place.1) {
        Popped::Got(n) => Some(n),
        _ => None,
    })
    .collect();

    assert!(matches!(first, None | Some(1)), "{first:?}");
    assert!(matches!(rest[..], [] | [3] | [2, 3]), "{rest:?}");
    queue.notify(SECOND, "arm", 4);
    assert_eq!(take(&queue, SECOND, 1, &place), [4]);
}
