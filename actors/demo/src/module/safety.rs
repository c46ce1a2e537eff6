//! Stops the robot when an obstacle is too near.

use super::messages::{Scan, Stop};
use blastema::prelude::*;

/// Nearer than this, the robot stands still.
const TOO_NEAR_M: f32 = 0.3;

/// Looks at those sweeps only in which something is too near.
#[derive(Debug, Default)]
pub(super) struct Safety;

impl Component for Safety {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Scan>().only_if(|scan| nearest(scan) < TOO_NEAR_M).named("scan");
        ports.asks::<Stop>("stop");
    }
}

impl Handle<Scan> for Safety {
    async fn handle(&mut self, scan: Scan, cx: &mut Context<Self>) {
        // Where the base cannot be reached it stands still by itself: no command comes.
        if let Ok(motors) = cx.port::<Sender<Stop>>("stop") {
            let _ = motors.tell(Stop { distance: nearest(&scan) });
        }
    }
}

fn nearest(scan: &Scan) -> f32 {
    scan.ranges.iter().copied().fold(f32::INFINITY, f32::min)
}
