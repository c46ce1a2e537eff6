//! Panics, grants of restarts, aborts, death watch.

use super::{Acc, Boom, ChildOrder, GRANT, Note, Slow, Stage, acc, boom, logged};
use crate::{
    ChildSpec, Component, Context, DeliveryError, Down, DownReason, Event, Handle, Incarnation,
};
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::ExitReason;
use blastema_core::Lifecycle;
use blastema_doubles::settle;
use std::sync::{Arc, Mutex};
use tokio::task::spawn_local;

#[blastema_macros::test(crate = "blastema_doubles")]
async fn the_asker_of_the_message_that_kills_is_told_which_incarnation_died() {
    let stage = Stage::new();
    let (mut child, acc) = stage.start(acc("acc").0).await;
    child.order(GRANT);

    let died = acc.ask(boom("x")).await.unwrap_err();

    assert_eq!(died.kind, DeliveryError::PeerDied { incarnation: Incarnation(1) });
    assert_eq!(died.message, None);
    assert_eq!(acc.incarnation(), Incarnation(2));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_grant_is_for_one_restart_and_the_queue_waits_for_the_supervisor() {
    let stage = Stage::new();
    let (spec, log) = acc("acc");
    let (mut child, acc) = stage.start(spec).await;
    child.order(GRANT);
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
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_grant_that_is_taken_back_restarts_nothing() {
    let stage = Stage::new();
    let (mut child, acc) = stage.start(acc("acc").0).await;
    child.order(GRANT);
    child.order(ChildOrder::GrantRestart(false));

    acc.tell(boom("x")).unwrap();
    settle().await;

    assert_eq!(stage.exits.drain()[0].restarted_as, None);
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

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_watches_is_told_how_each_incarnation_ends_until_its_own_does() {
    let stage = Stage::new();
    let told = Arc::new(Mutex::new(vec![]));
    let kept = told.clone();
    let spec = ChildSpec::new("widow", move || Widow(kept.clone()));
    let (mut widow_child, widow) = stage.start(spec).await;
    widow_child.order(GRANT);
    let (mut child, acc) = stage.start::<Acc>(acc("acc").0).await;
    child.order(GRANT);
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
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_component_that_ends_itself_has_returned_and_keeps_its_queue() {
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
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn an_incarnation_whose_arbiter_goes_away_is_reported_as_aborted() {
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
    }
}
