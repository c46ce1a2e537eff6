//! The out ports of a component: where it publishes, commands and asks without knowing whom.

use crate::actuator::{Commander, commander};
use crate::component::Component;
use crate::component::context::Context;
use crate::component::ports::Ports;
use crate::messaging::sender::Sender;
use crate::registry::lookup::CurrentSender;
use crate::registry::ports::PortReceiver;
use crate::topic::Publisher;
use blastema_core::port::{ConnectionRole, PortAddress};
use blastema_core::{Contract, DeliveryError, Event};

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
        let (commander, renewing) = commander(actuator, way, own, cx.incarnation());
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
