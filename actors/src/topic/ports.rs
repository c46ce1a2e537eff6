//! How components listen.

use super::{EventFilter, TopicSubscription, Topics};
use crate::component::cell::ComponentCell;
use crate::component::declaration::Declarations;
use crate::component::ports::Ports;
use crate::component::spec_error::SpecError;
use crate::component::subscription::{Subscription, Subscriptions};
use crate::component::{Component, Handle};
use blastema_core::port::ConnectionRole;
use blastema_core::{DeliveryError, Event, ObjectName};
use std::borrow::Cow;
use std::collections::BTreeSet;
use std::panic::Location;
use std::sync::Arc;

type Bind<C> = Box<dyn FnOnce(&Topics) -> Result<Arc<dyn Subscription<C>>, DeliveryError>>;

/// The subscriptions that a component declares, each with its topic and contract.
type ListenPorts<C> = Vec<(String, &'static str, Bind<C>)>;

impl<C: Component> Declarations<C> for ListenPorts<C> {
    fn check(&self, name: &ObjectName, _: &BTreeSet<&'static str>) -> Result<(), SpecError> {
        let mut known = BTreeSet::new();
        // One topic carries one contract: that is found where they are bound.
        match self.iter().find(|(topic, contract, _)| !known.insert((topic, contract))) {
            Some((topic, ..)) => {
                Err(SpecError::ListenTwice { name: name.clone(), topic: topic.clone() })
            }
            None => Ok(()),
        }
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let topics = cell.record.environment.feature::<Topics>();
        let bound: Result<Subscriptions<C>, _> =
            self.into_iter().map(|(_, _, bind)| bind(topics)).collect();
        let refused = |why| SpecError::Topic { name: cell.record.name.clone(), why };
        cell.set_subscriptions(bound.map_err(refused)?);
        Ok(())
    }
}

impl<C: Component> Ports<C> {
    /// Listens to the topic that has this event's contract name. The port that is returned takes a
    /// condition and another topic. A component listens to a topic once.
    #[track_caller]
    pub fn listen<E: Event>(&mut self) -> ListenPort<'_, C, E>
    where
        C: Handle<E>,
    {
        let (topic, named) = (E::NAME.to_owned(), E::NAME.into());
        ListenPort { ports: self, topic, named, only_if: None, at: Location::caller() }
    }
}

/// A subscription while it is declared.
pub struct ListenPort<'a, C: Handle<E>, E: Event> {
    ports: &'a mut Ports<C>,
    topic: String,
    named: Cow<'static, str>,
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

    /// Sets the port's name in [addresses of ports](crate::manual::components#ports), which is else
    /// that of the contract. It takes the events of its topic, and those of each port that is
    /// connected to it.
    pub fn named(mut self, name: &str) -> Self {
        self.named = Cow::Owned(name.to_owned());
        self
    }
}

impl<C: Handle<E>, E: Event> Drop for ListenPort<'_, C, E> {
    fn drop(&mut self) {
        let (topic, only_if) = (std::mem::take(&mut self.topic), self.only_if.take());
        let at = self.at;
        let name = topic.clone();
        let bind = move |topics: &Topics| {
            let topic = topics.topic::<E>(&topic, at)?;
            Ok(Arc::new(TopicSubscription::new(topic, only_if, at)) as Arc<dyn Subscription<C>>)
        };
        self.ports.keep_latched::<E>(&name);
        self.ports.declare::<E>(std::mem::take(&mut self.named), ConnectionRole::Listens);
        let declared = self.ports.feature::<ListenPorts<C>>();
        declared.push((name, E::NAME, Box::new(bind)));
    }
}
