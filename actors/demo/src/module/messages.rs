//! What the robot's objects say to each other.

use blastema::prelude::*;

/// One sweep of the laser, from right to left.
#[derive(Clone, Debug, Event)]
#[contract(name = "laser/scan", max_age = "200ms")]
pub(super) struct Scan {
    /// Distance to the next obstacle in each direction.
    #[contract(unit = "m", frame = "laser")]
    pub(super) ranges: Vec<f32>,
}

/// Where the robot believes to be.
#[derive(Clone, Copy, Debug, Default, Event)]
#[contract(name = "odometry/pose", max_age = "200ms")]
pub(super) struct Pose {
    /// Forward from the start.
    #[contract(unit = "m", frame = "map")]
    pub(super) x: f64,
    /// To the left.
    #[contract(unit = "m", frame = "map")]
    pub(super) y: f64,
    /// Counter-clockwise from the x axis.
    #[contract(unit = "rad", frame = "map")]
    pub(super) heading: f64,
}

/// Where the operator wants the robot to go.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "operator/goal", max_age = "1s")]
pub(super) struct Goal {
    /// Forward from the start.
    #[contract(unit = "m", frame = "map")]
    pub(super) x: f64,
    /// To the left.
    #[contract(unit = "m", frame = "map")]
    pub(super) y: f64,
}

/// How fast the robot is to move.
#[derive(Clone, Copy, Debug, Default, Event)]
#[contract(name = "motors/velocity", max_age = "100ms")]
pub(super) struct Velocity {
    #[contract(unit = "m/s", frame = "base")]
    pub(super) forward: f64,
    /// Positive is counter-clockwise.
    #[contract(unit = "rad/s", frame = "base")]
    pub(super) turning: f64,
}

/// Something is too near: stop, whatever the planner says.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "safety/stop")]
pub(super) struct Stop {
    /// The distance to the nearest obstacle.
    #[contract(unit = "m")]
    pub(super) distance: f32,
}

/// How far the wheels have turned since the last time.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "motors/wheels", max_age = "200ms")]
pub(super) struct Wheels {
    /// Way of the robot's middle.
    #[contract(unit = "m")]
    pub(super) way: f64,
    /// Turn of the robot.
    #[contract(unit = "rad")]
    pub(super) turn: f64,
}

/// One message of a numbered flow.
#[derive(Clone, Debug, Event)]
#[contract(name = "demo/numbered")]
pub(super) struct Numbered {
    pub(super) flow: String,
    /// The process of the source.
    pub(super) source: u64,
    /// Rises by 1 with each message, from 1.
    pub(super) number: u64,
    /// When it was sent, in nanoseconds of the computer's clock.
    pub(super) sent: u64,
}

/// A question that is answered at once, to measure response times.
#[derive(Clone, Copy, Debug, Request)]
#[contract(name = "demo/echo", reply = u64)]
pub(super) struct EchoRequest {
    /// The number that the reply returns.
    pub(super) number: u64,
}

/// An event whose way is measured.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "demo/tick")]
pub(super) struct Tick {
    /// Rises by 1 with each tick, from 1.
    pub(super) number: u64,
    /// When it was published, in nanoseconds of the computer's clock.
    pub(super) sent: u64,
}

/// Asks for the incarnation that answers.
#[derive(Clone, Copy, Debug, Request)]
#[contract(name = "demo/ping", reply = u64)]
pub(super) struct Ping {}

/// Lets a component that serves [`Ping`] answer it.
macro_rules! answers {
    ($component:ty) => {
        impl Handle<$crate::module::messages::Ping> for $component {
            async fn handle(
                &mut self,
                _: $crate::module::messages::Ping,
                cx: &mut Context<Self>,
            ) -> u64 {
                cx.incarnation().0
            }
        }
    };
}
pub(super) use answers;

/// Has an object break itself, in a way of its own.
#[derive(Clone, Copy, Debug, Event)]
#[contract(name = "demo/break")]
pub(super) struct Break {}
