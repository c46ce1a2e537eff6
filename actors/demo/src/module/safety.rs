//! Stops the robot when an obstacle is too near.

use super::harm::{HarmState, declare, vulnerable};
use super::messages::{Scan, Stop};
use blastema::prelude::*;

/// Nearer than this, the robot stands still.
const TOO_NEAR_M: f32 = 0.3;

/// Looks at those sweeps only in which something is too near.
#[derive(Debug)]
pub(super) struct Safety {
    pub(super) harm: HarmState,
    pub(super) motors: &'static str,
}

impl Component for Safety {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
        ports.listen::<Scan>().only_if(|scan| nearest(scan) < TOO_NEAR_M);
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.execute()
    }
}

impl Handle<Scan> for Safety {
    async fn handle(&mut self, scan: Scan, cx: &mut Context<Self>) {
        // Where the base cannot be reached it stands still by itself: no command comes.
        if let Ok(motors) = cx.sender::<Stop>(self.motors) {
            let _ = motors.tell(Stop { distance: nearest(&scan) });
        }
    }
}

vulnerable!(Safety);

fn nearest(scan: &Scan) -> f32 {
    scan.ranges.iter().copied().fold(f32::INFINITY, f32::min)
}
