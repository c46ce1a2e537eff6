//! Odometry: where the wheels have carried the robot.

use super::harm::{HarmState, declare, vulnerable};
use super::messages::{Pose, Wheels};
use blastema::prelude::*;

/// Adds up the turns of the wheels.
#[derive(Debug)]
pub(super) struct Odometry {
    pub(super) harm: HarmState,
    pub(super) pose: Pose,
}

impl Component for Odometry {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
        ports.listen::<Wheels>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.execute()?;
        cx.publish(self.pose);
        Ok(())
    }
}

impl Handle<Wheels> for Odometry {
    async fn handle(&mut self, wheels: Wheels, _: &mut Context<Self>) {
        self.pose.heading += wheels.turn;
        self.pose.x += wheels.way * self.pose.heading.cos();
        self.pose.y += wheels.way * self.pose.heading.sin();
    }
}

vulnerable!(Odometry);
