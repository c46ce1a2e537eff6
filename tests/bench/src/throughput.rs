//! How much two nodes carry: small reliable messages per second, and messages of a mebibyte,
//! without keys and with them.
//!
//! This process is pinned to the first core and every other to the second.
//! `MEDIA=udp` or `tcp` narrows it down, for a profile.

use crate::keys::BenchKeys;
use crate::measure::Table;
use crate::process::{Peer, addresses, builder, pin, serve_until_told, texts};
use blastema::Blob;
use blastema::prelude::*;
use std::time::{Duration, Instant};

const SMALL: u64 = 300_000;
const LARGE: u64 = 200;
const MEBIBYTE: usize = 1 << 20;

/// A small reliable message.
#[derive(Clone, Debug, Event)]
struct Tick {
    number: u64,
    values: [f64; 3],
}

/// A large one, which is not copied where it comes from another node.
#[derive(Clone, Debug, Event)]
#[contract(max_size = 2 << 20)]
struct Image(Blob);

/// How many messages have come.
#[derive(Clone, Debug, Request)]
#[contract(reply = u64)]
struct Count;

#[derive(Default)]
struct Sink(u64);

impl Component for Sink {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Tick>().accept::<Image>().serve::<Count>();
    }
}
impl Handle<Tick> for Sink {
    async fn handle(&mut self, tick: Tick, _: &mut Context<Self>) {
        assert_eq!(tick.number, self.0, "nothing is lost, doubled or overtaken");
        assert!(tick.values[0] < 1.0);
        self.0 += 1;
    }
}
impl Handle<Image> for Sink {
    async fn handle(&mut self, image: Image, _: &mut Context<Self>) {
        assert_eq!((image.0.len(), image.0.last()), (MEBIBYTE, Some(&7)));
        self.0 += 1;
    }
}
impl Handle<Count> for Sink {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u64 {
        self.0
    }
}

/// Another process: `MEDIUM OWN REMOTE KEY`; the key may be empty.
pub(crate) fn child(arguments: &[String]) {
    pin(1);
    let [medium, own, remote, key] = arguments else { return };
    blastema::run(async {
        let sink = |name: &str| ChildSpec::new(name, Sink::default).queue(4096, WhenFull::Wait);
        let link = [own.clone(), "source".into(), remote.clone()];
        let builder = builder("sink", key, medium, &link);
        let node = builder.child(sink("small")).child(sink("large")).start().await;
        let node = node.expect("the node starts");
        let _ = tokio::task::spawn_blocking(serve_until_told).await;
        node.shutdown().await;
    });
}

/// How many messages the sink has served, once what was sent before has been.
async fn served_by(sink: &Sender<Count>) -> u64 {
    loop {
        match sink.ask(Count).await {
            Ok(served) => return served,
            // It is not reached yet, or takes nothing more for the moment.
            Err(_) => tokio::time::sleep(Duration::from_millis(1)).await,
        }
    }
}

/// Sends so many messages, two batches at a time under way, and answers how many per second were
/// served.
async fn sent<M: Event>(
    node: &Node,
    sink: &str,
    count: u64,
    batch: u64,
    message: impl Fn(u64) -> M,
) -> f64 {
    let to: Sender<M> = node.sender(sink).expect("the name parses");
    let served: Sender<Count> = node.sender(sink).expect("the name parses");
    let before = served_by(&served).await;
    let start = Instant::now();
    let mut next = before;
    let end = before + count;
    while next < end {
        let numbers = next..end.min(next + batch);
        next = numbers.end;
        let (_, ()) = tokio::join!(served_by(&served), async {
            for number in numbers {
                to.deliver(message(number)).await.expect("the sink takes it");
            }
        });
    }
    assert_eq!(served_by(&served).await, end, "nothing is lost");
    count as f64 / start.elapsed().as_secs_f64()
}

pub(crate) fn run(rounds: usize) {
    pin(0);
    let keys = BenchKeys::new(&["source", "sink"]);
    let wanted = std::env::var("MEDIA").unwrap_or_else(|_| "udp,tcp".into());
    for medium in wanted.split(',') {
        blastema::run(async {
            let (mut nodes, mut sinks) = (Vec::new(), Vec::new());
            for (row, sealed) in [("without keys", false), ("with keys", true)] {
                let [own, far] = addresses().map(|address| address.to_string());
                let key = |name: &str| if sealed { keys.of(name) } else { String::new() };
                let arguments = texts(&[medium, &far, &own, &key("sink")]);
                sinks.push(Peer::start("throughput", &arguments));
                let link = [own, "sink".into(), far];
                let builder = builder("source", &key("source"), medium, &link);
                nodes.push((row, builder.start().await.expect("the node starts")));
            }
            let title = format!("messages of a mebibyte, {medium}");
            let mut large = Table::new(title, "per second: higher is better");
            let title = format!("small reliable messages, {medium}, a core each");
            let mut small = Table::new(title, "per second: higher is better");
            let blob = Blob::from(vec![7; MEBIBYTE]);
            for _ in 0..rounds {
                for (row, node) in &nodes {
                    let image = |_| Image(blob.clone());
                    large.add(row, sent(node, "sink:large", LARGE, 16, image).await);
                    let tick = |number| Tick { number, values: [0.5; 3] };
                    small.add(row, sent(node, "sink:small", SMALL, 1024, tick).await);
                }
            }
            large.print();
            small.print();
            for (_, node) in nodes {
                node.shutdown().await;
            }
        });
    }
}
