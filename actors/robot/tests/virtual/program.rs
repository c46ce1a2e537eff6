//! The types of a small program, as robot files name them.

use blastema::prelude::*;
use blastema::recovery::{RecoveryDone, RecoveryFailed, RecoveryOrder};
use blastema::trees::{Port, Status, TreeLeaves};
use blastema::{ActuatorSpec, DeviceSpec, RecoveryStrategy, StrategyContext};
use blastema_robot::Types;
use std::time::Duration;

#[derive(Clone, Debug, Event)]
#[contract(name = "robot/scan")]
pub(crate) struct Scan {
    #[contract(unit = "m")]
    ahead: f32,
}

#[derive(Clone, Debug, Event)]
#[contract(name = "robot/drive")]
pub(crate) struct Drive {
    #[contract(unit = "m/s")]
    speed: f32,
}

#[derive(Default)]
pub(crate) struct Laser;

impl Component for Laser {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Scan>("scan").parameters::<LaserParameters>();
    }
}

#[derive(Clone, Debug, Parameters)]
pub(crate) struct LaserParameters {
    /// Nothing farther away is seen.
    #[parameter(default = 5.5, range = 0.1..=30.0, unit = "m")]
    reach: f32,
    #[parameter(default = 0.5, range = 0.0..=2.0)]
    gain: f32,
    device: String,
}

impl Handle<LaserParameters> for Laser {
    async fn handle(&mut self, _: LaserParameters, _: &mut Context<Self>) {}
}

pub(crate) struct Motors;

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        let spec = ActuatorSpec::new(Drive { speed: 0.0 }, Duration::from_millis(200));
        ports.actuator::<Drive>(spec).named("drive");
        ports.listen::<Scan>().named("scan");
    }
}

impl Handle<Drive> for Motors {
    async fn handle(&mut self, _: Drive, _: &mut Context<Self>) {}
}

impl Handle<Scan> for Motors {
    async fn handle(&mut self, _: Scan, _: &mut Context<Self>) {}
}

#[derive(Default)]
struct Camera;

impl Component for Camera {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Scan>().named("scan");
    }
}

impl Handle<Scan> for Camera {
    async fn handle(&mut self, _: Scan, _: &mut Context<Self>) {}
}

#[derive(Default)]
struct Cell;

impl Component for Cell {}

#[derive(Clone, Debug, Event)]
#[contract(name = "robot/grasp")]
struct Grasp {
    #[contract(unit = "N")]
    force: f32,
}

fn gripper(device: DeviceSpec) -> DeviceSpec {
    let safe = Grasp { force: 0.0 };
    device.actuator(0, ActuatorSpec::new(safe, Duration::from_millis(200)))
}

#[derive(Default)]
struct Console;

impl Component for Console {
    fn ports(ports: &mut Ports<Self>) {
        ports.commands::<Drive>("motors").commands::<Drive>("brake");
    }
}

struct Oil;

impl RecoveryStrategy for Oil {
    async fn carry_out(
        &self,
        _: &RecoveryOrder,
        _: &StrategyContext,
    ) -> Result<RecoveryDone, RecoveryFailed> {
        Err("there is none left".into())
    }
}

/// What the robot files of the tests use.
pub(crate) fn types() -> Types {
    // Files are checked here, and their processes are not started.
    blastema::launch_processes_by("/bin/true");
    Types::new()
        .component::<Laser>("Laser")
        .component_with("Motors", || Motors)
        .component::<Camera>("Camera")
        .component::<Cell>("Cell")
        .device("Gripper", 0x6772_6970, gripper)
        .component::<Console>("Console")
        .strategy("oil", || Oil)
        .safe_outputs("brakes", |_| {})
        .leaves(TreeLeaves::new().action("Drive", [Port::input::<f64>("speed")], |leaf| {
            let _: f64 = leaf.input("speed")?;
            Ok(Status::Success)
        }))
}
