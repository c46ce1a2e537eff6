//! What a component asks of the features of its node, in one place: each is a method of its
//! context, which lies below them.

use crate::actuator::{self, Commander};
use crate::component::Component;
use crate::component::context::Context;
use crate::condition::{Condition, ConditionError, Conditions, Connected, Heartbeat, heartbeat};
use crate::platform;
use crate::port::OutPort;
use crate::service::{Roster, ServiceRef};
use crate::topic::{Publisher, Topics};
use crate::variable::{self, VariableRef};
use blastema_core::parameters::Parameters;
use blastema_core::port::{ConnectError, PortAddress};
use blastema_core::{
    Contract, ContractIdentity, DeliveryError, Event, FaultKind, Instant, NameError, ObjectName,
    Request, Variable,
};
use std::any::TypeId;
use std::rc::Rc;
use std::time::Duration;

impl<C: Component> Context<C> {
    /// Publishes an event on the topic that has its contract's name. Never waits. While the
    /// component is fenced off or isolated, events are not published but counted among the dead
    /// letters under the topic's name.
    #[track_caller]
    pub fn publish<E: Event>(&self, event: E) {
        self.publish_stamped(event, None);
    }

    /// Publishes an event whose data was captured at `captured_at`, such as the exposure of an
    /// image: `max_age` counts from there, and listeners read it by
    /// [`captured_at`](Self::captured_at). A time that is still to come counts as now.
    #[track_caller]
    pub fn publish_captured_at<E: Event>(&self, event: E, captured_at: Instant) {
        self.publish_stamped(event, Some(captured_at));
    }

    #[track_caller]
    fn publish_stamped<E: Event>(&self, event: E, captured_at: Option<Instant>) {
        let mut handles = self.handles.borrow_mut();
        let of_topic = TypeId::of::<Publisher<E>>();
        let known = handles.iter().find(|(of, port, _)| *of == of_topic && port.is_none());
        if let Some(publisher) = known.and_then(|(.., any)| any.downcast_ref::<Publisher<E>>()) {
            publisher.publish_or_count(event, captured_at);
            return;
        }
        match self.publisher::<E>(E::NAME) {
            Ok(publisher) => {
                publisher.publish_or_count(event, captured_at);
                handles.push((of_topic, None, Rc::new(publisher)));
            }
            Err(why) => self.declare_fault(FaultKind::ContractMismatch, why.to_string()),
        }
    }

    /// Returns a publisher on the topic of this name. It belongs to this incarnation: after the
    /// incarnation has ended, publishing fails on every thread with [`DeliveryError::Fenced`].
    ///
    /// # Errors
    /// [`DeliveryError::ContractDiffers`] if the topic carries another type under this contract's
    /// name; the text names both, where each was said, and what differs.
    #[track_caller]
    pub fn publisher<E: Event>(&self, topic: &str) -> Result<Publisher<E>, DeliveryError> {
        let topics = self.cell.record.environment.feature::<Topics>();
        let publisher = topics.publisher_of(topic, self.name().as_str())?;
        Ok(publisher.of(self.state.token.clone()))
    }

    /// The variable `V` of the object of this name, the component's own or another's, here or on
    /// another node.
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no object here has the name,
    /// [`DeliveryError::NoVariable`] where it owns no variables.
    pub fn variable<V: Variable>(&self, object: &str) -> Result<VariableRef<V>, DeliveryError> {
        variable::find(&self.cell.record.environment.registry, object)
    }

    /// Commands the actuator of this name, here or on another node. The lease is renewed by a task
    /// of this incarnation: it ends with the incarnation, and when the component hangs.
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no object here has the name,
    /// [`DeliveryError::NotServed`] where it is no actuator.
    pub fn commander<M: Contract>(
        &mut self,
        actuator: &str,
    ) -> Result<Commander<M>, DeliveryError> {
        let environment = &self.cell.record.environment;
        let own = environment.registry.full_name(self.name());
        let sender = environment.registry.sender(actuator)?;
        let incarnation = self.incarnation();
        let (commander, renewing) =
            actuator::commander(actuator.to_owned(), sender, own, incarnation);
        self.spawn(renewing);
        Ok(commander)
    }

    /// Returns what the component uses its out port `name` by: a [`Publisher`], a [`Commander`] or
    /// a [`Sender`](crate::Sender), as the port is declared by
    /// [`publishes`](crate::Ports::publishes), [`commands`](crate::Ports::commands) or
    /// [`asks`](crate::Ports::asks). It leads to what the port is connected to at the time of
    /// sending, and is the same for the whole incarnation.
    ///
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
    ///
    ///     async fn on_execute(&mut self, cx: &mut Context<Self>) -> Result<(), Failure> {
    ///         cx.port::<Publisher<Scan>>("scan")?.publish(Scan { nearest: 0.8 })?;
    ///         Ok(())
    ///     }
    /// }
    /// # fn main() {}
    /// ```
    ///
    /// # Errors
    /// [`ConnectError::NoPort`] if the component declares no such port, with those that it
    /// declares; [`ConnectError::Handle`] or [`ConnectError::Differ`] if it is of another kind or
    /// contract.
    #[track_caller]
    pub fn port<P: OutPort>(&mut self, name: &str) -> Result<P, ConnectError> {
        let of = TypeId::of::<P>();
        let is_meant = |port: &Option<Box<str>>| port.as_deref() == Some(name);
        let handles = self.handles.borrow();
        let known = handles.iter().find(|(kind, port, _)| *kind == of && is_meant(port));
        if let Some(handle) = known.and_then(|(.., handle)| handle.downcast_ref::<P>()) {
            return Ok(handle.clone());
        }
        drop(handles);
        let (object, port) = (self.name().clone(), ObjectName::new(name)?);
        let port = PortAddress { node: None, object, port };
        let registry = &self.cell.record.environment.registry;
        registry.check_port(&port, P::ROLE, &ContractIdentity::of::<P::Message>())?;
        let handle = P::open(self, port).map_err(ConnectError::Refused)?;
        self.handles.borrow_mut().push((of, Some(name.into()), Rc::new(handle.clone())));
        Ok(handle)
    }

    /// The component's own parameters as they are now.
    ///
    /// # Errors
    /// [`DeliveryError::NoVariable`] where its `ports` declare no such parameters.
    pub fn parameters<P: Parameters>(&self) -> Result<P, DeliveryError> {
        self.cell.parameters()
    }

    /// Returns the condition of this name, which needs this; declares it if it is new. It belongs
    /// to the node, and outlives this incarnation.
    ///
    /// # Errors
    /// [`ConditionError`] says what to write instead.
    pub fn condition(&self, name: &str, needs: Connected) -> Result<Condition, ConditionError> {
        self.cell.record.environment.feature::<Conditions>().declare(
            name,
            &needs,
            platform::now(),
            None,
        )
    }

    /// Publishes a [`Heartbeat`] on this topic every `interval`, 10 ms to an hour, for as long as
    /// this incarnation lasts and its thread turns.
    ///
    /// # Errors
    /// As [`publisher`](Self::publisher), and [`DeliveryError::CheckFailed`] for an interval out of
    /// range.
    #[track_caller]
    pub fn heartbeat(&mut self, topic: &str, interval: Duration) -> Result<(), DeliveryError> {
        let publisher = self.publisher::<Heartbeat>(topic)?;
        self.spawn(heartbeat::publish(publisher, interval)?);
        Ok(())
    }

    /// Returns a reference to the service of this name, whichever node is primary.
    ///
    /// # Errors
    /// The name does not parse. Whether there is such a service shows when a request is sent.
    pub fn service<M: Request>(&self, name: &str) -> Result<ServiceRef<M>, NameError> {
        let environment = &self.cell.record.environment;
        ServiceRef::new(&environment.registry, environment.feature::<Roster>(), name)
    }
}
