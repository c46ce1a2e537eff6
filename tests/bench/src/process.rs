//! What benchmarks of several processes, and of a whole process, have in common.

use blastema::{Link, Network, Node, NodeBuilder};
use rustix::thread::{CpuSet, sched_setaffinity};
use std::io::{BufRead, BufReader, Write};
use std::net::{Ipv4Addr, SocketAddr, UdpSocket};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

/// Keeps the threads that this one starts from now on, and itself, on one core.
pub(crate) fn pin(core: usize) {
    let mut set = CpuSet::new();
    set.set(core);
    // Where there is no second core, or no right to choose, both sides are unpinned alike.
    let _ = sched_setaffinity(None, &set);
}

/// Addresses that were free a moment ago.
pub(crate) fn addresses<const N: usize>() -> [SocketAddr; N] {
    let sockets = [(); N].map(|()| UdpSocket::bind((Ipv4Addr::LOCALHOST, 0)).expect("a free port"));
    sockets.map(|socket| socket.local_addr().expect("a bound socket has an address"))
}

/// Another process of this program, which ends with its standard input.
pub(crate) struct Peer(Child);

impl Peer {
    /// Starts a part of this program as a child, and waits until it says that it is ready.
    pub(crate) fn start(part: &str, arguments: &[String]) -> Self {
        let mut child = program(part, arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("this program starts");
        let output = child.stdout.take().expect("it was piped");
        BufReader::new(output).read_line(&mut String::new()).expect("it prints a line");
        Peer(child)
    }
}

impl Drop for Peer {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        let _ = self.0.wait();
    }
}

/// This program as a child that runs a part.
fn program(part: &str, arguments: &[String]) -> Command {
    let mut program = Command::new(std::env::current_exe().expect("a running program has a file"));
    program.args(["--child", part]).args(arguments);
    program
}

/// The figure that a fresh process prints that runs a part; not a number where it prints none.
pub(crate) fn fresh(part: &str, arguments: &[&str]) -> f64 {
    let output = program(part, &texts(arguments)).output().expect("this program starts");
    String::from_utf8_lossy(&output.stdout).trim().parse().unwrap_or(f64::NAN)
}

/// A node with these links, of three words each: `OWN NEIGHBOUR ADDRESS`. The key may be empty.
pub(crate) fn builder(name: &str, key: &str, medium: &str, links: &[String]) -> NodeBuilder {
    let builder = Node::builder(name);
    let mut builder = if key.is_empty() { builder } else { builder.keys(key) };
    for (number, link) in links.chunks(3).enumerate() {
        let [own, far, at] = link else { panic!("the parent writes three words for a link") };
        let parse = |text: &str| text.parse().expect("the parent writes addresses");
        let (name, far) = (format!("net{number}"), Link::new(far, parse(at)));
        builder = builder.network(match medium {
            "tcp" => Network::tcp(&name, parse(own)).link(far),
            _ => Network::udp(&name, parse(own)).link(far),
        });
    }
    builder
}

/// Says that this process is ready, and waits until its parent ends it.
pub(crate) fn serve_until_told() {
    println!("ready");
    let _ = std::io::stdout().flush();
    let _ = std::io::stdin().read_line(&mut String::new());
}

/// Arguments of a child.
pub(crate) fn texts(parts: &[&str]) -> Vec<String> {
    parts.iter().map(|part| (*part).to_owned()).collect()
}

/// The processor time that this process has taken.
pub(crate) fn cpu_seconds() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 / 1e9
}

/// Waits until the process rests: no report is on its way through the fault chain any more.
pub(crate) async fn settle() {
    loop {
        let (cpu, start) = (cpu_seconds(), Instant::now());
        tokio::time::sleep(Duration::from_millis(500)).await;
        let share = (cpu_seconds() - cpu) / start.elapsed().as_secs_f64();
        if share < 0.05 {
            return;
        }
    }
}
