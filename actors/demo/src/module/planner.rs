//! The planner: from where the robot is to where it shall be.

use super::harm::{HarmState, declare, vulnerable};
use super::messages::{Goal, Pose, Scan, Velocity};
use blastema::prelude::*;
use std::f64::consts::PI;

/// As fast as people walk slowly.
const FASTEST_M_PER_S: f64 = 0.8;
/// As fast as it may turn.
const FASTEST_RAD_PER_S: f64 = 1.5;
/// The distance at which it goes at full speed.
const CLEAR_M: f32 = 2.0;

/// Steers towards the goal, more slowly where something is near.
#[derive(Debug)]
pub(super) struct Planner {
    pub(super) harm: HarmState,
    pub(super) motors: &'static str,
    pub(super) pose: Option<Pose>,
    pub(super) goal: Option<Goal>,
    pub(super) clearance: f32,
}

impl Component for Planner {
    fn ports(ports: &mut Ports<Self>) {
        declare(ports);
        ports.listen::<Scan>();
        ports.listen::<Pose>();
        ports.listen::<Goal>();
    }

    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.initialize()
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.harm.execute()?;
        let (Some(pose), Some(goal)) = (self.pose, self.goal) else { return Ok(()) };
        let motors = cx.sender::<Velocity>(self.motors).map_err(|why| why.to_string())?;
        // The motors stand still by themselves when no command comes; the next one is better.
        let _ = motors.tell(steer(pose, goal, self.clearance));
        Ok(())
    }
}

impl Handle<Scan> for Planner {
    async fn handle(&mut self, scan: Scan, _: &mut Context<Self>) {
        self.clearance = scan.ranges.iter().copied().fold(f32::INFINITY, f32::min);
    }
}

impl Handle<Pose> for Planner {
    async fn handle(&mut self, pose: Pose, _: &mut Context<Self>) {
        self.pose = Some(pose);
    }
}

impl Handle<Goal> for Planner {
    async fn handle(&mut self, goal: Goal, _: &mut Context<Self>) {
        self.goal = Some(goal);
    }
}

vulnerable!(Planner);

fn steer(pose: Pose, goal: Goal, clearance_m: f32) -> Velocity {
    let bearing = (goal.y - pose.y).atan2(goal.x - pose.x) - pose.heading;
    let turn = (bearing + PI).rem_euclid(2.0 * PI) - PI;
    let slow = f64::from((clearance_m / CLEAR_M).clamp(0.0, 1.0));
    Velocity {
        forward: FASTEST_M_PER_S * slow * turn.cos().max(0.0),
        turning: turn.clamp(-FASTEST_RAD_PER_S, FASTEST_RAD_PER_S),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_robot_turns_towards_its_goal_and_slows_down_where_something_is_near() {
        let here = Pose::default();
        let ahead = steer(here, Goal { x: 5.0, y: 0.0 }, 4.0);
        let left = steer(here, Goal { x: 0.0, y: 5.0 }, 4.0);
        let near = steer(here, Goal { x: 5.0, y: 0.0 }, 0.2);

        assert!((ahead.forward - FASTEST_M_PER_S).abs() < 1e-9 && ahead.turning.abs() < 1e-9);
        assert!(left.turning > 1.0 && left.forward < 1e-9);
        assert!(near.forward < 0.11 * FASTEST_M_PER_S);
    }
}
