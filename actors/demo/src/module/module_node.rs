//! The node of a module, with its cables and objects.

use super::cell::Cell;
use super::harm::HarmState;
use super::laser::Laser;
use super::measurements::Measurements;
use super::messages::{Pose, Velocity};
use super::motors::Motors;
use super::odometry::Odometry;
use super::operator::Operator;
use super::pacer::Pacer;
use super::planner::Planner;
use super::safety::Safety;
use super::stopwatch::{Answerer, ECHO, Stopwatch};
use super::ticker::{ChoosyListener, PlainListener, Ticker};
use crate::robot::{FLOWS, Module, SIGN_OF_LIFE_MILLIS, skin};
use crate::wiring::{CableAddresses, CableEnd};
use blastema::core::detection::Pull;
use blastema::prelude::*;
use blastema::{Cable, Direction, Link, Network, NodeBuilder};
use std::io;
use std::net::UdpSocket;
use std::time::Duration;

/// Restarts that a supervisor of the demonstration makes in [`PERIOD`]: its objects are struck
/// again and again, on purpose.
const RESTARTS: u32 = 50;
/// See [`RESTARTS`].
const PERIOD: Duration = Duration::from_secs(10);
/// How long a handler may keep its arbiter. A robot's handlers take microseconds; on a machine with
/// ten times more ready threads than processors, a thread waits for up to 200 ms.
const BLOCK: Duration = Duration::from_millis(400);
/// Signs of life in a row that an object may miss, and answers, for the same reason.
const MISSED_SIGNS: u32 = 5;
/// How long a message may wait for a passive object before that is an overload.
const PATIENCE: Duration = Duration::from_millis(500);
/// Messages that wait for an object: two seconds of the fastest flow. What a cable cut holds back
/// arrives at once.
const FLOW_QUEUE: usize = 4_096;
/// Messages that wait for a passive object: more than it serves before they are an overload.
const PASSIVE_QUEUE: usize = 512;
/// Messages that wait for an object that no flow ends at.
const QUEUE: usize = 512;
/// How often both ends of a cable send a hello: after three and a half intervals without one a
/// silent cut is found. Longer, and after the return of both cables the links are up too late for
/// sessions, which wait for two seconds; shorter, and a busy machine delays hellos beyond the
/// limit.
const HELLO: Duration = Duration::from_millis(if cfg!(debug_assertions) { 100 } else { 50 });
/// What the cable of the paper's Fig. 9 costs.
const FIRST_COST: u16 = 10;
/// What the second path costs: it is taken only if the first is down.
const SECOND_COST: u16 = 15;
/// How often response times and the delivery of an event are measured. A debug build measures less
/// often, because it takes ten times as long for each message.
const PROBES_HZ: f64 = if cfg!(debug_assertions) { 20.0 } else { 100.0 };

/// The robot's work, and what measures it, in the order of their start.
pub(super) fn build(
    module: Module,
    wiring: &CableAddresses,
    measurements: &Measurements,
) -> NodeBuilder {
    let mut node = Node::builder(module.name())
        .supervisor(work_of(module, measurements))
        .supervisor(skin_of(module, measurements))
        .supervisor(measurements_of(module, measurements));
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
pub(super) fn check_addresses(module: Module, wiring: &CableAddresses) -> io::Result<()> {
    wiring.ends_of(module).iter().try_for_each(|end| UdpSocket::bind(end.here).map(drop))
}

/// Blocks a cable at this end. The medium reports nothing.
///
/// # Errors
/// There is no such cable.
pub(super) fn cut(node: &Node, name: &str) -> Result<(), DeliveryError> {
    cable(node, name).map(|cable| cable.cut(Direction::Both, false))
}

/// Unblocks a cable at this end.
///
/// # Errors
/// There is no such cable.
pub(super) fn restore(node: &Node, name: &str) -> Result<(), DeliveryError> {
    cable(node, name).map(|cable| cable.restore())
}

fn cable(node: &Node, name: &str) -> Result<Cable, DeliveryError> {
    node.cable(name).ok_or_else(|| DeliveryError::Unknown { name: name.to_owned() })
}

fn supervisor(name: &str) -> SupervisorSpec {
    SupervisorSpec::new(name, Strategy::OneForOne).intensity(RESTARTS, PERIOD)
}

/// An active object, which sends signs of life.
fn active<C: Component>(
    name: &str,
    rate_hz: f64,
    factory: impl Fn() -> C + Send + Sync + 'static,
) -> ChildSpec<C> {
    let sign_of_life = Duration::from_millis(SIGN_OF_LIFE_MILLIS);
    ChildSpec::new(name, factory)
        .rate_hz(rate_hz)
        .queue(QUEUE, WhenFull::Refuse)
        .liveness(Liveness::push(sign_of_life, MISSED_SIGNS))
        .max_block(BLOCK)
}

/// A passive object, which is pinged.
fn passive<C: Component>(
    name: &str,
    rate_hz: f64,
    factory: impl Fn() -> C + Send + Sync + 'static,
) -> ChildSpec<C> {
    active(name, rate_hz, factory)
        .queue(PASSIVE_QUEUE, WhenFull::Refuse)
        .max_delay(PATIENCE)
        .liveness(Liveness::Pull(Pull { tolerance: MISSED_SIGNS, ..Pull::default() }))
}

fn skin_of(module: Module, measurements: &Measurements) -> SupervisorSpec {
    let mut cells = supervisor("skin");
    for name in module.skin().map(skin) {
        let (record, measurements) = (measurements.record(&name), measurements.clone());
        let flow = FLOWS.iter().find(|flow| flow.to == module && flow.sink == name);
        let queue = if flow.is_some() { FLOW_QUEUE } else { QUEUE };
        let cell = move || {
            let (harm, measurements) = (HarmState::new(&record), measurements.clone());
            Cell { harm, measurements, flow, pressure: 0.0 }
        };
        cells = cells.child(active(&name, 10.0, cell).queue(queue, WhenFull::Refuse));
    }
    cells
}

fn work_of(module: Module, measurements: &Measurements) -> SupervisorSpec {
    let harm = |name: &str| {
        let record = measurements.record(name);
        move || HarmState::new(&record)
    };
    let work = supervisor("work");
    match module {
        Module::Module1 => {
            let (planner, safety) = (harm("planner"), harm("safety"));
            let motors = "module3:motors";
            work.child(active("safety", 50.0, move || Safety { harm: safety(), motors })).child(
                passive("planner", 20.0, move || Planner {
                    harm: planner(),
                    motors,
                    pose: None,
                    goal: None,
                    clearance: 0.0,
                }),
            )
        }
        Module::Module2 => {
            let (laser, operator) = (harm("laser"), harm("operator"));
            work.child(active("laser", 20.0, move || Laser { harm: laser(), sweeps: 0 }))
                .child(passive("operator", 10.0, move || Operator { harm: operator(), corner: 0 }))
        }
        Module::Module3 => {
            let (motors, odometry) = (harm("motors"), harm("odometry"));
            let velocity = Velocity::default();
            work.child(active("motors", 100.0, move || Motors {
                harm: motors(),
                velocity,
                rounds_since: 0,
            }))
            .child(active("odometry", 50.0, move || Odometry {
                harm: odometry(),
                pose: Pose::default(),
            }))
        }
    }
}

fn measurements_of(module: Module, measurements: &Measurements) -> SupervisorSpec {
    let mut instruments = supervisor("measure").child(ChildSpec::new(ECHO, || Answerer));
    for flow in FLOWS.iter().filter(|flow| flow.from == module) {
        let measurements = measurements.clone();
        let pacer = move || Pacer { measurements: measurements.clone(), flow };
        let spec = ChildSpec::new(flow.name, pacer).rate_hz(f64::from(flow.rate_hz));
        instruments = instruments.child(spec);
    }
    for of in asked_by(module) {
        let measurements = measurements.clone();
        let stopwatch =
            move || Stopwatch { measurements: measurements.clone(), of: *of, number: 0 };
        let spec = ChildSpec::new(&format!("measure/{of}"), stopwatch).rate_hz(PROBES_HZ);
        instruments = instruments.child(spec);
    }
    // In one module only: listeners elsewhere would have the events sent over the network.
    if module == Module::Module1 {
        let (plain, choosy) = (measurements.clone(), measurements.clone());
        let plain = move || PlainListener { measurements: plain.clone() };
        let choosy = move || ChoosyListener { measurements: choosy.clone() };
        instruments = instruments
            .child(ChildSpec::new("measure/listener", plain))
            .child(ChildSpec::new("measure/choosy", choosy))
            .child(ChildSpec::new("measure/ticker", || Ticker { number: 0 }).rate_hz(PROBES_HZ));
    }
    instruments
}

/// Returns the modules whose response times a module measures: each pair once.
fn asked_by(module: Module) -> &'static [Module] {
    match module {
        Module::Module1 => &[Module::Module2, Module::Module3],
        Module::Module2 => &[Module::Module3],
        Module::Module3 => &[],
    }
}
