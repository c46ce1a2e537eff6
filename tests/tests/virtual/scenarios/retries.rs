//! Requests that are asked again, by themselves or by a rule, of components here and elsewhere.

use blastema::core::recovery::Backoff;
use blastema::prelude::*;
use blastema::{MemoryMedium, RetryPolicy, ServiceSpec, StandbyKind, Stateful};
use blastema_testkit::{TestNode, now};
use blastema_tests::{MS, on_ethernet};
use std::sync::Arc;
use std::sync::atomic::AtomicU32;
use std::sync::atomic::Ordering::Relaxed;

/// Sets a value; kills as many incarnations as it is told to, first.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u32, idempotent)]
struct Set {
    value: u32,
    kills: u32,
}

/// The same, and may not be done twice.
#[derive(Clone, Debug, PartialEq, Request)]
#[contract(reply = u32)]
struct Book {
    value: u32,
    kills: u32,
}

/// Takes its time.
#[derive(Clone, Debug, Event)]
struct Dawdle;

/// Dies until it has died often enough, and counts how often it was asked.
#[derive(Clone, Default)]
struct Shelf(Arc<AtomicU32>);

impl Shelf {
    fn put(&self, value: u32, kills: u32) -> u32 {
        let asked = self.0.fetch_add(1, Relaxed);
        assert!(asked >= kills, "it falls off the shelf");
        value
    }
}

impl Component for Shelf {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Set>().serve::<Book>().accept::<Dawdle>();
    }
}

impl Handle<Set> for Shelf {
    async fn handle(&mut self, Set { value, kills }: Set, _: &mut Context<Self>) -> u32 {
        self.put(value, kills)
    }
}

impl Handle<Book> for Shelf {
    async fn handle(&mut self, Book { value, kills }: Book, _: &mut Context<Self>) -> u32 {
        self.put(value, kills)
    }
}

impl Handle<Dawdle> for Shelf {
    async fn handle(&mut self, _: Dawdle, _: &mut Context<Self>) {
        tokio::time::sleep(100 * MS).await;
    }
}

impl Stateful for Shelf {
    fn save(&self) -> Vec<u8> {
        Vec::new()
    }

    fn load(&mut self, _: &[u8]) -> Result<(), Failure> {
        Ok(())
    }
}

/// A shelf at module1, and a node that asks it over a network.
async fn robot() -> (TestNode, TestNode, Shelf) {
    let (medium, shelf) = (MemoryMedium::default(), Shelf::default());
    let kept = shelf.clone();
    let spec = ChildSpec::new("shelf", move || kept.clone()).queue(2, WhenFull::Refuse);
    let one = TestNode::start(on_ethernet("module1", "module2", &medium).child(spec)).await;
    let two = TestNode::start(on_ethernet("module2", "module1", &medium)).await;
    two.advance(2000 * MS).await;
    (one, two, shelf)
}

#[blastema_testkit::test]
async fn what_may_be_done_twice_is_asked_of_the_next_incarnation_here_and_elsewhere() {
    let (one, two, shelf) = robot().await;
    for (node, name) in [(&one, "shelf"), (&two, "module1:shelf")] {
        shelf.0.store(0, Relaxed);
        let set: Sender<Set> = node.sender(name).unwrap();
        assert_eq!(set.ask(Set { value: 7, kills: 1 }).await.unwrap(), 7, "{name}");
        assert_eq!(shelf.0.load(Relaxed), 2, "{name}");

        shelf.0.store(0, Relaxed);
        let book: Sender<Book> = node.sender(name).unwrap();
        let died = book.ask(Book { value: 7, kills: 1 }).await.unwrap_err();
        assert!(matches!(died.kind, DeliveryError::PeerDied { .. }), "{name}: {died}");
        assert_eq!(shelf.0.load(Relaxed), 1, "{name}: it may have taken effect");
    }
}

#[blastema_testkit::test]
async fn a_request_that_kills_every_incarnation_is_quarantined_however_often_it_may_be_done() {
    let (one, two, shelf) = robot().await;
    for (node, name) in [(&one, "shelf"), (&two, "module1:shelf")] {
        shelf.0.store(0, Relaxed);
        let set: Sender<Set> = node.sender(name).unwrap();
        let refused = set.ask_within(Set { value: 7, kills: 99 }, 10_000 * MS).await.unwrap_err();
        assert_eq!(refused.kind, DeliveryError::Quarantined { kills: 3 }, "{name}");
        assert_eq!(shelf.0.load(Relaxed), 3, "{name}");
        node.advance(20_000 * MS).await;
    }
}

#[blastema_testkit::test]
async fn by_a_rule_what_was_not_taken_up_is_asked_again_within_its_deadline() {
    let (one, _two, _shelf) = robot().await;
    let (book, dawdle) = (one.sender::<Book>("shelf").unwrap(), one.sender("shelf").unwrap());
    let fill = async || {
        dawdle.tell(Dawdle).unwrap();
        one.settle().await;
        (0..2).for_each(|_| dawdle.tell(Dawdle).unwrap());
    };
    let backoff = Backoff { first: 10 * MS, factor: 1, limit: 10 * MS, jitter_percent: 0 };
    let rule = RetryPolicy { attempts: 100, backoff, within: 1000 * MS };

    fill().await;
    let start = now();
    assert_eq!(book.ask_by(Book { value: 3, kills: 0 }, &rule).await.unwrap(), 3);
    assert!(now() - start >= 200 * MS, "it had to wait for room, and for its turn");

    fill().await;
    let few = RetryPolicy { attempts: 3, ..rule };
    let start = now();
    let refused = book.ask_by(Book { value: 4, kills: 0 }, &few).await.unwrap_err();
    assert_eq!(
        (refused.kind, refused.message),
        (DeliveryError::Full, Some(Book { value: 4, kills: 0 }))
    );
    assert!((20 * MS..30 * MS).contains(&(now() - start)), "twice after ten milliseconds");

    let short = RetryPolicy { within: 25 * MS, ..rule };
    let late = book.ask_by(Book { value: 5, kills: 0 }, &short).await.unwrap_err();
    assert_eq!(late.kind, DeliveryError::Full, "the next attempt would be over too late");
}

#[blastema_testkit::test]
async fn a_service_is_asked_again_where_that_does_no_harm_even_with_cold_standbys() {
    for kind in [StandbyKind::Cold, StandbyKind::Warm, StandbyKind::Hot] {
        let shelf = Shelf::default();
        let kept = shelf.clone();
        let spec = ServiceSpec::new("shelf", ["module1"], move || kept.clone()).standby(kind);
        let node = TestNode::start(Node::builder("module1").service(spec)).await;
        node.advance(1000 * MS).await;
        let set = node.service::<Set>("shelf").unwrap();
        assert_eq!(set.ask(Set { value: 7, kills: 1 }).await.unwrap(), 7, "{kind:?}");

        shelf.0.store(0, Relaxed);
        let book = node.service::<Book>("shelf").unwrap();
        let died = book.ask(Book { value: 7, kills: 1 }).await.unwrap_err();
        assert!(matches!(died.kind, DeliveryError::PeerDied { .. }), "{kind:?}: {died}");
    }
}
