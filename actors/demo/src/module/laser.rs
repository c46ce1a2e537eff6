//! The laser scanner on the robot's head.

use super::harm::{HarmState, declare, vulnerable};
use super::messages::Scan;
use blastema::prelude::*;

/// Directions in one sweep.
const RAYS: u16 = 32;
/// How far a person who walks by comes near and goes away, in sweeps.
const WALK: u32 = 200;

/// Sweeps the room, where a person walks to and fro.
#[derive(Debug)]
pub(super) struct Laser {
    pub(super) harm: HarmState,
    pub(super) sweeps: u32,
}

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.execute()?;
        self.sweeps = self.sweeps.wrapping_add(1);
        let ranges: Vec<f32> = (0..RAYS).map(|ray| self.range(ray)).collect();
        for range in &ranges {
            cx.check_range("range", range, 0.05..20.0);
        }
        cx.publish(Scan { ranges });
        Ok(())
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

vulnerable!(Laser);
