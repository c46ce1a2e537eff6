//! What a component takes, declared once for all its incarnations.

use crate::component::cell::ComponentCell;
use crate::component::declaration::Declarations;
use crate::component::spec_error::SpecError;
use crate::component::{Component, Handle};
use crate::messaging::queue::WhenFull;
use crate::registry::ContractPort;
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{Contract, Event, ObjectName, Request};
use std::any::{Any, TypeId};
use std::sync::Arc;
use std::time::Duration;

/// Makes the skeleton for one contract.
pub(crate) type PortConstructor<C> = fn(&Arc<ComponentCell<C>>) -> ContractPort;

/// What waits in a queue of its own: the messages of a contract, or of one of its topics.
pub(crate) type QueuePort = (TypeId, String);

/// The ports of one component: filled in `Component::ports`.
pub struct Ports<C: Component> {
    open: Vec<PortConstructor<C>>,
    /// The contracts that they are for.
    taken: Vec<&'static str>,
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
        let (open, taken, queues, latched, features) = Default::default();
        let mut ports = Ports { open, taken, queues, latched, features, max_wait: None };
        C::ports(&mut ports);
        ports
    }

    /// Serves this request to every object that uses the component's name, on this and on other
    /// nodes.
    pub fn serve<M: Request>(&mut self) -> &mut Self
    where
        C: Handle<M>,
    {
        self.open.push(ContractPort::open::<C, M>);
        self.taken.push(M::NAME);
        self
    }

    /// Accepts this event, or command, from every object that uses the component's name.
    pub fn accept<M: Event>(&mut self) -> &mut Self
    where
        C: Handle<M>,
    {
        self.open.push(ContractPort::open::<C, M>);
        self.taken.push(M::NAME);
        self
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
        let topics = self.latched.iter().map(|port| {
            let capacity = self.queues.get(&port.0).map_or(capacity, |(capacity, _)| *capacity);
            (port.clone(), (capacity, WhenFull::DropOldest))
        });
        contracts.chain(topics).collect()
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
        let mut served = SortedSet::new();
        if let Some(&contract) = self.taken.iter().find(|name| !served.insert(**name)) {
            let (name, ports) = (component.clone(), "both by serve or accept");
            return Err(SpecError::PortTwice { name, contract, ports });
        }
        self.features.iter().try_for_each(|feature| feature.check(component, &served))
    }

    /// Makes what features add. The component is registered already.
    pub(crate) fn bind(self, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        self.features.into_iter().try_for_each(|feature| feature.bind(cell))
    }
}
