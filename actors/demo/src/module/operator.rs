//! The operator's panel on the robot's head.

use super::messages::{Goal, Ping, Pose, answers};
use blastema::prelude::*;

/// How near the robot must come to a goal.
const NEAR_M: f64 = 0.3;
/// The corners of the round that the robot goes, in metres.
const ROUND: [(f64, f64); 4] = [(2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)];

/// Sends the robot on its round, one corner after the other.
#[derive(Debug, Default)]
pub(super) struct OperatorPanel {
    corner: usize,
}

impl Component for OperatorPanel {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ping>();
        ports.listen::<Pose>().named("pose");
        ports.publishes::<Goal>("goal");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let (x, y) = ROUND[self.corner % ROUND.len()];
        Ok(cx.port::<Publisher<Goal>>("goal")?.publish(Goal { x, y })?)
    }
}

impl Handle<Pose> for OperatorPanel {
    async fn handle(&mut self, pose: Pose, _: &mut Context<Self>) {
        let (x, y) = ROUND[self.corner % ROUND.len()];
        if (pose.x - x).hypot(pose.y - y) < NEAR_M {
            self.corner += 1;
        }
    }
}

answers!(OperatorPanel);
