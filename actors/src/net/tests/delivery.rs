//! How messages travel, as their contracts say.

use super::*;
use crate::Event;
use crate::net::stack::{NetworkStack, RunOnStack};
use crate::topic::Topics;
use blastema_core::TrafficClass;

/// A reading of which only the newest counts.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(delivery = "newest", max_size = 100_000)]
struct Reading(u64, Vec<u8>);

/// A command that must not wait for a failed cable.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(delivery = "redundant")]
struct Stop(u64);

/// Much at once, all of which counts.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(max_size = 1_100_000, bulk)]
struct Bulk(u64, Vec<u8>);

/// A step of which none may be lost without its sender's knowing.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(when_full = "refuse")]
struct Step(u64);

/// The same as a question.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u64, delivery = "redundant")]
struct Halt(u64);

struct Ear(Log);

impl Component for Ear {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Reading>().accept::<Stop>().accept::<Bulk>().serve::<Halt>();
        let _ = ports.listen::<Reading>();
        let _ = ports.listen::<Stop>();
        let _ = ports.listen::<Step>();
    }
}

impl Handle<Reading> for Ear {
    async fn handle(&mut self, Reading(n, _): Reading, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(n);
    }
}

impl Handle<Stop> for Ear {
    async fn handle(&mut self, Stop(n): Stop, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(n);
    }
}

impl Handle<Step> for Ear {
    async fn handle(&mut self, Step(n): Step, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(n);
    }
}

impl Handle<Bulk> for Ear {
    async fn handle(&mut self, Bulk(n, _): Bulk, _: &mut Context<Self>) {
        self.0.0.lock().unwrap().push(n);
    }
}

impl Handle<Halt> for Ear {
    async fn handle(&mut self, Halt(n): Halt, _: &mut Context<Self>) -> u64 {
        n
    }
}

async fn ear(module: &Module) -> (Box<dyn Child>, Log) {
    let begun = module.begin("ear", Ear, 20_000, WhenFull::Refuse).await;
    advance(50 * MS).await;
    begun
}

fn publisher<E: Event>(module: &Module) -> Publisher<E> {
    module.host.feature::<Topics>().publisher(E::NAME).unwrap()
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn of_readings_the_newest_arrives_and_what_was_lost_is_not_repeated() {
    let (robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let publisher = publisher::<Reading>(&left);
    let sender = left.sender::<Reading>("right:ear");

    publisher.publish(Reading(1, vec![])).unwrap();
    publisher.publish(Reading(2, vec![0; 50_000])).unwrap();
    advance(10 * MS).await;
    sender.tell(Reading(3, vec![])).unwrap();
    advance(10 * MS).await;
    assert_eq!(log.take(), [1, 2, 3]);

    robot.part("left");
    publisher.publish(Reading(4, vec![])).unwrap();
    sender.tell(Reading(5, vec![])).unwrap();
    advance(300 * MS).await;
    robot.unite("left");
    advance(1000 * MS).await;
    publisher.publish(Reading(6, vec![])).unwrap();
    advance(10 * MS).await;
    sender.tell(Reading(7, vec![])).unwrap();
    advance(10 * MS).await;

    assert_eq!(log.take(), [6, 7]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn readings_take_no_more_capacity_in_a_long_turn_of_the_stack() {
    let (_robot, left, right) = pair().await;
    let (_ear, _log) = ear(&right).await;
    let readings = left.sender::<Reading>("right:ear");
    readings.tell(Reading(0, vec![])).unwrap();
    advance(10 * MS).await;
    let (accepted, counts) = std::sync::mpsc::channel();
    let tell = move || (0..1000).filter(|n| readings.tell(Reading(*n, vec![])).is_ok()).count();

    let stack = left.net.stack.clone();
    left.net.on_stack(move |_| {
        let first = tell();
        // The stack serves this after the first thousand, before it yields.
        let again = move |_: &mut NetworkStack| accepted.send([first, tell()]).unwrap();
        stack.do_send(RunOnStack(Box::new(again)));
    });
    settle().await;

    // Seven eighths of 2048.
    assert_eq!(counts.try_recv(), Ok([1000, 792]));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn readings_do_not_wait_behind_what_waits_in_order() {
    let (robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let readings = left.sender::<Reading>("right:ear");
    readings.tell(Reading(0, vec![])).unwrap();
    advance(10 * MS).await;
    // What is reliable fills its buffers while nothing arrives at the other end.
    robot.part("right");
    let notes = left.sender::<Note>("right:acc");
    while notes.tell(Note(1)).is_ok() {}
    advance(5 * MS).await;
    assert!(matches!(
        notes.tell(Note(1)).unwrap_err().kind,
        DeliveryError::WayFull { class: TrafficClass::Request, .. }
    ));

    assert_eq!(readings.tell(Reading(1, vec![])), Ok(()));

    drop((log, right));
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn what_goes_every_way_is_not_late_when_a_cable_fails() {
    let (robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let publisher = publisher::<Stop>(&left);
    let mut received = Vec::new();

    for n in 0..300_u64 {
        let network = if n < 150 { "ethernet/left" } else { "ieee1394/left" };
        match n {
            50 | 200 => robot.cut(network),
            100 | 250 => robot.restore(network),
            _ => {}
        }
        publisher.publish(Stop(n)).unwrap();
        advance(10 * MS).await;
        let came = log.take();
        assert_eq!(came, [n], "each within its interval");
        received.extend(came);
    }

    assert_eq!(received.len(), 300);
    let session = right.net.read_sessions().await.remove(0);
    assert!(session.status.counters.replicas > 100, "{:?}", session.status.counters);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_question_that_goes_every_way_is_answered_every_way() {
    let (robot, left, right) = pair().await;
    let (_ear, _log) = ear(&right).await;
    let sender = left.sender::<Halt>("right:ear");
    assert_eq!(sender.ask(Halt(0)).await.unwrap(), 0);

    for (n, cable) in [(1, "ethernet/left"), (2, "ieee1394/left")] {
        robot.cut(cable);
        let before = platform::now();
        assert_eq!(sender.ask(Halt(n)).await.unwrap(), n);
        let took = platform::now() - before;
        assert!(took < 10 * MS, "{took:?}");
        robot.restore(cable);
        advance(3000 * MS).await;
    }
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn parties_that_count_on_other_deliveries_do_not_bind() {
    mod theirs {
        use crate::Event;

        #[derive(Clone, Debug, Event)]
        #[contract(name = "Stop")]
        pub(super) struct Stop(pub(super) u64);
    }
    let (_robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;

    publisher::<theirs::Stop>(&left).publish(theirs::Stop(1)).unwrap();
    advance(50 * MS).await;

    for module in [&left, &right] {
        let declared = module.declared.expect().await;
        assert_eq!(declared.kind, FaultKind::ContractMismatch);
        assert!(declared.detail.contains("delivery re"), "{}", declared.detail);
    }
    assert_eq!(log.take(), [0; 0]);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn a_burst_of_what_is_large_waits_for_room_and_arrives_whole() {
    let (_robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let sender = left.sender::<Bulk>("right:ear");
    let burst = async {
        for n in 0..40 {
            sender.deliver(Bulk(n, vec![7; 1 << 20])).await.unwrap();
        }
    };
    tokio::join!(burst, advance(5000 * MS));
    assert_eq!(log.take(), (0..40).collect::<Vec<_>>());
    assert_eq!(left.host.dead_letters.total(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn each_event_that_may_be_refused_arrives_or_comes_back_to_its_publisher() {
    let (_robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let steps = publisher::<Step>(&left);
    let (mut published, mut refused) = (vec![], 0);
    for n in 0..20_000 {
        match steps.publish(Step(n)) {
            Ok(()) => published.push(n),
            Err(error) => {
                let class = TrafficClass::Event;
                assert_eq!(error.kind, DeliveryError::WayFull { node: "right".into(), class });
                assert_eq!(error.message, Step(n));
                refused += 1;
            }
        }
        if n % 5_000 == 4_999 {
            advance(100 * MS).await;
        }
    }
    advance(1000 * MS).await;

    assert!(refused > 1000 && published.len() > 2000, "{refused}, {}", published.len());
    assert!(log.take() == published, "not all of {} arrived", published.len());
    assert_eq!(left.host.dead_letters.total(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn requests_are_never_refused_beside_bulk_and_the_order_of_one_sender_is_kept() {
    let (_robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let (bulk, notes) = (left.sender::<Bulk>("right:ear"), left.sender::<Note>("right:acc"));
    let images = async {
        for n in 0..40 {
            // A small one of the same contract behind each.
            bulk.deliver(Bulk(2 * n, vec![7; 1 << 20])).await.unwrap();
            bulk.deliver(Bulk(2 * n + 1, vec![])).await.unwrap();
        }
    };
    let orders = async {
        let mut reported = 0;
        loop {
            assert_eq!(notes.tell(Note(reported)), Ok(()));
            reported += 1;
            tokio::time::sleep(MS).await;
        }
    };
    tokio::select! {
        () = async { tokio::join!(images, advance(5000 * MS)); } => {}
        () = orders => {}
    }

    assert_eq!(log.take(), (0..80).collect::<Vec<_>>());
    let reported = right.log.take();
    assert!(reported.len() > 1000 && reported.is_sorted(), "{}", reported.len());
    assert_eq!(left.host.dead_letters.total() + right.host.dead_letters.total(), 0);
}

#[blastema_macros::test(crate = "blastema_doubles")]
async fn who_tells_bulk_without_waiting_is_told_that_the_way_is_full_and_not_the_receiver() {
    let (_robot, left, right) = pair().await;
    let (_ear, log) = ear(&right).await;
    let bulk = left.sender::<Bulk>("right:ear");
    let mut taken = 0;
    let error = loop {
        match bulk.tell(Bulk(taken, vec![7; 1 << 20])) {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
    };

    let class = TrafficClass::Bulk;
    assert_eq!(error.kind, DeliveryError::WayFull { node: "right".into(), class });
    assert!(error.to_string().contains("the way to node right is full of bulk"), "{error}");
    assert_eq!(left.sender::<Note>("right:acc").tell(Note(1)), Ok(()), "requests go");
    advance(1000 * MS).await;
    assert_eq!(log.take(), (0..taken).collect::<Vec<_>>());
}
