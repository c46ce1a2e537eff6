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
use crate::demo::wiring::{CableEnd, Wiring};
use blastema::core::detection::Pull;
use blastema::prelude::*;
use blastema::{Cable, Direction, Link, Network, NodeBuilder};
use std::io;
use std::net::UdpSocket;
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
const PATIENCE: Duration = Duration::from_millis(500);
/// Messages that wait for an object: two seconds of the fastest flow. What a cable cut holds back
/// arrives at once.
const FLOW_QUEUE: usize = 4_096;
/// Messages that wait for an object that is asked: more than it serves in its patience, so that a
/// flood is seen.
const PASSIVE_QUEUE: usize = 1_024;
/// Messages that wait for an object that no flow ends at.
const QUEUE: usize = 512;
/// How often both ends of a cable say hello: three and a half later a silent cut is found. A debug
/// build is ten times slower and shares the machine with a compiler.
const HELLO: Duration = Duration::from_millis(if cfg!(debug_assertions) { 50 } else { 20 });
/// What the cable of the paper's Fig. 9 costs.
const FIRST_COST: u16 = 10;
/// What the second path costs: it is taken only if the first is down.
const SECOND_COST: u16 = 15;
/// How often response times are measured.
const ECHOES_HZ: f64 = 100.0;
/// How often the delivery of an event is measured.
const TICKS_HZ: f64 = 100.0;

/// The robot's work, and what measures it, in the order of their start.
pub(super) fn build(module: Module, wiring: &Wiring, gauges: &Gauges) -> NodeBuilder {
    let mut node = Node::builder(module.name())
        .supervisor(work_of(module, gauges))
        .supervisor(skin_of(module, gauges))
        .supervisor(measurements_of(module, gauges));
    for end in wiring.ends_of(module) {
        node = node.network(network(&end));
    }
    node
}

/// A cable is a network of its own, so that it can be cut alone.
fn network(end: &CableEnd) -> Network {
    let CableEnd { cable, here, there, neighbour } = *end;
    let cost = if cable.second { SECOND_COST } else { FIRST_COST };
    let link = Link::new(neighbour.name(), there).named(cable.name).cost(cost).hello_every(HELLO);
    Network::udp(cable.name, here).link(link).with_faults(u64::from(here.port()))
}

/// Whether all our addresses are still free. A transport would wait for ever for one that is not.
///
/// # Errors
/// Another process took one since the director chose it.
pub(super) fn check_addresses(module: Module, wiring: &Wiring) -> io::Result<()> {
    wiring.ends_of(module).iter().try_for_each(|end| UdpSocket::bind(end.here).map(drop))
}

/// Lets nothing through a cable any more, at this end. The medium does not notice.
///
/// # Errors
/// There is no such cable.
pub(super) fn cut(node: &Node, name: &str) -> Result<(), Why> {
    cable(node, name).map(|cable| cable.cut(Direction::Both, false))
}

/// Plugs a cable in again, at this end.
///
/// # Errors
/// There is no such cable.
pub(super) fn restore(node: &Node, name: &str) -> Result<(), Why> {
    cable(node, name).map(|cable| cable.restore())
}

fn cable(node: &Node, name: &str) -> Result<Cable, Why> {
    node.cable(name).ok_or_else(|| Why::Unknown { name: name.to_owned() })
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
        .queue(PASSIVE_QUEUE, WhenFull::Refuse)
        .max_delay(PATIENCE)
        .watch(Watch::Pull(Pull::default()))
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
    // In one module only: listeners elsewhere would have the events sent over the network.
    if module == Module::Module1 {
        let (plain, choosy) = (gauges.clone(), gauges.clone());
        let plain = move || Listener { gauges: plain.clone() };
        let choosy = move || ChoosyListener { gauges: choosy.clone() };
        measurements = measurements
            .child(ChildSpec::new("measure/listener", plain))
            .child(ChildSpec::new("measure/choosy", choosy))
            .child(ChildSpec::new("measure/ticker", || Ticker { number: 0 }).rate_hz(TICKS_HZ));
    }
    measurements
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
