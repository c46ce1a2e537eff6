//! The planner: from where the robot is to where it shall be.

use super::messages::{Goal, Ping, Pose, Scan, Velocity, answers};
use blastema::prelude::*;
use std::f64::consts::PI;

/// As fast as people walk slowly.
const FASTEST_M_PER_S: f64 = 0.8;
/// As fast as it may turn.
const FASTEST_RAD_PER_S: f64 = 1.5;
/// Without a sweep for so many rounds it gives no command: half a second.
const BLIND: u32 = 10;
/// The distance at which it goes at full speed.
const CLEAR_M: f32 = 2.0;

/// Steers towards the goal, more slowly where something is near.
#[derive(Debug, Default)]
pub(super) struct Planner {
    pose: Option<Pose>,
    goal: Option<Goal>,
    clearance: f32,
    rounds_since: u32,
}

impl Component for Planner {
    fn ports(ports: &mut Ports<Self>) {
        ports.serve::<Ping>();
        ports.listen::<Scan>().named("scan");
        ports.listen::<Pose>().named("pose");
        ports.listen::<Goal>().named("goal");
        ports.asks::<Velocity>("drive");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.rounds_since = self.rounds_since.saturating_add(1);
        let (Some(pose), Some(goal)) = (self.pose, self.goal) else { return Ok(()) };
        if self.rounds_since > BLIND {
            return Ok(());
        }
        let motors = cx.port::<Sender<Velocity>>("drive")?;
        // The motors stand still by themselves when no command comes; the next one is better.
        let _ = motors.tell(steer(pose, goal, self.clearance));
        Ok(())
    }
}

impl Handle<Scan> for Planner {
    async fn handle(&mut self, scan: Scan, _: &mut Context<Self>) {
        self.rounds_since = 0;
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

answers!(Planner);

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
