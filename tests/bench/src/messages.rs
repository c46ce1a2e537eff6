//! Tell and ask between local components, beside bare actix.

use crate::measure::Table;
use actix::Addr;
use actix::prelude::{Actor, Handler, Message};
use blastema::prelude::*;
use std::time::{Duration, Instant};
use tokio::task::yield_now;

/// Adds without an answer.
#[derive(Clone, Debug, Event)]
struct Add(u64);

/// Asks for the sum.
#[derive(Clone, Debug, Request)]
#[contract(reply = u64)]
struct Sum(u64);

impl Message for Add {
    type Result = ();
}
impl Message for Sum {
    type Result = u64;
}

struct Bare(u64);

impl Actor for Bare {
    type Context = actix::Context<Self>;
}
impl Handler<Add> for Bare {
    type Result = ();
    fn handle(&mut self, message: Add, _: &mut Self::Context) {
        self.0 = self.0.wrapping_add(message.0);
    }
}
impl Handler<Sum> for Bare {
    type Result = u64;
    fn handle(&mut self, message: Sum, _: &mut Self::Context) -> u64 {
        self.0.wrapping_add(message.0)
    }
}

struct Ours(u64);

impl Component for Ours {}
impl Handle<Add> for Ours {
    async fn handle(&mut self, message: Add, _: &mut Context<Self>) {
        self.0 = self.0.wrapping_add(message.0);
    }
}
impl Handle<Sum> for Ours {
    async fn handle(&mut self, message: Sum, _: &mut Context<Self>) -> u64 {
        self.0.wrapping_add(message.0)
    }
}

/// Messages before the publisher lets the others have their turn: less than the queue holds.
const BURST: u64 = 256;
const TELLS: u64 = 200_000;
const ASKS: u64 = 20_000;

fn each(start: Instant, count: u64) -> f64 {
    start.elapsed().as_nanos() as f64 / count as f64
}

async fn tell_bare(bare: &Addr<Bare>) -> f64 {
    let start = Instant::now();
    for number in 0..TELLS {
        bare.do_send(Add(number));
        if number % BURST == 0 {
            yield_now().await;
        }
    }
    bare.send(Sum(0)).await.expect("the bare actor lives");
    each(start, TELLS)
}

async fn tell_ours(ours: &ActorRef<Ours>) -> f64 {
    let start = Instant::now();
    for number in 0..TELLS {
        let mut message = Add(number);
        // A turn of the component may end before it has served a whole burst.
        while let Err(refused) = ours.tell(message) {
            message = refused.message;
            yield_now().await;
        }
        if number % BURST == 0 {
            yield_now().await;
        }
    }
    ours.ask(Sum(0)).await.expect("the component lives");
    each(start, TELLS)
}

async fn asks(ask: impl AsyncFn(Sum) -> u64) -> f64 {
    let start = Instant::now();
    for number in 0..ASKS {
        ask(Sum(number)).await;
    }
    each(start, ASKS)
}

pub(crate) async fn run(rounds: usize) {
    let near = Node::builder("near")
        .on_this_thread()
        .child(ChildSpec::new("ours", || Ours(0)).queue(512, WhenFull::Refuse))
        .start()
        .await
        .expect("a node of one component starts");
    let ours = near.actor::<Ours>("ours").expect("it was just started");
    let bare = Bare(0).start();

    let mut tell = Table::new("tell, same thread", "ns");
    let mut ask = Table::new("ask, same thread", "ns");
    let bare_ask = async |sum| bare.send(sum).await.expect("the bare actor lives");
    let bare_ask_in_time = async |sum| {
        let reply = tokio::time::timeout(Duration::from_secs(1), bare.send(sum)).await;
        reply.expect("in time").expect("the bare actor lives")
    };
    let our_ask = async |sum| ours.ask(sum).await.expect("the component lives");
    for _ in 0..rounds {
        tell.add("bare actix do_send", tell_bare(&bare).await);
        tell.add("component, tell", tell_ours(&ours).await);
        ask.add("bare actix send", asks(bare_ask).await);
        ask.add("bare actix send, tokio timeout of 1 s", asks(bare_ask_in_time).await);
        ask.add("component, ask with its deadline of 1 s", asks(our_ask).await);
    }
    tell.print();
    ask.print();
    near.shutdown().await;
}
