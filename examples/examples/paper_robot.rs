//! A robot from one file: G. Biggs, N. Ando, T. Kotoku, a component manager with supervision trees
//! for RT-Middleware (2011), Fig. 2 and Listing 1.
//!
//! Without arguments it puts two components in error and prints the robot's reaction, as the
//! source's Listing 1 does; times go to standard error. With arguments it is a robot's program like
//! any other: `paper_robot run examples/robots/paper.robot.xml`.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "an example shows what happens")]
#![allow(clippy::disallowed_methods, reason = "it has no runtime of its own")]

use blastema::prelude::*;
use blastema::{ActuatorSpec, Commander};
use blastema_robot::Types;
use std::error::Error;
use std::path::Path;
use std::process::ExitCode;
use std::sync::LazyLock;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// What sensors, maps and planners give each other: the free way ahead.
#[derive(Clone, Debug, Event)]
#[contract(name = "paper/way")]
struct Way {
    #[contract(unit = "m")]
    ahead: f32,
}

#[derive(Clone, Debug, Event)]
#[contract(name = "paper/drive")]
struct Drive {
    #[contract(unit = "m/s")]
    speed: f32,
}

/// Puts a component in error, as a broken device would.
#[derive(Clone, Debug, Event)]
#[contract(name = "paper/break")]
struct Break;

/// One line of the listing, and its time.
type Entry = (Instant, String);

static LISTING: LazyLock<watch::Sender<Vec<Entry>>> =
    LazyLock::new(|| watch::channel(Vec::new()).0);

fn note<C: Component>(cx: &Context<C>, what: &str) {
    let line = format!("{} {what}", cx.name());
    println!("{line}");
    LISTING.send_modify(|listing| listing.push((Instant::now(), line)));
}

/// The hooks that write the listing.
macro_rules! listed {
    () => {
        async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
            note(cx, "starting");
            Ok(())
        }

        async fn on_aborting(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
            note(cx, "is in error");
            Ok(())
        }

        async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
            note(cx, "shut down");
            Ok(())
        }
    };
}

/// A component that can be broken.
macro_rules! breaks {
    ($name:ident) => {
        impl Handle<Break> for $name {
            async fn handle(&mut self, _: Break, cx: &mut Context<Self>) {
                cx.fail("it was broken");
            }
        }
    };
}

/// A component that hands on the way that it hears of, at once and at its rate: most of the robot.
struct Part {
    ahead: f32,
}

impl Default for Part {
    // As far as it sees, nothing stands in the way.
    fn default() -> Self {
        Part { ahead: 9.0 }
    }
}

impl Component for Part {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Way>("out").accept::<Break>();
        ports.listen::<Way>().named("in");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.port::<Publisher<Way>>("out")?.publish(Way { ahead: self.ahead })?;
        Ok(())
    }

    listed!();
}

impl Handle<Way> for Part {
    async fn handle(&mut self, way: Way, cx: &mut Context<Self>) {
        self.ahead = way.ahead;
        if let Err(failure) = self.on_execute(cx).await {
            cx.fail(failure);
        }
    }
}

breaks!(Part);

/// Sees how far the wall ahead is.
#[derive(Default)]
struct LaserDriver {
    wall: f32,
}

#[derive(Clone, Debug, Parameters)]
struct LaserParameters {
    /// Where the wall is.
    #[parameter(default = 2.0, range = 0.1..=100.0, unit = "m")]
    wall: f32,
}

impl Component for LaserDriver {
    fn ports(ports: &mut Ports<Self>) {
        ports.parameters::<LaserParameters>().publishes::<Way>("out").accept::<Break>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.wall = cx.parameters::<LaserParameters>()?.wall;
        Ok(())
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        cx.port::<Publisher<Way>>("out")?.publish(Way { ahead: self.wall })?;
        Ok(())
    }

    listed!();
}

impl Handle<LaserParameters> for LaserDriver {
    async fn handle(&mut self, parameters: LaserParameters, _: &mut Context<Self>) {
        self.wall = parameters.wall;
    }
}

breaks!(LaserDriver);

/// Drives as fast as the way ahead allows.
#[derive(Default)]
struct LocalPathPlanner {
    ahead: f32,
}

impl Component for LocalPathPlanner {
    fn ports(ports: &mut Ports<Self>) {
        ports.commands::<Drive>("drive").accept::<Break>();
        ports.listen::<Way>().named("in");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let motors: Commander<Drive> = cx.port("drive")?;
        let speed = (self.ahead - 0.3).clamp(0.0, 0.5);
        // The motors start after their commander, and are claimed as soon as they are there.
        if motors.holds() || motors.claim().await.is_ok() {
            let _ = motors.command(Drive { speed }).await;
        }
        Ok(())
    }

    listed!();
}

impl Handle<Way> for LocalPathPlanner {
    async fn handle(&mut self, way: Way, _: &mut Context<Self>) {
        self.ahead = way.ahead;
    }
}

breaks!(LocalPathPlanner);

/// Turns the wheels.
#[derive(Default)]
struct Motors {
    speed: f32,
}

impl Component for Motors {
    fn ports(ports: &mut Ports<Self>) {
        let spec = ActuatorSpec::new(Drive { speed: 0.0 }, Duration::from_millis(300));
        ports.actuator(spec).named("drive");
    }

    listed!();
}

impl Handle<Drive> for Motors {
    async fn handle(&mut self, drive: Drive, _: &mut Context<Self>) {
        if self.speed == 0.0 && drive.speed > 0.0 {
            DRIVES.send_modify(|times| *times += 1);
            eprintln!("the motors drive");
        }
        self.speed = drive.speed;
    }
}

/// How often the motors have begun to drive.
static DRIVES: LazyLock<watch::Sender<u32>> = LazyLock::new(|| watch::channel(0).0);

fn types() -> Types {
    let parts = [
        "ShortTermMap",
        "LongTermMap",
        "GlobalPathPlanner",
        "PoseFilter",
        "LaserSensorModel",
        "Odometry",
        "Gyro",
    ];
    let types = parts.into_iter().fold(Types::new(), Types::component::<Part>);
    types
        .component::<LocalPathPlanner>("LocalPathPlanner")
        .component::<Motors>("Motors")
        .component::<LaserDriver>("LaserDriver")
        .safe_outputs("brakes", |fault| println!("brakes on: {fault}"))
}

/// Puts a component in error, waits for the last line of the reaction, and shows its time.
async fn strike(node: &Node, component: &str, last: &str) -> Result<(), Box<dyn Error>> {
    println!("-- {component} is struck");
    let (known, mut listing) = (LISTING.borrow().len(), LISTING.subscribe());
    node.sender::<Break>(component)?.tell(Break)?;
    let done = listing.wait_for(|lines| lines[known..].iter().any(|(_, line)| line == last));
    let lines = tokio::time::timeout(Duration::from_secs(30), done).await??[known..].to_vec();
    let took = lines.last().map_or(Duration::ZERO, |(end, _)| *end - lines[0].0);
    eprintln!("{component}: {:.1} ms from the error to the last start", took.as_secs_f64() * 1e3);
    Ok(())
}

/// Waits until the motors have begun to drive so often: the way has passed through all ports.
async fn drives(times: u32) -> Result<(), Box<dyn Error>> {
    let mut drives = DRIVES.subscribe();
    let begun = drives.wait_for(|known| *known >= times);
    tokio::time::timeout(Duration::from_secs(30), begun).await??;
    println!("-- the robot drives");
    Ok(())
}

async fn show() -> Result<(), Box<dyn Error>> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/paper.robot.xml");
    let types = types();
    let robot = types.load(&file, &[])?;
    let node = types.node(&robot, "robot")?.start().await?;
    drives(1).await?;
    strike(&node, "laser", "laser starting").await?;
    strike(&node, "global_pp", "motors starting").await?;
    drives(2).await?;
    println!("-- the robot is shut down");
    node.shutdown().await;
    Ok(())
}

fn main() -> ExitCode {
    if std::env::args().len() > 1 {
        return types().main();
    }
    match blastema::run(show()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("{error}");
            ExitCode::FAILURE
        }
    }
}
