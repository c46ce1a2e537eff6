//! What a component takes and gives, declared once for all its incarnations.

use crate::component::cell::ComponentCell;
use crate::component::declaration::Declarations;
use crate::component::spec_error::SpecError;
use crate::component::{Component, Handle};
use crate::liveness::limits::ComponentLimits;
use crate::messaging::queue::WhenFull;
use crate::platform::panics;
use crate::registry::ContractPort;
use crate::registry::ports::DeclaredPort;
use blastema_core::parameters::{ParameterDescription, ParameterError, ParameterValue};
use blastema_core::port::{ConnectionRole, PortDescription, TypeDescription};
use blastema_core::sorted::SortedMap;
use blastema_core::{Contract, ContractIdentity, Event, NameError, ObjectName, Request};
use std::any::{Any, TypeId};
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

/// Makes the skeleton for one contract.
pub(crate) type PortConstructor<C> = fn(&Arc<ComponentCell<C>>) -> ContractPort;

/// What waits in a queue of its own: the messages of a contract, or of one of its topics.
pub(crate) type QueuePort = (TypeId, String);

/// The values that one component is given.
pub(crate) type ParameterValues = SortedMap<String, ParameterValue>;

/// What is known of the parameters of a type of components.
#[derive(Clone, Copy)]
pub(crate) struct ParametersType {
    pub(crate) describe: fn() -> Vec<ParameterDescription>,
    /// Returns an error for each value that they do not take.
    pub(crate) refused: fn(&ParameterValues) -> Vec<ParameterError>,
}

/// The ports of one component: filled in `Component::ports`.
pub struct Ports<C: Component> {
    open: Vec<PortConstructor<C>>,
    /// All that can be connected.
    declared: Vec<DeclaredPort>,
    pub(crate) parameters: Option<ParametersType>,
    /// The contracts that have a queue of their own.
    queues: SortedMap<TypeId, (usize, WhenFull)>,
    /// The topics of latched contracts that it listens to.
    latched: Vec<QueuePort>,
    /// What features add, each once.
    features: Vec<Box<dyn Declarations<C>>>,
    /// How long handlers may await something, unless the child spec says so.
    pub(crate) max_wait: Option<Duration>,
}

impl<C: Component> Ports<C> {
    /// What the component declares.
    pub(crate) fn of() -> Self {
        let (open, declared, parameters, queues, latched, features) = Default::default();
        let mut ports =
            Ports { open, declared, parameters, queues, latched, features, max_wait: None };
        C::ports(&mut ports);
        ports
    }

    /// Adds a port that can be connected.
    pub(crate) fn declare<M: Contract>(
        &mut self,
        name: Cow<'static, str>,
        role: ConnectionRole,
    ) -> &mut Self {
        self.declared.push(DeclaredPort { name, role, identity: ContractIdentity::of::<M>() });
        self
    }

    /// Sets the name of the port that was declared last, in
    /// [addresses of ports](crate::manual::components#ports); it is else that of the contract.
    ///
    /// ```
    /// # use blastema::prelude::*;
    /// # #[derive(Debug, Request)] #[contract(reply = f32)] struct Nearest;
    /// # struct Map;
    /// # impl Handle<Nearest> for Map {
    /// #     async fn handle(&mut self, _: Nearest, _: &mut Context<Self>) -> f32 { 0.8 }
    /// # }
    /// impl Component for Map {
    ///     fn ports(ports: &mut Ports<Self>) {
    ///         ports.serve::<Nearest>().named("nearest");
    ///     }
    /// }
    /// # fn main() {}
    /// ```
    pub fn named(&mut self, name: &str) -> &mut Self {
        if let Some(port) = self.declared.last_mut() {
            port.name = Cow::Owned(name.to_owned());
        }
        self
    }

    /// Serves this request to every object that uses the component's name, on this and on other
    /// nodes.
    pub fn serve<M: Request>(&mut self) -> &mut Self
    where
        C: Handle<M>,
    {
        self.open.push(ContractPort::open::<C, M>);
        self.declare::<M>(M::NAME.into(), ConnectionRole::Serves)
    }

    /// Accepts this event, or command, from every object that uses the component's name.
    pub fn accept<M: Event>(&mut self) -> &mut Self
    where
        C: Handle<M>,
    {
        self.open.push(ContractPort::open::<C, M>);
        self.declare::<M>(M::NAME.into(), ConnectionRole::Serves)
    }

    /// Gives messages of this contract a queue of their own, whether they are served, accepted or
    /// listened to: they take no places in the component's [queue](crate::ChildSpec::queue), and
    /// nothing else takes theirs. Whatever its contract, what came first is served first. Each topic
    /// of a `latched` contract that the component listens to has a queue of its own in any case, as
    /// long as its contract's, or else the component's, which drops the oldest event.
    pub fn queue<M: Contract>(&mut self, capacity: usize, when_full: WhenFull) -> &mut Self
    where
        C: Handle<M>,
    {
        self.queues.insert(TypeId::of::<M>(), (capacity, when_full));
        self
    }

    /// Gives the events of this topic a queue of their own where their contract is `latched`.
    pub(crate) fn keep_latched<E: Event>(&mut self, topic: &str) {
        if E::LATCHED {
            self.latched.push((TypeId::of::<E>(), topic.to_owned()));
        }
    }

    /// The queues of single contracts and topics, of a component whose own has this capacity.
    pub(crate) fn queues(&self, capacity: usize) -> SortedMap<QueuePort, (usize, WhenFull)> {
        let contracts = self.queues.iter().map(|(of, bound)| ((*of, String::new()), *bound));
        let of_latched = |of| match self.queues.get(of) {
            Some((capacity, _)) => (*capacity, WhenFull::DropOldest),
            None => (capacity, WhenFull::DropOldest),
        };
        let topics = self.latched.iter().map(|port| (port.clone(), of_latched(&port.0)));
        // Topics that a port is connected to while all runs.
        let connected = self.latched.iter().filter(|(of, _)| !self.queues.contains_key(of));
        let connected = connected.map(|(of, _)| ((*of, String::new()), of_latched(of)));
        contracts.chain(topics).chain(connected).collect()
    }

    /// More contracts that it takes.
    pub(crate) fn add_ports(&mut self, beside: Vec<PortConstructor<C>>) {
        self.open.extend(beside);
    }

    /// The skeletons by which other objects reach the component, by contract.
    pub(crate) fn skeletons(
        &self,
        cell: &Arc<ComponentCell<C>>,
    ) -> SortedMap<&'static str, ContractPort> {
        self.open.iter().map(|open| open(cell)).map(|port| (port.identity.name, port)).collect()
    }

    /// What was declared, for display.
    pub(crate) fn describe(&self) -> TypeDescription {
        let described = self.declared.iter().map(DeclaredPort::describe);
        let (gives, takes): (Vec<PortDescription>, Vec<_>) =
            described.partition(|port| port.role.is_out());
        TypeDescription {
            parameters: self.parameters.map(|of| (of.describe)()).unwrap_or_default(),
            takes,
            gives: (!gives.is_empty()).then_some(gives),
        }
    }

    /// What the component declares of one feature.
    pub(crate) fn feature<T: Declarations<C> + Default>(&mut self) -> &mut T {
        let is_wanted = |known: &dyn Declarations<C>| (known as &dyn Any).is::<T>();
        let known = self.features.iter().position(|known| is_wanted(&**known));
        let at = known.unwrap_or_else(|| {
            self.features.push(Box::new(T::default()));
            self.features.len() - 1
        });
        let feature: &mut dyn Any = &mut *self.features[at];
        feature.downcast_mut().expect("it was found, or pushed, by its type")
    }

    /// Finds what contradicts itself.
    pub(crate) fn check(&self, component: &ObjectName) -> Result<(), SpecError> {
        let (mut served, mut names) = (BTreeSet::new(), BTreeSet::new());
        for DeclaredPort { name: port, role, identity } in &self.declared {
            let (component, contract) = (component.clone(), identity.name);
            if *role == ConnectionRole::Serves && !served.insert(contract) {
                let (name, ports) = (component, "both by serve or accept");
                return Err(SpecError::PortTwice { name, contract, ports });
            }
            let refused = |why| SpecError::Port { name: component, port: port.to_string(), why };
            if let Err(error) = ObjectName::new(port) {
                return Err(refused(error.to_string()));
            }
            // Several topics of one contract may be listened to.
            let is_known = !names.insert((role.is_out(), port)) && *port != contract;
            if is_known {
                return Err(refused("another port has this name: give each its own".to_owned()));
            }
        }
        self.features.iter().try_for_each(|feature| feature.check(component, &served))
    }

    /// Returns all settings of a description that features refuse.
    pub(crate) fn refused(&self, name: &ObjectName, limits: &ComponentLimits) -> Vec<SpecError> {
        self.features.iter().flat_map(|feature| feature.refused(name, limits)).collect()
    }

    /// Makes what features add. The component is registered already.
    pub(crate) fn bind(self, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let name = cell.record.name.clone();
        let declared = cell.record.environment.registry.declare_ports(&name, self.declared);
        let refused = |(port, error): (String, NameError)| SpecError::Port {
            name,
            port,
            why: error.to_string(),
        };
        declared.map_err(refused)?;
        self.features.into_iter().try_for_each(|feature| feature.bind(cell))
    }
}

/// Describes a type of components: its parameters and its ports. Nothing is started, and no
/// instance is made.
///
/// # Errors
/// Its [`Component::ports`] panics: where, and the panic's text.
///
/// # Examples
/// ```
/// use blastema::prelude::*;
///
/// #[derive(Clone, Debug, Event)]
/// struct Scan {
///     #[contract(unit = "m")]
///     nearest: f32,
/// }
///
/// struct Laser;
///
/// impl Component for Laser {
///     fn ports(ports: &mut Ports<Self>) {
///         ports.publishes::<Scan>("scan");
///     }
/// }
///
/// let laser = blastema::describe::<Laser>()?;
/// let gives = laser.gives.expect("it declares what it gives");
/// assert_eq!((gives[0].name.as_str(), gives[0].fields[0].unit.as_deref()), ("scan", Some("m")));
/// # Ok::<(), String>(())
/// ```
pub fn describe<C: Component>() -> Result<TypeDescription, String> {
    panics::caught(Ports::<C>::of).map(|ports| ports.describe())
}
