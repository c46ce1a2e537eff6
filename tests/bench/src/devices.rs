//! Devices as processes on ptys: silence until the device is lost, a request and its reply, and the
//! share of a core that 32 of them take. A pty has no baud rate: the time of a request is beside
//! that of its bytes.

use crate::measure::Quantiles;
use blastema::prelude::*;
use blastema::{DeviceProxy, DeviceSpec, Lifecycle};
use blastema_ptys::Cable;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use tempfile::TempDir;

#[derive(Debug, Request)]
#[contract(name = "bench/echo", reply = u64)]
struct Echo {
    number: u64,
}

#[derive(Clone, Debug, Event)]
#[contract(name = "bench/sample", delivery = "newest")]
struct Sample {
    number: u64,
}

const INTERVAL: Duration = Duration::from_millis(10);
/// Framing, header, commands, status and checksum of a request and its reply, and eight bytes in
/// each.
const BYTES: u32 = 15 + 16;

fn spec(name: &str, port: &Path) -> DeviceSpec {
    DeviceSpec::new(name, &format!("serial://{}?baud=115200", port.display()), 7)
        .interval(INTERVAL)
        .turnaround(INTERVAL / 2)
        .period(INTERVAL)
        .serves::<Echo>(0)
        .publishes::<Sample>(0, name)
}

fn compile(folder: &Path) -> PathBuf {
    let header = spec("device", Path::new("/dev/null")).header().expect("the spec is right");
    std::fs::write(folder.join("device.h"), header).expect("a header");
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (library, program) = (here.join("../../core/lite/c"), folder.join("device"));
    let status = Command::new("cc")
        .args(["-std=c99", "-O2", "-DBL_CONFIG=\"device.h\""])
        .args([Path::new("-I"), folder, Path::new("-I"), &library])
        .args([Path::new("-I"), &library.join("boards"), Path::new("-o"), &program])
        .args([library.join("boards/linux.c"), library.join("blastema_lite.c")])
        .arg(here.join("src/device.c"))
        .status()
        .expect("the benchmark of devices needs a C compiler, `cc`");
    assert!(status.success());
    program
}

struct Chip(Child);

impl Chip {
    fn new(program: &Path, port: &Path, boots: &Path) -> Self {
        Chip(Command::new(program).arg(port).arg(boots).spawn().expect("the firmware starts"))
    }

    fn signal(&self, signal: &str) {
        let id = self.0.id().to_string();
        assert!(Command::new("kill").args([signal, &id]).status().expect("kill runs").success());
    }
}

impl Drop for Chip {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

async fn until_state(node: &Node, name: &str, is_active: bool) {
    let device = node.actor::<DeviceProxy>(name).expect("a device");
    while (device.state() == Lifecycle::Active) != is_active {
        blastema::sleep(Duration::from_micros(200)).await;
    }
}

/// The time that the threads of this process have had, without the relays of its ptys.
fn used() -> Duration {
    let threads = std::fs::read_dir("/proc/self/task").expect("the system is Linux");
    let times = threads.flatten().filter_map(|thread| {
        let read = |name| std::fs::read_to_string(thread.path().join(name)).ok();
        let of_bench = read("comm")?.trim() != "cable";
        let times = read("schedstat").filter(|_| of_bench)?;
        times.split(' ').next()?.parse().ok().map(Duration::from_nanos)
    });
    times.sum()
}

pub(crate) async fn run(rounds: usize) {
    let folder = TempDir::new().expect("a folder");
    let program = compile(folder.path());
    let cables: Vec<_> = (0..32).map(|_| Cable::new()).collect();
    let boots = |at: usize| folder.path().join(format!("boots{at}"));
    let start = |at: usize| Chip::new(&program, &cables[at].right(), &boots(at));
    let node = Node::builder("bench").intensity(1000, Duration::from_secs(1));
    let node = node.child(spec("d0", &cables[0].left()).child()).start().await;
    let node = node.expect("the node starts");
    let chip = start(0);
    until_state(&node, "d0", true).await;

    let echo: Sender<Echo> = node.sender("d0").expect("a device");
    let mut times = Quantiles::default();
    for number in 0..2000 {
        let begun = Instant::now();
        echo.ask(Echo { number }).await.expect("the device answers");
        times.add(begun.elapsed());
    }
    let line = Duration::from_secs(1) * (BYTES * 10) / 115_200;
    times.print(&format!("request and reply of 8 bytes; {line:?} on a line at 115,200 baud more"));

    let mut times = Quantiles::default();
    for _ in 0..rounds * 20 {
        chip.signal("-STOP");
        let begun = Instant::now();
        until_state(&node, "d0", false).await;
        times.add(begun.elapsed());
        chip.signal("-CONT");
        until_state(&node, "d0", true).await;
    }
    times.print("silence to lost, pings every 10 ms");
    node.shutdown().await;

    let mut times = Quantiles::default();
    for _ in 0..rounds * 20 {
        let begun = Instant::now();
        let node = Node::builder("bench").child(spec("d0", &cables[0].left()).child());
        let node = node.start().await.expect("the node starts");
        until_state(&node, "d0", true).await;
        times.add(begun.elapsed());
        node.shutdown().await;
    }
    times.print("a node that starts to a device at work, which goes on");
    drop(chip);

    let chips: Vec<_> = (0..cables.len()).map(start).collect();
    let mut builder = Node::builder("bench").intensity(1000, Duration::from_secs(1));
    for (at, cable) in cables.iter().enumerate() {
        // Values are signs of life as well.
        let device = spec(&format!("d{at}"), &cable.left()).interval(DeviceSpec::INTERVAL);
        builder = builder.child(device.child());
    }
    let node = builder.start().await.expect("the node starts");
    for at in 0..cables.len() {
        until_state(&node, &format!("d{at}"), true).await;
    }
    let (before, begun) = (used(), Instant::now());
    blastema::sleep(Duration::from_secs(10)).await;
    let share = (used() - before).as_secs_f64() / begun.elapsed().as_secs_f64();
    println!("32 devices at 100 Hz, without the ptys: {:.1} % of a core", share * 100.0);
    node.shutdown().await;
    drop(chips);
}
