//! Death watch: no notice is lost to a full queue, and no watch outlives its watcher.

use super::{Acc, Add, Boom, GRANT, Stage, acc, boom};
use crate::messaging::queue::WhenFull;
use crate::topic::Topics;
use crate::variable::VariableStore;
use crate::{
    ActorRef, ChildSpec, Component, Context, DeliveryError, Down, DownReason, Event, Failure,
    Handle, Incarnation, Ports, Variable, VariableSpec,
};
use blastema_contract::child::{ChildEvent, ChildOrder};
use blastema_doubles::{advance, paused, settle};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// Keeps its queue full.
#[derive(Clone, Debug, PartialEq, Event)]
struct Chatter(u64);

/// Is published by each incarnation.
#[derive(Clone, Debug, PartialEq, Event)]
struct Born(u64);

/// Is watched by each incarnation.
#[derive(Clone, Debug, PartialEq, Variable)]
struct Mood(u64);

#[derive(Clone, Debug, PartialEq)]
enum Received {
    Down(String, u64, DownReason),
    Chatter(u64),
}

/// Watches these from its first hook on, and takes a second for every message.
struct Widow {
    watched: Vec<String>,
    reported: Arc<Mutex<Vec<Received>>>,
}

impl Component for Widow {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Chatter>();
        ports.listen::<Born>();
        ports.variable(VariableSpec::new(Mood(0)));
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        for name in &self.watched {
            cx.watch(name).map_err(|error| error.to_string())?;
        }
        cx.publish(Born(cx.incarnation().0));
        let own = cx.name().to_string();
        let mut mood = cx.variable::<Mood>(&own).map_err(|why| why.to_string())?.watch();
        cx.spawn(async move { while mood.next().await.is_ok() {} });
        Ok(())
    }
}

impl Handle<Chatter> for Widow {
    async fn handle(&mut self, Chatter(n): Chatter, _: &mut Context<Self>) {
        tokio::time::sleep(Duration::from_secs(1)).await;
        self.reported.lock().unwrap().push(Received::Chatter(n));
    }
}

impl Handle<Born> for Widow {
    async fn handle(&mut self, _: Born, _: &mut Context<Self>) {}
}

impl Handle<Down> for Widow {
    async fn handle(&mut self, down: Down, _: &mut Context<Self>) {
        let reported = Received::Down(down.object.to_string(), down.incarnation.0, down.ending);
        self.reported.lock().unwrap().push(reported);
    }
}

impl Handle<Boom> for Widow {
    async fn handle(&mut self, Boom(text): Boom, _: &mut Context<Self>) {
        panic!("{text}")
    }
}

fn widow(name: &str, watched: &[&str]) -> (ChildSpec<Widow>, Arc<Mutex<Vec<Received>>>) {
    let reported = Arc::<Mutex<Vec<_>>>::default();
    let (kept, watched) = (reported.clone(), watched.iter().map(|name| (*name).to_owned()));
    let watched: Vec<_> = watched.collect();
    let make = move || Widow { watched: watched.clone(), reported: kept.clone() };
    (ChildSpec::new(name, make), reported)
}

fn taken(reported: &Mutex<Vec<Received>>) -> Vec<Received> {
    std::mem::take(&mut *reported.lock().unwrap())
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_object_of_another_node_is_lost_to_a_node_without_a_network() {
    let stage = Stage::new();
    let (spec, told) = widow("widow", &["there:arm"]);
    let _widow = stage.start(spec).await;
    settle().await;

    let reason = DeliveryError::Unreachable { node: "there".into() }.to_string();
    let lost = Received::Down("arm".into(), 0, DownReason::NodeLost { reason });
    assert_eq!(taken(&told), [lost]);
}

#[test]
fn a_full_queue_loses_no_notice_whatever_its_policy() {
    for policy in [WhenFull::Refuse, WhenFull::DropOldest, WhenFull::DropNewest, WhenFull::Wait] {
        paused(async {
            let stage = Stage::new();
            let (mut one, acc_one) = stage.start::<Acc>(acc("one").0).await;
            let (mut two, acc_two) = stage.start::<Acc>(acc("two").0).await;
            one.order(GRANT);
            two.order(GRANT);
            let (spec, reported) = widow("widow", &["one", "two"]);
            let (_widow, widow) = stage.start(spec.queue(1, policy)).await;
            widow.tell(Chatter(1)).unwrap();
            settle().await;
            widow.tell(Chatter(2)).unwrap();

            acc_one.tell(boom("first")).unwrap();
            acc_two.tell(boom("other")).unwrap();
            settle().await;
            one.order(GRANT);
            acc_one.tell(boom("second")).unwrap();
            settle().await;
            assert_eq!(taken(&reported), [], "it is busy");
            advance(Duration::from_millis(1500)).await;

            let reported = taken(&reported);
            let [Received::Chatter(1), Received::Down(first, 2, end), Received::Down(other, 1, _)] =
                &reported[..]
            else {
                panic!("{policy:?}: {reported:?}")
            };
            assert_eq!((first.as_str(), other.as_str()), ("one", "two"), "before what waits");
            assert!(
                matches!(end, DownReason::Panicked { text, .. } if text == "second"),
                "{end:?}"
            );
            assert_eq!(widow.queued(), 0, "Chatter(2) is in service");
        });
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn an_isolated_watcher_is_told_when_it_is_let_in_again() {
    let stage = Stage::new();
    let (mut child, arm) = stage.start::<Acc>(acc("arm").0).await;
    child.order(GRANT);
    let (spec, reported) = widow("widow", &["arm"]);
    let (mut watcher, _) = stage.start(spec).await;

    watcher.order(ChildOrder::Isolate(true));
    arm.tell(boom("x")).unwrap();
    settle().await;
    assert_eq!(taken(&reported), []);
    watcher.order(ChildOrder::Isolate(false));
    settle().await;

    assert!(matches!(&taken(&reported)[..], [Received::Down(of, 1, _)] if of == "arm"));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_notice_that_was_not_taken_ends_with_the_incarnation_that_watched() {
    let stage = Stage::new();
    let (mut child, arm) = stage.start::<Acc>(acc("arm").0).await;
    child.order(GRANT);
    let (spec, reported) = widow("widow", &["arm"]);
    let (mut watcher, widow) = stage.start(spec).await;
    watcher.order(GRANT);
    widow.tell(Chatter(1)).unwrap();
    settle().await;

    arm.tell(boom("x")).unwrap();
    settle().await;
    watcher.order(ChildOrder::Abandon);
    assert_eq!(stage.begin(&mut *watcher, 2).await, ChildEvent::Started);
    settle().await;

    assert_eq!(taken(&reported), [], "the second incarnation saw it alive");
    child.order(GRANT);
    arm.tell(boom("y")).unwrap();
    settle().await;
    assert!(matches!(&taken(&reported)[..], [Received::Down(_, 2, _)]));
}

/// How many watch this component.
fn watchers<C: Component>(of: &ActorRef<C>) -> usize {
    of.0.record.environment.registry.deaths().watchers(of.name())
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn three_hundred_incarnations_that_watch_listen_and_publish_leave_nothing_behind() {
    let stage = Stage::new();
    let (_arm, arm) = stage.start::<Acc>(acc("arm").0).await;
    let interest = Arc::<Mutex<Vec<_>>>::default();
    let kept = interest.clone();
    stage.environment.feature::<Topics>().on_interest(Arc::new(move |key| {
        kept.lock().unwrap().push(key.topic.to_string());
    }));
    let (spec, _) = widow("widow", &["arm", "widow", "absent"]);
    let (mut child, widow) = stage.start(spec).await;
    settle().await;
    let before = (watchers(&arm), watchers(&widow), Arc::strong_count(&widow.0));
    // Its variables' store hears of the widow's end with no watch of its own.
    assert_eq!((before.0, before.1), (1, 1));
    assert_eq!(stage.environment.feature::<VariableStore>().watchers(), 1);

    for incarnation in 1..=300 {
        child.order(GRANT);
        widow.tell(boom("again")).unwrap();
        settle().await;
        assert_eq!(widow.incarnation(), Incarnation(incarnation + 1));
    }

    let after = (watchers(&arm), watchers(&widow), Arc::strong_count(&widow.0));
    assert_eq!(after, before, "watches, and what holds the component");
    assert_eq!(stage.environment.feature::<VariableStore>().watchers(), 1);
    let reported = interest.lock().unwrap().clone();
    assert_eq!(reported, ["Born"], "one interest for all incarnations");
    assert_eq!(stage.environment.feature::<Topics>().listened().len(), 1);
}

/// Watches these two when it is told to.
struct Mate([&'static str; 2]);

impl Component for Mate {}

impl Handle<Born> for Mate {
    async fn handle(&mut self, _: Born, cx: &mut Context<Self>) {
        self.0.iter().for_each(|name| cx.watch(name).unwrap());
    }
}

impl Handle<Down> for Mate {
    async fn handle(&mut self, _: Down, _: &mut Context<Self>) {}
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn two_that_watch_each_other_do_not_keep_each_other() {
    let stage = Stage::new();
    let spec = |name| ChildSpec::new(name, || Mate(["one", "two"]));
    let (one, first) = stage.start(spec("one")).await;
    let (two, second) = stage.start(spec("two")).await;
    first.tell(Born(1)).unwrap();
    second.tell(Born(1)).unwrap();
    settle().await;
    assert_eq!((watchers(&first), watchers(&second)), (2, 2));
    let kept = (Arc::downgrade(&first.0), Arc::downgrade(&second.0));
    drop((first, second));

    drop(one);
    drop(two);
    settle().await;

    assert_eq!((kept.0.strong_count(), kept.1.strong_count()), (0, 0));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_watch_is_of_a_name_and_of_each_object_that_has_it() {
    let stage = Stage::new();
    let (spec, reported) = widow("widow", &["arm"]);
    let _widow = stage.start(spec).await;
    settle().await;
    assert_eq!(taken(&reported), [Received::Down("arm".into(), 0, DownReason::Unknown)]);

    for _ in 0..2 {
        let (child, arm) = stage.start::<Acc>(acc("arm").0).await;
        arm.tell(boom("x")).unwrap();
        stage.reports.wait(|report| report.object == *child.name()).await;
        let told = taken(&reported);
        let panicked = |down: &Received| matches!(down, Received::Down(of, 1, DownReason::Panicked { .. }) if of == "arm");
        assert!(told.iter().all(panicked) && told.len() == 1, "{told:?}");
        drop(child);
        settle().await;
        taken(&reported);
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_sender_by_name_reaches_the_component_that_has_the_name_and_a_reference_means_one() {
    let stage = Stage::new();
    let (first, arm) = stage.start::<Acc>(acc("arm").0).await;
    let by_name = stage.environment.registry.sender::<Add>("arm").unwrap();
    assert_eq!(by_name.ask(Add(1)).await, Ok(1));
    drop(first);
    assert_eq!(by_name.tell(Add(1)).unwrap_err().kind, DeliveryError::Stopped, "none has it");

    let (_second, _) = stage.start::<Acc>(acc("arm").0).await;

    by_name.tell(Add(2)).unwrap();
    by_name.deliver(Add(3)).await.unwrap();
    assert_eq!(by_name.ask(Add(4)).await, Ok(9));
    assert_eq!(arm.tell(Add(1)).unwrap_err().kind, DeliveryError::Stopped);
    assert_eq!(arm.ask(Add(1)).await.unwrap_err().kind, DeliveryError::Stopped);
    let of_the_first = arm.sender::<Add>().tell(Add(1)).unwrap_err();
    assert_eq!((of_the_first.kind, of_the_first.message), (DeliveryError::Stopped, Add(1)));
}
