//! A gripper and a bumper on microcontrollers. When the bumper is touched, the gripper closes. Then
//! the gripper loses its power, comes back, and closes again, with no line for that on its chip.
//! `examples/robots/devices.robot.xml` is the robot.
//!
//! Each chip is a process of this computer on a pty here, and its firmware is compiled first, which
//! needs a C compiler, `cc`. On chips of your own: `small_devices /dev/ttyUSB0 /dev/ttyUSB1`; the
//! firmware is in `examples/firmware`, and `small_devices headers DIR` writes its headers.
#![allow(clippy::print_stdout, reason = "an example shows what happens")]

use blastema::prelude::*;
use blastema::{DeviceSpec, FaultLocation};
use blastema_ptys::Cable;
use blastema_robot::Types;
use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use tempfile::TempDir;
use tokio::sync::watch;

#[derive(Clone, Debug, Event)]
#[contract(name = "hand/close", delivery = "newest")]
struct Close {
    #[contract(unit = "N")]
    force: f32,
}

#[derive(Clone, Debug, PartialEq, Event)]
#[contract(name = "hand/grip", delivery = "newest")]
struct Grip {
    #[contract(unit = "mm")]
    width: u16,
    holds: bool,
}

#[derive(Clone, Debug, Event)]
#[contract(name = "bumper/contact", delivery = "newest")]
struct Contact {
    pressed: bool,
}

/// What each type of devices has in its firmware.
const GRIPPER: u32 = 0x6772_6970;
const BUMPER: u32 = 0x6275_6d70;

fn gripper(device: DeviceSpec) -> DeviceSpec {
    device.accepts::<Close>(0).publishes::<Grip>(0, "hand/grip")
}

fn bumper(device: DeviceSpec) -> DeviceSpec {
    device.publishes::<Contact>(0, "bumper/contact")
}

/// Closes the gripper while the bumper is touched.
struct Reflex {
    gripper: Option<Sender<Close>>,
    told: watch::Sender<bool>,
}

impl Component for Reflex {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Contact>();
        ports.listen::<Grip>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.gripper = Some(cx.sender("gripper")?);
        Ok(())
    }
}

impl Handle<Contact> for Reflex {
    async fn handle(&mut self, Contact { pressed }: Contact, _: &mut Context<Self>) {
        let force = if pressed { 5.0 } else { 0.0 };
        if let Some(gripper) = &self.gripper {
            // While the gripper is away, there is nothing to close.
            let _ = gripper.tell(Close { force });
        }
    }
}

impl Handle<Grip> for Reflex {
    async fn handle(&mut self, Grip { width, holds }: Grip, _: &mut Context<Self>) {
        self.told.send_if_modified(|told| {
            let is_new = std::mem::replace(told, holds) != holds;
            if is_new {
                println!("the gripper {} at {width} mm", if holds { "holds" } else { "opens" });
            }
            is_new
        });
    }
}

/// A chip: a process that runs the firmware. Dropping it cuts the power.
struct Chip(Child);

impl Drop for Chip {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Compiles a firmware as a process of this computer.
fn compile(device: &DeviceSpec, name: &str, folder: &Path) -> Result<PathBuf, Box<dyn Error>> {
    std::fs::write(folder.join(format!("{name}.h")), device.header()?)?;
    let here = Path::new(env!("CARGO_MANIFEST_DIR"));
    let library = here.join("../core/lite/c");
    let program = folder.join(name);
    let compiled = Command::new("cc")
        .args(["-std=c99", "-O1", "-Wall", "-Wextra", &format!("-DBL_CONFIG=\"{name}.h\"")])
        .args([Path::new("-I"), folder, Path::new("-I"), &library])
        .args([Path::new("-I"), &library.join("boards"), Path::new("-o"), &program])
        .args([library.join("boards/linux.c"), library.join("blastema_lite.c")])
        .arg(here.join("firmware").join(format!("{name}.c")))
        .status();
    match compiled {
        Ok(status) if status.success() => Ok(program),
        Ok(status) => Err(format!("`cc` could not compile the firmware: {status}").into()),
        Err(error) => Err(format!(
            "the firmware is compiled by `cc`, which is not here ({error}): install a C compiler, \
             such as `apt-get install gcc libc6-dev`"
        )
        .into()),
    }
}

/// Runs the robot until the gripper was lost and has closed again.
async fn run(ports: [&Path; 2], mut power: impl FnMut(bool)) -> Result<(), Box<dyn Error>> {
    let [hand, front] = ports.map(|port| port.display().to_string());
    let (told, mut holds) = watch::channel(false);
    let types = Types::new()
        .device("Gripper", GRIPPER, gripper)
        .device("Bumper", BUMPER, bumper)
        .component_with("Reflex", move || Reflex { gripper: None, told: told.clone() });
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/devices.robot.xml");
    let robot = types.load(&file, &[("hand", &hand), ("front", &front)])?;
    let node = types.node(&robot, "robot")?.start().await?;
    let mut faults = node.fault_events();
    holds.wait_for(|holds| *holds).await?;

    power(false);
    while let Some(event) = faults.next().await {
        if matches!(&event.fault.location, FaultLocation::Object(at) if at.object.as_str() == "gripper")
        {
            println!("gripper: {}", event.fault.detail);
            break;
        }
    }
    power(true);
    holds.wait_for(|holds| !holds).await?;
    holds.wait_for(|holds| *holds).await?;
    println!("the gripper works again; its chip knows nothing of it");
    node.shutdown().await;
    Ok(())
}

#[blastema::main]
async fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let any = |name, device_type| DeviceSpec::new(name, "serial:///dev/null", device_type);
    let devices =
        [("gripper", gripper(any("gripper", GRIPPER))), ("bumper", bumper(any("bumper", BUMPER)))];
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["headers", folder] => {
            for (name, device) in devices {
                std::fs::write(Path::new(folder).join(format!("{name}.h")), device.header()?)?;
            }
            Ok(())
        }
        [hand, front] => {
            println!("switch the gripper off when it holds, and on again");
            run([Path::new(hand), Path::new(front)], |_| ()).await
        }
        [] => {
            let folder = TempDir::new()?;
            let cables = [Cable::new(), Cable::new()];
            let mut chips = Vec::new();
            for ((name, device), cable) in devices.iter().zip(&cables) {
                let program = compile(device, name, folder.path())?;
                let boots = folder.path().join(format!("{name}.boots"));
                let on =
                    move |right| Command::new(&program).arg(right).arg(&boots).spawn().map(Chip);
                chips.push((on(cable.right())?, on));
            }
            let (chip, on) = chips.swap_remove(0);
            let (mut chip, at) = (Some(chip), cables[0].right());
            let power = move |is_on: bool| {
                drop(chip.take());
                chip = is_on.then(|| on(at.clone()).expect("it ran before"));
            };
            run([&cables[0].left(), &cables[1].left()], power).await
        }
        _ => Err("usage: small_devices [PORT PORT | headers DIR]".into()),
    }
}
