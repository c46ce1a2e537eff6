//! Grants of restarts, ends, aborts.

use super::{ChildOrder, GRANT, Note, Slow, Stage, acc, boom, logged, logging};
use crate::{Component, Context, DeliveryError, Event, Handle};
use blastema_contract::child::ChildEvent;
use blastema_contract::reports::ExitReason;
use blastema_core::Lifecycle;
use blastema_doubles::settle;
use tokio::task::spawn_local;

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
    let (spec, log) = logging("guest", Guest);
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
