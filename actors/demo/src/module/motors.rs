//! The motors of the base.

use super::messages::{Break, Ping, Stop, Velocity, Wheels, answers};
use blastema::prelude::*;

/// One round of control, in seconds: the motors run at 100 Hz.
const ROUND_S: f64 = 0.01;
/// Without a command for so many rounds the wheels stand still: 200 ms.
const PATIENCE: u32 = 20;

/// Turns the wheels as commanded, and stops when commands cease.
#[derive(Debug, Default)]
pub(super) struct Motors {
    velocity: Velocity,
    rounds_since: u32,
}

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ping>().accept::<Break>();
        ports.accept::<Velocity>().named("drive");
        ports.accept::<Stop>().named("stop");
        ports.publishes::<Wheels>("wheels");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.rounds_since = self.rounds_since.saturating_add(1);
        if self.rounds_since > PATIENCE {
            self.velocity = Velocity::default();
        }
        let Velocity { forward, turning } = self.velocity;
        let wheels = Wheels { way: forward * ROUND_S, turn: turning * ROUND_S };
        Ok(cx.port::<Publisher<Wheels>>("wheels")?.publish(wheels)?)
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

impl Handle<Break> for Motors {
    async fn handle(&mut self, _: Break, cx: &mut Context<Self>) {
        cx.fail("the device reports an error, as ordered");
    }
}

answers!(Motors);
