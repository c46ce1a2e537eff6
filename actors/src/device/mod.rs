//! Small devices: a microcontroller as a component, with no recovery code on the chip.
//!
//! ```text
//!  other components ─ ports ─► DeviceProxy ─► DeviceLink ─► DeviceLine ═ serial, UDP ═ chip
//! ```
//!
//! The proxy is a component like any other: supervised, monitored, reached from other nodes. The
//! protocol is that of `blastema-lite`. Deliberately not here: keys; a line is trusted.

mod header;
mod line;
mod link;
mod medium;
mod port;
mod proxy;

pub use header::DeviceDescription;
pub use proxy::DeviceProxy;

use crate::actuator::ActuatorSpec;
use crate::component::Handle;
use crate::component::cell::ComponentCell;
use crate::component::declaration::Declarations;
use crate::component::ports::Ports;
use crate::component::spec_error::SpecError;
use crate::host::spec::ChildSpec;
use crate::variable::VariableSpec;
use blastema_core::port::TypeDescription;
use blastema_core::{Contract, Event, ObjectName, Request, Variable};
use blastema_lite::{HostConfig, PORTS_MAX, Port, PortKind, Tries, message};
use line::{DeviceLine, LineClaim};
use medium::DeviceMedium;
use port::{DevicePort, PortUse};
use proxy::ProxySettings;
use std::any::TypeId;
use std::collections::BTreeSet;
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

type DeclarePort = Box<dyn FnOnce(&mut Ports<DeviceProxy>) + Send>;

/// A device on a serial line or behind a UDP socket, and the ports of its firmware.
///
/// [`child`](Self::child) makes it a component for a node or a supervisor. Ports are numbered per
/// object and direction as the firmware numbers them. Each contract must have a fixed size, as a
/// packed struct of at most 239 bytes.
///
/// ```no_run
/// use blastema::prelude::*;
/// use blastema::DeviceSpec;
///
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "gripper/close")]
/// struct Close {
///     #[contract(unit = "N")]
///     force: f32,
/// }
///
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "gripper/grip", delivery = "newest")]
/// struct Grip {
///     #[contract(unit = "mm")]
///     width: u16,
///     holds: bool,
/// }
///
/// # #[blastema::main]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let gripper = DeviceSpec::new("gripper", "serial:///dev/ttyUSB0?baud=115200", 0x6772_6970)
///     .accepts::<Close>(0)
///     .publishes::<Grip>(0, "gripper/grip");
/// let node = Node::builder("arm").child(gripper.child()).start().await?;
/// let close: Sender<Close> = node.sender("gripper")?;
/// # Ok(())
/// # }
/// ```
#[must_use = "a device spec does nothing until its child is given to a node or a supervisor"]
pub struct DeviceSpec {
    name: String,
    medium: Result<DeviceMedium, String>,
    host: HostConfig<Vec<Port>>,
    period: Option<Duration>,
    object: u8,
    ports: Vec<DevicePort<DeviceProxy>>,
    declare: Vec<DeclarePort>,
    /// Which setting is wrong, and how; the node refuses to start.
    problem: Option<(&'static str, String)>,
}

impl fmt::Debug for DeviceSpec {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("DeviceSpec").field("name", &self.name).finish_non_exhaustive()
    }
}

/// What a node does about a device before it starts it.
#[derive(Default)]
struct DeviceDeclaration {
    /// With it, the node refuses to start.
    problem: Option<(&'static str, String)>,
    settings: Option<Arc<ProxySettings>>,
}

impl Declarations<DeviceProxy> for DeviceDeclaration {
    fn check(&self, name: &ObjectName, _: &BTreeSet<&'static str>) -> Result<(), SpecError> {
        let Some((setting, why)) = self.problem.clone() else { return Ok(()) };
        Err(SpecError::Device { name: name.clone(), setting, why })
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<DeviceProxy>>) -> Result<(), SpecError> {
        let Some(settings) = &self.settings else { return Ok(()) };
        // A check and a start have an environment each, and one does not hinder the other.
        let node = Arc::as_ptr(&cell.record.environment).addr();
        settings.line.claim(&settings.claim, node).map_err(|why| {
            let (name, setting) = (cell.record.name.clone(), "address");
            SpecError::Device { name, setting, why }
        })
    }
}

impl DeviceSpec {
    /// The [`interval`](Self::interval), unless that is set.
    pub const INTERVAL: Duration = Duration::from_millis(100);
    /// The [`deadman`](Self::deadman), unless that is set.
    pub const DEADMAN: Duration = Duration::from_millis(500);
    /// The [`turnaround`](Self::turnaround), unless that is set.
    pub const TURNAROUND: Duration = Duration::from_millis(20);

    /// The device at this endpoint: `serial://` and a port, or `udp://` and the device's address.
    ///
    /// A device with another `device_type` is refused: give each firmware a number of its own, and
    /// each of two devices that must not be confused.
    pub fn new(name: &str, endpoint: &str, device_type: u32) -> Self {
        let medium = DeviceMedium::parse(endpoint);
        let byte_time = medium.as_ref().map(DeviceMedium::byte_time).unwrap_or_default();
        let host = HostConfig {
            address: None,
            device_type,
            ports: Vec::new(),
            session: 0,
            interval: Self::INTERVAL,
            tries: Tries::Auto,
            deadman: Self::DEADMAN,
            byte_time,
            turnaround: Self::TURNAROUND,
        };
        let (ports, declare) = Default::default();
        DeviceSpec {
            name: name.to_owned(),
            medium,
            host,
            period: None,
            object: 1,
            ports,
            declare,
            problem: None,
        }
    }

    /// Returns the device's name, for topics that it publishes.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Describes what the component takes, as [`describe`](crate::describe) does for a type.
    pub fn describe_component(self) -> TypeDescription {
        let mut ports = Ports::of();
        self.declare.into_iter().for_each(|declare| declare(&mut ports));
        ports.describe()
    }

    /// Sets the device's address, 1 to 247, on a line with several devices.
    pub fn address(mut self, address: u8) -> Self {
        self.refuse_unless("address", (1..=247).contains(&address), || {
            format!("address {address}: addresses on a line are 1 to 247")
        });
        self.host.address = Some(address);
        self
    }

    /// Sets how often the device is asked for a sign of life; 100 ms unless set, at least 1 ms. A
    /// shorter interval finds a silent device sooner and takes more of the line.
    pub fn interval(mut self, interval: Duration) -> Self {
        self.refuse_unless("interval", interval >= Duration::from_millis(1), || {
            format!("an interval of {interval:?} is shorter than 1 ms")
        });
        self.host.interval = interval;
        self
    }

    /// Sets how many unanswered tries in a row declare the device lost. Unless set, it follows the
    /// measured loss: at least 3, and as many as keep false alarms below one a day.
    pub fn tries(mut self, tries: u8) -> Self {
        self.refuse_unless("tries", tries > 0, || {
            "without a try it would be lost at once: write 1 at least".to_owned()
        });
        self.host.tries = Tries::Fixed(tries);
        self
    }

    /// Sets after how long a silence of this node, or of the proxy, the device makes itself safe;
    /// 500 ms unless set, at least two intervals. The firmware has a limit of its own.
    pub fn deadman(mut self, deadman: Duration) -> Self {
        self.host.deadman = deadman;
        self
    }

    /// Sets how long the device and the drivers of both ends take for an answer at most, without
    /// its bytes; 20 ms unless set. A shorter time repeats sooner after a loss.
    pub fn turnaround(mut self, turnaround: Duration) -> Self {
        self.host.turnaround = turnaround;
        self
    }

    /// Sets the period of the device's `on_execute`, in whole milliseconds up to a minute. Unless
    /// set, the firmware's own counts.
    pub fn period(mut self, period: Duration) -> Self {
        let longest = Duration::from_millis(message::PERIOD_MAX_MS.into());
        let is_valid = (Duration::from_millis(1)..=longest).contains(&period);
        self.refuse_unless("period", is_valid, || {
            format!("a period of {period:?} is not in 1 ms to 60 s")
        });
        self.period = Some(period);
        self
    }

    /// Sets the object, from 1, to which the ports that follow belong. All objects of a device
    /// have one life cycle.
    pub fn object(mut self, object: u8) -> Self {
        self.refuse_unless("ports", object > 0, || "objects of a device count from 1".to_owned());
        self.object = object.max(1);
        self
    }

    /// Declares in port `number`: messages of this contract that are sent to the component.
    pub fn accepts<E: Event>(mut self, number: u8) -> Self {
        self.input::<E>(number);
        self.declare.push(Box::new(|ports| _ = ports.accept::<E>()));
        self
    }

    /// Declares in port `number`: events of this topic.
    pub fn listens<E: Event>(mut self, number: u8, topic: &str) -> Self {
        self.input::<E>(number);
        let topic = topic.to_owned();
        self.declare.push(Box::new(move |ports| _ = ports.listen::<E>().on(&topic)));
        self
    }

    /// Declares in port `number`: commands of the holder of its lease. The safe command goes to
    /// the device like any other; when the node falls silent, the device's dead-man acts.
    pub fn actuator<M: Event>(mut self, number: u8, spec: ActuatorSpec<M>) -> Self {
        self.input::<M>(number);
        self.declare.push(Box::new(|ports| _ = ports.actuator(spec)));
        self
    }

    /// Declares out port `number`, whose values are published on this topic.
    pub fn publishes<E: Event>(mut self, number: u8, topic: &str) -> Self {
        self.add::<E>(number, PortKind::Out, PortUse::output::<E>(topic));
        self
    }

    /// Declares operation `number`, which answers this request.
    pub fn serves<M: Request>(mut self, number: u8) -> Self {
        self.add::<M>(number, PortKind::Call, PortUse::Call);
        self.declare.push(Box::new(|ports| _ = ports.serve::<M>()));
        self
    }

    /// Declares variable `number`. Its value is the node's, which sets the device's whenever it
    /// changes, and again in each incarnation by the policy of the [`VariableSpec`].
    pub fn variable<V: Variable>(mut self, number: u8, spec: VariableSpec<V>) -> Self {
        self.add::<V>(number, PortKind::Variable, PortUse::variable::<V>());
        self.declare.push(Box::new(|ports| _ = ports.variable(spec)));
        self
    }

    /// The component, for [`NodeBuilder::child`](crate::NodeBuilder::child) or a supervisor. What
    /// is wrong with the spec is an error when the node starts.
    pub fn child(self) -> ChildSpec<DeviceProxy> {
        let DeviceSpec { name, medium, mut host, period, ports, declare, problem, .. } = self;
        let short = format!(
            "a deadman of {:?} is too short for an interval of {:?}: at least twice as long",
            host.deadman, host.interval
        );
        let problem = problem.or((host.deadman < host.interval * 2).then_some(("deadman", short)));
        let (line, problem) = match medium.and_then(|medium| DeviceLine::of(&medium)) {
            Ok(line) => (Some(line), problem),
            Err(error) => (None, problem.or(Some(("endpoint", error)))),
        };
        let claim = LineClaim::new(host.address);
        host.ports = ports.iter().map(|port| port.port).collect();
        let period_ms = period.map(|period| period.as_millis() as u16);
        let settings =
            line.map(|line| Arc::new(ProxySettings { line, claim, host, ports, period_ms }));
        let shared = settings.clone();
        let factory = move || {
            let settings = shared.clone().expect("a node starts no device with a problem");
            DeviceProxy::new(settings)
        };
        ChildSpec::new(&name, factory).with_ports(move |ports| {
            *ports.feature::<DeviceDeclaration>() = DeviceDeclaration { problem, settings };
            declare.into_iter().for_each(|declare| declare(ports));
        })
    }

    fn input<M: Contract>(&mut self, number: u8)
    where
        DeviceProxy: Handle<M>,
    {
        let reorders = self.medium.as_ref().is_ok_and(DeviceMedium::reorders);
        self.add::<M>(number, PortKind::In, PortUse::input::<M>(reorders));
    }

    fn add<M: Contract>(&mut self, number: u8, kind: PortKind, used: PortUse<DeviceProxy>) {
        let is_out = |port: &DevicePort<DeviceProxy>| matches!(port.used, PortUse::Out { .. });
        match DevicePort::new::<M>(self.object, number, kind, used) {
            Ok(port) => {
                let twice = self.ports.iter().any(|known| {
                    let same = known.of == TypeId::of::<M>() && !is_out(known) && !is_out(&port);
                    let at = |port: &DevicePort<DeviceProxy>| (port.port.object(), port.port.id());
                    same || at(known) == at(&port)
                });
                let room = self.ports.len() < PORTS_MAX;
                self.refuse_unless("ports", !twice && room, || {
                    format!("port {number} for `{}`, or its contract, is declared twice", M::NAME)
                });
                self.ports.push(port);
            }
            Err(problem) => self.refuse_unless("ports", false, || problem),
        }
    }

    fn refuse_unless(
        &mut self,
        setting: &'static str,
        holds: bool,
        problem: impl FnOnce() -> String,
    ) {
        if !holds {
            self.problem.get_or_insert_with(|| (setting, problem()));
        }
    }
}
