//! The hooks, their order, and the reports about them.

use super::{GRANT, Stage};
use crate::messaging::death_watch::Watchable;
use crate::messaging::injection::Injection;
use crate::{ChildSpec, Component, Context, DeliveryError, Event, Failure, Handle, Incarnation};
use blastema_contract::child::{ChildEvent, ChildOrder};
use blastema_contract::reports::ExitReason;
use blastema_core::{FaultKind, Lifecycle};
use blastema_doubles::{advance, paused, settle};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// What the next hook of this name shall do.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Fail,
    FailFatally,
    Hang,
}

#[derive(Default)]
struct Script {
    ran: Vec<&'static str>,
    next: Vec<(&'static str, Outcome)>,
}

/// Writes its hooks down.
#[derive(Clone, Default)]
struct Diary(Arc<Mutex<Script>>);

impl Diary {
    async fn note(&self, hook: &'static str) -> Result<(), Failure> {
        let outcome = {
            let mut script = self.0.lock().unwrap();
            script.ran.push(hook);
            let at = script.next.iter().position(|(name, _)| *name == hook);
            at.map(|at| script.next.remove(at).1)
        };
        tokio::task::yield_now().await;
        match outcome {
            None => Ok(()),
            Some(Outcome::Fail) => Err(format!("{hook} failed").into()),
            Some(Outcome::FailFatally) => Err(Failure::fatal(format!("{hook} failed"))),
            Some(Outcome::Hang) => std::future::pending().await,
        }
    }

    fn plan(&self, hook: &'static str, outcome: Outcome) {
        self.0.lock().unwrap().next.push((hook, outcome));
    }

    fn ran(&self) -> Vec<&'static str> {
        std::mem::take(&mut self.0.lock().unwrap().ran)
    }
}

macro_rules! noted {
    ($($hook:ident)*) => {
        impl Component for Diary {
            $(async fn $hook(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
                self.note(stringify!($hook)).await
            })*
        }
    };
}
noted! {
    on_initialize on_startup on_activated on_execute on_deactivated on_aborting
    on_error on_reset on_shutdown on_finalize
}

#[derive(Clone, Event)]
enum Do {
    Fail,
    DeclareFault,
    ChangeRate,
}

impl Handle<Do> for Diary {
    async fn handle(&mut self, what: Do, cx: &mut Context<Self>) {
        match what {
            Do::Fail => cx.fail("as told"),
            Do::DeclareFault => {
                cx.declare_fault(FaultKind::Overload, "too much");
                assert!(!cx.check_range("speed", &3.0, 0.0..=2.0));
                assert!(cx.check(true, "all is well"));
            }
            Do::ChangeRate => cx.set_interval(Some(Duration::from_millis(50))),
        }
    }
}

fn diary() -> (ChildSpec<Diary>, Diary) {
    let diary = Diary::default();
    let kept = diary.clone();
    (ChildSpec::new("diary", move || kept.clone()), diary)
}

fn states(stage: &Stage) -> Vec<(Lifecycle, Option<String>)> {
    stage.states.drain().into_iter().map(|reported| (reported.state, reported.reason)).collect()
}

const BEGINNING: [&str; 3] = ["on_initialize", "on_startup", "on_activated"];

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_incarnation_runs_from_initialisation_to_its_end_in_order() {
    let stage = Stage::new();
    let (spec, diary) = diary();
    let (mut child, reference) = stage.start(spec).await;
    settle().await;
    assert_eq!(diary.ran(), BEGINNING);
    let reported = states(&stage);
    assert_eq!(reported.last().unwrap(), &(Lifecycle::Active, None));
    assert_eq!(reference.state(), Lifecycle::Active);

    child.order(ChildOrder::Stop { again: false });
    settle().await;

    assert_eq!(diary.ran(), ["on_deactivated", "on_shutdown", "on_finalize"]);
    assert_eq!(states(&stage).last().unwrap(), &(Lifecycle::Finalized, None));
    assert_eq!(stage.reports.drain().pop().unwrap().event, ChildEvent::Stopped);
    assert_eq!(stage.exits.drain().pop().unwrap().exit, ExitReason::Stopped);
    assert_eq!(reference.tell(Do::Fail).unwrap_err().kind, DeliveryError::Stopped);

    child.order(ChildOrder::Stop { again: false });
    settle().await;
    assert_eq!(stage.reports.drain().pop().unwrap().event, ChildEvent::Stopped);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn on_execute_keeps_its_rate_and_skips_what_it_missed() {
    let stage = Stage::new();
    let (spec, diary) = diary();
    let (_child, reference) = stage.start(spec.rate_hz(10.0)).await;
    advance(Duration::from_millis(350)).await;
    let rounds = diary.ran().iter().filter(|hook| **hook == "on_execute").count();
    assert_eq!(rounds, 4, "at 0, 100, 200 and 300 ms");

    reference.tell(Do::ChangeRate).unwrap();
    advance(Duration::from_millis(510)).await;
    let ran = diary.ran();
    let rounds = ran.iter().filter(|hook| **hook == "on_execute").count();
    assert!((10..=12).contains(&rounds), "{rounds} in 510 ms at 20 Hz");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn messages_wait_while_a_component_is_in_error() {
    let stage = Stage::new();
    let (spec, _) = diary();
    let (mut child, reference) = stage.start(spec).await;
    reference.tell(Do::Fail).unwrap();
    reference.tell(Do::DeclareFault).unwrap();
    settle().await;
    assert_eq!((reference.state(), reference.queued()), (Lifecycle::Error, 1));

    child.order(ChildOrder::Reset);
    settle().await;

    assert_eq!(reference.queued(), 0);
    let faults = stage.faults.drain();
    assert_eq!(faults[0].kind, FaultKind::Overload);
    assert_eq!(faults[1].detail, "speed is 3.0, outside of 0.0..=2.0");
    assert_eq!(faults.len(), 2);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_component_leaves_work_and_returns_when_it_is_asked_to() {
    let stage = Stage::new();
    let (spec, diary) = diary();
    let (_child, reference) = stage.start(spec.rate_hz(10.0)).await;
    settle().await;
    diary.ran();

    reference.deactivate();
    reference.tell(Do::DeclareFault).unwrap();
    advance(Duration::from_secs(1)).await;
    assert_eq!(diary.ran(), ["on_deactivated"]);
    assert_eq!((reference.state(), reference.queued()), (Lifecycle::Initialized, 1));

    reference.activate();
    advance(Duration::from_millis(150)).await;
    assert_eq!(diary.ran()[..2], ["on_activated", "on_execute"]);
    assert_eq!(reference.queued(), 0);
}

#[test]
fn each_hook_that_fails_while_an_incarnation_ends_says_so() {
    for outcome in [Outcome::Fail, Outcome::FailFatally] {
        paused(async move {
            let stage = Stage::new();
            let (spec, diary) = diary();
            let (mut child, _) = stage.start(spec).await;
            settle().await;
            diary.ran();
            states(&stage);
            let hooks = ["on_deactivated", "on_shutdown", "on_finalize"];
            hooks.iter().for_each(|hook| diary.plan(hook, outcome));

            child.order(ChildOrder::Stop { again: false });
            settle().await;

            assert_eq!(diary.ran(), hooks, "the others run all the same");
            let reported = states(&stage);
            let reasons: Vec<_> = reported.into_iter().filter_map(|(_, reason)| reason).collect();
            let failed = hooks.map(|hook| format!("{hook} failed: {hook} failed"));
            assert_eq!(reasons, failed);
            assert_eq!(stage.exits.drain().pop().unwrap().exit, ExitReason::Stopped);
        });
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn the_last_hook_of_a_failed_start_has_no_longer_than_that_of_a_stop() {
    let stage = Stage::new();
    let (spec, diary) = diary();
    let spec = spec.shutdown_within(Duration::from_secs(2));
    let (mut child, _) = stage.add(spec);
    diary.plan("on_startup", Outcome::Fail);
    diary.plan("on_shutdown", Outcome::Hang);

    child.start(Incarnation(1), stage.reports.recipient().into());
    advance(Duration::from_millis(1900)).await;
    assert!(stage.exits.drain().is_empty());
    let events: Vec<_> = stage.reports.drain().into_iter().map(|r| r.event).collect();
    assert_eq!(events, [ChildEvent::FailsToStart], "the next one may not begin yet");
    advance(Duration::from_millis(200)).await;

    let event = stage.reports.drain().pop().expect("it has ended").event;
    assert!(matches!(event, ChildEvent::StartFailed { .. }), "{event:?}");
    let ended = stage.exits.drain().pop().expect("its end is told");
    assert_eq!((ended.incarnation, ended.exit), (Incarnation(1), ExitReason::Fatal));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn control_is_served_while_a_hook_awaits() {
    let stage = Stage::new();
    let (spec, diary) = diary();
    let (mut child, reference) = stage.add(spec);
    diary.plan("on_initialize", Outcome::Hang);
    child.start(Incarnation(1), stage.reports.recipient().into());
    settle().await;

    reference.0.inject(Injection::Panic);
    settle().await;

    let ended = stage.exits.drain().pop().expect("its end is told");
    assert!(matches!(ended.exit, ExitReason::Panicked { .. }), "{ended:?}");
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn states_that_a_replacement_passes_through_in_one_poll_are_told_as_one() {
    let stage = Stage::new();
    let (mut child, fragile) = stage.start(ChildSpec::new("fragile", || Fragile)).await;
    child.order(GRANT);
    stage.states.drain();

    fragile.tell(Die).unwrap();
    settle().await;

    let reported = stage.states.drain();
    assert_eq!(reported.len(), 1, "{reported:?}");
    assert_eq!((reported[0].incarnation, reported[0].state), (Incarnation(2), Lifecycle::Active));
}

#[derive(Clone, Event)]
struct Die;
struct Fragile;
impl Component for Fragile {}
impl Handle<Die> for Fragile {
    async fn handle(&mut self, _: Die, _: &mut Context<Self>) {
        panic!("as told")
    }
}
