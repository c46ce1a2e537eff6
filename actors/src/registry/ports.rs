//! The ports of this node's components, and what they are connected to.
//!
//! A connection stands at the end that makes it, so that it outlives the incarnations of both ends
//! and goes with its component. At a listener it is a subscription; at an out port it is where the
//! port's sender leads.

use super::Registry;
use super::lookup::CurrentReceiver;
use blastema_core::port::{
    ConnectError, ConnectionRole, PortAddress, PortConnection, PortDescription, check_connection,
};
use blastema_core::{ContractIdentity, DeliveryError, NameError, ObjectName, suggestion};
use std::borrow::Cow;
use tokio::sync::watch;

/// The most connections of one component: each is looked through where a message is sent.
const CONNECTIONS_MAX: usize = 256;

/// A port as its component declares it.
#[derive(Clone, Debug)]
pub(crate) struct DeclaredPort {
    pub(crate) name: Cow<'static, str>,
    pub(crate) role: ConnectionRole,
    pub(crate) identity: ContractIdentity,
}

impl DeclaredPort {
    /// The port as plain data.
    pub(crate) fn describe(&self) -> PortDescription {
        PortDescription::new(&self.name, self.role, &self.identity)
    }
}

/// The ports of one component.
#[derive(Default)]
pub(super) struct Wiring {
    declared: Box<[DeclaredPort]>,
    /// By the places of its own ports: the other ends of the connections that it makes.
    connections: Vec<(usize, PortAddress)>,
}

impl Wiring {
    fn place(&self, address: &PortAddress, is_out: bool) -> Result<usize, ConnectError> {
        let mut ports = self.declared.iter();
        let is_meant = |port: &DeclaredPort| port.role.is_out() == is_out;
        let found = ports.position(|port| is_meant(port) && port.name == address.port.as_str());
        let ports = self.declared.iter().filter(|port| is_meant(port));
        let declared = || ports.map(|port| port.name.to_string()).collect();
        found.ok_or_else(|| ConnectError::no_port(address, is_out, declared()))
    }
}

/// One connection at the end that makes it.
struct MadeConnection {
    object: ObjectName,
    place: usize,
    other: PortAddress,
    /// At a listener: which of its subscriptions it is like, and the topic.
    listens: Option<(usize, ObjectName)>,
}

impl super::Inner {
    fn wiring(&self, component: &ObjectName) -> Result<&Wiring, ConnectError> {
        let known = self.objects.get(component).map(|entry| &entry.wiring);
        known.ok_or_else(|| {
            let names = self.objects.keys().map(ObjectName::as_str);
            let nearest = suggestion::nearest(component.as_str(), names).map(str::to_owned);
            ConnectError::NoComponent { name: component.clone(), nearest }
        })
    }

    /// The port at one end of a connection; `None` on another node.
    fn end(
        &self,
        address: &PortAddress,
        is_out: bool,
    ) -> Result<Option<(usize, &DeclaredPort)>, ConnectError> {
        if address.node.is_some() {
            return Ok(None);
        }
        let wiring = self.wiring(&address.object)?;
        let place = wiring.place(address, is_out)?;
        Ok(Some((place, &wiring.declared[place])))
    }

    /// Which end makes this connection, after it was compared with the other where both are here.
    fn made(&self, connection: &PortConnection) -> Result<MadeConnection, ConnectError> {
        let PortConnection { from, to } = connection;
        let elsewhere = |what, address: &PortAddress| ConnectError::Elsewhere {
            what,
            node: address.node.clone().expect("an end that is not here names its node"),
        };
        let (here, place, other) = match (self.end(from, true)?, self.end(to, false)?) {
            (Some((sends, given)), Some((takes, taken))) => {
                check_connection(&given.describe(), &taken.describe())?;
                if given.role.connects() { (from, sends, to) } else { (to, takes, from) }
            }
            (Some((sends, given)), None) if given.role.connects() => (from, sends, to),
            (None, Some((takes, taken))) if taken.role.connects() => (to, takes, from),
            (Some(_), None) => {
                return Err(elsewhere("the listener's node makes the connection", to));
            }
            (None, Some(_)) => {
                return Err(elsewhere("the node that sends makes the connection", from));
            }
            (None, None) => return Err(elsewhere("neither port is on this node", to)),
        };
        self.made_at(here, place, other)
    }

    fn made_at(
        &self,
        here: &PortAddress,
        place: usize,
        other: &PortAddress,
    ) -> Result<MadeConnection, ConnectError> {
        let declared = &self.wiring(&here.object)?.declared;
        let is_listener = |port: &&DeclaredPort| port.role == ConnectionRole::Listens;
        let listens = match declared[place].role {
            ConnectionRole::Listens => {
                let before = declared[..place].iter().filter(is_listener).count();
                Some((before, other.topic(self.node.as_ref())?))
            }
            _ => None,
        };
        Ok(MadeConnection { object: here.object.clone(), place, other: other.clone(), listens })
    }

    /// Forgets a connection, whether or not the other end is still there.
    fn forget(&mut self, connection: &PortConnection) -> Result<MadeConnection, ConnectError> {
        let PortConnection { from, to } = connection;
        for (own, is_out, other) in [(from, true, to), (to, false, from)] {
            let Ok(Some((place, _))) = self.end(own, is_out) else { continue };
            let Some(entry) = self.objects.get_mut(&own.object) else { continue };
            let connections = &mut entry.wiring.connections;
            let is_this = |known: &(usize, PortAddress)| known.0 == place && known.1 == *other;
            if let Some(found) = connections.iter().position(is_this) {
                connections.remove(found);
                return self.made_at(own, place, other);
            }
        }
        self.made(connection)?;
        Err(ConnectError::NotConnected)
    }

    /// Notes a connection, unless there is one already that stands in its way.
    fn add(&mut self, made: &MadeConnection) -> Result<(), ConnectError> {
        let entry = self.objects.get_mut(&made.object).expect("its port was found");
        let connections = &mut entry.wiring.connections;
        let present = (made.place, made.other.clone());
        if connections.contains(&present) {
            return Err(ConnectError::Twice);
        }
        let first = connections.iter().find(|(place, _)| *place == made.place);
        if let (None, Some((_, to))) = (&made.listens, first) {
            return Err(ConnectError::Taken { to: to.clone() });
        }
        if connections.len() == CONNECTIONS_MAX {
            let (component, limit) = (made.object.clone(), CONNECTIONS_MAX);
            return Err(ConnectError::TooMany { component, limit });
        }
        connections.push(present);
        Ok(())
    }
}

impl Registry {
    /// The ports of a component that has been registered.
    ///
    /// # Errors
    /// The topic of an out port, with its node's name and its component's, is too long.
    pub(crate) fn declare_ports(
        &self,
        component: &ObjectName,
        ports: Vec<DeclaredPort>,
    ) -> Result<(), (String, NameError)> {
        let mut inner = self.lock();
        for port in ports.iter().filter(|port| port.role == ConnectionRole::Publishes) {
            let of_port = |error| (port.name.to_string(), error);
            let name = ObjectName::new(&port.name).map_err(of_port)?;
            let address = PortAddress { node: None, object: component.clone(), port: name };
            address.topic(inner.node.as_ref()).map_err(of_port)?;
        }
        if let Some(entry) = inner.objects.get_mut(component) {
            entry.wiring.declared = ports.into();
        }
        Ok(())
    }

    /// Checks that the component has this out port.
    pub(crate) fn check_port(
        &self,
        address: &PortAddress,
        wanted: ConnectionRole,
        with: &ContractIdentity,
    ) -> Result<(), ConnectError> {
        let inner = self.lock();
        let wiring = inner.wiring(&address.object)?;
        let DeclaredPort { role, identity, .. } = &wiring.declared[wiring.place(address, true)?];
        if *role != wanted || identity.name != with.name {
            return Err(ConnectError::Handle {
                port: address.clone(),
                declared: *role,
                contract: identity.name.to_owned(),
                wanted,
                with: with.name.to_owned(),
            });
        }
        identity.check(&with.full()).map_err(ConnectError::Differ)
    }

    /// The topic of a component's out port.
    pub(crate) fn port_topic(&self, address: &PortAddress) -> Result<ObjectName, DeliveryError> {
        let topic = address.topic(self.lock().node.as_ref());
        topic.map_err(|error| DeliveryError::InvalidName { reason: error.to_string() })
    }

    fn parsed(&self, from: &str, to: &str) -> Result<PortConnection, ConnectError> {
        let node = self.node();
        let address =
            |text: &str| text.parse().map(|known: PortAddress| known.seen_from(node.as_ref()));
        Ok(PortConnection { from: address(from)?, to: address(to)? })
    }

    /// Connects two ports.
    pub(crate) fn connect_ports(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        let connection = self.parsed(from, to)?;
        let mut inner = self.lock();
        let made = inner.made(&connection)?;
        inner.add(&made)?;
        let Some((like, topic)) = &made.listens else {
            inner.reconnected.send_modify(|times| *times += 1);
            return Ok(());
        };
        let listener = inner.objects.get(&made.object).map(|entry| entry.watchable.clone());
        drop(inner);
        // It may have been removed meanwhile.
        let listening = listener.map_or(Ok(()), |listener| listener.listen(*like, topic));
        listening.map_err(|why| {
            let _ = self.lock().forget(&connection);
            ConnectError::Refused(why)
        })
    }

    /// Disconnects two ports.
    pub(crate) fn disconnect_ports(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        let connection = self.parsed(from, to)?;
        let mut inner = self.lock();
        let made = inner.forget(&connection)?;
        inner.reconnected.send_modify(|times| *times += 1);
        let listener = inner.objects.get(&made.object).map(|entry| entry.watchable.clone());
        drop(inner);
        if let (Some((_, topic)), Some(listener)) = (&made.listens, listener) {
            listener.stop_listening(topic);
        }
        Ok(())
    }

    /// The connections that this node makes, in the order of their components.
    pub(crate) fn connections(&self) -> Vec<PortConnection> {
        let inner = self.lock();
        let mut connections = Vec::new();
        for (object, entry) in &inner.objects {
            for (place, other) in &entry.wiring.connections {
                let DeclaredPort { name, role, .. } = &entry.wiring.declared[*place];
                let port = ObjectName::new(name).expect("it was parsed when it was connected");
                let own = PortAddress { node: None, object: object.clone(), port };
                let other = other.clone();
                connections.push(match role.is_out() {
                    true => PortConnection { from: own, to: other },
                    false => PortConnection { from: other, to: own },
                });
            }
        }
        connections
    }
}

/// An out port of a component of this node, as a way to what it is connected to.
pub(crate) struct OutEnd {
    pub(crate) registry: Registry,
    pub(crate) port: PortAddress,
}

impl CurrentReceiver for OutEnd {
    fn current(&self) -> Result<(String, u64), DeliveryError> {
        let unconnected = || DeliveryError::Unconnected { port: self.port.to_string() };
        let inner = self.registry.lock();
        let wiring = inner.wiring(&self.port.object).map_err(|_| unconnected())?;
        let place = wiring.place(&self.port, true).map_err(|_| unconnected())?;
        let connected = wiring.connections.iter().find(|(own, _)| *own == place);
        let (_, to) = connected.ok_or_else(unconnected)?;
        // A component that was removed and added again has another queue.
        Ok((to.component(), inner.revision))
    }

    fn changes(&self) -> watch::Receiver<u64> {
        self.registry.lock().reconnected.subscribe()
    }
}
