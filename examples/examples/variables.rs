//! Variables of another node: they are read, watched and written as if they were here, and the owner
//! says what its restart leaves of them.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Link, Network, RestorePolicy, ValueState};
use blastema_examples::free_addresses;
use std::time::Duration;

/// For the nodes to find each other.
const PATIENCE: Duration = Duration::from_secs(10);

/// What the gripper holds, and how fast the arm may move with it: never one without the other.
#[derive(Clone, Debug, Variable)]
#[contract(name = "arm/load")]
struct Load {
    #[contract(unit = "kg")]
    mass: f32,
    #[contract(unit = "rad/s")]
    limit: f32,
}

/// Where it is to go. After a restart the robot should not go on to an old target unasked.
#[derive(Clone, Debug, Variable)]
#[contract(name = "arm/target")]
struct Target(String);

struct Arm;

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        let load = VariableSpec::new(Load { mass: 0.0, limit: 0.5 });
        let load = load.check(|load| match load.limit <= 2.0 {
            true => Ok(()),
            false => Err("the arm breaks above 2 rad/s".into()),
        });
        let target = VariableSpec::new(Target("rest".into()));
        ports.variable(load).variable(target.after_restart(RestorePolicy::Hold)).accept::<Blow>();
    }
}

/// Ends an incarnation of the arm.
#[derive(Clone, Debug, Event)]
struct Blow;

impl Handle<Blow> for Arm {
    async fn handle(&mut self, _: Blow, _: &mut Context<Self>) {
        panic!("a blow");
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let [here, there] = free_addresses()?;
    let arm = Node::builder("module2")
        .network(Network::udp("ethernet", there).link(Link::new("module1", here)))
        .child(ChildSpec::new("arm", || Arm))
        .start()
        .await?;
    let node = Node::builder("module1")
        .network(Network::udp("ethernet", here).link(Link::new("module2", there)))
        .start()
        .await?;
    assert!(node.connected("module2", PATIENCE).await);

    let load = node.variable::<Load>("module2:arm")?;
    let target = node.variable::<Target>("module2:arm")?;
    println!("limit: {} rad/s", load.read().await?.value.limit);

    // Heavier, and therefore slower.
    load.write(Load { mass: 3.0, limit: 0.2 }).await?;
    println!("limit: {} rad/s", load.read().await?.value.limit);
    if let Err(why) = load.write(Load { mass: 0.0, limit: 9.0 }).await {
        println!("{why}; the load is still {} kg", load.read().await?.value.mass);
    }

    target.write(Target("shelf".into())).await?;
    let mut watch = target.watch();
    println!("target: {}", watch.next().await?.value.0);
    arm.sender::<Blow>("arm")?.tell(Blow)?;
    let left = watch.next().await?;
    println!("after a blow: {}, {:?}", left.value.0, left.state);
    if left.state == ValueState::Held {
        target.write(Target("rest".into())).await?;
    }
    println!("target: {}", watch.next().await?.value.0);
    println!("the load is still {} kg", load.read().await?.value.mass);
    node.shutdown().await;
    arm.shutdown().await;
    Ok(())
}
