//! What is aboard a module: its node, its cables, its objects.

use super::cell::Cell;
use super::gauges::Gauges;
use super::laser::Laser;
use super::messages::{Pose, Velocity};
use super::motors::Motors;
use super::odometry::Odometry;
use super::operator::Operator;
use super::pacer::Pacer;
use super::planner::Planner;
use super::safety::Safety;
use super::stopwatch::{Answerer, ECHO, Stopwatch};
use super::ticker::{ChoosyListener, Listener, Ticker};
use super::wounds::Wounds;
use crate::demo::robot::{FLOWS, Module, SIGN_OF_LIFE_MILLIS, skin};
use crate::demo::wiring::Wiring;
use blastema::NodeBuilder;
use blastema::core::detection::Pull;
use blastema::prelude::*;
use std::time::Duration;

/// Restarts that a supervisor of the demonstration makes in [`PERIOD`]: its objects are struck again
/// and again, on purpose.
const RESTARTS: u32 = 50;
/// See [`RESTARTS`].
const PERIOD: Duration = Duration::from_secs(10);
/// How long a handler may keep its arbiter. A robot's handlers take microseconds; a busy machine may
/// leave a thread waiting for some tens of milliseconds.
const BLOCK: Duration = Duration::from_millis(150);
/// How long a message may wait for an object that is asked, before that is an overload.
const PATIENCE: Duration = Duration::from_millis(200);
/// Messages that wait for an object: two seconds of the fastest flow. What a cable cut holds back
/// arrives at once.
const FLOW_QUEUE: usize = 4_096;
/// Messages that wait for an object that no flow ends at.
const QUEUE: usize = 512;
/// How often response times are measured.
const ECHOES_HZ: f64 = 200.0;
/// How often the delivery of an event is measured.
const TICKS_HZ: f64 = 50.0;

/// The robot's work, and what measures it, in the order of their start.
pub(super) fn build(module: Module, wiring: &Wiring, gauges: &Gauges) -> NodeBuilder {
    let _ = wiring;
    Node::builder(module.name())
        .supervisor(skin_of(module, gauges))
        .supervisor(work_of(module, gauges))
        .supervisor(measurements_of(module, gauges))
}

/// Whether the node could not start because another process took one of its addresses.
pub(super) fn is_address_taken(_error: &StartError) -> bool {
    false
}

/// Lets nothing through a cable any more, at this end.
pub(super) fn cut(_node: &Node, cable: &str) -> Result<(), Why> {
    Err(Why::Unknown { name: cable.to_owned() })
}

/// Plugs a cable in again, at this end.
pub(super) fn restore(_node: &Node, cable: &str) -> Result<(), Why> {
    Err(Why::Unknown { name: cable.to_owned() })
}

/// Makes the router panic.
pub(super) fn panic_router(_node: &Node) -> Result<(), Why> {
    Err(Why::Unknown { name: "router".to_owned() })
}

fn supervisor(name: &str) -> SupervisorSpec {
    SupervisorSpec::new(name, Strategy::OneForOne).intensity(RESTARTS, PERIOD)
}

/// An object that gives signs of life.
fn active<C: Component>(
    name: &str,
    rate_hz: f64,
    factory: impl Fn() -> C + Send + Sync + 'static,
) -> ChildSpec<C> {
    let sign_of_life = Duration::from_millis(SIGN_OF_LIFE_MILLIS);
    ChildSpec::new(name, factory)
        .rate_hz(rate_hz)
        .queue(QUEUE, WhenFull::Refuse)
        .watch(Watch::push(sign_of_life, 3))
        .max_block(BLOCK)
}

/// An object that is asked whether it lives.
fn passive<C: Component>(
    name: &str,
    rate_hz: f64,
    factory: impl Fn() -> C + Send + Sync + 'static,
) -> ChildSpec<C> {
    active(name, rate_hz, factory)
        .watch(Watch::Pull(Pull { patience: PATIENCE, ..Pull::default() }))
}

fn skin_of(module: Module, gauges: &Gauges) -> SupervisorSpec {
    let mut cells = supervisor("skin");
    for name in module.skin().map(skin) {
        let (scar, gauges) = (gauges.scar(&name), gauges.clone());
        let flow = FLOWS.iter().find(|flow| flow.to == module && flow.sink == name);
        let queue = if flow.is_some() { FLOW_QUEUE } else { QUEUE };
        let cell = move || {
            let (wounds, gauges) = (Wounds::new(&scar), gauges.clone());
            Cell { wounds, gauges, flow, pressure: 0.0 }
        };
        cells = cells.child(active(&name, 10.0, cell).queue(queue, WhenFull::Refuse));
    }
    cells
}

fn work_of(module: Module, gauges: &Gauges) -> SupervisorSpec {
    let wounds = |name: &str| {
        let scar = gauges.scar(name);
        move || Wounds::new(&scar)
    };
    let work = supervisor("work");
    match module {
        Module::Module1 => {
            let (planner, safety) = (wounds("planner"), wounds("safety"));
            let motors = "module3:motors";
            work.child(active("safety", 50.0, move || Safety { wounds: safety(), motors })).child(
                passive("planner", 20.0, move || Planner {
                    wounds: planner(),
                    motors,
                    pose: None,
                    goal: None,
                    clearance: 0.0,
                }),
            )
        }
        Module::Module2 => {
            let (laser, operator) = (wounds("laser"), wounds("operator"));
            work.child(active("laser", 20.0, move || Laser { wounds: laser(), sweeps: 0 })).child(
                passive("operator", 10.0, move || Operator { wounds: operator(), corner: 0 }),
            )
        }
        Module::Module3 => {
            let (motors, odometry) = (wounds("motors"), wounds("odometry"));
            let velocity = Velocity::default();
            work.child(active("motors", 100.0, move || Motors {
                wounds: motors(),
                velocity,
                rounds_since: 0,
            }))
            .child(active("odometry", 50.0, move || Odometry {
                wounds: odometry(),
                pose: Pose::default(),
            }))
        }
    }
}

fn measurements_of(module: Module, gauges: &Gauges) -> SupervisorSpec {
    let mut measurements = supervisor("measure").child(ChildSpec::new(ECHO, || Answerer));
    for flow in FLOWS.iter().filter(|flow| flow.from == module) {
        let gauges = gauges.clone();
        let pacer = move || Pacer { gauges: gauges.clone(), flow };
        let spec = ChildSpec::new(flow.name, pacer).rate_hz(f64::from(flow.rate_hz));
        measurements = measurements.child(spec);
    }
    for of in asked_by(module) {
        let gauges = gauges.clone();
        let stopwatch = move || Stopwatch { gauges: gauges.clone(), of: *of, number: 0 };
        let spec = ChildSpec::new(&format!("measure/{of}"), stopwatch).rate_hz(ECHOES_HZ);
        measurements = measurements.child(spec);
    }
    let (plain, choosy) = (gauges.clone(), gauges.clone());
    measurements
        .child(ChildSpec::new("measure/listener", move || Listener { gauges: plain.clone() }))
        .child(ChildSpec::new("measure/choosy", move || ChoosyListener { gauges: choosy.clone() }))
        .child(ChildSpec::new("measure/ticker", || Ticker { number: 0 }).rate_hz(TICKS_HZ))
}

/// Whose response times a module measures, so that each pair is measured once and, in the story, by
/// modules that live on.
fn asked_by(module: Module) -> &'static [Module] {
    match module {
        Module::Module1 => &[Module::Module2, Module::Module3],
        Module::Module2 => &[Module::Module3],
        Module::Module3 => &[],
    }
}
