//! How much two nodes carry: small reliable messages per second, and messages of a mebibyte beside
//! bare TCP.
//!
//! This process is pinned to the first core and every other to the second, bare or not.
//! `SIZES=small` or `large` and `MEDIA=udp` or `tcp` narrow it down, for a profile.

use crate::keys::BenchKeys;
use crate::measure::Table;
use crate::process::{Peer, addresses, pin, serve_until_told, texts};
use blastema::prelude::*;
use blastema::{Blob, Link, Network};
use std::net::SocketAddr;
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

const SMALL: u64 = 300_000;
const LARGE: u64 = 200;
const MEBIBYTE: usize = 1 << 20;

/// A small reliable message.
#[derive(Clone, Debug, Event)]
struct Tick {
    number: u64,
    values: [f64; 3],
}

/// A large one.
#[derive(Clone, Debug, Event)]
#[contract(max_size = 2 << 20)]
struct Image(Vec<u8>);

/// The same, which is not copied where it comes from another node.
#[derive(Clone, Debug, Event)]
#[contract(max_size = 2 << 20)]
struct SharedImage(Blob);

/// How many messages have come.
#[derive(Clone, Debug, Request)]
#[contract(reply = u64)]
struct Count;

#[derive(Default)]
struct Sink(u64);

impl Component for Sink {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Tick>().accept::<Image>().accept::<SharedImage>().serve::<Count>();
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
        assert_eq!(image.0.len(), MEBIBYTE);
        self.0 += 1;
    }
}
impl Handle<SharedImage> for Sink {
    async fn handle(&mut self, image: SharedImage, _: &mut Context<Self>) {
        assert_eq!((image.0.len(), image.0.last()), (MEBIBYTE, Some(&7)));
        self.0 += 1;
    }
}
impl Handle<Count> for Sink {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) -> u64 {
        self.0
    }
}

/// Where a child and its parent meet.
fn network(medium: &str, own: SocketAddr, far: &str, remote: SocketAddr) -> Network {
    match medium {
        "tcp" => Network::tcp("net0", own).link(Link::new(far, remote)),
        _ => Network::udp("net0", own).link(Link::new(far, remote)),
    }
}

/// Another process: `bare ADDRESS`, or `MEDIUM OWN REMOTE`, and with keys `KEY`.
pub(crate) fn child(arguments: &[String]) {
    pin(1);
    let address = |text: &String| text.parse::<SocketAddr>().expect("the parent writes addresses");
    match arguments {
        [kind, own] if kind == "bare" => {
            let own = address(own);
            std::thread::spawn(move || blastema::run(bare_sink(own)));
            serve_until_told();
        }
        [medium, own, remote, key @ ..] => blastema::run(async {
            let network = network(medium, address(own), "source", address(remote));
            let sink = |name: &str| ChildSpec::new(name, Sink::default).queue(4096, WhenFull::Wait);
            let mut builder = Node::builder("sink").network(network);
            if let [key] = key {
                builder = builder.keys(key);
            }
            let builder = builder.child(sink("small")).child(sink("large"));
            let node = builder.start().await.expect("the node starts");
            let _ = tokio::task::spawn_blocking(serve_until_told).await;
            node.shutdown().await;
        }),
        _ => println!("the parent names a kind"),
    }
}

/// Reads images, and answers each batch of them with one byte.
async fn bare_sink(own: SocketAddr) {
    let listener = TcpListener::bind(own).await.expect("the address is free");
    let mut buffer = vec![0; MEBIBYTE];
    while let Ok((mut stream, _)) = listener.accept().await {
        for _ in 0..LARGE {
            if stream.read_exact(&mut buffer).await.is_err() {
                break;
            }
        }
        let _ = stream.write_all(&[1]).await;
    }
}

/// In MiB per second.
async fn bare(far: SocketAddr) -> f64 {
    let mut stream = TcpStream::connect(far).await.expect("the sink listens");
    let image = vec![7; MEBIBYTE];
    let start = Instant::now();
    for _ in 0..LARGE {
        stream.write_all(&image).await.expect("the sink reads");
    }
    stream.read_exact(&mut [0]).await.expect("the sink answers");
    LARGE as f64 / start.elapsed().as_secs_f64()
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
    (count, batch): (u64, u64),
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

/// Whether an environment variable, which lists what is wanted, is not there or lists this.
fn is_wanted(variable: &str, word: &str) -> bool {
    std::env::var(variable).map_or(true, |listed| listed.split(',').any(|one| one == word))
}

pub(crate) fn run(rounds: usize) {
    pin(0);
    let keys = BenchKeys::new(&["source", "sink"]);
    let [bare_at, udp, udp_sink, tcp, tcp_sink] = addresses();
    let _bare = Peer::start("throughput", &texts(&["bare", &bare_at.to_string()]));
    let media = [("udp", udp, udp_sink), ("tcp", tcp, tcp_sink)];
    for (medium, own, far) in media.into_iter().filter(|(medium, ..)| is_wanted("MEDIA", medium)) {
        let [sealed_own, sealed_far] = addresses();
        let arguments =
            [medium, &sealed_far.to_string(), &sealed_own.to_string(), &keys.of("sink")];
        let _sealed_sink = Peer::start("throughput", &texts(&arguments));
        let arguments = texts(&[medium, &far.to_string(), &own.to_string()]);
        let _sink = Peer::start("throughput", &arguments);
        blastema::run(async {
            let network = network(medium, own, "sink", far);
            let node = Node::builder("source").network(network).start().await;
            let node = node.expect("the node starts");
            let network = self::network(medium, sealed_own, "sink", sealed_far);
            let sealed = Node::builder("source").keys(keys.of("source")).network(network);
            let sealed = sealed.start().await.expect("the node starts");
            let title = format!("messages of a mebibyte, {medium}");
            let mut large = Table::new(title, "per second: higher is better");
            let title = format!("small reliable messages, {medium}, a core each");
            let mut small = Table::new(title, "per second: higher is better");
            let image = vec![7; MEBIBYTE];
            let blob = Blob::from(image.clone());
            for _ in 0..rounds {
                if is_wanted("SIZES", "large") {
                    large.add("bare TCP", bare(bare_at).await);
                    let count = (LARGE, 16);
                    let copied = |_| Image(image.clone());
                    large.add("deliver, Vec<u8>", sent(&node, "sink:large", count, copied).await);
                    let shared = |_| SharedImage(blob.clone());
                    large.add("deliver, Blob", sent(&node, "sink:large", count, shared).await);
                    let figure = sent(&sealed, "sink:large", count, shared).await;
                    large.add("deliver, Blob, sealed", figure);
                }
                if is_wanted("SIZES", "small") {
                    let tick = |number| Tick { number, values: [0.5; 3] };
                    let count = (SMALL, 1024);
                    small.add("Sender::deliver", sent(&node, "sink:small", count, tick).await);
                    let figure = sent(&sealed, "sink:small", count, tick).await;
                    small.add("Sender::deliver, sealed", figure);
                }
            }
            large.print();
            small.print();
            if is_wanted("SIZES", "large") {
                let [sealed, plain] =
                    ["deliver, Blob, sealed", "deliver, Blob"].map(|row| large.ratio(row));
                println!("sealed mebibytes: {:.2} of those without keys", sealed / plain);
            }
            sealed.shutdown().await;
            node.shutdown().await;
        });
    }
}
