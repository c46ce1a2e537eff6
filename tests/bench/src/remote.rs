//! A request of 64 bytes and its reply between processes, beside a bare ping-pong over the same
//! medium.
//!
//! This process is pinned to the first core and every other to the second, bare or not.

use crate::keys::BenchKeys;
use crate::measure::{Table, median};
use crate::process::{Peer, addresses, pin, serve_until_told, texts};
use blastema::prelude::*;
use blastema::{Link, Network, NodeBuilder};
use std::net::{Ipv4Addr, SocketAddr};
use std::time::{Duration, Instant};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream, UdpSocket};

const WARM_UP: usize = 200;
const ASKS: usize = 3_000;

/// 64 bytes there and back.
#[derive(Clone, Debug, Request)]
#[contract(reply = Vec<u8>)]
struct Echo(Vec<u8>);

struct Mirror;
impl Component for Mirror {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Echo>();
    }
}
impl Handle<Echo> for Mirror {
    async fn handle(&mut self, message: Echo, _: &mut Context<Self>) -> Vec<u8> {
        message.0
    }
}

/// Another process: `bare MEDIUM ADDRESS`, or `node MEDIUM NAME (OWN NEIGHBOUR ADDRESS)...`, or the
/// same with `single` for a node on one thread, or with `sealed KEY` for a node with that key.
pub(crate) fn child(arguments: &[String]) {
    pin(1);
    match arguments {
        [kind, medium, address] if kind == "bare" => {
            let address: SocketAddr = address.parse().expect("the parent writes an address");
            let medium = medium.clone();
            std::thread::spawn(move || {
                blastema::run(async move { bare_echo(&medium, address).await })
            });
            serve_until_told();
        }
        [kind, key, medium, name, links @ ..] if kind == "sealed" => {
            serve(Node::builder(name).keys(key), medium, links);
        }
        [kind, medium, name, links @ ..] if kind == "single" => {
            serve(Node::builder(name).on_this_thread(), medium, links);
        }
        [kind, medium, name, links @ ..] if kind == "node" => {
            serve(Node::builder(name), medium, links);
        }
        _ => println!("the parent names a kind"),
    }
}

fn serve(builder: NodeBuilder, medium: &str, links: &[String]) {
    blastema::run(async {
        let mut builder = builder.child(ChildSpec::new("mirror", || Mirror));
        for (number, link) in links.chunks(3).enumerate() {
            builder = builder.network(network(medium, number, link));
        }
        let node = builder.start().await.expect("the node starts");
        let told = tokio::task::spawn_blocking(serve_until_told);
        let _ = told.await;
        node.shutdown().await;
    });
}

fn network(medium: &str, number: usize, link: &[String]) -> Network {
    let parse = |text: &String| text.parse().expect("the parent writes addresses");
    let (name, own) = (format!("net{number}"), parse(&link[0]));
    let far = Link::new(&link[1], parse(&link[2]));
    match medium {
        "tcp" => Network::tcp(&name, own).link(far),
        _ => Network::udp(&name, own).link(far),
    }
}

/// The echo beside which we are measured.
async fn bare_echo(medium: &str, address: SocketAddr) {
    let mut buffer = [0; 2048];
    if medium == "tcp" {
        let listener = TcpListener::bind(address).await.expect("the address is free");
        while let Ok((mut stream, _)) = listener.accept().await {
            let _ = stream.set_nodelay(true);
            while stream.read_exact(&mut buffer[..64]).await.is_ok() {
                let _ = stream.write_all(&buffer[..64]).await;
            }
        }
    } else {
        let socket = UdpSocket::bind(address).await.expect("the address is free");
        while let Ok((length, from)) = socket.recv_from(&mut buffer).await {
            let _ = socket.send_to(&buffer[..length], from).await;
        }
    }
}

async fn bare(medium: &str, far: SocketAddr) -> f64 {
    let mut buffer = [7; 64];
    let mut figures = Vec::new();
    if medium == "tcp" {
        let mut stream = TcpStream::connect(far).await.expect("the echo listens");
        stream.set_nodelay(true).expect("a connected socket takes it");
        for _ in 0..WARM_UP + ASKS {
            let start = Instant::now();
            stream.write_all(&buffer).await.expect("loopback takes it");
            stream.read_exact(&mut buffer).await.expect("the echo comes");
            figures.push(start.elapsed().as_nanos() as f64 / 1e3);
        }
    } else {
        let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("a free port");
        for _ in 0..WARM_UP + ASKS {
            let start = Instant::now();
            socket.send_to(&buffer, far).await.expect("loopback takes it");
            socket.recv_from(&mut buffer).await.expect("the echo comes");
            figures.push(start.elapsed().as_nanos() as f64 / 1e3);
        }
    }
    median(figures.split_off(WARM_UP))
}

async fn asked(mirror: &Sender<Echo>) -> f64 {
    let mut figures = Vec::new();
    for _ in 0..WARM_UP + ASKS {
        let start = Instant::now();
        mirror.ask(Echo(vec![7; 64])).await.expect("the mirror answers");
        figures.push(start.elapsed().as_nanos() as f64 / 1e3);
    }
    median(figures.split_off(WARM_UP))
}

async fn reached(node: &Node, name: &str) -> Sender<Echo> {
    let mirror: Sender<Echo> = node.sender(name).expect("the name parses");
    while mirror.ask(Echo(Vec::new())).await.is_err() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    mirror
}

pub(crate) fn run(rounds: usize) {
    pin(0);
    over("udp", rounds);
    over("tcp", rounds);
}

fn over(medium: &str, rounds: usize) {
    let keys = BenchKeys::new(&["guarded", "vault", "near", "middle", "far"]);
    let [open_near, open_far, sealed_near, sealed_far] =
        addresses().map(|address| address.to_string());
    let [echo, near, left, right, far, single_near, single_far] =
        addresses().map(|address| address.to_string());
    let [sealed_end, sealed_left, sealed_right, sealed_beyond] =
        addresses().map(|address| address.to_string());
    let start = |arguments: &[&str]| Peer::start("remote", &texts(arguments));
    let _echo = start(&["bare", medium, &echo]);
    let _middle = start(&["node", medium, "middle", &left, "near", &near, &right, "far", &far]);
    let _far = start(&["node", medium, "far", &far, "middle", &right]);
    let _single = start(&["single", medium, "single", &single_far, "alone", &single_near]);
    // The same nodes without keys: those above have a third neighbour, or one thread.
    let _open = start(&["node", medium, "vault", &open_far, "guarded", &open_near]);
    let vault = keys.of("vault");
    let (middle, beyond) = (keys.of("middle"), keys.of("far"));
    let ends = ["near", &sealed_end, &sealed_right, "far", &sealed_beyond];
    let _sealed_middle =
        start(&[&["sealed", &middle, medium, "middle", &sealed_left], &ends[..]].concat());
    let _sealed_far =
        start(&["sealed", &beyond, medium, "far", &sealed_beyond, "middle", &sealed_right]);
    let _vault = start(&["sealed", &vault, medium, "vault", &sealed_far, "guarded", &sealed_near]);
    blastema::run(async {
        let link = network(medium, 0, &[open_near, "vault".into(), open_far]);
        let open = Node::builder("guarded").network(link).start().await;
        let open = open.expect("the node starts");
        let without_seals = reached(&open, "vault:mirror").await;
        let link = network(medium, 0, &[sealed_near, "vault".into(), sealed_far]);
        let guarded = Node::builder("guarded").keys(keys.of("guarded")).network(link).start().await;
        let guarded = guarded.expect("the node starts");
        let behind_seals = reached(&guarded, "vault:mirror").await;
        let link = network(medium, 0, &[single_near, "single".into(), single_far]);
        let alone = Node::builder("alone").on_this_thread().network(link).start().await;
        let alone = alone.expect("the node starts");
        let on_one_thread = reached(&alone, "single:mirror").await;
        let link = network(medium, 0, &[near, "middle".into(), left]);
        let node = Node::builder("near").network(link).start().await.expect("the node starts");
        let one = reached(&node, "middle:mirror").await;
        let two = reached(&node, "far:mirror").await;
        let link = network(medium, 0, &[sealed_end, "middle".into(), sealed_left]);
        let sealed_node = Node::builder("near").keys(keys.of("near")).network(link).start().await;
        let sealed_node = sealed_node.expect("the node starts");
        let two_sealed = reached(&sealed_node, "far:mirror").await;
        let title = format!("request and reply of 64 B between processes, {medium}");
        let mut table = Table::new(title, "us");
        let echo = echo.parse().expect("an address is printed as it is read");
        for _ in 0..rounds {
            table.add("bare tokio ping-pong", bare(medium, echo).await);
            table.add("Sender::ask, nodes on one thread each", asked(&on_one_thread).await);
            table.add("Sender::ask, one hop", asked(&one).await);
            table.add("Sender::ask, two nodes without keys", asked(&without_seals).await);
            table.add("Sender::ask, two nodes with keys", asked(&behind_seals).await);
            table.add("Sender::ask, two hops", asked(&two).await);
            table.add("Sender::ask, two hops with keys", asked(&two_sealed).await);
        }
        table.print();
        let (one, two) = ("Sender::ask, one hop", "Sender::ask, two hops");
        println!("two hops take {:.2} times one", table.ratio(two) / table.ratio(one));
        let [open_ratio, sealed] = ["without", "with"]
            .map(|keys| table.ratio(&format!("Sender::ask, two nodes {keys} keys")));
        println!("with keys it takes {:.2} times as long", sealed / open_ratio);
        let behind = table.ratio("Sender::ask, two hops with keys") / table.ratio(two);
        println!("two hops with keys take {behind:.2} times as long as without");
        open.shutdown().await;
        guarded.shutdown().await;
        node.shutdown().await;
        sealed_node.shutdown().await;
        alone.shutdown().await;
    });
}
