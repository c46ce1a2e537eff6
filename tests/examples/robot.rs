//! A robot's program for the tests of robot files: two nodes, of which one counts and the other
//! prints what is counted.
#![allow(clippy::print_stdout, reason = "the tests read what it prints")]

use blastema::prelude::*;
use blastema::{ActuatorSpec, Commander, Hold};
use blastema_robot::Types;
use std::process::ExitCode;
use std::time::Duration;

/// The number of a round.
#[derive(Clone, Debug, Event)]
#[contract(name = "test/count")]
struct Count(u32);

/// Counts its rounds.
#[derive(Default)]
struct Counter(u32);

impl Component for Counter {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Count>("count");
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        self.0 += 1;
        cx.port::<Publisher<Count>>("count")?.publish(Count(self.0))?;
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} ends", cx.name());
        Ok(())
    }
}

/// How a display behaves.
#[derive(Clone, Debug, Parameters)]
struct DisplayParameters {
    /// The process ends at this count; 0 for never.
    dies_at: u32,
    /// A file that it writes when it ends in order.
    ends_in: String,
    /// It leaves a process behind that holds its output.
    leaves_process: bool,
}

/// Prints what it hears.
#[derive(Default)]
struct Display {
    heard: u32,
    dies_at: u32,
}

impl Component for Display {
    fn ports(ports: &mut Ports<Self>) {
        ports.parameters::<DisplayParameters>().listen::<Count>().named("count");
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let parameters = cx.parameters::<DisplayParameters>()?;
        self.dies_at = parameters.dies_at;
        if parameters.leaves_process {
            std::process::Command::new("sh").args(["-c", "sleep 30 &"]).status()?;
        }
        println!("{} begins", cx.name());
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let file = cx.parameters::<DisplayParameters>()?.ends_in;
        if !file.is_empty() {
            std::fs::write(file, "it has ended")?;
        }
        println!("{} ends", cx.name());
        Ok(())
    }
}

impl Handle<DisplayParameters> for Display {
    async fn handle(&mut self, parameters: DisplayParameters, _: &mut Context<Self>) {
        self.dies_at = parameters.dies_at;
    }
}

impl Handle<Count> for Display {
    async fn handle(&mut self, _: Count, _: &mut Context<Self>) {
        self.heard += 1;
        println!("heard {}", self.heard);
        if self.heard == self.dies_at {
            std::process::exit(7);
        }
    }
}

/// Prints what becomes of it.
#[derive(Default)]
struct Part;

/// How a part is configured.
#[derive(Clone, Debug, Parameters)]
struct PartParameters {
    #[parameter(default = 1.0, range = 0.0..=10.0, unit = "kg")]
    mass: f32,
}

impl Component for Part {
    fn ports(ports: &mut Ports<Self>) {
        ports.parameters::<PartParameters>();
    }

    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let PartParameters { mass } = cx.parameters()?;
        println!("{} is initialized with {mass} kg", cx.name());
        Ok(())
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} is active", cx.name());
        Ok(())
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} is inactive", cx.name());
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} is finalized", cx.name());
        Ok(())
    }
}

impl Handle<PartParameters> for Part {
    async fn handle(&mut self, _: PartParameters, _: &mut Context<Self>) {}
}

/// Fails in `on_initialize`.
#[derive(Default)]
struct Broken;

impl Component for Broken {
    async fn on_initialize(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        Err(Failure::fatal("it is broken"))
    }
}

/// Begins well, and panics in each round.
#[derive(Default)]
struct Faulty;

impl Component for Faulty {
    async fn on_execute(&mut self, _: &mut Context<Self>) -> Result<(), Failure> {
        panic!("it is faulty")
    }
}

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "test/drive", reply = ())]
struct Drive(f32);

/// Prints its commands.
#[derive(Default)]
struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive(0.0), Hold));
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} ends", cx.name());
        Ok(())
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, Drive(speed): Drive, _: &mut Context<Self>) {
        println!("drive {speed}");
    }
}

/// Turns the wheels while it is initialized, which takes long.
#[derive(Default)]
struct Driver(Option<Commander<Drive>>);

impl Component for Driver {
    async fn on_initialize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        let wheels = self.0.insert(cx.commander("wheels")?);
        wheels.claim().await?;
        wheels.command(Drive(1.0)).await?;
        blastema::sleep(Duration::from_secs(3)).await;
        println!("{} is initialized", cx.name());
        Ok(())
    }

    async fn on_finalize(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} ends", cx.name());
        Ok(())
    }
}

/// Takes a minute to leave its work.
#[derive(Default)]
struct Slow;

impl Component for Slow {
    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} works", cx.name());
        Ok(())
    }

    async fn on_deactivated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        println!("{} slows down", cx.name());
        blastema::sleep(Duration::from_secs(60)).await;
        println!("{} rests", cx.name());
        Ok(())
    }
}

fn main() -> ExitCode {
    Types::new()
        .component::<Counter>("Counter")
        .component::<Display>("Display")
        .component::<Part>("Part")
        .component::<Broken>("Broken")
        .component::<Faulty>("Faulty")
        .component::<Wheels>("Wheels")
        .component::<Driver>("Driver")
        .component::<Slow>("Slow")
        .safe_outputs("brakes", |_| println!("the brakes are on"))
        .main()
}
