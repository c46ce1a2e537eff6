//! Wheels on one node, their commander on another: when the cable between them is cut, the wheels
//! stop by themselves, within their lease; what the commander still says is not carried out.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{ActuatorSpec, Direction, Link, Network};
use blastema_examples::free_addresses;
use std::time::Duration;

/// For the nodes to find each other.
const PATIENCE: Duration = Duration::from_secs(10);

/// Turns the wheels; answers how fast they turn now.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = f32)]
struct Drive(#[contract(unit = "m/s")] f32);

struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        let brakes = || println!("brakes on"); // without the component, should it hang
        let spec = ActuatorSpec::new(Drive(0.0), Duration::from_secs(10))
            .lease(Duration::from_secs(1))
            .cut_off(brakes);
        ports.actuator(spec);
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) -> f32 {
        println!("the wheels turn at {} m/s", drive.0);
        drive.0
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [here, there] = free_addresses()?;
    let base = Node::builder("module2")
        .network(Network::udp("ethernet", there).link(Link::new("module1", here)))
        .child(ChildSpec::new("wheels", || Wheels))
        .start()
        .await?;
    let node = Node::builder("module1")
        .network(Network::udp("ethernet", here).link(Link::new("module2", there)).with_faults(1))
        .start()
        .await?;
    assert!(node.connected("module2", PATIENCE).await);

    let planner = node.commander::<Drive>("module2:wheels", "planner")?;
    planner.claim().await?;
    planner.command(Drive(1.0)).await?;
    let console = base.commander::<Drive>("wheels", "console")?;
    if let Err(DeliveryError::Held { .. }) = console.claim().await {
        println!("the console is refused");
    }

    let mut faults = base.fault_events();
    println!("-- the cable is cut");
    node.cable("ethernet").expect("it was described with faults").cut(Direction::Both, false);
    while let Some(event) = faults.next().await {
        if event.fault.kind == FaultKind::CommanderGone {
            break; // the commander has gone
        }
    }
    if let Err(why) = planner.command(Drive(2.0)).await {
        println!("the planner hears: {why}");
    }
    console.claim_within(PATIENCE).await?; // the wheels are still being stopped
    println!("the console commands: {} m/s", console.command(Drive(0.1)).await?);
    node.shutdown().await;
    base.shutdown().await;
    Ok(())
}
