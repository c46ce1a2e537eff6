//! Publishing and listening, across deaths.

use crate::scenarios::puppet::{Deed, News, Strings, ask, incarnation, strike};
use blastema::SpecError;
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::prelude::*;
use blastema_testkit::{Harness, TestNode};
use std::time::Duration;

#[blastema_testkit::test]
async fn a_condition_decides_before_anything_is_queued() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("ear"))).await;
    let news = node.publisher::<News>("test/news").unwrap();

    (1..=4).for_each(|n| news.publish(News(n)).unwrap());
    node.settle().await;

    assert_eq!(strings.lines("news"), ["ear#1 news 1", "ear#1 news 3"]);
}

#[blastema_testkit::test]
async fn subscriptions_return_with_the_next_incarnation_and_end_with_the_last() {
    let strings = Strings::default();
    let builder = Node::builder("module1").child(strings.spec("mouth")).child(strings.spec("ear"));
    let mut node = TestNode::start(builder).await;

    for n in [1, 3, 5] {
        ask(&node, "mouth", Deed::Publish(n)).await.unwrap();
        node.settle().await;
        strike(&node, "ear").await;
        node.await_recovered(FaultKind::Panic, "ear").await;
    }

    let heard: Vec<_> = strings.lines("news").into_iter().filter(|l| l.contains("ear")).collect();
    assert_eq!(heard, ["ear#1 news 1", "ear#2 news 3", "ear#3 news 5"]);
    node.remove_child("ear").await.unwrap();
    ask(&node, "mouth", Deed::Publish(7)).await.unwrap();
    node.settle().await;
    assert_eq!(strings.lines("news"), ["mouth#1 news 7"]);
}

#[blastema_testkit::test]
async fn an_event_that_comes_while_the_listener_is_busy_waits_in_its_queue() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("ear"))).await;
    let news = node.publisher::<News>("test/news").unwrap();

    node.sender("ear").unwrap().tell(crate::scenarios::puppet::Do(Deed::Await(500))).unwrap();
    node.settle().await;
    [1, 3].into_iter().for_each(|n| news.publish(News(n)).unwrap());
    node.advance(Duration::from_millis(499)).await;
    assert_eq!(strings.lines("news"), [""; 0]);
    node.advance(Duration::from_millis(1)).await;

    assert_eq!(strings.lines("news"), ["ear#1 news 1", "ear#1 news 3"]);
}

#[blastema_testkit::test]
async fn an_event_whose_condition_panics_is_a_dead_letter_of_its_listener() {
    let strings = Strings::default();
    let mut node = TestNode::start(Node::builder("module1").child(strings.spec("ear"))).await;
    let news = node.publisher::<News>("test/news").unwrap();

    [11, 13, 15].into_iter().for_each(|n| news.publish(News(n)).unwrap());
    node.await_recovered(FaultKind::Panic, "ear").await;
    node.settle().await;

    assert_eq!(strings.lines("news"), ["ear#1 news 11", "ear#2 news 15"]);
    let ear = "ear".parse().unwrap();
    assert_eq!(node.dead_letters().count(&ear, DeadReason::PeerDied), 1);
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "test/fresh", max_age = "100ms")]
struct Fresh(u32);

/// Takes its time for each.
struct Slow;

impl Component for Slow {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Fresh>();
    }
}

impl Handle<Fresh> for Slow {
    async fn handle(&mut self, fresh: Fresh, cx: &mut Context<Self>) {
        tokio::time::sleep(Duration::from_millis(80)).await;
        cx.publish(fresh);
    }
}

#[blastema_testkit::test]
async fn what_has_grown_too_old_in_a_queue_is_counted_and_not_delivered() {
    let spec = ChildSpec::new("slow", || Slow);
    let mut slow = Harness::start(spec).await;
    let served = slow.listen::<Fresh>().await;

    (1..=4).for_each(|n| slow.tell(Fresh(n)).unwrap());
    slow.advance(Duration::from_secs(1)).await;

    assert_eq!(served.drain(), [Fresh(1), Fresh(2)]);
    let letters = slow.dead_letters();
    assert_eq!(letters.count(&"slow".parse().unwrap(), DeadReason::Expired), 2);
}

#[blastema_testkit::test]
async fn an_object_can_listen_to_itself() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("ear"))).await;

    ask(&node, "ear", Deed::Publish(1)).await.unwrap();
    node.settle().await;

    assert_eq!(strings.lines("news"), ["ear#1 news 1"]);
    assert_eq!(incarnation(&node, "ear").await, 1);
}

/// What `News` might be in another part of the program.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/news")]
struct OtherNews {
    text: String,
}

#[derive(Clone, Debug, Event)]
struct Speak;

/// Publishes what others know as something else.
struct Stranger;

impl Component for Stranger {}

impl Handle<Speak> for Stranger {
    async fn handle(&mut self, _: Speak, cx: &mut Context<Self>) {
        cx.publish(OtherNews { text: "hello".into() });
    }
}

#[blastema_testkit::test]
async fn who_publishes_what_a_topic_does_not_carry_is_found_and_nobody_gets_it() {
    let strings = Strings::default();
    let node = TestNode::start(Node::builder("module1").child(strings.spec("ear"))).await;
    let spec = ChildSpec::new("stranger", || Stranger);
    let mut stranger = Harness::within(node, spec).await;

    stranger.tell(Speak).unwrap();
    let fault = stranger.await_fault(FaultKind::ContractMismatch, "stranger").await;

    assert!(fault.detail.contains("test/news"), "{}", fault.detail);
    assert_eq!(strings.lines("news"), [""; 0]);
    assert!(stranger.publisher::<OtherNews>("test/news").is_err());
    assert!(stranger.publisher::<OtherNews>("other/news").is_ok(), "another topic may carry it");
}

/// Listens twice to one topic, under its own name and under that of its contract.
struct Twice;

impl Component for Twice {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Fresh>().only_if(|fresh| fresh.0 > 1);
        ports.listen::<Fresh>().on("other/fresh");
        ports.listen::<Fresh>().on("test/fresh");
    }
}

impl Handle<Fresh> for Twice {
    async fn handle(&mut self, _: Fresh, _: &mut Context<Self>) {}
}

#[blastema_testkit::test]
async fn a_component_that_listens_twice_to_one_topic_is_refused() {
    let node = TestNode::start(Node::builder("module1")).await;

    let refused = node.add_child(ChildSpec::new("twice", || Twice)).await;

    let why = refused.expect_err("each event would come twice");
    assert!(matches!(&why, SpecError::ListenTwice { topic, .. } if topic == "test/fresh"), "{why}");
    assert!(why.to_string().contains("write one `listen`"), "{why}");
}

/// Awaits what a task of its own tells it.
struct Awaiting(tokio::sync::mpsc::UnboundedSender<u32>);

impl Component for Awaiting {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<News>().on("test/news");
    }
}

impl Handle<News> for Awaiting {
    async fn handle(&mut self, News(n): News, cx: &mut Context<Self>) {
        let (tell, told) = tokio::sync::oneshot::channel();
        cx.spawn(async move { tell.send(n).expect("the handler awaits it") });
        self.0.send(told.await.unwrap()).unwrap();
    }
}

#[blastema_testkit::test]
async fn what_a_handler_starts_and_awaits_runs_though_an_event_began_it() {
    let (sender, mut told) = tokio::sync::mpsc::unbounded_channel();
    let awaiting = ChildSpec::new("awaiting", move || Awaiting(sender.clone()));
    let node = TestNode::start(Node::builder("module1").child(awaiting)).await;

    node.publisher::<News>("test/news").unwrap().publish(News(1)).unwrap();
    node.settle().await;

    assert_eq!(told.try_recv(), Ok(1));
}
