//! More messages than a component can serve.

use crate::scenarios::puppet::{Deed, Do, Note, Puppet, Strings, ask};
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::core::detection::{Liveness, Opinion, Pull};
use blastema::prelude::*;
use blastema_testkit::{TestNode, now};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A component with a queue of four that is busy for a second.
async fn busy(strings: &Strings, when_full: WhenFull) -> (TestNode, ActorRef<Puppet>) {
    let spec = strings.spec("hall").queue(4, when_full);
    let node = TestNode::start(Node::builder("module1").child(spec)).await;
    let hall = node.actor::<Puppet>("hall").unwrap();
    hall.tell(Do(Deed::Await(1000))).unwrap();
    node.settle().await;
    (node, hall)
}

fn lost(node: &TestNode) -> u64 {
    node.dead_letters().count(&"hall".parse().unwrap(), DeadReason::Full)
}

/// The notes that were served in the end.
async fn served(node: &TestNode, strings: &Strings) -> Vec<String> {
    node.advance(Duration::from_secs(2)).await;
    strings.lines("note").iter().map(|line| line.replace("hall#1 note ", "")).collect()
}

#[blastema_testkit::test]
async fn a_full_queue_refuses_or_drops_what_it_says_and_counts_what_is_lost() {
    let cases: [(_, &[u32], _, _); 3] = [
        (WhenFull::Refuse, &[5, 6], 0, ["1", "2", "3", "4"]),
        (WhenFull::DropOldest, &[], 2, ["3", "4", "5", "6"]),
        (WhenFull::DropNewest, &[], 2, ["1", "2", "3", "4"]),
    ];
    for (when_full, refused, dropped, kept) in cases {
        let strings = Strings::default();
        let (node, hall) = busy(&strings, when_full).await;

        let told = (1..=6).filter_map(|n| hall.tell(Note(n)).err());
        let expected = refused.iter().map(|&n| (DeliveryError::Full, Note(n)));

        assert!(told.map(|error| (error.kind, error.message)).eq(expected), "{when_full:?}");
        assert_eq!((hall.queued(), lost(&node)), (4, dropped), "{when_full:?}");
        assert_eq!(served(&node, &strings).await, kept, "{when_full:?}");
    }
}

#[blastema_testkit::test]
async fn whoever_waits_for_room_is_served_in_turn() {
    let strings = Strings::default();
    let (node, hall) = busy(&strings, WhenFull::Wait).await;
    let start = now();

    for n in 1..=9 {
        hall.deliver(Note(n)).await.unwrap();
    }

    assert_eq!(now() - start, Duration::from_millis(1000));
    assert_eq!(lost(&node), 0);
    assert_eq!(served(&node, &strings).await, ["1", "2", "3", "4", "5", "6", "7", "8", "9"]);
}

#[blastema_testkit::test]
async fn a_flooded_component_still_answers_and_its_overload_is_seen() {
    let strings = Strings::default();
    let watch = Liveness::Pull(Pull::default());
    let spec = strings.spec("hall").queue(8, WhenFull::DropOldest).liveness(watch);
    let spec = spec.max_delay(Duration::from_millis(500));
    let mut node = TestNode::start(Node::builder("module1").child(spec)).await;
    let hall = node.actor::<Puppet>("hall").unwrap();

    // Each takes 200 ms, and each 100 ms there is another one.
    for _ in 0..30 {
        hall.tell(Do(Deed::Await(200))).unwrap();
        node.advance(Duration::from_millis(100)).await;
    }

    let row = node.row("hall").await;
    assert_eq!(row.opinion, Opinion::Trusted, "{row:?}");
    assert!(row.queue.is_some_and(|queue| queue.queued > 4), "{row:?}");
    let fault = node.await_fault(FaultKind::Overload, "hall").await;
    assert!(fault.detail.contains("messages wait"), "{}", fault.detail);
    assert_eq!(hall.incarnation().0, 1, "{:?}", node.faults().await);
    node.advance(Duration::from_secs(5)).await;
    node.expect_no_faults().await;
    let record = node.faults().await;
    assert!(!record.entries[0].stands(), "it passes: {record:?}");
}

#[blastema_testkit::test]
async fn a_flooded_component_obeys_stop() {
    let strings = Strings::default();
    let (node, hall) = busy(&strings, WhenFull::DropOldest).await;
    (1..=99).for_each(|_| hall.tell(Do(Deed::Await(1000))).unwrap());
    let start = now();

    node.remove_child("hall").await.unwrap();

    assert_eq!(now() - start, Duration::from_secs(1), "after the present handler");
    assert!(strings.diary().contains(&"hall#1 on_finalize".into()));
}

#[blastema_testkit::test]
async fn a_component_that_does_not_end_is_ended_when_its_time_is_over() {
    let strings = Strings::default();
    let spec = strings.spec("hall").shutdown_within(Duration::from_secs(2));
    let node = TestNode::start(Node::builder("module1").child(spec)).await;
    let waiting = node.sender::<Do>("hall").unwrap();
    let waiting = tokio::task::spawn_local(async move {
        waiting.ask_within(Do(Deed::Await(3_600_000)), Duration::from_secs(60)).await
    });
    node.settle().await;
    let start = now();

    node.remove_child("hall").await.unwrap();

    assert_eq!(now() - start, Duration::from_secs(2));
    let error = waiting.await.unwrap().expect_err("it was cut short");
    assert!(matches!(error.kind, DeliveryError::PeerDied { .. }), "{}", error.kind);
    let lost = node.dead_letters().count(&"hall".parse().unwrap(), DeadReason::PeerDied);
    assert_eq!(lost, 1, "what it served is a dead letter");
}

#[blastema_testkit::test]
async fn a_flood_harms_no_neighbour() {
    let strings = Strings::default();
    let builder = Node::builder("module1")
        .child(strings.spec("hall").queue(100_000, WhenFull::Refuse))
        .child(strings.spec("room"));
    let node = TestNode::start(builder).await;
    let hall = node.actor::<Puppet>("hall").unwrap();

    (0..100_000).for_each(|n| hall.tell(Note(n)).unwrap());
    assert_eq!(ask(&node, "room", Deed::Nothing).await.unwrap(), 1);

    assert!(hall.queued() > 90_000, "the neighbour did not have to wait for all of it");
    strings.diary();
}

/// Of no worth after 100 ms.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/scan", max_age = "100ms")]
struct Scan(u32);

#[derive(Clone, Debug, Event)]
#[contract(name = "test/mode", latched)]
struct Mode(u32);

#[derive(Clone, Debug, Event)]
#[contract(name = "test/halt")]
struct Halt;

/// Takes a second to initialize, and writes down what it serves.
struct Base {
    served: Arc<Mutex<Vec<String>>>,
    with_own_queue: bool,
}

impl Base {
    fn spec(served: &Arc<Mutex<Vec<String>>>, with_own_queue: bool) -> ChildSpec<Base> {
        let served = served.clone();
        let spec = ChildSpec::new("base", move || Base { served: served.clone(), with_own_queue });
        let own = move |ports: &mut Ports<Base>| {
            if with_own_queue {
                ports.queue::<Scan>(4, WhenFull::DropOldest);
            }
        };
        spec.queue(8, WhenFull::Refuse).with_ports(own)
    }

    fn write(&self, line: String) {
        self.served.lock().unwrap().push(line);
    }
}

impl Component for Base {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Scan>().accept::<Halt>();
        ports.listen::<Mode>();
        ports.listen::<Mode>().on("test/gear");
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        tokio::time::sleep(Duration::from_secs(1)).await;
        Ok(())
    }
}

impl Handle<Scan> for Base {
    async fn handle(&mut self, Scan(n): Scan, _: &mut Context<Self>) {
        self.write(format!("scan {n}"));
        assert!(n != 13 || self.with_own_queue, "an unlucky number");
    }
}

impl Handle<Mode> for Base {
    async fn handle(&mut self, Mode(n): Mode, _: &mut Context<Self>) {
        self.write(format!("mode {n}"));
    }
}

impl Handle<Halt> for Base {
    async fn handle(&mut self, _: Halt, _: &mut Context<Self>) {
        self.write("halt".to_owned());
        panic!("it halts");
    }
}

#[blastema_testkit::test]
async fn a_latched_event_comes_to_each_incarnation_however_full_its_queue_is() {
    for lasts in [Duration::from_millis(500), Duration::ZERO] {
        let served = Arc::<Mutex<Vec<String>>>::default();
        let builder = Node::builder("module1").child(Base::spec(&served, false));
        let node = TestNode::start(builder).await;
        let scan = node.sender::<Scan>("base").unwrap();
        node.publisher::<Mode>("test/mode").unwrap().publish(Mode(1)).unwrap();
        node.settle().await;

        scan.tell(Scan(13)).unwrap();
        node.settle().await;
        while scan.tell(Scan(1)).is_ok() {}
        // They expire, or not.
        node.advance(lasts).await;
        node.publisher::<Mode>("test/mode").unwrap().publish(Mode(2)).unwrap();
        node.advance(Duration::from_secs(3)).await;

        let served = served.lock().unwrap();
        let newest = served.iter().rfind(|line| line.starts_with("mode"));
        assert_eq!(newest.map(String::as_str), Some("mode 2"), "{lasts:?}: {served:?}");
    }
}

#[blastema_testkit::test]
async fn a_flood_on_one_topic_displaces_no_latched_event_of_another_of_the_same_contract() {
    for own in [None, Some(WhenFull::DropNewest)] {
        let served = Arc::<Mutex<Vec<String>>>::default();
        let own = move |ports: &mut Ports<Base>| {
            if let Some(when_full) = own {
                ports.queue::<Mode>(3, when_full);
            }
        };
        let spec = Base::spec(&served, false).with_ports(own);
        let node = TestNode::start(Node::builder("module1").child(spec)).await;
        let mode = node.publisher::<Mode>("test/mode").unwrap();
        let gear = node.publisher::<Mode>("test/gear").unwrap();
        node.sender::<Scan>("base").unwrap().tell(Scan(13)).unwrap();
        node.settle().await;

        gear.publish(Mode(101)).unwrap();
        for n in 1..=20 {
            mode.publish(Mode(n)).unwrap();
            node.settle().await;
        }
        node.advance(Duration::from_secs(3)).await;

        let served = served.lock().unwrap();
        for newest in ["mode 101", "mode 20"] {
            assert!(served.iter().any(|line| line == newest), "{newest}: {served:?}");
        }
    }
}

#[blastema_testkit::test]
async fn what_has_expired_keeps_no_place_in_a_queue() {
    let served = Arc::<Mutex<Vec<String>>>::default();
    let builder = Node::builder("module1").child(Base::spec(&served, false));
    let node = TestNode::start(builder).await;
    let (scan, halt) = (node.sender::<Scan>("base").unwrap(), node.sender::<Halt>("base").unwrap());
    scan.tell(Scan(13)).unwrap();
    node.settle().await;
    (1..=8).for_each(|n| scan.tell(Scan(n)).unwrap());
    assert_eq!(halt.tell(Halt).unwrap_err().kind, DeliveryError::Full);

    node.advance(Duration::from_millis(200)).await;

    halt.tell(Halt).expect("what it would wait behind is worth nothing any more");
    let base = "base".parse().unwrap();
    assert_eq!(node.dead_letters().count(&base, DeadReason::Expired), 8);
    node.advance(Duration::from_secs(2)).await;
    assert_eq!(*served.lock().unwrap(), ["scan 13", "halt"]);
}

#[blastema_testkit::test]
async fn a_sender_that_waits_for_the_place_of_what_has_expired_is_served() {
    let served = Arc::<Mutex<Vec<String>>>::default();
    let own = |ports: &mut Ports<Base>| {
        ports.queue::<Scan>(2, WhenFull::Wait);
    };
    let spec = Base::spec(&served, false).queue(2, WhenFull::Refuse).with_ports(own);
    let node = TestNode::start(Node::builder("module1").child(spec)).await;
    let (scan, halt) = (node.sender::<Scan>("base").unwrap(), node.sender::<Halt>("base").unwrap());
    scan.tell(Scan(13)).unwrap();
    node.settle().await;
    (1..=2).for_each(|n| scan.tell(Scan(n)).unwrap());
    let waits = tokio::task::spawn_local(async move { scan.deliver(Scan(3)).await });
    node.advance(Duration::from_millis(200)).await;

    halt.tell(Halt).unwrap();
    node.settle().await;

    assert!(waits.is_finished(), "nothing waits at its port any more");
}

#[blastema_testkit::test]
async fn a_flood_at_a_port_with_a_queue_of_its_own_refuses_nothing_at_another() {
    let served = Arc::<Mutex<Vec<String>>>::default();
    let builder = Node::builder("module1").child(Base::spec(&served, true));
    let node = TestNode::start(builder).await;
    let (scan, halt) = (node.sender::<Scan>("base").unwrap(), node.sender::<Halt>("base").unwrap());
    halt.tell(Halt).unwrap();
    node.settle().await;

    (1..=1000).for_each(|n| scan.tell(Scan(n)).unwrap());
    halt.tell(Halt).expect("a stop has a place");
    scan.tell(Scan(1001)).unwrap();
    node.advance(Duration::from_millis(1001)).await;

    let base = "base".parse().unwrap();
    assert_eq!(node.dead_letters().count(&base, DeadReason::Full), 997);
    let expired = node.dead_letters().count(&base, DeadReason::Expired);
    assert_eq!(expired, 3, "the last scan came after the stop, and waits behind it");
    assert_eq!(*served.lock().unwrap(), ["halt", "halt"]);
}
