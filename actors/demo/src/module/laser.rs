//! The laser scanner on the robot's head.

use super::messages::{Break, Ping, Scan, answers};
use blastema::prelude::*;
use std::time::Duration;

/// Directions in one sweep.
const RAYS: u16 = 32;
/// How far a person who walks by comes near and goes away, in sweeps.
const WALK: u32 = 200;
/// How long the laser keeps its thread when it is to hang: longer than any grace, short enough that
/// the thread returns while the demonstration runs.
const HANG: Duration = Duration::from_millis(2_500);

/// Sweeps the room, where a person walks to and fro.
#[derive(Debug, Default)]
pub(super) struct Laser {
    sweeps: u32,
}

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ping>().accept::<Break>();
        ports.publishes::<Scan>("scan");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.sweeps = self.sweeps.wrapping_add(1);
        let ranges: Vec<f32> = (0..RAYS).map(|ray| self.range(ray)).collect();
        for range in &ranges {
            cx.check_range("range", range, 0.05..20.0);
        }
        Ok(cx.port::<Publisher<Scan>>("scan")?.publish(Scan { ranges })?)
    }
}

impl Laser {
    /// Walls at four metres, and the person in the middle.
    fn range(&self, ray: u16) -> f32 {
        let phase = (self.sweeps % WALK) as f32 / WALK as f32;
        let person = 2.0 + 1.8 * (phase * std::f32::consts::TAU).cos();
        let is_hit = ray.abs_diff(RAYS / 2) < 3;
        if is_hit { person } else { 4.0 }
    }
}

#[expect(clippy::disallowed_methods, reason = "it is to hang")]
impl Handle<Break> for Laser {
    async fn handle(&mut self, _: Break, _: &mut Context<Self>) {
        std::thread::sleep(HANG);
    }
}

answers!(Laser);
