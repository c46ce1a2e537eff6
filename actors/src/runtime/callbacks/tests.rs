//! Calls that return in time, late, or never, on real threads.

use super::*;
use std::sync::mpsc::{Receiver, Sender, channel};

const LIMIT: Duration = Duration::from_millis(100);
/// For threads of a busy computer.
const PATIENCE: Duration = Duration::from_secs(30);

/// The number of a call, and what became of it.
type NumberedOutcome = (u32, CallOutcome);

struct Rig {
    callbacks: Callbacks,
    outcomes: (Sender<NumberedOutcome>, Receiver<NumberedOutcome>),
}

impl Rig {
    fn new() -> Self {
        Rig::of(Callbacks::on_threads(LIMIT, ArbiterPool::here()))
    }

    fn of(callbacks: Callbacks) -> Self {
        Rig { callbacks, outcomes: channel() }
    }

    fn threads(&self) -> &Arc<Threads> {
        self.callbacks.0.as_ref().unwrap()
    }

    fn call(&self, number: u32, run: impl FnOnce() + Send + 'static) {
        self.call_of("arm", number, run);
    }

    fn call_of(&self, object: &str, number: u32, run: impl FnOnce() + Send + 'static) {
        let outcomes = self.outcomes.0.clone();
        let outcome = move |outcome| outcomes.send((number, outcome)).unwrap();
        self.callbacks.call(&object.parse().unwrap(), run, outcome);
    }

    /// Blocks until the sender is dropped.
    fn block(&self, number: u32) -> Sender<()> {
        let (hold, held) = channel::<()>();
        let (begun, begins) = channel();
        self.call(number, move || {
            begun.send(()).unwrap();
            let _ = held.recv();
        });
        begins.recv_timeout(PATIENCE).expect("a thread makes the call");
        hold
    }

    fn outcomes(&self) -> (u32, CallOutcome) {
        self.outcomes.1.recv_timeout(PATIENCE).expect("a call has an outcome")
    }

    fn abandoned(&self) -> usize {
        self.threads().arbiters.abandoned()
    }
}

#[test]
fn calls_are_made_in_order_and_a_panic_is_an_outcome() {
    let rig = Rig::new();

    rig.call(1, || {});
    rig.call(2, || panic!("no brake"));
    rig.call(3, || {});

    assert_eq!(rig.outcomes(), (1, CallOutcome::Done));
    assert_eq!(rig.outcomes(), (2, CallOutcome::Panicked("no brake".into())));
    assert_eq!(rig.outcomes(), (3, CallOutcome::Done));
}

#[test]
fn a_call_that_blocks_is_told_once_and_those_behind_it_are_made_on_another_thread() {
    let rig = Rig::new();
    let hold = rig.block(1);
    rig.call(2, || {});

    rig.callbacks.look(LIMIT);
    assert!(rig.outcomes.1.try_recv().is_err(), "it has the whole limit");
    rig.callbacks.look(Duration::from_millis(1));

    assert_eq!(rig.outcomes(), (1, CallOutcome::Blocked(LIMIT)));
    assert_eq!(rig.outcomes(), (2, CallOutcome::Done));
    assert_eq!(rig.abandoned(), 1);
    rig.callbacks.look(10 * LIMIT);
    drop(hold);
    assert_eq!(rig.outcomes(), (1, CallOutcome::ReturnedLate));
    assert_eq!(rig.abandoned(), 0);
    rig.call(3, || {});
    assert_eq!(rig.outcomes(), (3, CallOutcome::Done));
}

#[test]
fn a_call_that_returns_while_its_delay_is_reported_leaves_no_lost_thread() {
    let rig = Rig::new();
    let hold = rig.block(1);
    // The report of the delay stops at this lock.
    let queue = lock(&rig.threads().queue);
    let callbacks = rig.callbacks.clone();
    let look = std::thread::spawn(move || callbacks.look(2 * LIMIT));
    while !lock(&rig.threads().running).is_empty() {
        std::thread::yield_now();
    }

    drop(hold);
    let early = rig.outcomes.1.recv_timeout(LIMIT);
    assert!(early.is_err(), "its delay is reported first: {early:?}");
    drop(queue);
    look.join().unwrap();

    assert_eq!(rig.outcomes(), (1, CallOutcome::Blocked(LIMIT)));
    assert_eq!(rig.outcomes(), (1, CallOutcome::ReturnedLate));
    assert_eq!(rig.abandoned(), 0);
}

#[test]
fn an_object_whose_calls_block_is_called_no_more_and_others_are() {
    let rig = Rig::new();
    let mut holds = Vec::new();
    for number in 0..THREADS_OF_ONE as u32 {
        holds.push(rig.block(number));
        rig.callbacks.look(2 * LIMIT);
        assert_eq!(rig.outcomes(), (number, CallOutcome::Blocked(LIMIT)));
    }

    rig.call(9, || panic!("it is not called"));
    assert_eq!(rig.outcomes(), (9, CallOutcome::NotMade));

    rig.call_of("leg", 8, || {});
    assert_eq!(rig.outcomes(), (8, CallOutcome::Done));

    holds.clear();
    for _ in 0..THREADS_OF_ONE {
        assert_eq!(rig.outcomes().1, CallOutcome::ReturnedLate);
    }
    rig.call(10, || {});
    assert_eq!(rig.outcomes(), (10, CallOutcome::Done));
}

#[test]
fn without_a_thread_safe_outputs_are_applied_at_once() {
    let start = |_: &str, _| Err(std::io::ErrorKind::WouldBlock.into());
    let arbiters = ArbiterPool::here();
    let rig = Rig::of(Callbacks::on_threads_of(Box::new(start), LIMIT, arbiters));
    let here = std::thread::current().id();

    rig.call(1, move || assert_eq!(std::thread::current().id(), here));

    assert_eq!(rig.outcomes(), (1, CallOutcome::Done));
}
