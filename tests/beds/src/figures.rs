//! From a pulled cable to the next reply, on interfaces that lose their carrier.
//!
//! Two hosts with four cables. The one in use is pulled while requests follow each other without a
//! pause; the figure is how long the slowest of them took, that is the one which met the cut. A
//! cable counts again as soon as it has proved itself, so that every cut falls into the second
//! after another, which is when Linux keeps news of real interfaces back.

use crate::bed::{Bed, Kind, PARALLEL};
use crate::host::Host;
use crate::node::{Order, Parcel, describe, say};
use blastema::core::net::LinkId;
use blastema::core::random::Random;
use blastema::prelude::*;
use blastema::{LinkState, Route};
use std::io::Write;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::time::{Duration, Instant};

const PATIENCE: Duration = Duration::from_secs(30);
/// For a thousand cuts, each of which waits until a cable is ready to be spared.
const RUN: Duration = Duration::from_secs(1_200);
const PACE: Duration = Duration::from_millis(1);
/// Long after the command to pull the cable has been carried out.
const WINDOW: Duration = Duration::from_millis(25);
const HELLO_MS: &str = "5";

/// Measures on both kinds of cables. `PREFIX CUTS` are its arguments.
pub(crate) fn run(arguments: &[String]) -> Result<(), String> {
    let [prefix, count] = arguments else { return Err("PREFIX CUTS".into()) };
    println!("## from a pulled cable to the next reply, UDP, hellos every {HELLO_MS} ms (ms)");
    for kind in [Kind::Tap, Kind::Veth] {
        let bed = Bed::new(kind, prefix, &PARALLEL)?;
        let node = |name: &str| {
            let mut words: Vec<String> = vec![name.into(), "udp".into(), HELLO_MS.into()];
            words.extend(bed.links(name));
            words
        };
        let start = |name: &str, mut words: Vec<String>, first: &[String]| {
            words.splice(0..0, first.iter().cloned());
            Host::start(name, &bed.namespace(name), &words)
        };
        let mut far = start("b", node("b"), &["mirror".into()])?;
        let how = if kind == Kind::Tap { "carrier" } else { "down" };
        let [own, other] = ["a", "b"].map(|host| bed.namespace(host));
        let first = ["measure".into(), count.clone(), how.into(), own, other];
        let mut near = start("a", node("a"), &first)?;
        far.expect("ready", PATIENCE)?;
        let told = near.expect("measured", RUN);
        println!("{kind:?}");
        told?.iter().filter(|line| !line.is_empty()).for_each(|line| println!("    {line}"));
        far.order("tell")?;
        let heard = far.expect("told", PATIENCE)?;
        heard.iter().filter(|line| line.starts_with("heard")).for_each(|line| {
            let words: Vec<&str> = line.split(' ').collect();
            if let ["heard", kind, _, count, lost, doubled, gap] = words[..] {
                println!(
                    "    {count} {kind}: {lost} lost, {doubled} doubled, longest gap {gap} ms"
                );
            }
        });
        near.end(PATIENCE)?;
        far.end(PATIENCE)?;
    }
    Ok(())
}

/// Sets interfaces of one host, without starting a program each time.
struct Hand {
    stdin: ChildStdin,
    child: Child,
}

impl Hand {
    fn of(namespace: &str) -> Result<Hand, String> {
        let mut child = Command::new("ip")
            .args(["-n", namespace, "-force", "-batch", "-"])
            .stdin(Stdio::piped())
            .spawn()
            .map_err(|error| format!("ip: {error}"))?;
        let stdin = child.stdin.take().ok_or("ip takes no input")?;
        Ok(Hand { stdin, child })
    }

    fn set(&mut self, interface: &str, how: &str) -> Result<(), String> {
        writeln!(self.stdin, "link set {interface} {how}").map_err(|error| error.to_string())
    }
}

impl Drop for Hand {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The link that is in use, once another could take over at once.
async fn in_use(node: &Node) -> usize {
    loop {
        let routes = node.routes().await;
        let links = node.links().await;
        let up = |link: &LinkId| {
            links.get(usize::from(link.0)).is_some_and(|row| row.state == LinkState::Up)
        };
        let ready = |route: &&Route| {
            route.alternate.as_ref().is_some_and(up) && route.chosen == Some(route.next)
        };
        if let Some(route) = routes.iter().find(ready) {
            return usize::from(route.next.0);
        }
        tokio::time::sleep(PACE).await;
    }
}

async fn stream(parcels: Sender<Parcel>) {
    for number in 0.. {
        while parcels.deliver(Parcel { from: "a".into(), number }).await.is_err() {
            tokio::time::sleep(PACE).await;
        }
        tokio::time::sleep(PACE).await;
    }
}

/// The node that measures: how often, how cables are pulled, both namespaces, and then a node's
/// words.
pub(crate) async fn measure(arguments: &[String]) -> Result<(), String> {
    let [count, how, own, other, rest @ ..] = arguments else { return Err("COUNT HOW".into()) };
    let count: u64 = count.parse().map_err(|_| "COUNT is a number")?;
    let (off, on) = match how.as_str() {
        "carrier" => ("carrier off", "carrier on"),
        _ => ("down", "up"),
    };
    let (builder, _) = describe(rest)?;
    let node = builder.start().await.map_err(|error| error.to_string())?;
    if !node.connected("b", PATIENCE).await {
        return Err("b is not found".into());
    }
    // A pair of virtual interfaces is one thing: both ends lose the carrier with either.
    let mut hands = vec![Hand::of(own)?];
    if how == "carrier" {
        hands.push(Hand::of(other)?);
    }
    let orders: Sender<Order> = node.sender("b:ledger").map_err(|why| why.to_string())?;
    let parcels: Sender<Parcel> = node.sender("b:ledger").map_err(|why| why.to_string())?;
    let streaming = tokio::task::spawn_local(stream(parcels));
    let mut figures = Vec::new();
    // Any moment between two looks is as likely.
    let mut chance = Random::new(1);
    let mut last = Instant::now();
    let mut within_a_second = 0;
    let mut number = 0;
    for _ in 0..count {
        let interface = PARALLEL[in_use(&node).await % PARALLEL.len()].name;
        tokio::time::sleep(Duration::from_micros(chance.below(10_000))).await;
        let start = Instant::now();
        within_a_second += u32::from(start - last < Duration::from_secs(1));
        last = start;
        for hand in &mut hands {
            hand.set(interface, off)?;
        }
        // The request that meets the cut waits for the other cable. It cannot be told from the
        // others.
        let mut worst = Duration::ZERO;
        while start.elapsed() < WINDOW {
            let asked = Instant::now();
            let order = Order { from: "a".into(), number };
            orders.ask_within(order, PATIENCE).await.map_err(|error| error.to_string())?;
            (number, worst) = (number + 1, worst.max(asked.elapsed()));
        }
        figures.push(worst);
        for hand in &mut hands {
            hand.set(interface, on)?;
        }
    }
    streaming.abort();
    figures.sort();
    let at = |share: f64| {
        figures[((count as f64 * share).ceil() as usize).max(1) - 1].as_secs_f64() * 1e3
    };
    say(&format!(
        "n {count}, {within_a_second} within a second of the one before: p50 {:.3} p99 {:.3} max {:.3}",
        at(0.5),
        at(0.99),
        at(1.0)
    ));
    say("measured");
    drop(hands);
    node.shutdown().await;
    Ok(())
}
