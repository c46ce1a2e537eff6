//! Panics, standing orders, aborts, death watch.

use super::{Acc, Add, Boom, ChildOrder, Note, Slow, Stage, acc, boom, logged, order};
use crate::{
    ChildSpec, Component, Context, DeliveryError, Down, DownReason, Event, Handle, Incarnation,
};
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::ExitReason;
use blastema_core::Lifecycle;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_doubles::{advance, paused, settle};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tokio::task::spawn_local;

#[test]
fn a_panic_ends_one_incarnation_and_the_queue_lives() {
    paused(async {
        let stage = Stage::new();
        let (spec, log) = acc("acc");
        let (mut child, acc) = stage.start(spec).await;
        child.order(order(5));
        assert_eq!(acc.ask(Add(5)).await, Ok(5));
        acc.tell(boom("one")).unwrap();
        acc.tell(Note(7)).unwrap();

        assert_eq!(acc.ask(Add(5)).await, Ok(5), "a fresh component");

        assert_eq!(logged(&log), [7], "what was queued is still served");
        let exited = stage.exits.expect().await;
        assert_eq!(exited.incarnation, Incarnation(1));
        assert_eq!(exited.restarted_as, Some(Incarnation(2)));
        let ExitReason::Panicked { text, at, during } = exited.exit.clone() else {
            panic!("{exited:?}")
        };
        assert_eq!(text, "one");
        assert!(at.contains("tests/mod.rs:"), "{at}");
        assert!(during.contains("Boom"), "{during}");
        let died = stage.reports.expect().await;
        let event = ChildEvent::Died { exit: exited.exit, restarted_as: exited.restarted_as };
        assert_eq!((died.incarnation, died.event), (Incarnation(1), event));
        let dead = &stage.environment.dead_letters;
        assert_eq!(dead.count(acc.name(), DeadReason::PeerDied), 1);
    });
}

#[test]
fn the_asker_of_the_message_that_kills_is_told_which_incarnation_died() {
    paused(async {
        let stage = Stage::new();
        let (mut child, acc) = stage.start(acc("acc").0).await;
        child.order(order(5));

        let died = acc.ask(boom("x")).await.unwrap_err();

        assert_eq!(died.kind, DeliveryError::PeerDied { incarnation: Incarnation(1) });
        assert_eq!(died.message, None);
        assert_eq!(acc.incarnation(), Incarnation(2));
    });
}

#[test]
fn a_standing_order_has_an_end_and_the_queue_waits_for_the_supervisor() {
    paused(async {
        let stage = Stage::new();
        let (spec, log) = acc("acc");
        let (mut child, acc) = stage.start(spec).await;
        child.order(order(1));
        acc.tell(boom("one")).unwrap();
        acc.tell(boom("two")).unwrap();
        acc.tell(Note(3)).unwrap();
        settle().await;

        let exits = stage.exits.drain();
        assert_eq!(exits[0].restarted_as, Some(Incarnation(2)));
        assert_eq!(exits[1].restarted_as, None);
        assert_eq!((acc.queued(), logged(&log)), (1, vec![]));

        stage.reports.drain();
        assert_eq!(stage.begin(&mut *child, 3).await, ChildEvent::Started);
        settle().await;
        assert_eq!(logged(&log), [3]);
        assert_eq!(acc.incarnation(), Incarnation(3));
    });
}

#[test]
fn a_standing_order_is_worth_its_number_in_every_period() {
    paused(async {
        let stage = Stage::new();
        let (mut child, acc) = stage.start(acc("acc").0).await;
        child.order(order(1));
        for _ in 0..3 {
            acc.tell(boom("x")).unwrap();
            advance(Duration::from_secs(11)).await;
        }
        assert!(stage.exits.drain().iter().all(|exited| exited.restarted_as.is_some()));

        child.order(ChildOrder::RestartGrant(None));
        acc.tell(boom("x")).unwrap();
        settle().await;

        assert_eq!(stage.exits.drain()[0].restarted_as, None);
    });
}

/// What a component can do to kill itself beside its handlers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    Factory,
    Initialize,
    Task,
    Every,
    After,
    Execute,
}

struct Fragile(Way);

impl Component for Fragile {
    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), crate::Failure> {
        assert!(self.0 != Way::Initialize, "in on_initialize");
        Ok(())
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), crate::Failure> {
        let span = Duration::from_millis(10);
        match self.0 {
            Way::Task => cx.spawn(async move {
                tokio::time::sleep(span).await;
                panic!("in a task")
            }),
            Way::Every => drop(cx.every(span, |_, _| panic!("in a timer"))),
            Way::After => drop(cx.after(span, |_, _| panic!("in a timer"))),
            Way::Factory | Way::Initialize | Way::Execute => {}
        }
        Ok(())
    }

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), crate::Failure> {
        assert!(self.0 != Way::Execute, "in on_execute");
        Ok(())
    }
}

#[test]
fn a_panic_anywhere_in_a_component_is_its_death() {
    paused(async {
        let check = async |way: Way, text: &str, place: &str| {
            let stage = Stage::new();
            let spec = ChildSpec::new("fragile", move || {
                assert!(way != Way::Factory, "in the factory");
                Fragile(way)
            });
            let (mut child, _) = stage.add(spec.rate_hz(10.0));
            child.start(Incarnation(1), stage.reports.recipient().into());
            let exited = stage.exits.expect().await;
            let ExitReason::Panicked { text: told, during, .. } = exited.exit else {
                panic!("{way:?}: {exited:?}")
            };
            assert_eq!((told.as_str(), during), (text, place), "{way:?}");
            let report = stage.reports.wait(|r| r.event != ChildEvent::Started).await;
            let starting = matches!(way, Way::Factory | Way::Initialize);
            let failed = matches!(report.event, ChildEvent::StartFailed { .. });
            assert_eq!(failed, starting, "{report:?}");
        };
        check(Way::Factory, "in the factory", "its factory").await;
        check(Way::Initialize, "in on_initialize", "on_initialize").await;
        check(Way::Task, "in a task", "a task of its own").await;
        check(Way::Every, "in a timer", "a timer").await;
        check(Way::After, "in a timer", "a timer").await;
        check(Way::Execute, "in on_execute", "on_execute").await;
    });
}

#[test]
fn a_handler_that_waits_for_ever_is_given_up_on_the_same_arbiter() {
    paused(async {
        let stage = Stage::new();
        let (mut child, acc) = stage.start(acc("acc").0).await;
        let lost = spawn_local({
            let acc = acc.clone();
            async move { acc.ask(Slow(3_600_000)).await }
        });
        settle().await;
        acc.tell(Add(1)).unwrap();

        child.order(ChildOrder::Abandon);
        assert_eq!(stage.begin(&mut *child, 2).await, ChildEvent::Started);

        let why = lost.await.unwrap().unwrap_err().kind;
        assert_eq!(why, DeliveryError::PeerDied { incarnation: Incarnation(1) });
        assert_eq!(acc.ask(Add(2)).await, Ok(3), "the queue was kept");
        assert!(stage.exits.drain().is_empty(), "who gives up does not want to be told");
        let dead = &stage.environment.dead_letters;
        assert_eq!(dead.count(acc.name(), DeadReason::PeerDied), 1);
    });
}

/// Watches others, and keeps what it is told.
struct Widow(Arc<Mutex<Vec<Down>>>);

#[derive(Clone, Event)]
struct Look(String);

impl Component for Widow {}
impl Handle<Look> for Widow {
    async fn handle(&mut self, Look(name): Look, cx: &mut Context<Self>) {
        cx.watch(&name).unwrap();
    }
}
impl Handle<Down> for Widow {
    async fn handle(&mut self, down: Down, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(down);
    }
}
impl Handle<Boom> for Widow {
    async fn handle(&mut self, Boom(text): Boom, _: &mut Context<Self>) {
        panic!("{text}")
    }
}

#[test]
fn who_watches_is_told_how_each_incarnation_ends_until_its_own_does() {
    paused(async {
        let stage = Stage::new();
        let told = Arc::new(Mutex::new(vec![]));
        let kept = told.clone();
        let spec = ChildSpec::new("widow", move || Widow(kept.clone()));
        let (mut widow_child, widow) = stage.start(spec).await;
        widow_child.order(order(5));
        let (mut child, acc) = stage.start::<Acc>(acc("acc").0).await;
        child.order(order(5));
        let endings = || {
            let downs = std::mem::take(&mut *told.lock().unwrap());
            downs.into_iter().map(|down| (down.incarnation.0, down.ending)).collect::<Vec<_>>()
        };

        widow.tell(Look("absent".into())).unwrap();
        settle().await;
        assert_eq!(endings(), [(0, DownReason::Unknown)]);

        widow.tell(Look("acc".into())).unwrap();
        widow.tell(Look("acc".into())).unwrap();
        settle().await;
        assert_eq!(endings(), []);
        acc.tell(boom("x")).unwrap();
        settle().await;
        let first = endings();
        assert!(matches!(&first[..], [(1, DownReason::Panicked { text, .. })] if text == "x"));

        child.order(ChildOrder::Stop { again: false });
        settle().await;
        assert_eq!(endings(), [(2, DownReason::Stopped)]);
        widow.tell(Look("acc".into())).unwrap();
        settle().await;
        assert_eq!(endings(), [(2, DownReason::NotAlive)]);

        widow.tell(boom("grief")).unwrap();
        settle().await;
        stage.reports.drain();
        assert_eq!(stage.begin(&mut *child, 3).await, ChildEvent::Started);
        child.order(ChildOrder::Stop { again: false });
        settle().await;
        assert_eq!(endings(), [], "the incarnation that asked is over");
    });
}

#[test]
fn a_component_that_ends_itself_has_returned_and_keeps_its_queue() {
    #[derive(Clone, Event)]
    struct Leave;
    struct Guest(super::Log);
    impl Component for Guest {}
    impl Handle<Leave> for Guest {
        async fn handle(&mut self, _: Leave, cx: &mut Context<Self>) {
            cx.stop();
        }
    }
    impl Handle<Note> for Guest {
        async fn handle(&mut self, Note(n): Note, _: &mut Context<Self>) {
            self.0.lock().unwrap().push(n);
        }
    }
    paused(async {
        let stage = Stage::new();
        let log = super::Log::default();
        let kept = log.clone();
        let spec = ChildSpec::new("guest", move || Guest(kept.clone()));
        let (mut child, guest) = stage.start(spec).await;
        guest.tell(Leave).unwrap();
        guest.tell(Note(1)).unwrap();
        settle().await;

        assert_eq!(stage.exits.drain()[0].exit, ExitReason::Returned);
        assert_eq!(guest.state(), Lifecycle::Finalized);
        let report = stage.reports.expect().await;
        assert!(matches!(report.event, ChildEvent::Died { restarted_as: None, .. }));

        assert_eq!(stage.begin(&mut *child, 2).await, ChildEvent::Started);
        settle().await;
        assert_eq!(logged(&log), [1]);
    });
}

/// On real threads.
mod real {
    use super::*;

    #[test]
    fn an_incarnation_whose_arbiter_goes_away_is_reported_as_aborted() {
        let _turn = blastema_doubles::turn();
        let system = actix_rt::System::new();
        system.block_on(async {
            let stage = Stage::on(crate::arbiter::pool::ArbiterPool::pool(1));
            let (_child, acc) = stage.start(acc("acc").0).await;
            let asked = spawn_local({
                let acc = acc.clone();
                async move { acc.ask(Slow(3_600_000)).await }
            });
            settle().await;

            stage.environment.arbiters.stop();

            let exited = stage.exits.expect().await;
            assert_eq!((exited.exit, exited.restarted_as), (ExitReason::Aborted, None));
            let why = asked.await.unwrap().unwrap_err().kind;
            assert!(
                matches!(
                    why,
                    DeliveryError::PeerDied { .. }
                        | DeliveryError::Stopped
                        | DeliveryError::DeadlinePassed
                ),
                "{why}"
            );
        });
    }
}
