//! A rover whose operator is another process. What the rover does, a behaviour tree says: it drives
//! as the operator says while the radio is good, stands while the radio is slow, and returns by
//! itself when the operator is lost. The tree is `examples/robots/rover.tree.xml`.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::trees::{BehaviorTree, Port, Status, TreeLeaves};
use blastema::{ActuatorSpec, Direction, Hold, Impairment, Link, Network};
use std::net::{SocketAddr, UdpSocket};
use std::process::{Child, Command};
use std::time::{Duration, Instant};
use tokio::sync::mpsc::{UnboundedReceiver, unbounded_channel};

/// The position of the operator's stick.
#[derive(Clone, Debug, Event)]
#[contract(name = "operator/stick", version = 1)]
struct Stick {
    #[contract(unit = "m/s")]
    speed: f64,
}

/// The last position of the stick, on the rover.
#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "rover/stick", version = 1)]
struct StickPosition {
    #[contract(unit = "m/s")]
    speed: f64,
}

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", version = 1, reply = ())]
struct Drive {
    #[contract(unit = "m/s")]
    speed: f64,
}

/// Keeps the position of the stick.
struct StickReceiver;

impl Component for StickReceiver {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Stick>();
        ports.variable(VariableSpec::new(StickPosition { speed: 0.0 }));
    }
}

impl Handle<Stick> for StickReceiver {
    async fn handle(&mut self, stick: Stick, cx: &mut Context<Self>) {
        if let Ok(position) = cx.variable::<StickPosition>("stick") {
            let _ = position.write(StickPosition { speed: stick.speed }).await;
        }
    }
}

struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive { speed: 0.0 }, Hold));
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, _: Drive, _: &mut Context<Self>) {}
}

/// The operator's process: heartbeats, and a stick that is pushed forward.
async fn operate(own: SocketAddr, rover: SocketAddr) -> Result<(), Box<dyn std::error::Error>> {
    blastema::platform::end_with_parent(std::os::unix::process::parent_id())?;
    let network = Network::udp("radio", own).link(Link::new("rover", rover));
    let node = Node::builder("operator").network(network).start().await?;
    let _beats = node.heartbeat("operator/heartbeat", Duration::from_millis(50))?;
    let stick = node.publisher::<Stick>("operator/stick")?;
    loop {
        let _ = stick.publish(Stick { speed: 1.0 });
        blastema::sleep(Duration::from_millis(100)).await;
    }
}

/// Waits until the rover does this, and prints a line of the table.
async fn row(what: &str, does: &str, begun: Instant, doing: &mut UnboundedReceiver<String>) {
    while let Some(text) = doing.recv().await {
        if text == does {
            println!("{:5.1} s | {what:24} | {does}", begun.elapsed().as_secs_f64());
            return;
        }
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    if let [own, rover] = &arguments[..] {
        return operate(own.parse()?, rover.parse()?).await;
    }
    let [here, there] = free_addresses()?;
    let operator = || -> std::io::Result<Child> {
        let addresses = [there.to_string(), here.to_string()];
        Command::new(std::env::current_exe()?).args(addresses).spawn()
    };

    let (told, mut doing) = unbounded_channel();
    let leaves = TreeLeaves::new()
        .actuator::<Drive>("Wheels")
        .variable::<StickPosition>("Stick")
        .action("Tell", [Port::input::<String>("text")], move |cx| {
            let _ = told.send(cx.input::<String>("text")?);
            Ok(Status::Success)
        });
    let tree = BehaviorTree::of_text("mission", &leaves, include_str!("../robots/rover.tree.xml"))?;
    let rover = Node::builder("rover")
        .network(Network::udp("radio", here).link(Link::new("operator", there)).with_faults(7))
        .child(ChildSpec::new("stick", || StickReceiver))
        .child(ChildSpec::new("wheels", || Wheels))
        .child(tree)
        .start()
        .await?;
    let radio = rover.cable("radio").expect("it was described with faults");

    let (drives, stands, returns) =
        ("drives as the operator says", "stands: the radio is too slow", "returns by itself");
    let begun = Instant::now();
    println!("   time | what happens             | what the rover does");
    row("it is switched on", returns, begun, &mut doing).await;
    let mut process = operator()?;
    row("the operator starts", drives, begun, &mut doing).await;
    process.kill()?;
    process.wait()?;
    row("the operator is killed", returns, begun, &mut doing).await;
    let mut process = operator()?;
    row("the operator is back", drives, begun, &mut doing).await;
    radio.cut(Direction::Both, true);
    row("the cable is pulled", returns, begun, &mut doing).await;
    radio.restore();
    row("the cable is back", drives, begun, &mut doing).await;
    let slow = Impairment { delay: Duration::from_millis(300), loss: 0.2, ..Impairment::NONE };
    radio.impair(Direction::Both, slow);
    row("the radio is slow", stands, begun, &mut doing).await;
    radio.restore();
    row("the radio is well again", drives, begun, &mut doing).await;
    process.kill()?;
    process.wait()?;
    rover.shutdown().await;
    Ok(())
}

/// Two addresses of this computer that are free.
fn free_addresses() -> std::io::Result<[SocketAddr; 2]> {
    let held = [0; 2].map(|_| UdpSocket::bind("127.0.0.1:0"));
    let mut addresses = [SocketAddr::from(([127, 0, 0, 1], 0)); 2];
    for (address, socket) in addresses.iter_mut().zip(held) {
        *address = socket?.local_addr()?;
    }
    Ok(addresses)
}
