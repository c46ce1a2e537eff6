//! A cable is pulled while an arm is being commanded, and the arm does not notice: the other cable
//! takes over, and every step of the movement arrives, once and in order.
//!
//! On a real network the interface tells of the pulled cable (`Network::udp` finds it by its
//! address), and hellos find whatever it does not tell of; here a faulty medium stands in for both.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Direction, FaultLocation, Link, LinkRow, LinkState, Network};
use std::f32::consts::FRAC_PI_2;
use std::net::{SocketAddr, UdpSocket};
use std::time::{Duration, Instant};

/// For the nodes to find each other.
const PATIENCE: Duration = Duration::from_secs(10);
const STEPS: u32 = 500;

/// Where the arm should be next.
#[derive(Clone, Debug, Event)]
#[contract(name = "arm/step")]
struct Step {
    number: u32,
    #[contract(unit = "rad")]
    angle: f32,
}

/// How the movement went, as the arm saw it.
#[derive(Clone, Debug, Request)]
#[contract(name = "arm/report", reply = Report)]
struct HowWasIt;

/// What an arm has to say of its movement.
#[derive(Clone, Debug, Structure)]
struct Report {
    steps: u32,
    #[contract(unit = "rad")]
    angle: f32,
    #[contract(unit = "ms")]
    longest_pause: f32,
}

/// Commands the arm, wherever it is: one step in every round.
struct Planner {
    arm: Sender<Step>,
    number: u32,
}

impl Component for Planner {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.number += 1;
        let angle = FRAC_PI_2 * self.number as f32 / STEPS as f32;
        self.arm.deliver(Step { number: self.number, angle }).await?;
        if self.number == STEPS {
            cx.set_interval(None);
        }
        Ok(())
    }
}

#[derive(Default)]
struct Arm {
    steps: u32,
    angle: f32,
    last: Option<Instant>,
    longest_pause: Duration,
}

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Step>().serve::<HowWasIt>();
    }
}

impl Handle<Step> for Arm {
    async fn handle(&mut self, step: Step, _: &mut Context<Self>) {
        // A step that is left out is a jerk, and one that comes twice is one back.
        assert_eq!(step.number, self.steps + 1);
        (self.steps, self.angle) = (step.number, step.angle);
        let now = Instant::now();
        let pause = self.last.map_or(Duration::ZERO, |last| now - last);
        self.longest_pause = self.longest_pause.max(pause);
        self.last = Some(now);
    }
}

impl Handle<HowWasIt> for Arm {
    async fn handle(&mut self, _: HowWasIt, _: &mut Context<Self>) -> Report {
        let longest_pause = self.longest_pause.as_secs_f32() * 1e3;
        Report { steps: self.steps, angle: self.angle, longest_pause }
    }
}

/// One of two cables to `neighbour`.
fn cable(name: &str, own: SocketAddr, neighbour: &str, remote: SocketAddr) -> Network {
    Network::udp(name, own).link(Link::new(neighbour, remote)).with_faults(1)
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [a1, a2, b1, b2] = free_addresses()?;
    let shoulder = Node::builder("shoulder")
        .network(cable("left", a2, "brain", a1))
        .network(cable("right", b2, "brain", b1))
        .child(ChildSpec::new("arm", Arm::default))
        .start()
        .await?;
    let brain = Node::builder("brain")
        .network(cable("left", a1, "shoulder", a2))
        .network(cable("right", b1, "shoulder", b2))
        .start()
        .await?;
    assert!(brain.connected("shoulder", PATIENCE).await);
    let up = |links: Vec<LinkRow>| links.iter().all(|link| link.state == LinkState::Up);
    while !up(brain.links().await) {} // both cables, so that one can be spared

    let mut faults = brain.fault_events();
    let report: Sender<HowWasIt> = brain.sender("shoulder:arm")?;
    let arm: Sender<Step> = brain.sender("shoulder:arm")?;
    let planner = move || Planner { arm: arm.clone(), number: 0 };
    brain.add_child(ChildSpec::new("planner", planner).rate_hz(500.0)).await?;

    while report.ask(HowWasIt).await?.steps < 200 {}
    println!("the left cable is pulled");
    for node in [&brain, &shoulder] {
        node.cable("left").expect("it is faulty").cut(Direction::Both, true);
    }
    while let Some(event) = faults.next().await {
        let FaultLocation::Link { link, .. } = &event.fault.location else { continue };
        if event.fault.kind == FaultKind::LinkDown && link.as_ref() == "left" {
            println!("{}: {}", event.fault.kind, event.fault.location);
            break;
        }
    }
    let mut seen = report.ask(HowWasIt).await?;
    while seen.steps < STEPS {
        seen = report.ask(HowWasIt).await?;
    }
    println!("the arm took {} steps, once and in order, to {:.2} rad", seen.steps, seen.angle);
    println!("its longest pause: {:.1} ms", seen.longest_pause);
    brain.shutdown().await;
    shoulder.shutdown().await;
    Ok(())
}

/// Four addresses of this computer that are free.
fn free_addresses() -> std::io::Result<[SocketAddr; 4]> {
    // Held together, so that they differ, and given back for the nodes to take.
    let held = [0; 4].map(|_| UdpSocket::bind("127.0.0.1:0"));
    let mut addresses = [SocketAddr::from(([127, 0, 0, 1], 0)); 4];
    for (address, socket) in addresses.iter_mut().zip(held) {
        *address = socket?.local_addr()?;
    }
    Ok(addresses)
}
