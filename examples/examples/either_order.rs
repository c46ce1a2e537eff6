//! A planner that starts before the motors which it commands, and outlives their restart: it claims
//! them in a task, which waits until they are there, and claims them again whenever the lease has
//! ended.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{ActuatorSpec, Hold};
use std::time::Duration;

/// Turns the wheels; answers how fast they turn now.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", reply = f32)]
struct Drive(#[contract(unit = "m/s")] f32);

#[derive(Clone, Debug, Event)]
struct Overcurrent;

struct Motors;

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        let spec = ActuatorSpec::new(Drive(0.0), Hold).lease(Duration::from_millis(100));
        ports.actuator(spec).accept::<Overcurrent>();
    }
}

impl Handle<Drive> for Motors {
    async fn handle(&mut self, drive: Drive, cx: &mut Context<Self>) -> f32 {
        println!("motors {}: {} m/s", cx.incarnation(), drive.0);
        drive.0
    }
}

impl Handle<Overcurrent> for Motors {
    async fn handle(&mut self, _: Overcurrent, _: &mut Context<Self>) {
        panic!("the fuse has blown");
    }
}

struct Planner;

impl Component for Planner {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let motors = cx.commander::<Drive>("motors")?;
        // Not here: the motors start only when the planner is active.
        cx.spawn(async move {
            loop {
                match motors.claim_within(Duration::from_secs(5)).await {
                    Ok(_) => {
                        while motors.command(Drive(1.0)).await.is_ok() {
                            blastema::sleep(Duration::from_millis(20)).await;
                        }
                    }
                    Err(why) => println!("planner: {why}"),
                }
                // A refusal can be immediate: always wait before the next claim.
                blastema::sleep(Duration::from_millis(20)).await;
            }
        });
        println!("the planner is active");
        Ok(())
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let group = SupervisorSpec::new("drive", Strategy::OneForOne)
        .child(ChildSpec::new("planner", || Planner))
        .child(ChildSpec::new("motors", || Motors));
    let node = Node::builder("module1").supervisor(group).start().await?;
    blastema::sleep(Duration::from_millis(300)).await;

    println!("-- the motors fail");
    node.sender::<Overcurrent>("motors")?.tell(Overcurrent)?;
    blastema::sleep(Duration::from_millis(500)).await;
    node.shutdown().await;
    Ok(())
}
