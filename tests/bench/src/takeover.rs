//! From the kill of the process that serves to the first reply of its standby, between processes
//! over UDP.
//!
//! Three processes carry a service; a fourth, this one, asks it without a pause. At a random moment
//! the one that serves is killed as `kill -9` does, and is started again. A row ends with what
//! became of all requests: every one adds one, so that the last sum tells whether any was lost or
//! done twice. With cold standbys the sum starts from zero, and requests in flight end as
//! `OutcomeUnknown`, which is counted. `N=n` sets how often each kind is killed,
//! `KINDS=hot,warm,cold` which.

use crate::measure::Quantiles;
use blastema::core::random::Random;
use blastema::prelude::*;
use blastema::{
    Link, LinkState, Network, RequestError, Role, ServiceRef, ServiceSpec, StandbyKind, Stateful,
};
use std::collections::BTreeSet;
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};

const MEMBERS: [&str; 3] = ["module1", "module2", "module3"];
/// As often as the goals say: the primary's, and those of links.
const HELLO: Duration = Duration::from_millis(10);
/// How often the members are polled until all are in step: a fifth of the heartbeat interval.
const PACE: Duration = Duration::from_millis(2);
/// A killed process that is not replaced within this is no matter of load.
const PATIENCE: Duration = Duration::from_secs(60);
/// Requests between two kills, so that there is something to lose.
const BETWEEN: usize = 8;
/// Requests that are under way at a kill.
const UNDER_WAY: usize = 3;

/// Adds one.
#[derive(Clone, Debug, Request)]
#[contract(name = "takeover/add", reply = Counted)]
struct Add;

/// The sum, and which node has counted.
#[derive(Clone, Debug, Structure)]
struct Counted {
    sum: u64,
    node: u8,
}

struct Counter {
    sum: u64,
    node: u8,
}

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Add>();
    }
}

impl Handle<Add> for Counter {
    async fn handle(&mut self, _: Add, _: &mut Context<Self>) -> Counted {
        self.sum += 1;
        Counted { sum: self.sum, node: self.node }
    }
}

impl Stateful for Counter {
    fn save(&self) -> Vec<u8> {
        self.sum.to_le_bytes().into()
    }

    fn load(&mut self, state: &[u8]) -> Result<(), Failure> {
        let bytes = state.try_into().map_err(|_| Failure::from("a sum has eight bytes"))?;
        self.sum = u64::from_le_bytes(bytes);
        Ok(())
    }
}

/// Whether this node serves, or could.
#[derive(Clone, Debug, Request)]
#[contract(name = "takeover/ready", reply = bool)]
struct Ready;

struct Witness(Arc<AtomicBool>);

impl Component for Witness {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ready>();
    }
}

impl Handle<Ready> for Witness {
    async fn handle(&mut self, _: Ready, _: &mut Context<Self>) -> bool {
        self.0.load(Relaxed)
    }
}

fn ethernet(addresses: &[SocketAddr], own: usize) -> Network {
    let mut network = Network::udp("ethernet", addresses[own]);
    for (number, address) in addresses.iter().enumerate().filter(|(number, _)| *number != own) {
        network = network.link(Link::new(&format!("module{number}"), *address).hello_every(HELLO));
    }
    network
}

fn kind_of(name: &str) -> StandbyKind {
    match name {
        "hot" => StandbyKind::Hot,
        "cold" => StandbyKind::Cold,
        _ => StandbyKind::Warm,
    }
}

/// One of the processes: its kind, its number, and all addresses.
pub(crate) fn child(arguments: &[String]) {
    let [kind, number, addresses @ ..] = arguments else { return };
    // Whatever becomes of the measurement, no process is left behind.
    let _ = blastema::platform::end_with_parent(std::os::unix::process::parent_id());
    let number: u8 = number.parse().expect("the parent writes a number");
    let addresses: Vec<SocketAddr> =
        addresses.iter().map(|text| text.parse().expect("the parent writes addresses")).collect();
    let (ready, kind) = (Arc::new(AtomicBool::new(false)), kind_of(kind));
    blastema::run(async {
        let told = ready.clone();
        let counter =
            ServiceSpec::new("counter", MEMBERS, move || Counter { sum: 0, node: number });
        let node = Node::builder(&format!("module{number}"))
            .network(ethernet(&addresses, usize::from(number)))
            .child(ChildSpec::new("witness", move || Witness(told.clone())))
            .service(counter.standby(kind).heartbeat_every(HELLO))
            .start()
            .await
            .expect("the node starts");
        loop {
            // All links are used: what is measured is one failure, and not a second one.
            let met = node.links().await.iter().all(|link| link.state == LinkState::Up);
            let able = match node.service_role("counter") {
                Some(Role::Primary { .. }) => true,
                Some(Role::Standby { in_step, .. }) => in_step,
                None => false,
            };
            ready.store(met && able, Relaxed);
            tokio::time::sleep(PACE).await;
        }
    });
}

/// A process that is killed at the latest when this one ends.
struct Carrier(Child);

impl Carrier {
    fn start(kind: &str, number: usize, addresses: &[SocketAddr]) -> Self {
        let program = std::env::current_exe().expect("a running program has a file");
        let child = Command::new(program)
            .args(["--child", "takeover", kind, &number.to_string()])
            .args(addresses.iter().map(SocketAddr::to_string))
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .spawn();
        Carrier(child.expect("this program starts"))
    }
}

impl Drop for Carrier {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// What became of all requests of one row.
#[derive(Default)]
struct Book {
    asked: u64,
    unknown: u64,
    failed: u64,
    sums: BTreeSet<u64>,
    twice: u64,
}

impl Book {
    fn enter(&mut self, answered: &Result<Counted, RequestError<Add>>) {
        self.asked += 1;
        match answered {
            Ok(counted) => self.twice += u64::from(!self.sums.insert(counted.sum)),
            Err(RequestError { kind: DeliveryError::OutcomeUnknown { .. }, .. }) => {
                self.unknown += 1
            }
            Err(error) => {
                println!("{error}");
                self.failed += 1;
            }
        }
    }

    /// Where a state is kept, the greatest sum is how often it was added; two requests with one sum
    /// are one that was lost.
    fn print(&self, keeps: bool) {
        let added = self.sums.last().copied().unwrap_or(0);
        let (asked, unknown, failed) = (self.asked, self.unknown, self.failed);
        if keeps {
            let answered = asked - unknown - failed;
            let (lost, doubled) = (self.twice, added.saturating_sub(answered - self.twice));
            println!(
                "  {asked} requests: {lost} lost, {doubled} doubled, {failed} failed, {unknown} unknown"
            );
        } else {
            println!("  {asked} requests: {failed} failed, {unknown} with an unknown outcome");
        }
    }
}

struct Bed {
    node: Node,
    kind: String,
    addresses: Vec<SocketAddr>,
    carriers: Vec<Carrier>,
    counter: ServiceRef<Add>,
    book: Book,
}

impl Bed {
    async fn start(kind: &str) -> Self {
        let sockets: Vec<_> = (0..=MEMBERS.len())
            .map(|_| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port"))
            .collect();
        let address = |socket: &UdpSocket| socket.local_addr().expect("a bound socket has one");
        let addresses: Vec<_> = sockets.iter().map(address).collect();
        drop(sockets);
        let carriers = (1..=MEMBERS.len()).map(|number| Carrier::start(kind, number, &addresses));
        let carriers = carriers.collect();
        let node = Node::builder("module0").network(ethernet(&addresses, 0)).start().await;
        let node = node.expect("the node starts");
        let counter = node.service::<Add>("counter").expect("it is a name");
        Bed { node, kind: kind.into(), addresses, carriers, counter, book: Book::default() }
    }

    /// Waits until each process serves, or could.
    async fn settle(&self) {
        let start = Instant::now();
        for member in MEMBERS {
            let ready: Sender<Ready> =
                self.node.sender(&format!("{member}:witness")).expect("a name");
            while !ready.ask_within(Ready, HELLO).await.unwrap_or(false) {
                assert!(start.elapsed() < PATIENCE, "{member} does not come into step");
                tokio::time::sleep(PACE).await;
            }
        }
    }

    /// One kill; until the first reply of another node to a request that was made after it.
    async fn kill(&mut self, chance: Duration) -> Duration {
        self.settle().await;
        let mut primary = 0;
        for _ in 0..BETWEEN {
            let answered = self.counter.ask_within(Add, PATIENCE).await;
            self.book.enter(&answered);
            primary = answered.map_or(primary, |counted| usize::from(counted.node));
        }
        tokio::time::sleep(chance).await;
        let under_way: Vec<_> = (0..UNDER_WAY)
            .map(|_| {
                let counter = self.counter.clone();
                tokio::task::spawn_local(async move { counter.ask_within(Add, PATIENCE).await })
            })
            .collect();
        tokio::task::yield_now().await;
        let start = Instant::now();
        self.carriers[primary - 1].0.kill().expect("it still runs");
        let took = loop {
            let answered = self.counter.ask_within(Add, PATIENCE).await;
            self.book.enter(&answered);
            if answered.is_ok_and(|counted| usize::from(counted.node) != primary) {
                break start.elapsed();
            }
        };
        for asked in under_way {
            self.book.enter(&asked.await.expect("asking does not panic"));
        }
        self.carriers[primary - 1].0.wait().expect("it was started here");
        self.carriers[primary - 1] = Carrier::start(&self.kind, primary, &self.addresses);
        took
    }
}

pub(crate) async fn run() {
    let count = std::env::var("N").ok().and_then(|text| text.parse().ok()).unwrap_or(1000);
    let kinds = std::env::var("KINDS").unwrap_or_else(|_| "hot,warm,cold".into());
    println!(
        "\n## from the kill of a service's primary to the next reply, hellos every {HELLO:?} (ms)"
    );
    for kind in kinds.split(',') {
        let mut bed = Bed::start(kind).await;
        let mut figures = Quantiles::default();
        // Any moment between two hellos is as likely.
        let mut chance = Random::new(1);
        for _ in 0..count {
            let moment = Duration::from_micros(chance.below(10_000));
            figures.add(bed.kill(moment).await);
        }
        let goal = match kind_of(kind) {
            StandbyKind::Hot => "hot (goal: p99 50)",
            StandbyKind::Warm => "warm (goal: p99 100)",
            StandbyKind::Cold => "cold",
        };
        figures.print(goal);
        bed.book.print(kind_of(kind) != StandbyKind::Cold);
        bed.node.shutdown().await;
    }
}
