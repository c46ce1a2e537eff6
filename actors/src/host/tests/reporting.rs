//! Every death is reported, also where a second panic follows before the first was reported.

use super::{ChildOrder, GRANT, Log, Stage, logged, logging};
use crate::arbiter::pool::ArbiterPool;
use crate::topic::Topics;
use crate::{ChildSpec, Component, Context, Event, Handle, Incarnation, Ports};
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::ExitReason;
use blastema_doubles::settle;

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
    logging(name, Picky)
}

fn publish(stage: &Stage, topic: &str, n: u64) {
    stage.environment.feature::<Topics>().publisher(topic).unwrap().publish(Sample(n)).unwrap();
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_condition_that_panics_on_each_event_of_a_batch_is_one_reported_death() {
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
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn each_incarnation_that_a_condition_ends_within_a_batch_is_reported() {
    let stage = Stage::new();
    let (mut child, _) = stage.start(picky("picky").0).await;
    child.order(GRANT);

    (101..=104).for_each(|n| publish(&stage, "other", n));
    settle().await;

    let exits = stage.exits.drain();
    let incarnations: Vec<_> = exits.iter().map(|e| (e.incarnation.0, e.restarted_as)).collect();
    assert_eq!(incarnations, [(1, Some(Incarnation(2))), (2, None)]);
    let died = |event: &ChildEvent| {
        matches!(event, ChildEvent::Died { .. } | ChildEvent::StartFailed { .. })
    };
    let reports = stage.reports.drain();
    assert_eq!(reports.iter().filter(|report| died(&report.event)).count(), 2, "{reports:?}");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_incarnation_that_is_given_up_leaves_the_report_of_the_incarnation_before_it() {
    let stage = Stage::new();
    let (mut child, picky) = stage.start(picky("picky").0).await;
    child.order(GRANT);
    let executor = crate::host::executor::executor_here(&picky.0).unwrap().upgrade().unwrap();

    // On the spot, before the executor has its turn.
    executor.borrow_mut().die_of(Box::new("in a condition"), "a condition of a subscription");
    child.order(ChildOrder::Abandon);
    settle().await;

    let exits = stage.exits.drain();
    let incarnations: Vec<_> = exits.iter().map(|e| (e.incarnation.0, e.restarted_as)).collect();
    assert_eq!(incarnations, [(1, Some(Incarnation(2)))], "the second was given up, not the first");
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_death_at_a_hub_is_reported_though_the_arbiter_ends_first() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let (_child, picky) = stage.start(picky("picky").0).await;
        let cell = picky.0.clone();
        let arbiter = cell.record.arbiter().unwrap().arbiter;

        arbiter.handle.spawn_fn(move || {
            let executor = crate::host::executor::executor_here(&cell).unwrap().upgrade().unwrap();
            executor
                .borrow_mut()
                .die_of(Box::new("in a condition"), "a condition of a subscription");
            actix_rt::Arbiter::current().stop();
        });

        let exited = stage.exits.expect().await;
        assert!(matches!(exited.exit, ExitReason::Panicked { .. }), "{exited:?}");
    }
}
