//! From a cut cable to the next reply, between two nodes with several cables.
//!
//! The cable that is in use is cut, at a random moment, and a request is made in the same instant:
//! its reply has come when the fault was found, another cable taken, and what was under way
//! repeated. Meanwhile a numbered stream goes the same way, of which nothing may be lost or
//! doubled. Cuts follow each other as fast as cables come back, so that nearly every one falls into
//! the second after another. `CUTS=n` sets how many there are of each kind.

use crate::measure::Quantiles;
use crate::process::addresses;
use blastema::core::net::LinkId;
use blastema::core::random::Random;
use blastema::prelude::*;
use blastema::{Cable, Direction, Link, LinkState, Network};
use std::net::SocketAddr;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

/// Cables that were cut must prove themselves before they count again; so many, and one is always
/// ready.
const CABLES: usize = 4;
const HELLO: Duration = Duration::from_millis(5);
const PACE: Duration = Duration::from_millis(1);
const PATIENCE: Duration = Duration::from_secs(30);

/// 64 bytes there and back.
#[derive(Clone, Debug, Request)]
#[contract(reply = Vec<u8>)]
struct Echo(Vec<u8>);

/// One of a numbered stream.
#[derive(Clone, Debug, Event)]
struct Parcel(u64);

/// Answers, and takes down what was lost or doubled of the stream.
#[derive(Clone, Default)]
struct Far(Arc<Mutex<Stream>>);

#[derive(Default)]
struct Stream {
    next: u64,
    lost: u64,
    doubled: u64,
}

impl Component for Far {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Echo>().accept::<Parcel>();
    }
}

impl Handle<Echo> for Far {
    async fn handle(&mut self, message: Echo, _: &mut Context<Self>) -> Vec<u8> {
        message.0
    }
}

impl Handle<Parcel> for Far {
    async fn handle(&mut self, Parcel(number): Parcel, _: &mut Context<Self>) {
        let mut stream = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if number < stream.next {
            stream.doubled += 1;
        } else {
            stream.lost += number - stream.next;
            stream.next = number + 1;
        }
    }
}

/// Two nodes and their cables.
struct Pair {
    near: Node,
    far: Node,
    cables: Vec<[Cable; 2]>,
    stream: Arc<Mutex<Stream>>,
}

impl Pair {
    async fn start() -> Pair {
        let at = addresses::<{ 2 * CABLES }>();
        let network = |number: usize, own: SocketAddr, name: &str, remote: SocketAddr| {
            let link = Link::new(name, remote).hello_every(HELLO);
            Network::udp(&format!("cable{number}"), own).link(link).with_faults(number as u64)
        };
        let (kept, mut near) = (Far::default(), Node::builder("near"));
        let stream = kept.0.clone();
        let spec = ChildSpec::new("far", move || kept.clone()).queue(8192, WhenFull::Wait);
        let mut far = Node::builder("far").child(spec);
        for (number, ends) in at.chunks(2).enumerate() {
            near = near.network(network(number, ends[0], "far", ends[1]));
            far = far.network(network(number, ends[1], "near", ends[0]));
        }
        let near = near.start().await.expect("the node starts");
        let far = far.start().await.expect("the node starts");
        let cable = |number: usize| {
            [&near, &far].map(|node| node.cable(&format!("cable{number}")).expect("it is faulty"))
        };
        let cables = (0..CABLES).map(cable).collect();
        assert!(near.connected("far", PATIENCE).await && far.connected("near", PATIENCE).await);
        Pair { near, far, cables, stream }
    }

    /// The cable that both ends use, once there is another that could take over at once.
    async fn cable_in_use(&self) -> usize {
        loop {
            let mut chosen = Vec::new();
            for node in [&self.near, &self.far] {
                let (routes, links) = (node.routes().await, node.links().await);
                let up = |link: &LinkId| {
                    links.get(usize::from(link.0)).is_some_and(|row| row.state == LinkState::Up)
                };
                let mut ready = routes.iter().filter(|route| {
                    // Where the alternate is in use already, the next one is still being sought.
                    route.alternate.as_ref().is_some_and(up) && route.chosen == Some(route.next)
                });
                chosen.extend(ready.next().map(|route| route.next));
            }
            if let [one, other] = chosen[..]
                && one == other
            {
                return usize::from(one.0);
            }
            tokio::time::sleep(PACE).await;
        }
    }

    async fn cuts(&self, echo: &Sender<Echo>, reported: bool, count: usize) -> Quantiles {
        let mut figures = Quantiles::default();
        // Any moment between two hellos is as likely.
        let mut chance = Random::new(1);
        for _ in 0..count {
            let cable = self.cable_in_use().await;
            tokio::time::sleep(Duration::from_micros(chance.below(10_000))).await;
            let start = Instant::now();
            self.cables[cable].iter().for_each(|end| end.cut(Direction::Both, reported));
            echo.ask_within(Echo(vec![7; 64]), PATIENCE).await.expect("another cable carries it");
            figures.add(start.elapsed());
            self.cables[cable].iter().for_each(Cable::restore);
        }
        figures
    }

    /// What came of a stream of so many.
    fn count(&self, sent: u64) {
        let Stream { next, lost, doubled } =
            *self.stream.lock().unwrap_or_else(PoisonError::into_inner);
        let lost = lost + sent.saturating_sub(next);
        println!("meanwhile {sent} messages sent: {lost} lost, {doubled} doubled");
    }
}

pub(crate) async fn run() {
    let count = std::env::var("CUTS").ok().and_then(|text| text.parse().ok()).unwrap_or(1000);
    let pair = Pair::start().await;
    let echo: Sender<Echo> = pair.near.sender("far:far").expect("the name parses");
    let parcels: Sender<Parcel> = pair.near.sender("far:far").expect("the name parses");
    while echo.ask(Echo(Vec::new())).await.is_err() {
        tokio::time::sleep(PACE).await;
    }
    let (stop, sent) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicU64::new(0)));
    let (told, counted) = (stop.clone(), sent.clone());
    let sending = tokio::task::spawn_local(async move {
        while !told.load(Relaxed) {
            let number = counted.load(Relaxed);
            if parcels.deliver(Parcel(number)).await.is_ok() {
                counted.store(number + 1, Relaxed);
            }
            tokio::time::sleep(PACE).await;
        }
    });
    println!(
        "\n## from a cut cable to the next reply, {CABLES} cables, hellos every {HELLO:?} (ms)"
    );
    let mut undisturbed = Quantiles::default();
    for _ in 0..count {
        let start = Instant::now();
        echo.ask(Echo(vec![7; 64])).await.expect("nothing is cut");
        undisturbed.add(start.elapsed());
        tokio::time::sleep(PACE).await;
    }
    undisturbed.print("no cut");
    pair.cuts(&echo, true, count).await.print("carrier cut (goal: p99 10)");
    pair.cuts(&echo, false, count).await.print("silent cut (goal: p99 25)");
    stop.store(true, Relaxed);
    sending.await.expect("it does not panic");
    // The last of the stream is at most one repetition behind.
    let start = Instant::now();
    let arrived = || pair.stream.lock().unwrap_or_else(PoisonError::into_inner).next;
    while arrived() < sent.load(Relaxed) && start.elapsed() < PATIENCE {
        tokio::time::sleep(PACE).await;
    }
    pair.count(sent.load(Relaxed));
    pair.near.shutdown().await;
    pair.far.shutdown().await;
}
