//! What a full mesh costs: so many processes, each with a link to every other over UDP on loopback.
//!
//! `blastema-bench mesh 20` says how many there are. It shows after how long all are connected,
//! what all of them together take when nothing happens, and how many are in safe state. With
//! `mesh 20 busy`, each node publishes ten events a second to all others, and asks five requests.

use crate::process::{Peer, cpu_seconds, texts};
use blastema::prelude::*;
use blastema::{Link, Network, NodeState};
use std::io::{BufRead, Write};
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

/// A node that is not connected to all others by then says with how many it is.
const PATIENCE: Duration = Duration::from_secs(60);
/// Reports of the start, and the first refresh of every router, are over by then.
const SETTLE: Duration = Duration::from_secs(12);
/// Whole rounds of the routers' refresh.
const MEASURED: Duration = Duration::from_secs(20);

/// A node that is connected has no fault any more by then.
const HEALTHY_WITHIN: Duration = Duration::from_secs(120);

/// The argument of a mesh whose nodes talk to each other.
const BUSY: &str = "busy";
const EVENTS_HZ: f64 = 10.0;

/// Where a node is.
#[derive(Clone, Debug, Event)]
#[contract(name = "mesh/pose")]
struct Pose {
    position: [f64; 3],
}

/// Asks a node how many events it has received.
#[derive(Debug, Request)]
#[contract(name = "mesh/received", reply = u64)]
struct Received;

/// A component that publishes in each round, and asks another node in every second one.
struct Walker {
    others: Vec<String>,
    rounds: usize,
    received: u64,
}

impl Component for Walker {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Pose>();
        ports.serve::<Received>();
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.rounds += 1;
        cx.publish(Pose { position: [self.rounds as f64; 3] });
        if self.rounds.is_multiple_of(2) {
            let other = &self.others[self.rounds / 2 % self.others.len()];
            let other = cx.sender::<Received>(&format!("{other}:walker"))?;
            // What does not arrive is counted by the product; an overloaded mesh refuses some.
            cx.spawn(async move { drop(other.ask(Received).await) });
        }
        Ok(())
    }
}

impl Handle<Pose> for Walker {
    async fn handle(&mut self, _: Pose, _: &mut Context<Self>) {
        self.received += 1;
    }
}

impl Handle<Received> for Walker {
    async fn handle(&mut self, _: Received, _: &mut Context<Self>) -> u64 {
        self.received
    }
}

/// One of the processes: its number, whether it is busy, and all addresses.
pub(crate) fn child(arguments: &[String]) {
    let [number, busy, addresses @ ..] = arguments else { return };
    let own: usize = number.parse().expect("the parent writes a number");
    let addresses: Vec<SocketAddr> =
        addresses.iter().map(|text| text.parse().expect("the parent writes addresses")).collect();
    blastema::run(async {
        let others = (0..addresses.len()).filter(|number| *number != own);
        let others: Vec<_> = others.map(|number| (format!("module{number}"), number)).collect();
        let mut network = Network::udp("ethernet", addresses[own]);
        for (name, number) in &others {
            network = network.link(Link::new(name, addresses[*number]));
        }
        let mut node = Node::builder(&format!("module{own}")).network(network);
        if busy == BUSY {
            let others: Vec<String> = others.iter().map(|(name, _)| name.clone()).collect();
            let walker = move || Walker { others: others.clone(), rounds: 0, received: 0 };
            node = node.child(ChildSpec::new("walker", walker).rate_hz(EVENTS_HZ));
        }
        let start = Instant::now();
        let node = node.start().await.expect("the node starts");
        let mut met = 0;
        for (name, _) in &others {
            let left = PATIENCE.saturating_sub(start.elapsed());
            met += usize::from(node.connected(name, left).await);
        }
        say(&met.to_string());
        // Each line asks what was used so far; the end of the parent's input ends this process.
        loop {
            let asked = tokio::task::spawn_blocking(|| {
                std::io::stdin().lock().lines().next().is_some_and(|line| line.is_ok())
            });
            if !asked.await.expect("reading does not panic") {
                return;
            }
            let standing = node.faults().await.entries.iter().filter(|e| e.stands()).count();
            let sent: u64 = node.media().await.iter().map(|row| row.counters.sent).sum();
            let safe = u8::from(matches!(node.state(), NodeState::InSafeState { .. }));
            say(&format!("{} {sent} {safe} {standing}", cpu_seconds()));
        }
    });
}

fn say(line: &str) {
    println!("{line}");
    let _ = std::io::stdout().flush();
}

/// Of all processes together: seconds of a core, frames sent, those in safe state, faults that
/// stand.
fn totals(peers: &mut [Peer]) -> [f64; 4] {
    peers.iter_mut().for_each(Peer::ask);
    let lines: Vec<String> = peers.iter_mut().map(Peer::line).collect();
    let mut sums = [0.0; 4];
    for line in lines {
        let numbers = line.split_whitespace().map(|word| word.parse().unwrap_or(f64::NAN));
        sums.iter_mut().zip(numbers).for_each(|(sum, number): (_, f64)| *sum += number);
    }
    sums
}

pub(crate) fn run(arguments: &[String]) {
    let count: usize = arguments.first().and_then(|count| count.parse().ok()).unwrap_or(20);
    let busy = arguments.get(1).cloned().unwrap_or_default();
    let sockets: Vec<_> = (0..count)
        .map(|_| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port"))
        .collect();
    let address = |socket: &UdpSocket| socket.local_addr().expect("a bound socket has an address");
    let addresses: Vec<String> = sockets.iter().map(|socket| address(socket).to_string()).collect();
    drop(sockets);
    let start = Instant::now();
    let spawn = |number: usize| {
        let arguments = [texts(&[&number.to_string(), &busy]), addresses.clone()].concat();
        Peer::spawn("mesh", &arguments)
    };
    let mut peers: Vec<_> = (0..count).map(spawn).collect();
    let met: usize = peers.iter_mut().map(|peer| peer.line().trim().parse().unwrap_or(0)).sum();
    let seconds = start.elapsed().as_secs_f64();
    println!("\n## a full mesh of {count} processes over UDP on loopback {busy}");
    println!("{met} of {} connections after {seconds:.1} s", count * count.saturating_sub(1));
    let [starting, sent, safe, faults] = totals(&mut peers);
    println!(
        "{starting:.1} s of a core and {sent} frames until then; {safe} in safe state, {faults} \
         faults stand"
    );
    std::thread::sleep(SETTLE);
    let healthy = loop {
        let [_, _, safe, faults] = totals(&mut peers);
        if safe + faults == 0.0 {
            break format!("no fault stands after {:.0} s", start.elapsed().as_secs_f64());
        }
        if start.elapsed().as_secs_f64() > seconds + HEALTHY_WITHIN.as_secs_f64() {
            break format!("{faults} faults stand after {HEALTHY_WITHIN:?}, {safe} in safe state");
        }
        std::thread::sleep(Duration::from_secs(1));
    };
    println!("{healthy}");
    let ([before, sent_before, ..], start) = (totals(&mut peers), Instant::now());
    std::thread::sleep(MEASURED);
    let ([after, sent, safe, faults], span) = (totals(&mut peers), start.elapsed().as_secs_f64());
    let percent = (after - before) / span * 100.0;
    let frames = (sent - sent_before) / span;
    println!(
        "then: {percent:.1} % of a core, {frames:.0} frames a second; {safe} in safe state, {faults} \
         faults stand"
    );
}
