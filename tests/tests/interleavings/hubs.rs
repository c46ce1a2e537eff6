//! A listener that leaves a hub while the hub gives it events: each event is given once, by the hub
//! or by the hub that follows, and in order.

#[path = "../../../actors/src/topic/batch_position.rs"]
mod batch_position;
#[path = "../../../actors/src/topic/hub_queue.rs"]
#[expect(dead_code, reason = "the models use a part of it")]
mod hub_queue;

use crate::Model;
use crate::component::envelope::Times;
use crate::messaging::queue::{BoundedQueue, WhenFull};
use crate::sync::atomic::Ordering::Relaxed;
use crate::sync::atomic::{AtomicBool, AtomicU64};
use crate::sync::{Mutex, MutexGuard};
use batch_position::BatchPosition;
use blastema::Event;
use blastema_core::Incarnation;
use hub_queue::{HubBatch, HubQueue, Posted};
use loom::thread;
use std::cell::Cell;
use std::collections::VecDeque;
use std::sync::Arc;

pub(crate) const MODELS: [Model; 3] = [
    ("hub: an event is given by the hub that a listener leaves, or taken along", departure),
    ("hub: so is one that a condition decides on, or it is lost and named", undecided_departure),
    ("hub: a listener whose turn comes or is over leaves its events alike", departure_of_another),
];

/// The entry that leaves, and those that have their turn before and after it.
const ENTRIES: [u64; 3] = [1, 2, 3];
const LEAVES: u64 = 2;

/// As the topic locks.
fn lock<T>(shared: &Mutex<T>) -> MutexGuard<'_, T> {
    shared.lock().expect("no thread of a model panics while it holds this")
}

#[derive(Clone, Debug, Event)]
struct Number(u64);

/// A hub whose batch is the first events, and whose queue holds the others.
fn hub(batch: &[u64], queued: &[u64]) -> Arc<HubQueue<Number>> {
    let queue = BoundedQueue::new(4, WhenFull::DropOldest);
    queue.begin(Incarnation::FIRST);
    let posted = |&number: &u64| Posted { event: Number(number), at: Times, number };
    let serving = HubBatch {
        events: Arc::new(batch.iter().map(posted).collect()),
        only: None,
        left: Vec::new(),
        brought: VecDeque::new(),
    };
    let hub = HubQueue {
        queue,
        id: 1,
        listeners: AtomicU64::new(1),
        retired: AtomicBool::new(false),
        serving: Mutex::new(serving),
        position: BatchPosition::default(),
        gone: AtomicU64::new(0),
    };
    queued.iter().for_each(|&number| drop(hub.push(Number(number), Times, number)));
    Arc::new(hub)
}

/// What became of the events of the entry that leaves.
struct Outcome {
    given: Vec<u64>,
    taken: Vec<u64>,
    is_undecided: bool,
}

/// Gives the batch to these entries in turn, as `Hub::offer` and `Resident::take` do, while one of
/// them leaves.
fn leave_during(
    hub: &Arc<HubQueue<Number>>,
    batch: u64,
    entries: &'static [u64],
    has_condition: bool,
) -> Outcome {
    let present = Arc::new(AtomicU64::new(LEAVES));
    let leaving = {
        let (hub, present) = (hub.clone(), present.clone());
        thread::spawn(move || {
            let is_undecided = Cell::new(false);
            let leave = || present.swap(0, Relaxed);
            let taken = hub.leftover(0, leave, &is_undecided);
            (taken.into_iter().map(|posted| posted.number).collect(), is_undecided.get())
        })
    };

    let mut given = Vec::new();
    for &entry in entries {
        let is_present = || entry != LEAVES || present.load(Relaxed) == entry;
        hub.position.begin(entry);
        for number in 1..=batch {
            hub.position.step();
            if has_condition {
                hub.position.set_undecided(true);
                hub.position.set_undecided(false);
            }
            if hub.still_gets(entry, is_present) && entry == LEAVES {
                given.push(number);
            }
        }
    }
    let (taken, is_undecided) = leaving.join().expect("it does not panic");
    Outcome { given, taken, is_undecided }
}

fn departure() {
    let hub = hub(&[1, 2], &[3]);

    let Outcome { given, taken, is_undecided } = leave_during(&hub, 2, &[LEAVES], false);

    assert_eq!([given, taken].concat(), [1, 2, 3]);
    assert!(!is_undecided);
}

fn undecided_departure() {
    let hub = hub(&[1, 2], &[]);

    let Outcome { given, taken, is_undecided } = leave_during(&hub, 2, &[LEAVES], true);

    let lost = if is_undecided { vec![given.len() as u64 + 1] } else { Vec::new() };
    assert_eq!([given, lost, taken].concat(), [1, 2]);
}

fn departure_of_another() {
    let hub = hub(&[1], &[]);

    let Outcome { given, taken, .. } = leave_during(&hub, 1, &ENTRIES, false);

    assert_eq!([given, taken].concat(), [1]);
}
