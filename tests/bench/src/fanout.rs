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
/// Deliveries to all listeners together.
const ALL: u64 = EVENTS * LISTENERS as u64;
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

struct Ear;
impl Component for Ear {}
impl Handle<Reading> for Ear {
    async fn handle(&mut self, reading: Reading, _: &mut Context<Self>) {
        take(&reading);
    }
}

/// A listener to the topic `plain`, or to `always` by a condition that is always true.
fn ear(topic: &'static str, number: usize) -> ChildSpec<Ear> {
    let ear = ChildSpec::new(&format!("{topic}/{number}"), || Ear).queue(512, WhenFull::Refuse);
    ear.with_ports(move |ports| {
        let listening = ports.listen::<Reading>().on(topic);
        if topic == "always" {
            listening.only_if(|reading| black_box(reading.key) != u64::MAX);
        }
    })
}

/// After so long without a delivery, what is missing was dropped.
const STALLED: Duration = Duration::from_secs(10);

/// Publishes all events and waits until all deliveries were made.
async fn measure(burst: u64, mut publish: impl FnMut(&Reading)) -> f64 {
    let data = Arc::new(vec![1u8; 64]);
    RECEIVED.set(0);
    let start = Instant::now();
    for key in 0..EVENTS {
        publish(&Reading { key, data: data.clone() });
        if key % burst == 0 {
            yield_now().await;
            // The queues of listeners that are further behind could not take another burst.
            let behind = |due: u64| due.saturating_sub(RECEIVED.get()) > BEHIND * LISTENERS as u64;
            while behind((key + 1) * LISTENERS as u64) {
                yield_now().await;
            }
        }
    }
    let (mut received, mut since) = (0, Instant::now());
    while RECEIVED.get() < ALL {
        yield_now().await;
        if RECEIVED.get() > received {
            (received, since) = (RECEIVED.get(), Instant::now());
        }
        let waited = since.elapsed();
        assert!(
            waited < STALLED,
            "{received} of {ALL} deliveries were made: queues dropped events on a busy computer; run it again"
        );
    }
    EVENTS as f64 / start.elapsed().as_secs_f64()
}

pub(crate) async fn run(rounds: usize) {
    let mut builder = Node::builder("fanout").on_this_thread();
    for number in 0..LISTENERS {
        for topic in ["plain", "always"] {
            builder = builder.child(ear(topic, number));
        }
    }
    let node = builder.start().await.expect("a node of listeners starts");
    let topic = |name: &str| node.publisher::<Reading>(name).expect("the name parses");
    let (plain, always) = (topic("plain"), topic("always"));
    let bare: Rc<Vec<Recipient<Reading>>> =
        Rc::new((0..LISTENERS).map(|_| Bare.start().recipient()).collect());
    for burst in [256, 1] {
        let title = format!("fan-out to 100, the publisher yields after every {burst}");
        let mut table = Table::new(title, "events/s");
        for _ in 0..rounds {
            let to_bare = |reading: &Reading| bare.iter().for_each(|b| b.do_send(reading.clone()));
            table.add("bare actix recipients", measure(burst, to_bare).await);
            let row = measure(burst, |reading| drop(plain.publish(reading.clone()))).await;
            table.add("topic, no condition", row);
            let row = measure(burst, |reading| drop(always.publish(reading.clone()))).await;
            table.add("topic, a condition that is always true", row);
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
