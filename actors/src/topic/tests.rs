//! What the network learns of listeners that come and go on several threads, and events that
//! panic.

use super::hub::{Batch, EventListener, Hub, HubProgress, ListenerEntry};
use super::hub_queue::Posted;
use super::*;
use blastema_core::ContractIdentity;
use blastema_doubles::settle;
use std::any::Any;
use std::cell::{Cell, RefCell};
use std::panic::Location;
use std::rc::Rc;
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

/// Panics where it is dropped.
#[derive(Clone, crate::Event)]
struct Undroppable;

impl Drop for Undroppable {
    fn drop(&mut self) {
        assert!(thread::panicking(), "no end");
    }
}

#[test]
fn a_drop_that_panics_is_no_panic_of_the_publisher() {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let publisher = topics.publisher::<Undroppable>("fragile").unwrap();
    let topic: Arc<Topic<Undroppable>> = topics.topic("fragile", Location::caller()).unwrap();

    publisher.publish(Undroppable).unwrap();

    assert!(topic.complained.load(Relaxed));
}

/// A listener of a hub, which records what it gets, and runs code at a step of the hub.
struct Recorder {
    got: Rc<RefCell<Vec<u32>>>,
    /// Before its turn.
    before: Box<dyn Fn()>,
    /// When an event has begun, and it is not decided whether it still gets it.
    during: Box<dyn Fn()>,
}

impl EventListener<Sample> for Recorder {
    fn take(
        &self,
        hub: &Hub<Sample>,
        entry: &ListenerEntry<Sample>,
        batch: &Batch<Sample>,
    ) -> HubProgress {
        while let Some(posted) = hub.next(batch) {
            (self.during)();
            if hub.still_gets(entry) {
                self.got.borrow_mut().push(posted.event.0);
            }
        }
        HubProgress::Done
    }

    fn call_up(&self) {
        (self.before)();
    }

    fn die_in_service(&self, _: Box<dyn Any + Send>) {}

    fn die_of_condition(&self, _: Box<dyn Any + Send>) {}

    fn record_dead_letter(&self, _: &DeliveryError) {}
}

/// Three entries of a hub, of which the second has gone, get two events. The first one leaves at
/// the end of its turn, or as soon as it has begun the first event. Returns the events that it
/// gets, and those that it takes along.
async fn leave_a_hub(during_its_turn: bool) -> (Vec<u32>, Vec<u32>) {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let topic = topic(&topics);
    let hub = topic.hub_here(&mut lock(&topic.hubs));
    let presents: Vec<_> = (1..=3).map(|number| Arc::new(AtomicU64::new(number))).collect();
    let (got, along) = (Rc::default(), Rc::new(RefCell::new(None)));
    let leave = {
        let (shared, present, along) = (hub.shared.clone(), presents[0].clone(), along.clone());
        move || {
            if along.borrow().is_none() {
                let left = shared.leftover(0, || present.swap(0, Relaxed), &Cell::new(false));
                *along.borrow_mut() = Some(left);
            }
        }
    };
    for (present, number) in presents.iter().zip(1..) {
        hub.shared.listeners.fetch_add(1, Relaxed);
        let mut before: Box<dyn Fn()> = Box::new(|| {});
        let mut during: Box<dyn Fn()> = Box::new(|| {});
        match number {
            1 if during_its_turn => during = Box::new(leave.clone()),
            3 if !during_its_turn => before = Box::new(leave.clone()),
            _ => {}
        }
        let got = if number == 1 { Rc::clone(&got) } else { Rc::default() };
        hub.newcomers.borrow_mut().push(ListenerEntry {
            only_if: None,
            present: present.clone(),
            number,
            since: 0,
            activity_slot: Cell::new(None),
            listener: Box::new(Recorder { got, before, during }),
        });
    }
    presents[1].store(0, Relaxed);
    topic.leave(&hub.shared);
    for number in [7, 8] {
        topic.hand_out(Sample(number), platform::now().into(), false, None);
    }
    while along.borrow().is_none() {
        tokio::task::yield_now().await;
    }
    let along = along.take().unwrap_or_default();
    let along = along.iter().map(|posted: &Posted<Sample>| posted.event.0).collect();
    (got.take(), along)
}

/// Another node, with capacity for one event at a time.
#[derive(Default)]
struct Narrow {
    is_taken: AtomicBool,
    changed: tokio::sync::Notify,
    got: Mutex<Vec<u32>>,
    /// Runs once, as an event is sent.
    on_send: Mutex<Option<Box<dyn FnOnce() + Send>>>,
}

/// The capacity of a node that is taken.
struct Taken(Arc<Narrow>);

impl Drop for Taken {
    fn drop(&mut self) {
        self.0.is_taken.store(false, Relaxed);
        self.0.changed.notify_waiters();
    }
}

struct ToNarrow(Arc<Narrow>);

impl ToNarrow {
    fn take(&self) -> Option<Taken> {
        (!self.0.is_taken.swap(true, Relaxed)).then(|| Taken(self.0.clone()))
    }
}

impl EventForward for ToNarrow {
    fn has_ended(&self) -> bool {
        false
    }

    fn forward(&self, event: &GatherBuffer, _: Instant) -> bool {
        let event: Sample = codec::decode(&event.clone().into_bytes()).unwrap();
        lock(&self.0.got).push(event.0);
        let act = lock(&self.0.on_send).take();
        act.into_iter().for_each(|act| act());
        true
    }

    fn reserve(&self, _: usize, _: bool) -> Reservation {
        let Some(taken) = self.take() else { return Reservation::Full };
        let to = ToNarrow(self.0.clone());
        Reservation::Taken(Box::new(move |event, sent| {
            to.forward(event, sent);
            drop(taken);
        }))
    }

    fn full(&self) -> DeliveryError {
        DeliveryError::Full
    }

    fn capacity(&self) -> Pin<Box<dyn Future<Output = ()> + Send>> {
        let node = self.0.clone();
        Box::pin(async move {
            loop {
                let changed = node.changed.notified();
                if !node.is_taken.load(Relaxed) {
                    return;
                }
                changed.await;
            }
        })
    }
}

/// A node begins to listen to a topic of samples.
fn joins<E: Event>(topics: &Topics, topic: &str, node: &Arc<Narrow>) -> ForwardId {
    let key = TopicKey::new(topic, E::NAME).unwrap();
    let wanted = vec![ContractIdentity::of::<E>().brief()];
    let far = NodeName::new("far").unwrap();
    topics.forward(&key, far, wanted, Arc::new(ToNarrow(node.clone())), None)
}

#[test]
fn a_topic_that_no_other_node_listens_to_any_more_is_forgotten() {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let publisher = topics.publisher::<Sample>("known").unwrap();
    let node = Arc::<Narrow>::default();
    let joined = ["known", "unknown"].map(|topic| joins::<Sample>(&topics, topic, &node));
    assert_eq!(topics.forwarded(), 2);

    joined.iter().for_each(|forward| topics.end_forward(forward));

    assert_eq!(topics.forwarded(), 0);
    publisher.publish(Sample(1)).unwrap();
    assert_eq!(*lock(&node.got), [0; 0]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn two_publishers_that_wait_for_the_same_nodes_in_another_order_do_not_block_each_other() {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let (left, right) = (Arc::<Narrow>::default(), Arc::<Narrow>::default());
    [&left, &right].into_iter().for_each(|node| drop(joins::<Sample>(&topics, "one", node)));
    [&right, &left].into_iter().for_each(|node| drop(joins::<Sample>(&topics, "two", node)));
    let held = ToNarrow(right.clone()).take();
    let delivers = |topic, n| {
        let publisher = topics.publisher::<Sample>(topic).unwrap();
        actix_rt::spawn(async move { publisher.deliver(Sample(n)).await.unwrap() })
    };

    let second = delivers("two", 2);
    settle().await;
    let first = delivers("one", 1);
    settle().await;
    assert!(!left.is_taken.load(Relaxed), "who waits holds nothing");
    drop(held);
    settle().await;

    assert!(first.is_finished() && second.is_finished());
    for node in [left, right] {
        let mut got = lock(&node.got).clone();
        got.sort_unstable();
        assert_eq!(got, [1, 2]);
    }
}

#[derive(Clone, Debug, crate::Event)]
#[contract(when_full = "refuse")]
struct Order(u32);

#[test]
fn an_event_that_is_to_be_refused_goes_to_no_node_where_one_has_no_capacity() {
    let letters = DeadLetterLog::default();
    let topics = Topics::new(letters.clone(), FaultReports::default());
    let publisher = topics.publisher::<Order>("orders").unwrap();
    let (left, right) = (Arc::<Narrow>::default(), Arc::<Narrow>::default());
    [&left, &right].into_iter().for_each(|node| drop(joins::<Order>(&topics, "orders", node)));
    let held = ToNarrow(right.clone()).take();

    let refused = publisher.publish(Order(1)).unwrap_err();
    assert_eq!((refused.kind, refused.message.0), (DeliveryError::Full, 1));
    assert!(!left.is_taken.load(Relaxed), "what was taken is given back");
    drop(held);
    publisher.publish(Order(2)).unwrap();

    for node in [left, right] {
        assert_eq!(*lock(&node.got), [2]);
    }
    assert_eq!(letters.total(), 0);
}

#[derive(Clone, crate::Event)]
#[contract(latched)]
struct LastSample(u32);

#[test]
fn a_node_that_joins_while_an_event_is_published_gets_the_newest_once() {
    let topics = Topics::new(DeadLetterLog::default(), FaultReports::default());
    let publisher = topics.publisher::<LastSample>("last").unwrap();
    publisher.publish(LastSample(1)).unwrap();
    let (early, late) = (Arc::<Narrow>::default(), Arc::<Narrow>::default());
    joins::<LastSample>(&topics, "last", &early);
    assert_eq!(*lock(&early.got), [1]);
    let (joined, joining) = channel();
    let (all, node) = (topics.clone(), late.clone());
    let joiner = Mutex::new(None);
    let joiner = Arc::new(joiner);
    let kept = joiner.clone();
    *lock(&early.on_send) = Some(Box::new(move || {
        let thread = thread::spawn(move || {
            joins::<LastSample>(&all, "last", &node);
            joined.send(()).unwrap();
        });
        // Where it need not wait for the publisher, it has joined by then.
        let _ = joining.recv_timeout(Duration::from_millis(200));
        *lock(&kept) = Some((thread, joining));
    }));

    publisher.publish(LastSample(2)).unwrap();
    let (thread, joining) = lock(&joiner).take().unwrap();
    thread.join().unwrap();
    drop(joining);

    assert_eq!(*lock(&late.got), [2]);
    publisher.publish(LastSample(3)).unwrap();
    assert_eq!((&*lock(&early.got), &*lock(&late.got)), (&vec![1, 2, 3], &vec![2, 3]));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_entry_that_leaves_its_hub_gets_each_event_there_or_elsewhere() {
    assert_eq!(leave_a_hub(false).await, (vec![7, 8], vec![]));
    assert_eq!(leave_a_hub(true).await, (vec![7], vec![8]));
}
