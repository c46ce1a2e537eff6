//! Events to a hundred listeners, beside bare actix recipients.

use crate::measure::Table;
use actix::Recipient;
use actix::prelude::{Actor, Handler, Message};
use blastema::prelude::*;
use std::cell::Cell;
use std::hint::black_box;
use std::rc::Rc;
use std::sync::Arc;
use std::time::{Duration, Instant};
use tokio::task::yield_now;

const LISTENERS: usize = 100;
const EVENTS: u64 = 4_096;
/// Events that a listener may be behind before more are published: half of its queue.
const BEHIND: u64 = 256;

/// An event of 64 bytes that are shared, not copied.
#[derive(Clone, Debug, Event)]
struct Reading {
    key: u64,
    data: Arc<Vec<u8>>,
}

impl Message for Reading {
    type Result = ();
}

thread_local! {
    static RECEIVED: Cell<u64> = const { Cell::new(0) };
}

fn take(reading: &Reading) {
    RECEIVED.set(RECEIVED.get() + u64::from(black_box(reading.data[0])));
}

struct Bare;

impl Actor for Bare {
    type Context = actix::Context<Self>;
}
impl Handler<Reading> for Bare {
    type Result = ();
    fn handle(&mut self, reading: Reading, _: &mut Self::Context) {
        take(&reading);
    }
}

struct Plain;
impl Component for Plain {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Reading>().on("plain");
    }
}
impl Handle<Reading> for Plain {
    async fn handle(&mut self, reading: Reading, _: &mut Context<Self>) {
        take(&reading);
    }
}

struct Always;
impl Component for Always {
    fn ports(ports: &mut Ports<Self>) {
        ports
            .listen::<Reading>()
            .on("always")
            .only_if(|reading| black_box(reading.key) != u64::MAX);
    }
}
impl Handle<Reading> for Always {
    async fn handle(&mut self, reading: Reading, _: &mut Context<Self>) {
        take(&reading);
    }
}

struct Tenth;
impl Component for Tenth {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Reading>().on("tenth").only_if(|reading| reading.key % 10 == 0);
    }
}
impl Handle<Reading> for Tenth {
    async fn handle(&mut self, reading: Reading, _: &mut Context<Self>) {
        take(&reading);
    }
}

/// After so long without a delivery, what is missing was dropped.
const STALLED: Duration = Duration::from_secs(10);

/// Publishes all events and waits until `expected` deliveries were made.
async fn measure(burst: u64, expected: u64, mut publish: impl FnMut(&Reading)) -> f64 {
    let data = Arc::new(vec![1u8; 64]);
    RECEIVED.set(0);
    let start = Instant::now();
    for key in 0..EVENTS {
        publish(&Reading { key, data: data.clone() });
        if key % burst == 0 {
            yield_now().await;
            // The queues of listeners that are further behind could not take another burst.
            let behind = |due: u64| due.saturating_sub(RECEIVED.get()) > BEHIND * LISTENERS as u64;
            while behind((key + 1) * expected / EVENTS) {
                yield_now().await;
            }
        }
    }
    let (mut received, mut since) = (0, Instant::now());
    while RECEIVED.get() < expected {
        yield_now().await;
        if RECEIVED.get() > received {
            (received, since) = (RECEIVED.get(), Instant::now());
        }
        let waited = since.elapsed();
        assert!(
            waited < STALLED,
            "{received} of {expected} deliveries were made: queues dropped events on a busy computer; run it again"
        );
    }
    EVENTS as f64 / start.elapsed().as_secs_f64()
}

pub(crate) async fn run(rounds: usize) {
    let mut builder = Node::builder("fanout").on_this_thread();
    for number in 0..LISTENERS {
        builder = builder
            .child(
                ChildSpec::new(&format!("plain/{number}"), || Plain).queue(512, WhenFull::Refuse),
            )
            .child(
                ChildSpec::new(&format!("always/{number}"), || Always).queue(512, WhenFull::Refuse),
            )
            .child(
                ChildSpec::new(&format!("tenth/{number}"), || Tenth).queue(512, WhenFull::Refuse),
            );
    }
    let node = builder.start().await.expect("a node of listeners starts");
    let topic = |name: &str| node.publisher::<Reading>(name).expect("the name parses");
    let (plain, always, tenth) = (topic("plain"), topic("always"), topic("tenth"));
    let bare: Rc<Vec<Recipient<Reading>>> =
        Rc::new((0..LISTENERS).map(|_| Bare.start().recipient()).collect());
    let all = EVENTS * LISTENERS as u64;
    let some = EVENTS.div_ceil(10) * LISTENERS as u64;
    for burst in [256, 1] {
        let title = format!("fan-out to 100, the publisher yields after every {burst}");
        let mut table = Table::new(title, "events/s");
        for _ in 0..rounds {
            let to_bare = |reading: &Reading| bare.iter().for_each(|b| b.do_send(reading.clone()));
            table.add("bare actix recipients", measure(burst, all, to_bare).await);
            let row = measure(burst, all, |reading| drop(plain.publish(reading.clone()))).await;
            table.add("topic, no condition", row);
            let row = measure(burst, all, |reading| drop(always.publish(reading.clone()))).await;
            table.add("topic, a condition that is always true", row);
            let row = measure(burst, some, |reading| drop(tenth.publish(reading.clone()))).await;
            table.add("topic, a condition true for 1 in 10", row);
        }
        table.print();
        let with = table.ratio("topic, a condition that is always true");
        let without = table.ratio("topic, no condition");
        println!(
            "a condition that is always true takes {:.1} % of a delivery",
            (without / with - 1.0) * 100.0
        );
    }
    node.shutdown().await;
}
