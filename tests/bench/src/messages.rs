//! Tell and ask between local components, beside bare actix.

use crate::measure::Table;
use actix::prelude::{Actor, AtomicResponse, Handler, Message, WrapFuture};
use actix::{ActorFutureExt, Addr, Arbiter};
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

/// Asks for the sum, later.
#[derive(Clone, Debug, Request)]
#[contract(reply = u64)]
struct Later(u64);

impl Message for Add {
    type Result = ();
}
impl Message for Sum {
    type Result = u64;
}
impl Message for Later {
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
impl Handler<Later> for Bare {
    type Result = AtomicResponse<Self, u64>;
    fn handle(&mut self, message: Later, _: &mut Self::Context) -> Self::Result {
        AtomicResponse::new(Box::pin(yield_now().into_actor(self).map(move |(), bare, _| {
            bare.0 = bare.0.wrapping_add(message.0);
            bare.0
        })))
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
impl Handle<Later> for Ours {
    async fn handle(&mut self, message: Later, _: &mut Context<Self>) -> u64 {
        yield_now().await;
        self.0 = self.0.wrapping_add(message.0);
        self.0
    }
}

/// Messages before the publisher lets the others have their turn: less than the queue holds.
const BURST: u64 = 256;
const TELLS: u64 = 200_000;
const ASKS: u64 = 20_000;
const FAR_ASKS: u64 = 4_000;

fn each(start: Instant, count: u64) -> f64 {
    start.elapsed().as_nanos() as f64 / count as f64
}

async fn tell_bare(bare: &Addr<Bare>, yields: bool) -> f64 {
    let start = Instant::now();
    for number in 0..TELLS {
        bare.do_send(Add(number));
        if yields && number % BURST == 0 {
            yield_now().await;
        }
    }
    bare.send(Sum(0)).await.expect("the bare actor lives");
    each(start, TELLS)
}

async fn tell_ours(ours: &ActorRef<Ours>, yields: bool) -> f64 {
    let start = Instant::now();
    for number in 0..TELLS {
        let mut message = Add(number);
        // A turn of the component may end before it has served a whole burst.
        while let Err(refused) = ours.tell(message) {
            message = refused.message;
            yield_now().await;
        }
        if yields && number % BURST == 0 {
            yield_now().await;
        }
    }
    ours.ask(Sum(0)).await.expect("the component lives");
    each(start, TELLS)
}

macro_rules! asks {
    ($count:expr, $callee:expr, $call:ident, $message:ident) => {{
        let start = Instant::now();
        for number in 0..$count {
            $callee.$call($message(number)).await.expect("the callee lives");
        }
        each(start, $count)
    }};
}

async fn ask_bare_in_time(bare: &Addr<Bare>) -> f64 {
    let start = Instant::now();
    for number in 0..ASKS {
        let reply = tokio::time::timeout(Duration::from_secs(1), bare.send(Sum(number))).await;
        reply.expect("in time").expect("the bare actor lives");
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
    let mut borrow = Table::new("ask, the handler awaits once and borrows self across it", "ns");
    for _ in 0..rounds {
        tell.add("bare actix do_send", tell_bare(&bare, true).await);
        tell.add("component, tell", tell_ours(&ours, true).await);
        ask.add("bare actix send", asks!(ASKS, bare, send, Sum));
        ask.add("bare actix send, tokio timeout of 1 s", ask_bare_in_time(&bare).await);
        ask.add("component, ask with its deadline of 1 s", asks!(ASKS, ours, ask, Sum));
        borrow.add("bare actix AtomicResponse", asks!(ASKS, bare, send, Later));
        borrow.add("component, async handler", asks!(ASKS, ours, ask, Later));
    }
    tell.print();
    ask.print();
    borrow.print();
    near.shutdown().await;

    let arbiter = Arbiter::new();
    let far_bare = Bare::start_in_arbiter(&arbiter.handle(), |_| Bare(0));
    let far = Node::builder("far")
        .child(ChildSpec::new("ours", || Ours(0)).queue(1 << 20, WhenFull::Refuse).on_own_thread())
        .start()
        .await
        .expect("a node of one component starts");
    let far_ours = far.actor::<Ours>("ours").expect("it was just started");
    let mut tell = Table::new("tell, across threads", "ns");
    let mut ask = Table::new("ask, across threads", "ns");
    for _ in 0..rounds {
        tell.add("bare actix do_send", tell_bare(&far_bare, false).await);
        tell.add("component, tell", tell_ours(&far_ours, false).await);
        ask.add("bare actix send", asks!(FAR_ASKS, far_bare, send, Sum));
        ask.add("component, ask with its deadline of 1 s", asks!(FAR_ASKS, far_ours, ask, Sum));
    }
    tell.print();
    ask.print();
    far.shutdown().await;
    arbiter.stop();
}
