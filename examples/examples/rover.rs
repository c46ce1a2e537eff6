//! A tele-operated rover and its operator on another node, from one robot file. What the rover does
//! a behaviour tree says: it drives as the operator says while the radio is good, stands while the
//! radio is slow, and returns by itself when the operator is lost. If the operator stays away, the
//! rover stops, whatever its tree does.
//!
//! Without arguments it starts both nodes, the operator as a process, harms the operator and the
//! radio, and prints what the rover does: first with `robots/rover.tree.xml`, then with the tree of
//! the source as it is. With arguments it is a robot's program like any other: `rover run
//! examples/robots/rover.robot.xml`.
#![allow(clippy::print_stdout, clippy::disallowed_methods, reason = "it shows what happens")]

use blastema::prelude::*;
use blastema::trees::{LeafResult, LeafTask, Status, TreeLeaves};
use blastema::{ActuatorSpec, Direction, Hold, Impairment};
use blastema_examples::free_addresses;
use blastema_robot::Types;
use std::error::Error;
use std::path::Path;
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::LazyLock;
use std::time::{Duration, Instant};
use tokio::sync::watch;

/// The position of the operator's stick.
#[derive(Clone, Debug, Event)]
#[contract(name = "operator/stick", version = 1)]
struct Stick {
    #[contract(unit = "m/s")]
    speed: f64,
}

/// The last position of the stick, on the rover.
#[derive(Clone, Debug, PartialEq, Variable)]
#[contract(name = "rover/stick", version = 1)]
struct StickPosition {
    #[contract(unit = "m/s")]
    speed: f64,
}

/// Turns the wheels.
#[derive(Clone, Debug, Request)]
#[contract(name = "wheels/drive", version = 1, reply = ())]
struct Drive {
    #[contract(unit = "m/s")]
    speed: f64,
}

/// Shows that the operator is there, and holds the stick forward.
#[derive(Default)]
struct Console;

impl Component for Console {
    fn ports(ports: &mut Ports<Self>) {
        ports.publishes::<Stick>("stick");
    }

    async fn on_activated(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        Ok(cx.heartbeat("operator/heartbeat", Duration::from_millis(50))?)
    }

    async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
        Ok(cx.port::<Publisher<Stick>>("stick")?.publish(Stick { speed: 1.0 })?)
    }
}

/// Keeps the position of the stick.
#[derive(Default)]
struct StickReceiver;

impl Component for StickReceiver {
    fn ports(ports: &mut Ports<Self>) {
        ports.listen::<Stick>().named("stick");
        ports.variable(VariableSpec::new(StickPosition { speed: 0.0 }));
    }
}

impl Handle<Stick> for StickReceiver {
    async fn handle(&mut self, stick: Stick, cx: &mut Context<Self>) {
        if let Ok(position) = cx.variable::<StickPosition>("stick") {
            let _ = position.write(StickPosition { speed: stick.speed }).await;
        }
    }
}

#[derive(Default)]
struct Wheels;

impl Component for Wheels {
    fn ports(ports: &mut Ports<Self>) {
        ports.actuator(ActuatorSpec::new(Drive { speed: 0.0 }, Hold)).named("drive");
    }
}

impl Handle<Drive> for Wheels {
    async fn handle(&mut self, _: Drive, _: &mut Context<Self>) {}
}

/// What the rover does.
static DOES: LazyLock<watch::Sender<&str>> = LazyLock::new(|| watch::channel("").0);
const DRIVES: &str = "drives as the operator says";
const STANDS: &str = "stands: the radio is too slow";
const RETURNS: &str = "returns by itself";
const STOPS: &str = "stops";

/// Commands the wheels again and again, until the tree halts the leaf. Then the lease is given back.
async fn drive(mut leaf: LeafTask, does: &'static str, speed: Option<f64>) -> LeafResult {
    let wheels = leaf.context().commander::<Drive>("wheels")?;
    let stick = leaf.context().variable::<StickPosition>("stick")?;
    loop {
        leaf.alive();
        let speed = match speed {
            Some(speed) => speed,
            None => stick.read().await?.value.speed,
        };
        // While the rover is stopped, the wheels are not to be had.
        let is_claimed = wheels.holds() || wheels.claim().await.is_ok();
        if is_claimed && wheels.command(Drive { speed }).await.is_ok() {
            DOES.send_if_modified(|known| std::mem::replace(known, does) != does);
        }
        blastema::sleep(Duration::from_millis(50)).await;
    }
}

fn types() -> Types {
    let leaves = TreeLeaves::new()
        .task("TeleoperatedMission", [], |leaf| drive(leaf, DRIVES, None))
        .task("HoldPosition", [], |leaf| drive(leaf, STANDS, Some(0.0)))
        .task("AutonomousSafeReturn", [], |leaf| async {
            let home = drive(leaf, RETURNS, Some(-0.5));
            let _ = tokio::time::timeout(Duration::from_millis(500), home).await;
            Ok(Status::Success)
        });
    Types::new()
        .component::<Wheels>("Wheels")
        .component::<StickReceiver>("StickReceiver")
        .component::<Console>("Console")
        .leaves(leaves)
}

/// The table, row by row.
struct Show {
    begun: Instant,
    node: Node,
}

impl Show {
    fn row(&self, what: &str, does: &str) {
        println!("{:5.1} s | {what:25} | {does}", self.begun.elapsed().as_secs_f64());
    }

    /// Waits until the rover does this.
    async fn until(&self, what: &str, does: &str) -> Result<(), Box<dyn Error>> {
        let mut doing = DOES.subscribe();
        let done = doing.wait_for(|known| *known == does);
        tokio::time::timeout(Duration::from_secs(60), done).await??;
        self.row(what, does);
        Ok(())
    }

    /// Waits until the rover is stopped because the operator has not come back. Returns what it did
    /// until then.
    async fn until_stopped(&self, what: &str) -> &'static str {
        let mut before = "";
        loop {
            blastema::sleep(Duration::from_millis(20)).await;
            if self.node.lost_communication()[0].rung.as_deref() == Some("stop") {
                // The last command may be noted later than the rung.
                match DOES.send_replace(STOPS) {
                    STOPS => break,
                    does => before = does,
                }
            }
        }
        self.row(what, STOPS);
        before
    }
}

/// Shows a rover with this tree, until the node is shut down.
async fn show(tree: &str) -> Result<(), Box<dyn Error>> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("robots/rover.robot.xml");
    let [rover, operator] = free_addresses()?.map(|address| address.to_string());
    let set = [("tree", tree), ("stop-after", "3s"), ("rover", &rover), ("operator", &operator)];
    let start_operator = || -> std::io::Result<Child> {
        let mut process = Command::new(std::env::current_exe()?);
        let set = set.iter().map(|(name, value)| format!("--set={name}={value}"));
        process.arg("run").arg(&file).args(["--node=operator", "--until-stdin-ends"]).args(set);
        // It ends with this process at the latest.
        process.stdin(Stdio::piped());
        process.spawn()
    };
    let (types, slow) = (
        types(),
        Impairment { delay: Duration::from_millis(300), loss: 0.2, ..Impairment::default() },
    );
    let node = types.node(&types.load(&file, &set)?, "rover")?.with_faults(7).start().await?;
    let radio = node.cable("radio").ok_or("the network of the file")?;
    let show = Show { begun: Instant::now(), node };
    println!("\n{tree}\n   time | what happens              | what the rover does");
    show.until("it is switched on", RETURNS).await?;
    let mut process = start_operator()?;
    show.until("the operator starts", DRIVES).await?;
    process.kill()?;
    process.wait()?;
    if tree == RIGHT {
        show.until("the operator is killed", RETURNS).await?;
        show.until_stopped("the operator stays away").await;
        process = start_operator()?;
        show.until("the operator is back", DRIVES).await?;
        radio.cut(Direction::Both, true);
        show.until("the cable is pulled", RETURNS).await?;
        radio.restore();
        show.until("the cable is back", DRIVES).await?;
        radio.impair(Direction::Both, slow);
        show.until("the radio is slow", STANDS).await?;
        radio.restore();
        show.until("the radio is well again", DRIVES).await?;
        process.kill()?;
        process.wait()?;
    } else {
        // Its sequence does not look again: it goes on, and is stopped.
        let before = show.until_stopped("the operator is killed").await;
        show.row("until then", before);
    }
    show.node.shutdown().await;
    Ok(())
}

const RIGHT: &str = "rover.tree.xml";

async fn show_both() -> Result<(), Box<dyn Error>> {
    show(RIGHT).await?;
    show("comms_aware_operation.tree.xml").await
}

fn main() -> ExitCode {
    if std::env::args().len() > 1 {
        return types().main();
    }
    match blastema::run(show_both()) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            println!("{error}");
            ExitCode::FAILURE
        }
    }
}
