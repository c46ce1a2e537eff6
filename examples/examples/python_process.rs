//! A program in Python as a child of a supervisor, beside a component: it is killed, and it hangs,
//! and both times the planner, which needs it, is restarted behind it.
//!
//! `examples/robots/vision.robot.xml` is the robot, `examples/robots/vision.py` the program, which
//! needs `python3`.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{FaultEvents, Lifecycle};
use blastema_robot::Types;
use std::error::Error;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

#[derive(Default)]
struct Planner;

impl Component for Planner {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("planner: incarnation {} plans", cx.incarnation().0);
        Ok(())
    }
}

/// Waits until incarnation `number` of the planner works, and returns the process that says so
/// beside it.
async fn works(node: &Node, number: u64) -> String {
    loop {
        let table = node.table().await;
        let row = |name: &str| {
            table.iter().find(|row| {
                let is_at_work = row.state == Some(Lifecycle::Active);
                row.location.to_string().ends_with(name) && is_at_work
            })
        };
        let planner = row(":planner").is_some_and(|row| row.incarnation.0 == number);
        // What the program says of itself: `STATUS=process 4711`.
        let status = row(":vision").and_then(|row| row.note.as_deref()).unwrap_or_default();
        if let Some(process) = status.strip_prefix("process ").filter(|_| planner) {
            return process.to_owned();
        }
        sleep(Duration::from_millis(10)).await;
    }
}

/// Prints the next fault, without what is to be done about it.
async fn print_fault(faults: &mut FaultEvents) {
    while let Some(event) = faults.next().await {
        let fault = event.fault;
        if fault.location.to_string().ends_with(":vision") && fault.count == 1 {
            let what = fault.detail.split(':').next().unwrap_or_default();
            return println!("vision: {}: {what}", fault.kind);
        }
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn Error>> {
    if Command::new("python3").arg("-V").output().is_err() {
        println!("this example needs python3: install it");
        return Ok(());
    }
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/vision.robot.xml");
    let types = Types::new().component::<Planner>("Planner");
    let robot = types.load(&file, &[])?;
    let node = types.node(&robot, "rover")?.start().await?;

    for (number, signal) in [(1, "-KILL"), (2, "-USR1")] {
        let process = works(&node, number).await;
        let mut faults = node.fault_events();
        println!("-- kill {signal}");
        Command::new("kill").args([signal, &process]).status()?;
        print_fault(&mut faults).await;
    }
    works(&node, 3).await;
    node.shutdown().await;
    println!("-- the node has ended, and the program with it");
    Ok(())
}
