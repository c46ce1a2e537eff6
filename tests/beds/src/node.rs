//! One node of the bed: it sends to both others without pause, and takes down what comes.

use blastema::prelude::*;
use blastema::{Link, Network};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::{BufRead, Write as _};
use std::net::SocketAddr;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};
use tokio::sync::mpsc;

/// The pause between two messages of one stream: fast enough that some are under way at every
/// moment.
const PACE: Duration = Duration::from_millis(5);
/// How often links are looked at, to say when one changes.
const LOOK: Duration = Duration::from_millis(20);
/// Longer than any outage here lasts.
const PATIENCE: Duration = Duration::from_secs(30);

/// One of a numbered series, sent reliably.
#[derive(Clone, Debug, Event)]
#[contract(name = "bed/parcel")]
pub(crate) struct Parcel {
    pub(crate) from: String,
    pub(crate) number: u64,
}

/// One of a numbered series of requests; each takes effect once.
#[derive(Clone, Debug, Request)]
#[contract(name = "bed/order", reply = u64)]
pub(crate) struct Order {
    pub(crate) from: String,
    pub(crate) number: u64,
}

/// What came of one series.
#[derive(Debug, Default)]
struct Series {
    next: u64,
    lost: u64,
    doubled: u64,
    last: Option<Instant>,
    longest_gap: Duration,
}

impl Series {
    fn take(&mut self, number: u64) {
        if number < self.next {
            self.doubled += 1;
            return;
        }
        self.lost += number - self.next;
        self.next = number + 1;
        let now = Instant::now();
        let gap = self.last.map_or(Duration::ZERO, |last| now - last);
        self.last = Some(now);
        self.longest_gap = self.longest_gap.max(gap);
    }
}

/// Takes down what arrives, by the kind and the sender.
#[derive(Clone, Default)]
struct Ledger(Arc<Mutex<BTreeMap<(&'static str, String), Series>>>);

impl Ledger {
    fn lock(&self) -> MutexGuard<'_, BTreeMap<(&'static str, String), Series>> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Ledger {
    fn tell(&self) {
        let mut text = String::new();
        for ((kind, from), series) in self.lock().iter() {
            let Series { next, lost, doubled, longest_gap, .. } = series;
            let gap = longest_gap.as_millis();
            // Writing to a text does not fail.
            let _ = writeln!(text, "heard {kind} {from} {next} {lost} {doubled} {gap}");
        }
        say(&format!("{text}told"));
    }
}

impl Component for Ledger {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Parcel>();
        ports.serve::<Order>();
    }
}

impl Handle<Parcel> for Ledger {
    async fn handle(&mut self, Parcel { from, number }: Parcel, _: &mut Context<Self>) {
        self.lock().entry(("parcels", from)).or_default().take(number);
    }
}

impl Handle<Order> for Ledger {
    async fn handle(&mut self, Order { from, number }: Order, _: &mut Context<Self>) -> u64 {
        self.lock().entry(("orders", from)).or_default().take(number);
        number
    }
}

/// Writes a line to the process that started this one.
pub(crate) fn say(line: &str) {
    let mut out = std::io::stdout().lock();
    // If the reader has ended, standard input has ended, too.
    let _ = writeln!(out, "{line}").and_then(|()| out.flush());
}

/// Sends parcels until told to stop; answers how many.
async fn parcels(sender: Sender<Parcel>, from: String, stop: Arc<AtomicBool>) -> (u64, u64) {
    let mut number = 0;
    while !stop.load(Relaxed) {
        match sender.deliver(Parcel { from: from.clone(), number }).await {
            Ok(()) => number += 1,
            // It has come back, so it is sent again under the same number.
            Err(error) => say(&format!("refused parcel {number}: {}", error.kind)),
        }
        tokio::time::sleep(PACE).await;
    }
    (number, 0)
}

/// Asks until told to stop; answers how many were asked and how many of them failed.
async fn orders(sender: Sender<Order>, from: String, stop: Arc<AtomicBool>) -> (u64, u64) {
    let (mut number, mut failed) = (0, 0);
    while !stop.load(Relaxed) {
        match sender.ask_within(Order { from: from.clone(), number }, PATIENCE).await {
            Ok(echoed) if echoed == number => {}
            Ok(_) => failed += 1,
            Err(error) => {
                say(&format!("failed order {number}: {}", error.kind));
                failed += 1;
            }
        }
        number += 1;
        tokio::time::sleep(PACE).await;
    }
    (number, failed)
}

/// What the node is started with: its name, the medium, the interval of hellos, and its links as
/// `NAME OWN-ADDRESS NEIGHBOUR ITS-ADDRESS`.
pub(crate) fn describe(
    arguments: &[String],
) -> Result<(blastema::NodeBuilder, Vec<String>), String> {
    let [name, medium, hello_ms, links @ ..] = arguments else {
        return Err("NAME MEDIUM HELLO_MS (LINK OWN NEIGHBOUR REMOTE)...".into());
    };
    let address = |text: &str| -> Result<SocketAddr, String> {
        text.parse().map_err(|error| format!("{text}: {error}"))
    };
    let hello = Duration::from_millis(hello_ms.parse().map_err(|_| "HELLO_MS is a number")?);
    let mut builder = Node::builder(name);
    let mut neighbours = Vec::new();
    for link in links.chunks_exact(4) {
        let (own, remote) = (address(&link[1])?, address(&link[3])?);
        let network = match medium.as_str() {
            "udp" => Network::udp(&link[0], own),
            "tcp" => Network::tcp(&link[0], own),
            other => return Err(format!("no medium is called {other}")),
        };
        let link_to = Link::new(&link[2], remote).hello_every(hello);
        builder = builder.network(network.link(link_to).insecure());
        neighbours.push(link[2].clone());
    }
    neighbours.sort();
    neighbours.dedup();
    Ok((builder, neighbours))
}

/// The part of a node that takes down what comes, and where it stands.
fn ledger() -> (Ledger, ChildSpec<Ledger>) {
    let ledger = Ledger::default();
    let kept = ledger.clone();
    let spec = ChildSpec::new("ledger", move || kept.clone());
    // What an outage held back comes in one burst.
    (ledger, spec.queue(8192, WhenFull::Wait))
}

/// A node that only answers, until standard input ends.
pub(crate) async fn mirror(arguments: &[String]) -> Result<(), String> {
    let mut commands = commands();
    let (builder, _) = describe(arguments)?;
    let (ledger, spec) = ledger();
    let node = builder.child(spec).start().await.map_err(|error| error.to_string())?;
    say("ready");
    while commands.recv().await.is_some() {
        ledger.tell();
    }
    node.shutdown().await;
    Ok(())
}

/// Lines from the process that started this one; the channel ends when they do.
fn commands() -> mpsc::Receiver<String> {
    let (sender, receiver) = mpsc::channel(16);
    std::thread::spawn(move || {
        for line in std::io::stdin().lock().lines() {
            let Ok(line) = line else { return };
            if sender.blocking_send(line).is_err() {
                return;
            }
        }
    });
    receiver
}

async fn tell_faults(node: Node) {
    let mut events = node.fault_events();
    while let Some(event) = events.next().await {
        let turn = format!("{:?}", event.turn).to_lowercase();
        let turn = turn.split([' ', '{']).next().unwrap_or_default().to_owned();
        say(&format!("fault {turn} {} at {}", event.fault.kind, event.fault.location));
    }
}

/// Says how links and sessions are whenever that changes, and how many messages were accepted in
/// vain.
async fn tell_changes(node: Node) {
    let mut before: BTreeMap<String, String> = BTreeMap::new();
    let mut dead = 0;
    loop {
        let letters = node.dead_letters().total();
        if std::mem::replace(&mut dead, letters) != letters {
            say(&format!("dead letters {letters}: {:?}", node.dead_letters().counts()));
        }
        for row in node.sessions().await {
            let incarnation = format!("{:?}", row.status.incarnation);
            if before.insert(format!("with {}", row.node), incarnation.clone()).as_ref()
                != Some(&incarnation)
            {
                say(&format!("session with {} {incarnation}", row.node));
            }
        }
        for row in node.links().await {
            let state = row.state.to_string();
            if before.insert(row.link.to_string(), state.clone()).as_ref() != Some(&state) {
                say(&format!("link {} {state}", row.link));
            }
        }
        tokio::time::sleep(LOOK).await;
    }
}

/// Runs one node until standard input ends.
pub(crate) async fn run(arguments: &[String]) -> Result<(), String> {
    let mut commands = commands();
    let (builder, neighbours) = describe(arguments)?;
    let (ledger, spec) = ledger();
    let node = builder.child(spec).start().await.map_err(|error| error.to_string())?;
    tokio::task::spawn_local(tell_faults(node.clone()));
    tokio::task::spawn_local(tell_changes(node.clone()));

    let stop = Arc::new(AtomicBool::new(false));
    let mut streams = Vec::new();
    for neighbour in &neighbours {
        if !node.connected(neighbour, PATIENCE).await {
            return Err(format!("{} does not find {neighbour}", node.name()));
        }
    }
    for neighbour in neighbours {
        let (from, name) = (node.name().to_string(), format!("{neighbour}:ledger"));
        let sender = node.sender(&name).map_err(|why| why.to_string())?;
        let task = tokio::task::spawn_local(parcels(sender, from.clone(), stop.clone()));
        streams.push(("parcels", neighbour.clone(), task));
        let sender = node.sender(&name).map_err(|why| why.to_string())?;
        let task = tokio::task::spawn_local(orders(sender, from, stop.clone()));
        streams.push(("orders", neighbour, task));
    }
    say("ready");

    while let Some(command) = commands.recv().await {
        match command.as_str() {
            "stop" => {
                stop.store(true, Relaxed);
                for (kind, to, task) in streams.drain(..) {
                    let (sent, failed) = task.await.map_err(|error| error.to_string())?;
                    say(&format!("sent {kind} {to} {sent} {failed}"));
                }
                say("stopped");
            }
            "tell" => ledger.tell(),
            other => say(&format!("no command is called {other}")),
        }
    }
    node.shutdown().await;
    Ok(())
}
