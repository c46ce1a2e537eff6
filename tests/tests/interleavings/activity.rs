//! The activity record: one thread writes, and what others read of it belongs together.

use crate::Model;
use crate::liveness::activity::ActivityRecord;
use blastema_core::Incarnation;
use blastema_core::detection::hang::ComponentSample;
use loom::thread;
use std::sync::Arc;

pub(crate) const MODELS: [Model; 2] = [
    ("stamp: who is seen serving is seen with what it serves, or something later", turn_and_label),
    ("stamp: turns and signs of life never go back", never_back),
];

fn turn_and_label() {
    let activity = Arc::new(ActivityRecord::default());
    let worker = {
        let activity = activity.clone();
        thread::spawn(move || {
            activity.begin(7);
            activity.step();
            activity.begin(8);
        })
    };

    let reading = activity.read();

    match reading.component.turn {
        0 => {}
        1 | 2 => assert!(matches!(reading.during, 7 | 8), "{reading:?}"),
        _ => assert_eq!(reading.during, 8, "{reading:?}"),
    }
    worker.join().expect("it does not panic");
}

fn never_back() {
    let activity = Arc::new(ActivityRecord::default());
    let worker = {
        let activity = activity.clone();
        thread::spawn(move || {
            activity.begin_incarnation(1);
            activity.begin(7);
            activity.give_sign();
            activity.step();
        })
    };

    let (first, second) = (activity.read(), activity.read());

    let (before, after) = (first.component, second.component);
    assert!(before.turn <= after.turn && before.alive <= after.alive, "{first:?} {second:?}");
    worker.join().expect("it does not panic");
    let last = activity.read();
    let ComponentSample { turn, alive, incarnation, .. } = last.component;
    assert_eq!((turn, alive, incarnation, last.during), (2, 1, Incarnation(1), 7));
}
