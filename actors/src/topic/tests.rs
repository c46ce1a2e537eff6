//! What the network learns of listeners that come and go on several threads, and events that
//! panic.

use super::*;
use std::panic::Location;
use std::sync::mpsc::channel;
use std::thread;

/// For threads of a busy computer.
const PATIENCE: Duration = Duration::from_secs(30);

#[derive(Clone, crate::Event)]
struct Sample(u32);

fn topic(topics: &Topics) -> Arc<Topic<Sample>> {
    topics.topic("sample", Location::caller()).unwrap()
}

fn change(topic: &Topic<Sample>, more: bool) {
    let entry: ObjectName = "ear".parse().unwrap();
    let first_or_last = match more {
        true => topic.add_listener(&lock(&topic.latch)),
        false => topic.remove_listener(),
    };
    topic.listener_changed(&entry, more, first_or_last);
}

#[test]
fn what_is_known_of_interest_is_true_whatever_the_order_of_its_reports() {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let topic = topic(&topics);
    let (report, reported) = channel();
    let (hold, held) = channel::<()>();
    let (begun, begins) = channel();
    let held = Mutex::new(Some(held));
    topics.on_interest(Arc::new(move |key| {
        // The thread of the first listener is interrupted here.
        let first = lock(&held).take();
        if let Some(held) = first {
            begun.send(()).unwrap();
            let _ = held.recv();
        }
        report.send(key.clone()).unwrap();
    }));

    let joined = topic.clone();
    let joins = thread::spawn(move || change(&joined, true));
    begins.recv_timeout(PATIENCE).unwrap();
    change(&topic, false);
    drop(hold);
    joins.join().unwrap();

    let settled: Vec<bool> =
        reported.try_iter().map(|key| !topics.settle_interest(&key.topic).is_empty()).collect();
    assert_eq!(settled, [false, false], "there is no listener");
}

/// Panics where it is copied, if it is told to.
#[derive(crate::Event)]
#[contract(latched)]
struct Fragile {
    breaks: bool,
}

impl Clone for Fragile {
    fn clone(&self) -> Self {
        assert!(!self.breaks, "no copy");
        Fragile { breaks: false }
    }
}

#[test]
fn a_copy_that_panics_is_no_panic_of_the_publisher() {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let publisher = topics.publisher::<Fragile>("fragile").unwrap();
    let topic: Arc<Topic<Fragile>> = topics.topic("fragile", Location::caller()).unwrap();

    for breaks in [false, true] {
        publisher.publish(Fragile { breaks }).unwrap();
        assert_eq!(lock(&topic.latch).is_none(), breaks, "what cannot be copied is not kept");
        assert_eq!(topic.complained.load(Relaxed), breaks);
    }
}
