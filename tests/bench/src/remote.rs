//! A request of 64 bytes and its reply between processes, beside a bare UDP ping-pong.
//!
//! This process is pinned to the first core and every other to the second, bare or not.

use crate::measure::{Table, median};
use crate::process::{Peer, addresses, pin, serve_until_told, texts};
use blastema::prelude::*;
use blastema::{Link, Network};
use std::net::{Ipv4Addr, SocketAddr};
use std::time::{Duration, Instant};

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

/// Another process: `bare ADDRESS`, or `node NAME (OWN NEIGHBOUR ADDRESS)...`, or the same with
/// `single` for a node on one thread.
pub(crate) fn child(arguments: &[String]) {
    pin(1);
    match arguments {
        [kind, address] if kind == "bare" => {
            let address: SocketAddr = address.parse().expect("the parent writes an address");
            std::thread::spawn(move || blastema::run(bare_echo(address)));
            serve_until_told();
        }
        [kind, name, links @ ..] if kind == "node" || kind == "single" => blastema::run(async {
            let mut builder = Node::builder(name).child(ChildSpec::new("mirror", || Mirror));
            if kind == "single" {
                builder = builder.on_this_thread();
            }
            for (number, link) in links.chunks(3).enumerate() {
                builder = builder.network(network(number, link));
            }
            let node = builder.start().await.expect("the node starts");
            let told = tokio::task::spawn_blocking(serve_until_told);
            let _ = told.await;
            node.shutdown().await;
        }),
        _ => println!("the parent names a kind"),
    }
}

fn network(number: usize, link: &[String]) -> Network {
    let parse = |text: &String| text.parse().expect("the parent writes addresses");
    let far = Link::new(&link[1], parse(&link[2]));
    Network::udp(&format!("net{number}"), parse(&link[0])).link(far)
}

async fn bare_echo(address: SocketAddr) {
    let socket = tokio::net::UdpSocket::bind(address).await.expect("the address is free");
    let mut buffer = [0; 2048];
    while let Ok((length, from)) = socket.recv_from(&mut buffer).await {
        let _ = socket.send_to(&buffer[..length], from).await;
    }
}

async fn bare(far: SocketAddr) -> f64 {
    let socket = tokio::net::UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).await.expect("a free port");
    let mut buffer = [0; 2048];
    let mut figures = Vec::new();
    for _ in 0..WARM_UP + ASKS {
        let start = Instant::now();
        socket.send_to(&[7; 64], far).await.expect("loopback takes it");
        socket.recv_from(&mut buffer).await.expect("the echo comes");
        figures.push(start.elapsed().as_nanos() as f64 / 1e3);
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
    let [echo, near, left, right, far, single_near, single_far] = addresses();
    let (near_at, left_at) = (near.to_string(), left.to_string());
    let (right_at, far_at) = (right.to_string(), far.to_string());
    let _echo = Peer::start("remote", &texts(&["bare", &echo.to_string()]));
    let middle = ["node", "middle", &left_at, "near", &near_at, &right_at, "far", &far_at];
    let _middle = Peer::start("remote", &texts(&middle));
    let _far = Peer::start("remote", &texts(&["node", "far", &far_at, "middle", &right_at]));
    let single = ["single", "single", &single_far.to_string(), "alone", &single_near.to_string()];
    let _single = Peer::start("remote", &texts(&single));
    blastema::run(async {
        let network = Network::udp("net0", single_near).link(Link::new("single", single_far));
        let alone = Node::builder("alone").on_this_thread().network(network).start().await;
        let alone = alone.expect("the node starts");
        let on_one_thread = reached(&alone, "single:mirror").await;
        let network = Network::udp("net0", near).link(Link::new("middle", left));
        let node = Node::builder("near").network(network).start().await.expect("the node starts");
        let one = reached(&node, "middle:mirror").await;
        let two = reached(&node, "far:mirror").await;
        let mut table = Table::new("request and reply of 64 B between processes, UDP", "us");
        for _ in 0..rounds {
            table.add("bare tokio UDP ping-pong", bare(echo).await);
            table.add("Sender::ask, nodes on one thread each", asked(&on_one_thread).await);
            table.add("Sender::ask, one hop", asked(&one).await);
            table.add("Sender::ask, two hops", asked(&two).await);
        }
        table.print();
        let (one, two) = ("Sender::ask, one hop", "Sender::ask, two hops");
        println!("two hops take {:.2} times one", table.ratio(two) / table.ratio(one));
        node.shutdown().await;
        alone.shutdown().await;
    });
}
