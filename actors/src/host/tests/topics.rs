//! Publish and subscribe.

use super::{Boom, GRANT, Log, Stage, boom, logged, logging};
use crate::topic::Topics;
use crate::topic::{EventForward, Reservation, TopicKey};
use crate::{ChildSpec, Component, Context, DeliveryError, Event, Failure, Handle, Ports};
use blastema_contract::child::{ChildEvent, ChildOrder};
use blastema_contract::reports::ExitReason;
use blastema_core::{
    Contract, ContractIdentity, GatherBuffer, Incarnation, Instant, Lifecycle, NodeName,
};
use blastema_doubles::{advance, settle};
use bytes::Bytes;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Clone, Debug, PartialEq, Event)]
struct Sample(u64);

#[derive(Clone, Event)]
struct Rest(u64);

/// Listens to even samples, and to all on a second topic.
struct Listener(Log);
impl Component for Listener {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Sample>().only_if(|Sample(n)| {
            assert!(*n != 666, "in a condition");
            n % 2 == 0
        });
        ports.listen::<Sample>().on("other");
    }
}
impl Handle<Sample> for Listener {
    async fn handle(&mut self, Sample(n): Sample, _: &mut Context<Self>) {
        assert!(n != 13, "in a handler");
        self.0.lock().unwrap().push(n);
    }
}
impl Handle<Rest> for Listener {
    async fn handle(&mut self, Rest(millis): Rest, _: &mut Context<Self>) {
        tokio::time::sleep(Duration::from_millis(millis)).await;
    }
}
impl Handle<Boom> for Listener {
    async fn handle(&mut self, Boom(text): Boom, _: &mut Context<Self>) {
        panic!("{text}")
    }
}

fn listener(name: &str) -> (ChildSpec<Listener>, Log) {
    logging(name, Listener)
}

fn publish(stage: &Stage, topic: &str, n: u64) {
    stage.environment.feature::<Topics>().publisher(topic).unwrap().publish(Sample(n)).unwrap();
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn listeners_get_what_they_want_in_order_idle_or_busy() {
    let stage = Stage::new();
    let ((idle, idle_log), (busy, busy_log)) = (listener("idle"), listener("busy"));
    let (_idle, _) = stage.start(idle).await;
    let (_busy, busy) = stage.start(busy).await;
    busy.tell(Rest(30)).unwrap();
    settle().await;

    (0..6).for_each(|n| publish(&stage, Sample::NAME, n));
    publish(&stage, "other", 7);
    publish(&stage, "unheard", 8);

    settle().await;
    assert_eq!(logged(&idle_log), [0, 2, 4, 7]);
    assert_eq!((logged(&busy_log), busy.queued()), (vec![], 4), "they wait in its queue");
    advance(Duration::from_millis(40)).await;
    assert_eq!(logged(&busy_log), [0, 2, 4, 7]);
}

struct Source;
impl Component for Source {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.publish(Sample(2));
        cx.publisher("other").map_err(|why| why.to_string())?.publish(Sample(3)).unwrap();
        Ok(())
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_component_publishes_on_its_contracts_topic_and_on_others() {
    let stage = Stage::new();
    let (spec, log) = listener("ear");
    let (_ear, _) = stage.start(spec).await;
    let (_source, _) = stage.start(ChildSpec::new("source", || Source).rate_hz(10.0)).await;

    advance(Duration::from_millis(105)).await;

    let mut received = logged(&log);
    received.sort_unstable();
    assert_eq!(received, [2, 2, 3, 3]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_subscription_ends_with_a_stop_and_returns_with_the_next_incarnation() {
    let stage = Stage::new();
    let (spec, log) = listener("ear");
    let (mut child, ear) = stage.start(spec).await;
    child.order(GRANT);
    ear.tell(boom("x")).unwrap();
    settle().await;
    publish(&stage, "other", 1);
    settle().await;
    assert_eq!(logged(&log), [1], "after a restart on the spot");

    ear.tell(boom("x")).unwrap();
    settle().await;
    publish(&stage, "other", 2);
    settle().await;
    assert_eq!((logged(&log), ear.queued()), (vec![], 1), "kept between two incarnations");
    stage.reports.drain();
    assert_eq!(stage.begin(&mut *child, 3).await, ChildEvent::Started);
    settle().await;
    assert_eq!(logged(&log), [2]);

    child.order(ChildOrder::Stop { again: false });
    settle().await;
    publish(&stage, "other", 3);
    settle().await;
    assert!(stage.environment.feature::<Topics>().listened().is_empty());
    stage.reports.drain();
    assert_eq!(stage.begin(&mut *child, 4).await, ChildEvent::Started);
    publish(&stage, "other", 4);
    settle().await;
    assert_eq!(logged(&log), [4]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_panic_in_a_condition_or_on_an_event_is_the_listeners_alone() {
    let stage = Stage::new();
    let ((one, one_log), (two, two_log)) = (listener("one"), listener("two"));
    let (mut one, _) = stage.start(one).await;
    let (mut two, _) = stage.start(two).await;

    one.order(GRANT);
    two.order(GRANT);

    publish(&stage, Sample::NAME, 666);
    publish(&stage, "other", 13);
    publish(&stage, "other", 1);
    settle().await;
    stage.reports.drain();
    stage.begin(&mut *one, 3).await;
    stage.begin(&mut *two, 3).await;
    settle().await;

    let exits = stage.exits.drain();
    let during = |exit: &ExitReason| match exit {
        ExitReason::Panicked { during, .. } => *during,
        _ => panic!("{exit:?}"),
    };
    let condition = "a condition of a subscription";
    let of_condition = exits.iter().filter(|e| during(&e.exit) == condition).count();
    assert_eq!((exits.len(), of_condition), (4, 2), "{exits:?}");
    assert_eq!((logged(&one_log), logged(&two_log)), (vec![1], vec![1]));
}
#[blastema_macros::test(crate = "blastema_doubles")]
async fn the_replacement_of_a_listener_that_dies_of_an_event_begins_without_another() {
    let stage = Stage::new();
    let (mut child, _) = stage.start(listener("ear").0).await;
    child.order(GRANT);
    settle().await;

    publish(&stage, "other", 13);

    settle().await;
    let reported = stage.states.drain();
    let last = reported.last().map(|reported| (reported.incarnation, reported.state));
    assert_eq!(last, Some((Incarnation(2), Lifecycle::Active)));
}

/// What was sent to another node, which has capacity for everything.
struct Shipped(Arc<Mutex<Vec<GatherBuffer>>>);

impl EventForward for Shipped {
    fn has_ended(&self) -> bool {
        false
    }

    fn forward(&self, event: &GatherBuffer, _: Instant) -> bool {
        self.0.lock().unwrap().push(event.clone());
        true
    }

    fn reserve(&self, _: usize, _: bool) -> Reservation {
        Reservation::Needless
    }

    fn full(&self) -> DeliveryError {
        DeliveryError::Full
    }

    fn capacity(&self) -> Pin<Box<dyn Future<Output = ()> + Send>> {
        Box::pin(std::future::ready(()))
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn events_are_shipped_out_once_and_come_in_from_outside() {
    let stage = Stage::new();
    let topics = &stage.environment.feature::<Topics>();
    let key = TopicKey::new("other", Sample::NAME).unwrap();
    let far = NodeName::new("far").unwrap();
    let shipped = Arc::new(Mutex::new(vec![]));
    let kept = shipped.clone();
    let wanted = vec![ContractIdentity::of::<Sample>().brief()];
    let forward = topics.forward(&key, far, wanted, Arc::new(Shipped(kept)), None);
    assert!(matches!(
        topics.inject(&key.topic, 0, &Bytes::from_static(&[1]), Duration::ZERO),
        Err(DeliveryError::Unknown { .. })
    ));
    let interest = Arc::new(Mutex::new(vec![]));
    let kept = interest.clone();
    let of = crate::topic::Topics::clone(topics);
    topics.on_interest(Arc::new(move |key| {
        let listens = !of.settle_interest(&key.topic).is_empty();
        kept.lock().unwrap().push((key.topic.to_string(), listens));
    }));
    let (spec, log) = listener("ear");
    let (mut child, _) = stage.start(spec).await;

    publish(&stage, "other", 5);
    settle().await;
    let bytes = shipped.lock().unwrap().pop().unwrap();
    topics.inject(&key.topic, 0, &bytes.into_bytes(), Duration::ZERO).unwrap();
    settle().await;
    assert_eq!(logged(&log), [5, 5]);
    assert!(shipped.lock().unwrap().is_empty(), "what came in is not sent out again");
    assert!(matches!(
        topics.inject(&key.topic, 0, &Bytes::from_static(&[9, 9, 9]), Duration::ZERO),
        Err(DeliveryError::Undecodable { .. })
    ));

    topics.end_forward(&forward);
    publish(&stage, "other", 6);
    settle().await;
    assert!(shipped.lock().unwrap().is_empty());
    assert_eq!(topics.identities(&key.topic)[0].name, Sample::NAME);
    assert_eq!(topics.listened().len(), 2);

    child.order(ChildOrder::Stop { again: false });
    settle().await;
    let mut reported = interest.lock().unwrap().clone();
    reported.sort();
    let other = |more| ("other".to_owned(), more);
    let sample = |more| (Sample::NAME.to_owned(), more);
    // The first report is that its contract is known, to which another node listens.
    let mut expected = [other(false), other(true), other(false), sample(false), sample(true)];
    expected.sort();
    assert_eq!(reported, expected);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn two_types_of_one_name_do_not_meet_on_a_topic() {
    #[derive(Clone, Event)]
    #[contract(name = "clash")]
    struct One(u64);
    #[derive(Clone, Event)]
    #[contract(name = "clash")]
    struct Two(f64);

    let stage = Stage::new();
    let topics = &stage.environment.feature::<Topics>();
    topics.publisher::<One>("t").unwrap();

    let Err(DeliveryError::ContractDiffers { difference }) = topics.publisher::<Two>("t") else {
        panic!("they met")
    };

    assert!(difference.contains("u64") && difference.contains("f64"), "{difference}");
}
