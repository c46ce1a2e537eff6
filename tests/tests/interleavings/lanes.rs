//! The data lane: nothing is lost, served twice, or served to an incarnation that does not own it.

use crate::messaging::queue::{BoundedQueue, Popped, WhenFull};
use crate::{Bell, Model, bell};
use blastema_core::{DeliveryError, Incarnation};
use loom::thread;
use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::task::{Context, Waker};

pub(crate) const MODELS: [Model; 7] = [
    ("lane: what two send is taken once each, and no wake is lost", two_senders),
    ("lane: a message is taken by one incarnation, whichever owns the lane then", change_of_owner),
    (
        "lane: of an incarnation that dies and one who gives it up, one decides",
        death_and_abandonment,
    ),
    ("lane: a sender that waits for capacity gets it", waiting_for_room),
    ("lane: room that a sender gave up is the next one's", room_given_up),
    ("lane: what a stop meets is handed out or refused", push_and_stop),
    ("lane: a notice wakes its incarnation, and reaches no other", notice_and_change_of_owner),
];

const FIRST: Incarnation = Incarnation(1);
const SECOND: Incarnation = Incarnation(2);

fn lane(capacity: usize) -> Arc<BoundedQueue<u32>> {
    let lane = BoundedQueue::new(capacity, WhenFull::Wait);
    lane.begin(FIRST);
    Arc::new(lane)
}

fn push(lane: &BoundedQueue<u32>, n: u32) -> Result<Option<u32>, (u32, DeliveryError)> {
    lane.push_with(n, |n| n)
}

/// Takes so many, sleeping in between; fewer where the lane has changed hands.
fn take(
    lane: &BoundedQueue<u32>,
    incarnation: Incarnation,
    many: usize,
    (bell, waker): &(Arc<Bell>, Waker),
) -> Vec<u32> {
    let mut taken = Vec::new();
    while taken.len() < many {
        match lane.take(incarnation, waker) {
            Popped::Got(n) => taken.push(n),
            Popped::Empty => bell.0.wait(),
            Popped::Retired => break,
        }
    }
    taken
}

/// As `Sender::deliver` does.
fn deliver(lane: &BoundedQueue<u32>, n: u32) {
    let (bell, waker) = bell();
    while push(lane, n).is_err() {
        let mut room = pin!(lane.room());
        while room.as_mut().poll(&mut Context::from_waker(&waker)).is_pending() {
            bell.0.wait();
        }
    }
}

fn two_senders() {
    let lane = lane(2);
    let senders = [1, 2].map(|n| {
        let lane = lane.clone();
        thread::spawn(move || push(&lane, n).expect("there is room for both"))
    });

    let mut taken = take(&lane, FIRST, 2, &bell());

    taken.sort_unstable();
    assert_eq!(taken, [1, 2]);
    for sender in senders {
        sender.join().expect("it does not panic");
    }
    assert!(lane.is_empty());
}

fn change_of_owner() {
    let lane = lane(2);
    push(&lane, 1).expect("there is room");
    let old = {
        let lane = lane.clone();
        thread::spawn(move || match lane.take(FIRST, Waker::noop()) {
            Popped::Got(n) => Some(n),
            Popped::Empty => panic!("it was there, and for this taker alone"),
            Popped::Retired => None,
        })
    };

    lane.begin(SECOND);
    push(&lane, 2).expect("there is room");
    let by_new = take(&lane, SECOND, 1, &bell());

    let by_old = old.join().expect("it does not panic");
    assert_eq!(by_new, if by_old == Some(1) { [2] } else { [1] });
    assert!(matches!(lane.take(FIRST, Waker::noop()), Popped::Retired));
}

fn death_and_abandonment() {
    let lane = lane(1);
    push(&lane, 7).expect("there is room");
    let dying = {
        let lane = lane.clone();
        thread::spawn(move || lane.pass_on(FIRST, SECOND))
    };

    let third = Incarnation(3);
    let given_up = lane.leave(FIRST);
    if given_up {
        lane.begin(third);
    }

    let passed_on = dying.join().expect("it does not panic");
    assert!(passed_on != given_up, "one of them");
    let owner = if passed_on { SECOND } else { third };
    assert_eq!(lane.owner(), Some(owner));
    assert_eq!(take(&lane, owner, 1, &bell()), [7]);
}

fn waiting_for_room() {
    let lane = lane(1);
    push(&lane, 1).expect("there is room");
    let sender = {
        let lane = lane.clone();
        thread::spawn(move || {
            deliver(&lane, 2);
            deliver(&lane, 3);
        })
    };

    assert_eq!(take(&lane, FIRST, 3, &bell()), [1, 2, 3]);
    sender.join().expect("it does not panic");
}

fn room_given_up() {
    let lane = lane(1);
    push(&lane, 1).expect("there is room");
    let sender = {
        let lane = lane.clone();
        thread::spawn(move || deliver(&lane, 2))
    };
    let impatient = {
        let lane = lane.clone();
        thread::spawn(move || {
            let mut room = Box::pin(lane.room());
            let _ = room.as_mut().poll(&mut Context::from_waker(Waker::noop()));
        })
    };

    assert_eq!(take(&lane, FIRST, 2, &bell()), [1, 2]);
    sender.join().expect("it does not panic");
    impatient.join().expect("it does not panic");
}

fn push_and_stop() {
    let lane = lane(2);
    let sender = {
        let lane = lane.clone();
        thread::spawn(move || push(&lane, 1))
    };

    let left = lane.stop();

    let refused = sender.join().expect("it does not panic") == Err((1, DeliveryError::Stopped));
    assert_eq!(left.len(), usize::from(!refused));
    assert!(lane.is_empty());
}

fn notice_and_change_of_owner() {
    let lane = lane(1);
    let watched = {
        let lane = lane.clone();
        thread::spawn(move || {
            lane.notify(FIRST, "arm", 1);
            lane.notify(SECOND, "arm", 2);
            lane.notify(SECOND, "leg", 3);
        })
    };

    let place = bell();
    let first = match lane.take(FIRST, &place.1) {
        Popped::Got(n) => Some(n),
        _ => None,
    };
    assert!(lane.pass_on(FIRST, SECOND));
    watched.join().expect("it does not panic");
    let rest: Vec<_> = std::iter::from_fn(|| match lane.take(SECOND, &place.1) {
        Popped::Got(n) => Some(n),
        _ => None,
    })
    .collect();

    assert!(matches!(first, None | Some(1)), "{first:?}");
    assert!(matches!(rest[..], [] | [3] | [2, 3]), "{rest:?}");
    lane.notify(SECOND, "arm", 4);
    assert_eq!(take(&lane, SECOND, 1, &place), [4]);
}
