//! Every death is reported, also where a second panic follows before the first was reported.

use super::{ChildOrder, Log, Stage, logged, GRANT};
use crate::arbiter::pool::ArbiterPool;
use crate::{ChildSpec, Component, Context, Event, Handle, Incarnation, Ports};
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::ExitReason;
use blastema_doubles::{paused, settle};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

#[derive(Clone, Debug, PartialEq, Event)]
struct Sample(u64);

/// Its conditions panic on every sample above a hundred.
struct Picky(Log);

fn small(Sample(n): &Sample) -> bool {
    assert!(*n <= 100, "{n} is too large");
    true
}

impl Component for Picky {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Sample>().only_if(small);
        ports.listen::<Sample>().on("other").only_if(small);
    }
}

impl Handle<Sample> for Picky {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(n);
    }
}

fn picky(name: &str) -> (ChildSpec<Picky>, Log) {
    let log = Log::default();
    let kept = log.clone();
    (ChildSpec::new(name, move || Picky(kept.clone())), log)
}

fn publish(stage: &Stage, topic: &str, n: u64) {
    stage.environment.topics().publisher(topic).unwrap().publish(Sample(n)).unwrap();
}

#[test]
fn a_condition_that_panics_on_each_event_of_a_batch_is_one_reported_death() {
    paused(async {
        let stage = Stage::new();
        let (spec, log) = picky("picky");
        let (mut child, _) = stage.start(spec).await;

        (101..=105).for_each(|n| publish(&stage, "other", n));
        publish(&stage, <Sample as blastema_core::Contract>::NAME, 101);
        publish(&stage, <Sample as blastema_core::Contract>::NAME, 102);
        settle().await;

        let exits = stage.exits.drain();
        assert_eq!(exits.len(), 1, "{exits:?}");
        assert_eq!(exits[0].restarted_as, None);
        let ExitReason::Panicked { during, .. } = exits[0].exit else { panic!("{exits:?}") };
        assert_eq!(during, "a condition of a subscription");
        let reports = stage.reports.drain();
        assert!(matches!(reports[..], [ref only] if matches!(only.event, ChildEvent::Died { .. })));

        assert_eq!(stage.begin(&mut *child, 2).await, ChildEvent::Started);
        publish(&stage, "other", 1);
        settle().await;
        assert_eq!(logged(&log), [1]);
    });
}

#[test]
fn each_incarnation_that_a_condition_ends_within_a_batch_is_reported() {
    paused(async {
        let stage = Stage::new();
        let (mut child, _) = stage.start(picky("picky").0).await;
        child.order(GRANT);

        (101..=104).for_each(|n| publish(&stage, "other", n));
        settle().await;

        let exits = stage.exits.drain();
        let incarnations: Vec<_> =
            exits.iter().map(|e| (e.incarnation.0, e.restarted_as)).collect();
        assert_eq!(incarnations, [(1, Some(Incarnation(2))), (2, None)]);
        let died = |event: &ChildEvent| {
            matches!(event, ChildEvent::Died { .. } | ChildEvent::StartFailed { .. })
        };
        let reports = stage.reports.drain();
        assert_eq!(reports.iter().filter(|report| died(&report.event)).count(), 2, "{reports:?}");
    });
}

#[test]
fn an_incarnation_that_is_given_up_leaves_the_report_of_the_incarnation_before_it() {
    paused(async {
        let stage = Stage::new();
        let (mut child, picky) = stage.start(picky("picky").0).await;
        child.order(GRANT);
        let executor = crate::host::executor::executor_here(&picky.0).unwrap().upgrade().unwrap();

        // On the spot, before the executor has its turn.
        executor.borrow_mut().die_of(Box::new("in a condition"), "a condition of a subscription");
        child.order(ChildOrder::Abandon);
        settle().await;

        let exits = stage.exits.drain();
        let incarnations: Vec<_> =
            exits.iter().map(|e| (e.incarnation.0, e.restarted_as)).collect();
        assert_eq!(
            incarnations,
            [(1, Some(Incarnation(2)))],
            "the second was given up, not the first"
        );
    });
}

/// Panics on each sample; what was left of its first incarnation blocks until the test lets it go.
struct Clingy {
    held: Option<Arc<Held>>,
}

/// Where a thread waits for the test.
struct Held {
    gate: Mutex<mpsc::Receiver<()>>,
    waits: AtomicU64,
}

impl Held {
    fn new() -> (mpsc::Sender<()>, Arc<Held>) {
        let (open, gate) = mpsc::channel();
        (open, Arc::new(Held { gate: Mutex::new(gate), waits: AtomicU64::new(0) }))
    }

    fn wait(&self) {
        self.waits.fetch_add(1, Relaxed);
        let _ = self.gate.lock().unwrap().recv();
    }

    async fn until_a_thread_waits(&self) {
        while self.waits.load(Relaxed) == 0 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
}

impl Component for Clingy {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Sample>();
    }
}

impl Handle<Sample> for Clingy {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        panic!("{n} breaks it");
    }
}

impl Drop for Clingy {
    fn drop(&mut self) {
        if let Some(held) = self.held.take() {
            held.wait();
        }
    }
}

/// Panics, and what the handler had blocks as the panic unwinds.
struct Trap(Arc<Held>);

struct Local<'a>(&'a Held);

impl Drop for Local<'_> {
    fn drop(&mut self) {
        self.0.wait();
    }
}

impl Component for Trap {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Sample>();
    }
}

impl Handle<Sample> for Trap {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        let _local = (n == 7).then_some(Local(&self.0));
        panic!("{n} springs it");
    }
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn a_death_at_a_hub_is_reported_though_the_arbiter_ends_first() {
        let _turn = blastema_doubles::turn();
        let system = actix_rt::System::new();
        system.block_on(async {
            let stage = Stage::on(ArbiterPool::pool(1));
            let (_child, picky) = stage.start(picky("picky").0).await;
            let cell = picky.0.clone();
            let arbiter = cell.record.arbiter().unwrap().arbiter;

            arbiter.handle.spawn_fn(move || {
                let executor =
                    crate::host::executor::executor_here(&cell).unwrap().upgrade().unwrap();
                executor
                    .borrow_mut()
                    .die_of(Box::new("in a condition"), "a condition of a subscription");
                actix_rt::Arbiter::current().stop();
            });

            let exited = stage.exits.expect().await;
            assert!(matches!(exited.exit, ExitReason::Panicked { .. }), "{exited:?}");
        });
    }

    #[test]
    fn a_panic_whose_drop_blocks_is_reported_once() {
        let _turn = blastema_doubles::turn();
        actix_rt::System::new().block_on(async {
            let stage = Stage::on(ArbiterPool::pool(1));
            let (open, held) = Held::new();
            let first = Mutex::new(Some(held.clone()));
            let spec =
                ChildSpec::new("clingy", move || Clingy { held: first.lock().unwrap().take() });
            let (mut child, clingy) = stage.start(spec).await;

            clingy.tell(Sample(7)).unwrap();
            held.until_a_thread_waits().await;
            child.order(ChildOrder::Abandon);

            let exited = stage.exits.expect().await;
            let ExitReason::Panicked { text, .. } = &exited.exit else { panic!("{exited:?}") };
            assert_eq!((text.as_str(), exited.incarnation), ("7 breaks it", Incarnation(1)));
            assert_eq!(stage.begin(&mut *child, 2).await, ChildEvent::Started);
            drop(open);
            clingy.tell(Sample(8)).unwrap();
            let next = stage.exits.expect().await;
            assert_eq!(next.incarnation, Incarnation(2), "the first was told once");
            stage.environment.arbiters.stop();
        });
    }

    #[test]
    fn a_panic_whose_unwinding_blocks_is_reported_once() {
        let _turn = blastema_doubles::turn();
        actix_rt::System::new().block_on(async {
            let stage = Stage::on(ArbiterPool::pool(1));
            let (open, held) = Held::new();
            let of = held.clone();
            let (mut child, trap) =
                stage.start(ChildSpec::new("trap", move || Trap(of.clone()))).await;

            trap.tell(Sample(7)).unwrap();
            held.until_a_thread_waits().await;
            child.order(ChildOrder::Abandon);

            let exited = tokio::time::timeout(Duration::from_secs(30), stage.exits.expect()).await;
            let exited = exited.expect("the panic is reported while it unwinds");
            let ExitReason::Panicked { text, at, during } = &exited.exit else {
                panic!("{exited:?}")
            };
            assert_eq!((text.as_str(), exited.incarnation), ("7 springs it", Incarnation(1)));
            assert!(at.contains("reporting.rs:") && during.contains("Sample"), "{exited:?}");
            assert_eq!(stage.begin(&mut *child, 2).await, ChildEvent::Started);
            drop(open);
            trap.tell(Sample(8)).unwrap();
            let next = stage.exits.expect().await;
            assert_eq!(next.incarnation, Incarnation(2), "the first was told once");
            stage.environment.arbiters.stop();
        });
    }

    #[test]
    fn a_panic_is_reported_though_the_factory_of_the_next_incarnation_blocks() {
        let _turn = blastema_doubles::turn();
        actix_rt::System::new().block_on(async {
            let stage = Stage::on(ArbiterPool::pool(1));
            let ((_open, held), incarnations) = (Held::new(), AtomicU64::new(0));
            let blocks = held.clone();
            let spec = ChildSpec::new("clingy", move || {
                if incarnations.fetch_add(1, Relaxed) == 1 {
                    blocks.wait();
                }
                Clingy { held: None }
            });
            let (mut child, clingy) = stage.start(spec).await;
            child.order(GRANT);

            clingy.tell(Sample(7)).unwrap();
            held.until_a_thread_waits().await;
            child.order(ChildOrder::Abandon);

            let exited = stage.exits.expect().await;
            assert_eq!(exited.restarted_as, Some(Incarnation(2)));
            assert!(matches!(exited.exit, ExitReason::Panicked { .. }), "{exited:?}");
            // Told before, where the panic had used the turn up.
            stage.reports.drain();
            assert_eq!(stage.begin(&mut *child, 3).await, ChildEvent::Started);
            assert_eq!(stage.exits.drain(), []);
            stage.environment.arbiters.stop();
        });
    }
}
