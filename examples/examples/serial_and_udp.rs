//! One robot over a serial line and UDP at once: whichever cable is pulled, the arm gets every
//! order once, and notices nothing.
//!
//! The serial line is a pair of ptys here, so that the example runs anywhere; on a robot it is a
//! path such as `/dev/serial/by-id/…`.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Direction, FaultEvents, FaultLocation, FaultTransition, Link, LinkState, Network};
use blastema_examples::free_addresses;
use blastema_ptys::Cable;
use std::path::Path;
use std::time::Duration;

/// Also on a machine with other things to do.
const PATIENCE: Duration = Duration::from_secs(10);

/// Moves the arm by so much; the answer is where it is then.
#[derive(Debug, Request)]
#[contract(name = "arm/move", reply = i32)]
struct Move {
    #[contract(unit = "mm")]
    by: i32,
}

#[derive(Default)]
struct Arm {
    at_mm: i32,
}

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Move>();
    }
}

impl Handle<Move> for Arm {
    async fn handle(&mut self, order: Move, _: &mut Context<Self>) -> i32 {
        self.at_mm += order.by;
        self.at_mm
    }
}

/// The networks of one end. The serial line is dearer, and so only used when it must be. Nodes with
/// keys (`.keys("arm.key")` at the builder) seal both; these have none, which the word `insecure`
/// accepts for the line.
fn networks(own: &str, serial: &Path, far: &str, peer: &str) -> [Network; 2] {
    let serial = format!("serial://{}?baud=921600", serial.display());
    [
        Network::new("ethernet", &format!("udp://{own}")).peer(peer, far).with_faults(1),
        Network::new("serial", &serial).link(Link::to(peer, "").cost(50)).insecure(),
    ]
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [a, b] = free_addresses()?.map(|address| address.to_string());
    let line = Cable::new();
    let [ethernet, serial] = networks(&b, &line.right(), &a, "body");
    let module = Node::builder("arm")
        .network(ethernet)
        .network(serial)
        .child(ChildSpec::new("arm", Arm::default))
        .start()
        .await?;
    let [ethernet, serial] = networks(&a, &line.left(), &b, "arm");
    let body = Node::builder("body").network(ethernet).network(serial).start().await?;
    assert!(body.connected("arm", Duration::from_secs(10)).await);
    all_links_up(&body).await;
    let arm: Sender<Move> = body.sender("arm:arm")?;
    let mut faults = body.fault_events();

    let ethernet = body.cable("ethernet").expect("it was described with faults");
    for order in 1..=300 {
        match order {
            100 => ethernet.cut(Direction::Both, false), // pulled behind a switch: no node is told
            200 => {
                println!("{}", link_down(&mut faults, "ethernet").await);
                ethernet.restore();
                all_links_up(&body).await;
                line.inject(&line.left(), b"noise is nothing but noise");
                line.unplug(); // the port itself vanishes
            }
            _ => {}
        }
        // Nothing is lost, and nothing done twice.
        assert_eq!(arm.ask_within(Move { by: 1 }, PATIENCE).await?, order);
    }
    println!("{}", link_down(&mut faults, "serial").await);
    println!("300 orders carried out, each once");

    line.plug();
    all_links_up(&body).await;
    println!("both cables are back");
    body.shutdown().await;
    module.shutdown().await;
    Ok(())
}

/// Waits until this link fails, and says so.
async fn link_down(faults: &mut FaultEvents, name: &str) -> String {
    while let Some(event) = faults.next().await {
        let FaultLocation::Link { link, .. } = &event.fault.location else { continue };
        let found = event.turn == FaultTransition::Found && link.as_ref() == name;
        if found && event.fault.kind == FaultKind::LinkDown {
            return format!("{}: {}", event.fault.kind, event.fault.location);
        }
    }
    "the node has ended".into()
}

async fn all_links_up(node: &Node) {
    while node.links().await.iter().any(|link| link.state != LinkState::Up) {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}
