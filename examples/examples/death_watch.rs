//! Anyone may ask to be told when an incarnation of an object ends: here the tool changer, which
//! must not let go while the arm that holds it is down.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{Down, DownReason};

/// Moves the arm.
#[derive(Debug, Request)]
#[contract(name = "arm/move", reply = ())]
struct Move {
    #[contract(unit = "m")]
    to: f32,
}

struct Arm;

impl Component for Arm {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Move>();
    }
}

impl Handle<Move> for Arm {
    async fn handle(&mut self, order: Move, _: &mut Context<Self>) {
        assert!(order.to < 1.0, "{} m is out of reach", order.to);
    }
}

/// Says whether the tool may be released.
#[derive(Debug, Request)]
#[contract(name = "tool/release", reply = bool)]
struct Release;

#[derive(Default)]
struct ToolChanger {
    deaths: u32,
}

impl Component for ToolChanger {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Release>();
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.watch("arm")?; // for this incarnation, through all incarnations of the arm
        Ok(())
    }
}

impl Handle<Down> for ToolChanger {
    async fn handle(&mut self, down: Down, _: &mut Context<Self>) {
        self.deaths += 1;
        match down.ending {
            DownReason::Panicked { text, during, .. } => {
                println!("{}{} died in {during}: {text}", down.object, down.incarnation);
            }
            other => println!("{}{}: {other:?}", down.object, down.incarnation),
        }
    }
}

impl Handle<Release> for ToolChanger {
    async fn handle(&mut self, _: Release, _: &mut Context<Self>) -> bool {
        self.deaths == 0
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let node = Node::builder("module1")
        .child(ChildSpec::new("arm", || Arm))
        .child(ChildSpec::new("tool", ToolChanger::default))
        .start()
        .await?;
    let arm: Sender<Move> = node.sender("arm")?;
    let tool: Sender<Release> = node.sender("tool")?;

    println!("may release: {}", tool.ask(Release).await?);
    let killed = arm.ask(Move { to: 2.0 }).await;
    println!("{}", killed.map_or_else(|error| error.to_string(), |()| "moved".into()));
    arm.ask(Move { to: 0.5 }).await?; // the arm's next incarnation, and by now the watcher has been told
    println!("may release: {}", tool.ask(Release).await?);
    node.shutdown().await;
    Ok(())
}
