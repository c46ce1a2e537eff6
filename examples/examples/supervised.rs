//! A chain in which each depends on the one before: when the laser dies, the planner and the motors
//! are stopped and started again behind it, and the wheels are not driven on old data meanwhile.
//! When that happens more often than the supervisor allows, and the robot cannot do without its
//! drive, the node enters the safe state with its brakes on.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use std::time::Duration;

/// Makes the component panic, as a programming error would.
#[derive(Debug, Request)]
#[contract(reply = ())]
struct Strike;

/// A part of the drive: it says when it works, and when it brings its outputs to rest.
struct Part {
    name: &'static str,
}

impl Component for Part {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Strike>();
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{}{} works", self.name, cx.incarnation());
        Ok(())
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{}{} rests", self.name, cx.incarnation());
        Ok(())
    }
}

impl Handle<Strike> for Part {
    async fn handle(&mut self, _: Strike, _: &mut Context<Self>) {
        panic!("struck");
    }
}

/// Strikes the laser once a round.
struct Gremlin;

impl Component for Gremlin {
    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("-- the laser is struck");
        cx.sender::<Strike>("laser")?.tell(Strike)?;
        Ok(())
    }
}

fn part(name: &'static str) -> ChildSpec<Part> {
    ChildSpec::new(name, move || Part { name })
}

#[blastema::main]
async fn main() -> Result<(), StartError> {
    // Started in this order, stopped in reverse. When one fails, it is restarted with all that
    // follow.
    let drive = SupervisorSpec::new("drive", Strategy::RestForOne)
        .intensity(1, Duration::from_secs(10))
        .essential()
        .child(part("laser"))
        .child(part("planner"))
        .child(part("motors"));
    let node = Node::builder("module1")
        .supervisor(drive)
        .child(ChildSpec::new("gremlin", || Gremlin).rate_hz(1.0))
        // A drive that has given up is not restarted, and it is essential: the root gives up as
        // well.
        .intensity(0, Duration::from_secs(10))
        .safe_outputs(|fault| println!("brakes on: {} of {}", fault.kind, fault.location))
        .start()
        .await?;

    if let NodeState::InSafeState { reason } = node.ended().await {
        println!("in safe state: {reason}");
    }
    node.shutdown().await;
    Ok(())
}
