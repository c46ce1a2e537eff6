//! The operator's panel on the robot's head.

use super::harm::{HarmState, declare, vulnerable};
use super::messages::{Goal, Pose};
use blastema::prelude::*;

/// How near the robot must come to a goal.
const NEAR_M: f64 = 0.3;
/// The corners of the round that the robot goes, in metres.
const ROUND: [(f64, f64); 4] = [(2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)];

/// Sends the robot on its round, one corner after the other.
#[derive(Debug)]
pub(super) struct Operator {
    pub(super) harm: HarmState,
    pub(super) corner: usize,
}

impl Component for Operator {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
        ports.listen::<Pose>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.execute()?;
        let (x, y) = ROUND[self.corner % ROUND.len()];
        cx.publish(Goal { x, y });
        Ok(())
    }
}

impl Handle<Pose> for Operator {
    async fn handle(&mut self, pose: Pose, _: &mut Context<Self>) {
        let (x, y) = ROUND[self.corner % ROUND.len()];
        if (pose.x - x).hypot(pose.y - y) < NEAR_M {
            self.corner += 1;
        }
    }
}

vulnerable!(Operator);
