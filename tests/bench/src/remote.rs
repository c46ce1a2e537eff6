//! A request of 64 bytes and its reply between processes, over one hop and over two, without keys
//! and with them.
//!
//! This process is pinned to the first core and every other to the second.

use crate::keys::BenchKeys;
use crate::measure::{Table, median};
use crate::process::{Peer, addresses, builder, pin, serve_until_told, texts};
use blastema::prelude::*;
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

/// Another process: `KEY MEDIUM NAME (OWN NEIGHBOUR ADDRESS)...`; the key may be empty.
pub(crate) fn child(arguments: &[String]) {
    pin(1);
    let [key, medium, name, links @ ..] = arguments else { return };
    blastema::run(async {
        let builder = builder(name, key, medium, links).child(ChildSpec::new("mirror", || Mirror));
        let node = builder.start().await.expect("the node starts");
        let _ = tokio::task::spawn_blocking(serve_until_told).await;
        node.shutdown().await;
    });
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
    let keys = BenchKeys::new(&["near", "middle", "far"]);
    blastema::run(async {
        let (mut nodes, mut peers, mut rows) = (Vec::new(), Vec::new(), Vec::new());
        for sealed in [false, true] {
            let [near, left, right, far] = addresses().map(|address| address.to_string());
            let key = |name: &str| if sealed { keys.of(name) } else { String::new() };
            let with = if sealed { "with" } else { "without" };
            for arguments in [
                &[&key("middle"), medium, "middle", &left, "near", &near, &right, "far", &far][..],
                &[&key("far"), medium, "far", &far, "middle", &right],
            ] {
                peers.push(Peer::start("remote", &texts(arguments)));
            }
            let links = [near, "middle".into(), left];
            let node = builder("near", &key("near"), medium, &links).start().await;
            let node = node.expect("the node starts");
            for (mirror, hops) in [("middle:mirror", "one hop"), ("far:mirror", "two hops")] {
                rows.push((format!("{hops}, {with} keys"), reached(&node, mirror).await));
            }
            nodes.push(node);
        }
        let title = format!("request and reply of 64 B between processes, {medium}");
        let mut table = Table::new(title, "us");
        for _ in 0..rounds {
            for (row, mirror) in &rows {
                table.add(row, asked(mirror).await);
            }
        }
        table.print();
        for hops in ["one hop", "two hops"] {
            let [open, sealed] =
                ["without", "with"].map(|keys| table.ratio(&format!("{hops}, {keys} keys")));
            println!("{hops} with keys takes {:.2} times as long", sealed / open);
        }
        for node in nodes {
            node.shutdown().await;
        }
    });
}
