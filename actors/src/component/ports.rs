//! What a component takes, declared once for all its lives.

use crate::actuator;
use crate::actuator::ActuatorSpec;
use crate::component::cell::ComponentCell;
use crate::component::spec_error::SpecError;
use crate::component::subscription::{Subscription, Subscriptions};
use crate::component::{Component, Handle};
use crate::parameters::{self, DeclareParameters};
use crate::registry::{ContractPort, Skeleton};
use crate::topic::{EventFilter, TopicSubscription, Topics};
use crate::variable::{DeclaredVariable, VariableSpec};
use blastema_core::parameters::{ParameterError, Parameters};
use blastema_core::{Contract, DeliveryError, Event, ObjectName, Request, Variable};
use std::collections::{BTreeMap, BTreeSet};
use std::panic::Location;
use std::sync::Arc;

/// Makes the door for one contract.
pub(crate) type PortConstructor<C> = fn(&Arc<ComponentCell<C>>) -> ContractPort;
type Bind<C> = Box<dyn FnOnce(&Topics) -> Result<Arc<dyn Subscription<C>>, DeliveryError>>;

/// The ports of one component: filled in `Component::ports`.
pub struct Ports<C: Component> {
    open: Vec<PortConstructor<C>>,
    /// The contracts that they are for.
    taken: Vec<&'static str>,
    listen: Vec<Bind<C>>,
    variables: Vec<DeclaredVariable>,
    parameters: Vec<(&'static str, DeclareParameters<C>)>,
    actuators: Vec<(actuator::DeclaredActuator, PortConstructor<C>)>,
}

impl<C: Component> Ports<C> {
    /// What the component declares.
    pub(crate) fn of() -> Self {
        let mut ports = Ports {
            open: Vec::new(),
            taken: Vec::new(),
            listen: Vec::new(),
            variables: Vec::new(),
            parameters: Vec::new(),
            actuators: Vec::new(),
        };
        C::ports(&mut ports);
        ports
    }

    /// Answers this request to anyone who knows the component's name, here and on other nodes.
    pub fn serve<M: Request>(&mut self) -> &mut Self
    where
        C: Handle<M>,
    {
        self.open.push(ContractPort::open::<C, M>);
        self.taken.push(M::NAME);
        self
    }

    /// Takes this event, or command, from anyone who knows the component's name.
    pub fn accept<M: Event>(&mut self) -> &mut Self
    where
        C: Handle<M>,
    {
        self.open.push(ContractPort::open::<C, M>);
        self.taken.push(M::NAME);
        self
    }

    /// Listens to the topic that has this event's contract name. The port that is returned takes a
    /// condition and another topic.
    #[track_caller]
    pub fn listen<E: Event>(&mut self) -> ListenPort<'_, C, E>
    where
        C: Handle<E>,
    {
        ListenPort { ports: self, topic: E::NAME.to_owned(), only_if: None, at: Location::caller() }
    }

    /// Owns a variable: a value that any node may read, write and watch at the component's name. It
    /// outlives the component's lives.
    pub fn variable<V: Variable>(&mut self, spec: VariableSpec<V>) -> &mut Self {
        self.variables.push(spec.declared());
        self
    }

    /// Has parameters, with the values that the
    /// [configuration](crate::NodeBuilder::parameters_from) gives them, or their defaults. The
    /// component reads them by [`Context::parameters`](crate::Context::parameters) in
    /// `on_initialize`, and is handed them anew by its handler whenever one is set. A component has
    /// one set of parameters.
    pub fn parameters<P: Parameters>(&mut self) -> &mut Self
    where
        C: Handle<P>,
    {
        self.parameters.push((P::NAME, parameters::declare::<C, P>));
        self
    }

    /// Takes commands from whoever holds the lease, and from nobody else; when its commander goes,
    /// the component gets the safe command.
    pub fn actuator<M: Contract>(&mut self, spec: ActuatorSpec<M>) -> &mut Self
    where
        C: Handle<M>,
    {
        self.actuators.push((spec.declared(), ContractPort::open::<C, M>));
        self
    }

    /// Finds contracts of which two ports are.
    pub(crate) fn check(&self, component: &ObjectName) -> Result<(), SpecError> {
        let twice = |contract, ports| {
            Err(SpecError::PortTwice { name: component.clone(), contract, ports })
        };
        let mut taken = BTreeSet::new();
        if let Some(contract) = self.taken.iter().find(|name| !taken.insert(**name)) {
            return twice(*contract, "both by serve or accept");
        }
        let mut commanded = BTreeSet::new();
        for (actuator, _) in &self.actuators {
            let contract = actuator.identity.name;
            if !actuator::SPANS.contains(&actuator.span) {
                let (value, cure) = (format!("{:?}", actuator.span), "write 20 ms to 60 s");
                return Err(SpecError::setting(component.as_str(), "a lease", value, cure));
            }
            // What anybody may send would move the actuator without a lease.
            if taken.contains(contract) {
                return twice(contract, "one for everybody and one for whoever holds the lease");
            }
            if !commanded.insert(contract) {
                return twice(contract, "both by actuator");
            }
        }
        if let [_, (contract, _), ..] = self.parameters[..] {
            return twice(contract, "a component has one set of parameters");
        }
        let mut variables: BTreeSet<_> = self.parameters.iter().map(|(name, _)| *name).collect();
        match self
            .variables
            .iter()
            .map(DeclaredVariable::name)
            .find(|name| !variables.insert(*name))
        {
            Some(contract) => twice(contract, "both by variable"),
            None => Ok(()),
        }
    }

    /// The actuators that were declared, and the ways to them.
    pub(crate) fn take_actuators(
        &mut self,
        anchor: &Arc<ComponentCell<C>>,
    ) -> Vec<(actuator::DeclaredActuator, Arc<dyn Skeleton>)> {
        let actuators = std::mem::take(&mut self.actuators).into_iter();
        actuators.map(|(declared, open)| (declared, open(anchor).into_doorway())).collect()
    }

    /// More contracts that it takes.
    pub(crate) fn add_ports(&mut self, beside: Vec<PortConstructor<C>>) {
        self.open.extend(beside);
    }

    /// The variables that were declared, its parameters among them.
    pub(crate) fn take_variables(
        &mut self,
        anchor: &Arc<ComponentCell<C>>,
    ) -> Result<Vec<DeclaredVariable>, ParameterError> {
        let configured = &anchor.record.environment.parameters;
        for (_, declare) in std::mem::take(&mut self.parameters) {
            self.variables.push(declare(anchor, configured)?);
        }
        Ok(std::mem::take(&mut self.variables))
    }

    /// The doors by which others find the component, by contract.
    pub(crate) fn doors(
        &self,
        anchor: &Arc<ComponentCell<C>>,
    ) -> BTreeMap<&'static str, ContractPort> {
        self.open.iter().map(|open| open(anchor)).map(|port| (port.identity.name, port)).collect()
    }

    /// The subscriptions, bound to their topics.
    pub(crate) fn subscriptions(self, topics: &Topics) -> Result<Subscriptions<C>, DeliveryError> {
        self.listen.into_iter().map(|bind| bind(topics)).collect()
    }
}

/// One subscription that is being declared.
pub struct ListenPort<'a, C: Handle<E>, E: Event> {
    ports: &'a mut Ports<C>,
    topic: String,
    only_if: Option<EventFilter<E>>,
    at: &'static Location<'static>,
}

impl<C: Handle<E>, E: Event> ListenPort<'_, C, E> {
    /// Only events for which the condition holds are delivered, or even queued. The condition is
    /// called on the component's arbiter for every event; if it panics, the component has panicked.
    pub fn only_if(mut self, condition: impl Fn(&E) -> bool + Send + Sync + 'static) -> Self {
        self.only_if = Some(Arc::new(condition));
        self
    }

    /// Listens to a topic with a name of its own.
    pub fn on(mut self, topic: &str) -> Self {
        topic.clone_into(&mut self.topic);
        self
    }
}

impl<C: Handle<E>, E: Event> Drop for ListenPort<'_, C, E> {
    fn drop(&mut self) {
        let (topic, only_if) = (std::mem::take(&mut self.topic), self.only_if.take());
        let at = self.at;
        self.ports.listen.push(Box::new(move |topics| {
            let topic = topics.topic::<E>(&topic, at)?;
            Ok(Arc::new(TopicSubscription::new(topic, only_if)))
        }));
    }
}
