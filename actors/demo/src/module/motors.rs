//! The motors of the base.

use super::harm::{HarmState, declare, vulnerable};
use super::messages::{Stop, Velocity, Wheels};
use blastema::prelude::*;

/// One round of control, in seconds: the motors run at 100 Hz.
const ROUND_S: f64 = 0.01;
/// Without a command for so many rounds the wheels stand still: 200 ms.
const PATIENCE: u32 = 20;

/// Turns the wheels as commanded, and stops when commands cease.
#[derive(Debug)]
pub(super) struct Motors {
    pub(super) harm: HarmState,
    pub(super) velocity: Velocity,
    pub(super) rounds_since: u32,
}

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
        ports.accept::<Velocity>().accept::<Stop>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.execute()?;
        self.rounds_since = self.rounds_since.saturating_add(1);
        if self.rounds_since > PATIENCE {
            self.velocity = Velocity::default();
        }
        let Velocity { forward, turning } = self.velocity;
        cx.publish(Wheels { way: forward * ROUND_S, turn: turning * ROUND_S });
        Ok(())
    }

    async fn on_aborting(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.velocity = Velocity::default();
        Ok(())
    }
}

impl Handle<Velocity> for Motors {
    async fn handle(&mut self, velocity: Velocity, _: &mut Context<Self>) {
        self.velocity = velocity;
        self.rounds_since = 0;
    }
}

impl Handle<Stop> for Motors {
    async fn handle(&mut self, _: Stop, _: &mut Context<Self>) {
        self.velocity = Velocity::default();
    }
}

vulnerable!(Motors);
