//! Capture stamps, events that are kept for who joins, and what a node tells of its topics.

use blastema::prelude::*;
use blastema::{DeadReason, Instant, MemoryMedium, TopicRow};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, Notes, Part, listens, on_ethernet, part};
use std::time::Duration;

/// An image, old as soon as it is 100 ms old.
#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "camera/image", max_age = "100ms")]
struct Image(u32);

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "map", latched)]
struct Map(u32);

/// How an incarnation ends.
#[derive(Clone, Debug, Request)]
#[contract(reply = ())]
enum End {
    Panic,
    Fatal,
    Return,
    Hang,
}

/// A map at which the viewer panics.
const BAD: Map = Map(13);

type Seen = Notes<(u32, Option<Instant>)>;

/// Notes what it gets, and when that was captured.
struct Viewer(Seen);

impl Component for Viewer {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Image>();
        ports.listen::<Map>();
        ports.serve::<End>();
    }
}

impl Handle<Image> for Viewer {
    async fn handle(&mut self, Image(n): Image, cx: &mut Context<Self>) {
        self.0.note((n, cx.captured_at()));
    }
}

impl Handle<Map> for Viewer {
    async fn handle(&mut self, map: Map, cx: &mut Context<Self>) {
        self.0.note((map.0, cx.captured_at()));
        assert_ne!(map, BAD);
    }
}

impl Handle<End> for Viewer {
    async fn handle(&mut self, how: End, cx: &mut Context<Self>) {
        match how {
            End::Panic => panic!("the viewer fails"),
            End::Fatal => cx.fail(Failure::fatal("no use")),
            End::Return => cx.stop(),
            End::Hang => std::future::pending().await,
        }
    }
}

fn viewer(name: &str) -> (ChildSpec<Viewer>, Seen) {
    let seen = Seen::default();
    let kept = seen.clone();
    (ChildSpec::new(name, move || Viewer(kept.clone())), seen)
}

fn numbers(seen: &Seen) -> Vec<u32> {
    seen.lock().iter().map(|(n, _)| *n).collect()
}

fn row_of(node: &Node, topic: &str) -> TopicRow {
    node.topics().into_iter().find(|row| row.topic == topic).expect("the topic was named")
}

#[blastema_testkit::test]
async fn the_age_of_an_event_counts_from_the_capture_of_its_data() {
    let (spec, seen) = viewer("viewer");
    let node = TestNode::start(Node::builder("module1").child(spec)).await;
    let images = node.publisher::<Image>("camera/image").unwrap();
    node.advance(1000 * MS).await;
    let captured = Instant::from_nanos(now().as_nanos() - 60_000_000);

    images.publish_captured_at(Image(1), captured).unwrap();
    node.settle().await;
    node.advance(50 * MS).await;
    images.publish_captured_at(Image(2), captured).unwrap();
    images.publish_captured_at(Image(3), now() + 500 * MS).unwrap();
    node.settle().await;

    let seen = seen.all();
    assert_eq!(seen, [(1, Some(captured)), (3, Some(now()))], "the second was 110 ms old");
    assert_eq!(node.dead_letters().count(&"viewer".parse().unwrap(), DeadReason::Expired), 1);
}

#[blastema_testkit::test]
async fn a_publisher_knows_its_listeners_and_can_wait_for_them() {
    let node = TestNode::start(Node::builder("module1")).await;
    let images = node.publisher::<Image>("camera/image").unwrap();
    assert_eq!(images.matched(), 0);
    let waits = images.matched_at_least(2);
    let mut waits = std::pin::pin!(waits);

    for name in ["left", "right"] {
        let early = tokio::time::timeout(100 * MS, waits.as_mut()).await;
        assert!(early.is_err(), "{name} has not joined");
        node.add_child(viewer(name).0).await.unwrap();
    }

    waits.await;
    assert_eq!(images.matched(), 2);
    node.remove_child("left").await.unwrap();
    node.settle().await;
    assert_eq!(images.matched(), 1);
}

#[blastema_testkit::test]
async fn a_latched_topic_gives_its_last_event_once_to_who_joins_and_to_each_new_incarnation() {
    let node = TestNode::start(Node::builder("module1")).await;
    let maps = node.publisher::<Map>("map").unwrap();
    [1, 2].into_iter().for_each(|n| maps.publish(Map(n)).unwrap());

    let (spec, seen) = viewer("viewer");
    node.add_child(spec).await.unwrap();
    node.settle().await;
    assert_eq!(numbers(&seen), [2]);

    maps.publish(Map(3)).unwrap();
    node.settle().await;
    assert_eq!(numbers(&seen), [2, 3]);

    let (late, seen_late) = viewer("late");
    maps.publish(Map(4)).unwrap();
    node.add_child(late).await.unwrap();
    node.settle().await;
    assert_eq!((numbers(&seen), numbers(&seen_late)), (vec![2, 3, 4], vec![4]));

    let viewer = node.sender::<End>("viewer").unwrap();
    let mut expected = vec![2, 3, 4];
    for how in [End::Panic, End::Fatal, End::Return, End::Hang] {
        viewer.tell(how.clone()).unwrap();
        node.advance(Duration::from_secs(60)).await;
        expected.push(4);
        assert_eq!(numbers(&seen), expected, "the incarnation after {how:?} knows nothing");
    }
    node.restart_child("viewer").await.unwrap();
    node.settle().await;
    expected.push(4);
    assert_eq!(numbers(&seen), expected);
    assert_eq!(numbers(&seen_late), [4]);
}

#[blastema_testkit::test]
async fn an_incarnation_gets_what_is_latched_in_order_and_once_with_what_waited() {
    let node = TestNode::start(Node::builder("module1")).await;
    let maps = node.publisher::<Map>("map").unwrap();
    let (spec, seen) = viewer("viewer");
    node.add_child(spec).await.unwrap();

    [Map(1), BAD, Map(14), Map(15)].into_iter().for_each(|map| maps.publish(map).unwrap());
    node.settle().await;

    assert_eq!(numbers(&seen), [1, 13, 14, 15]);
}

/// Two nodes on one network that know each other's topics.
async fn two_nodes(medium: &MemoryMedium) -> (TestNode, TestNode) {
    let here = TestNode::start(on_ethernet("module1", "module2", medium)).await;
    let there = TestNode::start(on_ethernet("module2", "module1", medium)).await;
    assert!(here.connected("module2", Duration::from_secs(10)).await);
    assert!(there.connected("module1", Duration::from_secs(10)).await);
    here.advance(1000 * MS).await;
    (here, there)
}

#[blastema_testkit::test]
async fn listeners_of_other_nodes_are_matched_and_get_what_is_latched_and_the_age_of_the_rest() {
    let (here, there) = two_nodes(&MemoryMedium::default()).await;
    let maps = here.publisher::<Map>("map").unwrap();
    maps.publish(Map(1)).unwrap();

    let (spec, seen) = viewer("viewer");
    there.add_child(spec).await.unwrap();
    maps.matched_at_least(1).await;
    there.advance(100 * MS).await;

    assert_eq!((maps.matched(), numbers(&seen)), (1, vec![1]));
    assert_eq!(row_of(&here, "map").listening_nodes.len(), 1);
    let (late, seen_late) = viewer("late");
    there.add_child(late).await.unwrap();
    there.advance(100 * MS).await;
    assert_eq!((numbers(&seen), numbers(&seen_late)), (vec![1], vec![1]));

    let images = here.publisher::<Image>("camera/image").unwrap();
    images.matched_at_least(1).await;
    seen.take();
    images.publish(Image(1)).unwrap();
    there.advance(20 * MS).await;
    let ago = |millis: u64| Instant::from_nanos(now().as_nanos() - millis * 1_000_000);
    images.publish_captured_at(Image(2), ago(60)).unwrap();
    let late = ago(95);
    images.publish_captured_at(Image(3), late).unwrap();
    there.advance(20 * MS).await;
    images.publish_captured_at(Image(4), late).unwrap();
    there.advance(20 * MS).await;
    assert_eq!(numbers(&seen), [1, 2, 3], "the fourth was 115 ms old");
}

/// Publishes ten times a second.
struct Camera;

impl Component for Camera {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.publish(Image(0));
        Ok(())
    }
}

#[blastema_testkit::test]
async fn a_topic_shows_its_rate_its_size_who_publishes_and_who_listens() {
    let camera = ChildSpec::new("camera", || Camera).rate_hz(10.0);
    let builder = Node::builder("module1").child(camera).child(viewer("viewer").0);
    let node = TestNode::start(builder).await;
    let _kept = node.publisher::<Image>("camera/image").unwrap();
    node.topics();

    node.advance(Duration::from_secs(10)).await;

    let row = row_of(&node, "camera/image");
    assert_eq!(
        (row.contract.as_str(), row.latched, row.listening_nodes.len()),
        ("camera/image", false, 0)
    );
    assert_eq!(row.listeners, ["viewer".parse().unwrap()]);
    assert_eq!(row.publishers, ["camera", "module1"]);
    assert!((9.0..=11.0).contains(&row.rate_hz), "{row:?}");
    assert_eq!(row.bytes, Some(1));
    let picture = node.snapshot().await;
    assert!(picture.contains(r#""topics":[{"#), "{picture}");
}

#[blastema_testkit::test]
async fn a_publisher_of_another_contract_than_the_listeners_of_its_topic_is_refused() {
    let node = TestNode::start(Node::builder("module1").child(viewer("viewer").0)).await;

    let refused = node.publisher::<Map>("camera/image").expect_err("it carries images");
    assert!(matches!(refused, DeliveryError::ContractDiffers { .. }), "{refused:?}");
    let told = refused.to_string();
    let both = ["\"camera/image\"", "`camera/image` version 1", "`map` version 1", "viewer"];
    both.iter().for_each(|part| assert!(told.contains(part), "{part} is missing in {told}"));

    // A listener to another contract is refused likewise.
    let _plans = node.publisher::<Map>("plan").expect("it is new");
    let told = node.add_child(planner()).await.expect_err("it carries maps").to_string();
    let both = ["\"plan\"", "`camera/image` version 1", "`map` version 1", "module1"];
    both.iter().for_each(|part| assert!(told.contains(part), "{part} is missing in {told}"));
}

/// Listens to images on a topic that may carry something else.
fn planner() -> ChildSpec<Part<(), Image>> {
    listens("planner", "plan", (), |_, _, _| {})
}

#[blastema_testkit::test]
async fn a_topic_that_two_nodes_give_different_contracts_is_a_fault_on_both() {
    for publishes_first in [true, false] {
        let (mut here, mut there) = two_nodes(&MemoryMedium::default()).await;
        let plans = if publishes_first {
            let plans = here.publisher::<Map>("plan").unwrap();
            there.add_child(planner()).await.unwrap();
            plans
        } else {
            there.add_child(planner()).await.unwrap();
            there.advance(100 * MS).await;
            let plans = here.publisher::<Map>("plan").unwrap();
            assert_eq!(plans.matched(), 0, "at no time");
            plans
        };
        if publishes_first {
            plans.publish(Map(1)).unwrap();
        }

        // Without an event too: who waits for a listener would wait for this one.
        for node in [&mut here, &mut there] {
            let fault = node.await_fault(FaultKind::ContractMismatch, "net/stack").await;
            let parts = ["\"plan\"", "`map` version 1", "`camera/image` version 1"];
            for part in parts.into_iter().chain(["module1", "module2"]) {
                assert!(fault.detail.contains(part), "{part} is missing in {}", fault.detail);
            }
        }
        assert_eq!(plans.matched(), 0);
    }
}

#[blastema_testkit::test]
async fn a_mismatch_of_contracts_is_over_when_the_other_node_comes_back_without_it() {
    let medium = MemoryMedium::default();
    let (mut here, there) = two_nodes(&medium).await;
    let _plans = here.publisher::<Map>("plan").unwrap();
    there.add_child(planner()).await.unwrap();
    here.await_fault(FaultKind::ContractMismatch, "net/stack").await;
    let stands = async |node: &Node| {
        let record = node.faults().await;
        let mut mismatches =
            record.entries.iter().filter(|entry| entry.fault.kind == FaultKind::ContractMismatch);
        mismatches.any(|entry| entry.stands())
    };
    there.shutdown().await;
    assert!(stands(&here).await);

    let there = TestNode::start(on_ethernet("module2", "module1", &medium)).await;
    assert!(here.connected("module2", Duration::from_secs(10)).await);
    there.advance(1000 * MS).await;

    assert!(!stands(&here).await);
}

#[blastema_testkit::test]
async fn the_name_of_a_topic_obeys_the_rule_for_names_of_objects() {
    let node = TestNode::start(Node::builder("module1")).await;

    for name in ["", "a b!", "camera//image", "../image", "-image", &"n".repeat(129)] {
        let refused = node.publisher::<Map>(name).expect_err(name).to_string();
        assert!(refused.contains("name of a topic"), "{refused}");
    }
    let told = node.publisher::<Map>("a b!").unwrap_err().to_string();
    assert!(told.contains("\"a b!\"") && told.contains("letters, digits"), "{told}");
    let wrong = listens("wrong", "camera//image", (), |_, _: Image, _| {});
    let told = node.add_child(wrong).await.unwrap_err().to_string();
    assert!(told.contains("wrong") && told.contains("camera//image"), "{told}");
}

const SIX: [&str; 6] = ["six/a", "six/b", "six/c", "six/d", "six/e", "six/f"];

#[blastema_testkit::test]
async fn a_node_that_is_connected_has_told_what_it_listens_to() {
    for _ in 0..20 {
        let medium = MemoryMedium::default();
        let here = TestNode::start(on_ethernet("module1", "module2", &medium)).await;
        let publishers = SIX.map(|topic| here.publisher::<Image>(topic).unwrap());
        let seen = Notes::<u32>::default();
        let listener = part("listener", seen.clone(), |seen, Image(n), _| seen.note(n));
        let listener = listener.with_ports(|ports| {
            for topic in SIX {
                ports.listen::<Image>().on(topic);
            }
        });
        let there = on_ethernet("module2", "module1", &medium).child(listener);
        let there = TestNode::start(there).await;
        assert!(here.connected("module2", 10_000 * MS).await);
        for (publisher, number) in publishers.iter().zip(0..) {
            publisher.publish(Image(number)).unwrap();
        }
        here.advance(1000 * MS).await;
        let mut heard = seen.all();
        heard.sort();
        assert_eq!(heard, [0, 1, 2, 3, 4, 5]);
        drop((here, there));
    }
}
