//! Variables of another node: they are read, watched and written as if they were here, several
//! together or not at all, and the owner says what its restart leaves of them.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Link, Network, RestoreDecision, RestorePolicy, Transaction};
use blastema_examples::free_addresses;
use std::time::Duration;

/// For the nodes to find each other.
const PATIENCE: Duration = Duration::from_secs(10);

/// How fast the arm may move.
#[derive(Clone, Debug, Variable)]
#[contract(name = "arm/speed-limit")]
struct SpeedLimit(#[contract(unit = "rad/s")] f32);

/// What the gripper holds.
#[derive(Clone, Debug, Variable)]
#[contract(name = "arm/load")]
struct Load(#[contract(unit = "kg")] f32);

/// Where it is to go. After a restart the robot should not go on to an old target unasked.
#[derive(Clone, Debug, Variable)]
#[contract(name = "arm/target")]
struct Target(String);

struct Arm;

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        let limit = VariableSpec::new(SpeedLimit(0.5)).check(|limit| match limit.0 <= 2.0 {
            true => Ok(()),
            false => Err("the arm breaks above 2 rad/s".into()),
        });
        let target = VariableSpec::new(Target("rest".into()));
        ports
            .variable(limit)
            .variable(VariableSpec::new(Load(0.0)))
            .variable(target.after_restart(RestorePolicy::AskFirst))
            .accept::<Blow>();
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

    let limit = node.variable::<SpeedLimit>("module2:arm")?;
    let load = node.variable::<Load>("module2:arm")?;
    let target = node.variable::<Target>("module2:arm")?;
    println!("limit: {} rad/s", limit.read().await?.value.0);

    // Heavier, and therefore slower: never one without the other.
    Transaction::new().write(&load, Load(3.0)).write(&limit, SpeedLimit(0.2)).commit().await?;
    println!("limit: {} rad/s", limit.read().await?.value.0);
    let wrong = Transaction::new().write(&load, Load(0.0)).write(&limit, SpeedLimit(9.0));
    if let Err(why) = wrong.commit().await {
        println!("{why}; the load is still {} kg", load.read().await?.value.0);
    }

    target.write(Target("shelf".into())).await?;
    let mut watch = target.watch();
    println!("target: {}", watch.next().await?.value.0);
    arm.sender::<Blow>("arm")?.tell(Blow)?;
    println!("after a blow: {:?}", watch.next().await?.state);
    if let Err(why) = target.read().await {
        println!("{why}");
    }
    target.decide(RestoreDecision::Default).await?;
    println!("target: {}", watch.next().await?.value.0);
    println!("the load is still {} kg", load.read().await?.value.0);
    node.shutdown().await;
    arm.shutdown().await;
    Ok(())
}
