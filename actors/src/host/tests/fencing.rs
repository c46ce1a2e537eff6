//! What a component left behind in threads, tasks and publishers is fenced with its incarnation.

use super::{Boom, ChildOrder, GRANT, Log, Stage, boom, logged, logging};
use crate::arbiter::pool::ArbiterPool;
use crate::topic::Publisher;
use crate::{ChildSpec, Component, Context, DeliveryError, Event, Failure, Handle, Ports};
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::{Contract, ObjectName};
use blastema_doubles::{advance, settle};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "reading")]
struct Reading(u64);

/// Publishes when the test says so, on a thread of its own, and says what came of it.
#[derive(Clone, Default)]
struct Bench {
    publishers: Arc<Mutex<Vec<Publisher<Reading>>>>,
}

/// Gives the publisher of each incarnation to the test.
struct Source(Bench);

impl Component for Source {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let publisher = cx.publisher(Reading::NAME).map_err(|why| why.to_string())?;
        self.0.publishers.lock().unwrap().push(publisher);
        Ok(())
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.publish(Reading(cx.incarnation().0));
        Ok(())
    }
}

impl Handle<Boom> for Source {
    async fn handle(&mut self, Boom(text): Boom, _: &mut Context<Self>) {
        panic!("{text}")
    }
}

struct Ear(Log);
impl Component for Ear {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Reading>();
    }
}
impl Handle<Reading> for Ear {
    async fn handle(&mut self, Reading(n): Reading, _: &mut Context<Self>) {
        self.0.lock().unwrap().push(n);
    }
}

fn ear() -> (ChildSpec<Ear>, Log) {
    logging("ear", Ear)
}

fn source(bench: &Bench) -> ChildSpec<Source> {
    let bench = bench.clone();
    ChildSpec::new("source", move || Source(bench.clone()))
}

/// A thread that publishes what it is told, and answers what came of it.
fn thread(publisher: Publisher<Reading>) -> (Sender<u64>, Receiver<Option<DeliveryError>>) {
    let (orders, reported) = channel();
    let (answer, answers) = channel();
    std::thread::spawn(move || {
        while let Ok(n) = reported.recv() {
            let refused = publisher.publish(Reading(n)).err();
            assert!(refused.as_ref().is_none_or(|error| error.message == Reading(n)));
            let _ = answer.send(refused.map(|error| error.kind));
        }
    });
    (orders, answers)
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_publisher_is_fenced_when_its_incarnation_is_given_up_or_stopped() {
    let stage = Stage::new();
    let bench = Bench::default();
    let (spec, log) = ear();
    let (_ear, _) = stage.start(spec).await;
    let (mut child, _) = stage.start(source(&bench)).await;
    let publish = |at: usize, n: u64| {
        let publisher = bench.publishers.lock().unwrap()[at].clone();
        publisher.publish(Reading(n)).map_err(|error| error.kind)
    };
    assert_eq!(publish(0, 1), Ok(()));

    child.order(ChildOrder::Abandon);
    assert_eq!(publish(0, 2), Err(DeliveryError::Fenced));
    stage.begin(&mut *child, 2).await;
    assert_eq!(publish(1, 3), Ok(()));
    child.order(ChildOrder::Isolate(true));
    assert_eq!(publish(1, 4), Err(DeliveryError::SenderIsolated));
    child.order(ChildOrder::Isolate(false));
    child.order(ChildOrder::Stop { again: false });
    settle().await;
    assert_eq!(publish(1, 5), Err(DeliveryError::Fenced));

    settle().await;
    assert_eq!(logged(&log), [1, 3]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_an_isolated_component_publishes_without_a_result_is_counted() {
    let stage = Stage::new();
    let (spec, log) = ear();
    let (_ear, _) = stage.start(spec).await;
    let (mut child, _) = stage.start(source(&Bench::default()).rate_hz(10.0)).await;
    advance(Duration::from_millis(250)).await;
    let before = logged(&log).len();
    assert!(before >= 2, "{before}");

    child.order(ChildOrder::Isolate(true));
    advance(Duration::from_millis(500)).await;

    assert_eq!(logged(&log), [0; 0]);
    let topic = ObjectName::new(Reading::NAME).unwrap();
    let counted = stage.environment.dead_letters.count(&topic, DeadReason::Isolated);
    assert_eq!(counted, 5);
}

/// On real threads.
mod real {
    use super::*;

    #[blastema_macros::test(crate = "blastema_doubles::real")]
    async fn a_publisher_in_a_thread_is_fenced_with_its_incarnation() {
        let stage = Stage::on(ArbiterPool::pool(1));
        let bench = Bench::default();
        let (spec, log) = ear();
        let (_ear, _) = stage.start(spec).await;
        let (mut child, source) = stage.start(source(&bench)).await;
        child.order(GRANT);
        let first = bench.publishers.lock().unwrap()[0].clone();
        let (tell, answers) = thread(first);

        tell.send(1).unwrap();
        assert_eq!(answers.recv().unwrap(), None);
        source.tell(boom("x")).unwrap();
        stage.exits.expect().await;
        tell.send(2).unwrap();
        assert_eq!(answers.recv().unwrap(), Some(DeliveryError::Fenced));
        while bench.publishers.lock().unwrap().len() < 2 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        let second = bench.publishers.lock().unwrap()[1].clone();
        second.publish(Reading(3)).unwrap();
        while log.lock().unwrap().len() < 2 {
            tokio::time::sleep(Duration::from_millis(5)).await;
        }

        assert_eq!(logged(&log), [1, 3], "nothing of the first incarnation after its end");
        assert_eq!(stage.environment.dead_letters.total(), 1, "the message that killed, no more");
        stage.environment.arbiters.stop();
    }
}
