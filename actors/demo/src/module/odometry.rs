//! Odometry: where the wheels have carried the robot.

use super::messages::{Ping, Pose, Wheels, answers};
use blastema::prelude::*;

/// Adds up the turns of the wheels.
#[derive(Debug, Default)]
pub(super) struct Odometry {
    pose: Pose,
}

impl Component for Odometry {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ping>();
        ports.listen::<Wheels>().named("wheels");
        ports.publishes::<Pose>("pose");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        Ok(cx.port::<Publisher<Pose>>("pose")?.publish(self.pose)?)
    }
}

impl Handle<Wheels> for Odometry {
    async fn handle(&mut self, wheels: Wheels, _: &mut Context<Self>) {
        self.pose.heading += wheels.turn;
        self.pose.x += wheels.way * self.pose.heading.cos();
        self.pose.y += wheels.way * self.pose.heading.sin();
    }
}

answers!(Odometry);
