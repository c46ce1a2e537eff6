//! Data that is too old, or wrong: an event says how old it may become, and a component checks what
//! it is given at fixed points. A failed check is a fault: it is told and goes into the record, and
//! what is done about it is for the application to say.
#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "it shows what happens")]

use blastema::prelude::*;
use blastema::{DeadReason, FaultTransition, Range};
use std::time::Duration;

/// How fast to go. A component should not act upon one that has waited for long.
#[derive(Clone, Debug, Event)]
#[contract(name = "drive/speed", version = 1, max_age = "200ms")]
struct Speed {
    #[contract(unit = "m/s", frame = "base")]
    forward: f64,
}

/// Says how fast the motors turn, after so much other work.
#[derive(Debug, Request)]
#[contract(name = "motors/turning", reply = f64)]
struct Turning {
    #[contract(unit = "ms")]
    working: u64,
}

const SPEED: Range<f64> = Range::new("speed", 0.0..=1.5);

#[derive(Default)]
struct Motors {
    speed: f64,
}

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        ports.accept::<Speed>().serve::<Turning>();
    }
}

impl Handle<Speed> for Motors {
    async fn handle(&mut self, speed: Speed, cx: &mut Context<Self>) {
        match SPEED.check(speed.forward) {
            Ok(forward) => self.speed = forward,
            // Reported, and not obeyed.
            Err(failed) => cx.declare_fault(FaultKind::CheckFailed, failed.to_string()),
        }
    }
}

impl Handle<Turning> for Motors {
    async fn handle(&mut self, request: Turning, _: &mut Context<Self>) -> f64 {
        std::thread::sleep(Duration::from_millis(request.working));
        self.speed
    }
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn std::error::Error>> {
    let node =
        Node::builder("module1").child(ChildSpec::new("motors", Motors::default)).start().await?;
    let mut faults = node.fault_events();
    let speed: Sender<Speed> = node.sender("motors")?;
    let motors: Sender<Turning> = node.sender("motors")?;

    speed.tell(Speed { forward: 1.2 })?;
    println!("turning at {} m/s", motors.ask(Turning { working: 0 }).await?);

    // While the motors are busy for 300 ms, an order waits for longer than its 200 ms.
    motors.tell(Turning { working: 300 })?;
    speed.tell(Speed { forward: 0.4 })?;
    println!("still turning at {} m/s", motors.ask(Turning { working: 0 }).await?);
    let expired = node.dead_letters().count(&"motors".parse()?, DeadReason::Expired);
    println!("too old: {expired}");

    speed.tell(Speed { forward: 9.0 })?;
    while let Some(event) = faults.next().await {
        if event.turn == FaultTransition::Found {
            println!("{}: {}", event.fault.kind, event.fault.detail);
            break;
        }
    }
    println!("still turning at {} m/s", motors.ask(Turning { working: 0 }).await?);
    node.shutdown().await;
    Ok(())
}
