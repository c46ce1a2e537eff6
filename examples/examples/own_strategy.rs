//! A recovery strategy of the application's own, handed over by name: a gripper that has lost its
//! grip is told to grasp again, and is restarted only if that does not help.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::{FaultTransition, RecoveryStrategy, StrategyContext};

/// The application's own kind of fault.
const SLIP: &str = "GRIPPER-SLIP";

/// Takes hold. Says whether it has.
#[derive(Debug, Request)]
#[contract(name = "gripper/grasp", reply = bool)]
struct Grasp;

/// The thing slips away.
#[derive(Debug, Request)]
#[contract(name = "gripper/slip", reply = ())]
struct Slip;

/// A gripper that is sometimes clumsy.
struct Gripper {
    attempts: u32,
}

impl Component for Gripper {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Grasp>().serve::<Slip>();
    }
}

impl Handle<Grasp> for Gripper {
    async fn handle(&mut self, _: Grasp, _: &mut Context<Self>) -> bool {
        self.attempts += 1;
        self.attempts > 1
    }
}

impl Handle<Slip> for Gripper {
    async fn handle(&mut self, _: Slip, cx: &mut Context<Self>) {
        cx.declare_fault(FaultKind::Custom(SLIP.into()), "the force sensor reads nothing");
    }
}

/// Grasps again. The fault chain calls it, and waits for it no longer than the plan allows.
struct Regrasp;

impl RecoveryStrategy for Regrasp {
    async fn carry_out(
        &self,
        order: &RecoveryOrder,
        context: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        println!("attempt {} at {}", order.attempt, order.action);
        let gripper = context.sender::<Grasp>("gripper").map_err(|why| why.to_string())?;
        match gripper.ask(Grasp).await {
            Ok(true) => Ok(RecoveryDone::default()),
            Ok(false) => Err("it holds nothing".into()),
            Err(error) => Err(error.to_string().into()),
        }
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let regrasp = Ladder::first(RecoveryAction::Custom("regrasp".into())).times(3);
    let node = Node::builder("module1")
        .child(ChildSpec::new("gripper", || Gripper { attempts: 0 }))
        .fault_kind(SLIP)
        .recovery("regrasp", || Regrasp)
        .plan(
            Plan::default()
                .on(FaultKind::Custom(SLIP.into()), regrasp.then(RecoveryAction::Restart)),
        )
        .start()
        .await?;
    let mut faults = node.fault_events();

    node.sender::<Slip>("gripper")?.ask(Slip).await?;

    while let Some(event) = faults.next().await {
        println!("{} of {}: {:?}", event.fault.kind, event.fault.location, event.turn);
        if event.turn == FaultTransition::Recovered {
            break;
        }
    }
    node.shutdown().await;
    Ok(())
}
