//! Publishing and listening, across deaths.

use crate::scenarios::puppet::{News, Strings};
use blastema::SpecError;
use blastema::core::delivery::dead_letters::DeadReason;
use blastema::prelude::*;
use blastema_testkit::{Harness, TestNode};
use blastema_tests::part;

#[blastema_testkit::test]
async fn an_event_whose_condition_panics_is_a_dead_letter_of_its_listener() {
    let (strings, mut node) = Strings::robot(["ear"]).await;
    let news = node.publisher::<News>("test/news").unwrap();

    [11, 13, 15].into_iter().for_each(|n| news.publish(News(n)).unwrap());
    node.await_recovered(FaultKind::Panic, "ear").await;
    node.settle().await;

    assert_eq!(strings.lines("news"), ["ear#1 news 11", "ear#2 news 15"]);
    let ear = "ear".parse().unwrap();
    assert_eq!(node.dead_letters().count(&ear, DeadReason::PeerDied), 1);
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "test/fresh")]
struct Fresh(u32);

/// What `News` might be in another part of the program.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/news")]
struct OtherNews {
    text: String,
}

#[derive(Clone, Debug, Event)]
struct Speak;

#[blastema_testkit::test]
async fn who_publishes_what_a_topic_does_not_carry_is_found_and_nobody_gets_it() {
    let (strings, node) = Strings::robot(["ear"]).await;
    let spec = part("stranger", (), |_, _: Speak, cx| {
        cx.publish(OtherNews { text: "hello".into() });
    });
    let mut stranger = Harness::within(node, spec).await;

    stranger.tell(Speak).unwrap();
    let fault = stranger.await_fault(FaultKind::ContractMismatch, "stranger").await;

    assert!(fault.detail.contains("test/news"), "{}", fault.detail);
    assert_eq!(strings.lines("news"), [""; 0]);
    assert!(stranger.publisher::<OtherNews>("test/news").is_err());
    assert!(stranger.publisher::<OtherNews>("other/news").is_ok(), "another topic may carry it");
}

#[blastema_testkit::test]
async fn a_component_that_listens_twice_to_one_topic_is_refused() {
    let node = TestNode::start(Node::builder("module1")).await;

    let twice = part("twice", (), |_, _: Fresh, _| {}).with_ports(|ports| {
        ports.listen::<Fresh>().only_if(|fresh| fresh.0 > 1);
        ports.listen::<Fresh>().on("other/fresh");
        ports.listen::<Fresh>().on("test/fresh");
    });
    let refused = node.add_child(twice).await;

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
