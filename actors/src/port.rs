//! The out ports of a component: where it publishes, commands and asks without knowing whom.

use crate::actuator::{Commander, commander};
use crate::component::Component;
use crate::component::context::Context;
use crate::component::ports::Ports;
use crate::messaging::sender::Sender;
use crate::registry::lookup::CurrentSender;
use crate::registry::ports::PortReceiver;
use crate::topic::Publisher;
use blastema_core::port::{ConnectError, ConnectionRole, PortAddress};
use blastema_core::{Contract, ContractIdentity, DeliveryError, Event, ObjectName};
use std::any::TypeId;
use std::rc::Rc;

/// What a component uses an out port by: a [`Publisher`], a [`Commander`] or a [`Sender`].
pub trait OutPort: Clone + 'static {
    /// What the ports of such handles do.
    #[doc(hidden)]
    const ROLE: ConnectionRole;
    /// What passes through.
    #[doc(hidden)]
    type Message: Contract;

    /// The handle of a port that was checked.
    #[doc(hidden)]
    fn open<C: Component>(cx: &mut Context<C>, port: PortAddress) -> Result<Self, DeliveryError>;
}

fn sender<C: Component, M: Contract>(cx: &Context<C>, port: PortAddress) -> Sender<M> {
    let registry = cx.cell.record.environment.registry.clone();
    CurrentSender::to(PortReceiver { registry: registry.clone(), port }, registry)
}

impl<E: Event> OutPort for Publisher<E> {
    const ROLE: ConnectionRole = ConnectionRole::Publishes;
    type Message = E;

    fn open<C: Component>(cx: &mut Context<C>, port: PortAddress) -> Result<Self, DeliveryError> {
        let topic = cx.cell.record.environment.registry.port_topic(&port)?;
        cx.publisher(topic.as_str())
    }
}

impl<M: Contract> OutPort for Commander<M> {
    const ROLE: ConnectionRole = ConnectionRole::Commands;
    type Message = M;

    fn open<C: Component>(cx: &mut Context<C>, port: PortAddress) -> Result<Self, DeliveryError> {
        let (actuator, way) = (port.to_string(), sender(cx, port));
        let own = cx.cell.record.environment.registry.full_name(cx.name());
        let (commander, renewing) = commander(actuator, way, (own, cx.incarnation()));
        cx.spawn(renewing);
        Ok(commander)
    }
}

impl<M: Contract> OutPort for Sender<M> {
    const ROLE: ConnectionRole = ConnectionRole::Asks;
    type Message = M;

    fn open<C: Component>(cx: &mut Context<C>, port: PortAddress) -> Result<Self, DeliveryError> {
        Ok(sender(cx, port))
    }
}

impl<C: Component> Ports<C> {
    /// Publishes events at this port, which any number of listeners are connected to. While none
    /// is, the events reach no listener. They are those of the topic `NODE/COMPONENT/PORT`,
    /// so the name has no `/`.
    pub fn publishes<E: Event>(&mut self, name: &str) -> &mut Self {
        self.declare::<E>(name.to_owned().into(), Publisher::<E>::ROLE)
    }

    /// Commands the one actuator that this port is connected to. While it is connected to none, a
    /// claim fails with [`DeliveryError::Unconnected`].
    pub fn commands<M: Contract>(&mut self, name: &str) -> &mut Self {
        self.declare::<M>(name.to_owned().into(), Commander::<M>::ROLE)
    }

    /// Sends requests, or other messages, to the one object that this port is connected to. While
    /// it is connected to none, sending fails with [`DeliveryError::Unconnected`].
    pub fn asks<M: Contract>(&mut self, name: &str) -> &mut Self {
        self.declare::<M>(name.to_owned().into(), Sender::<M>::ROLE)
    }
}

impl<C: Component> Context<C> {
    /// Returns what the component uses its out port `name` by: a [`Publisher`], a [`Commander`] or
    /// a [`Sender`], as the port is declared by [`publishes`](Ports::publishes),
    /// [`commands`](Ports::commands) or [`asks`](Ports::asks). It leads to what the port is
    /// connected to at the time of sending, and is the same for the whole incarnation.
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
}
