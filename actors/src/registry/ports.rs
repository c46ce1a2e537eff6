//! The ports of this node's components, and what they are connected to.
//!
//! A connection stands on the node of the end that makes it, so that it outlives the incarnations
//! of both ends. For a listener it is a subscription; for an out port that commands or asks it is
//! where the port's sender leads.

use super::lookup::CurrentReceiver;
use super::{Inner, Registry};
use blastema_core::port::{
    ConnectError, ConnectionEnd, ConnectionRole, PortAddress, PortConnection, PortDescription,
    resolve,
};
use blastema_core::sorted::SortedMap;
use blastema_core::{ContractIdentity, DeliveryError, NameError, ObjectName};
use std::borrow::Cow;
use std::collections::BTreeSet;
use tokio::sync::watch;
use tracing::warn;

/// The most connections that one node makes: some for each of several thousand components.
const CONNECTION_LIMIT: usize = 16_384;

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

/// The connections that this node makes.
#[derive(Default)]
pub(super) struct Connections {
    /// Those of listeners.
    listening: BTreeSet<PortConnection>,
    /// Where out ports that command or ask lead.
    leading: SortedMap<PortAddress, PortAddress>,
    /// Components that come and go, and the connections to be made when they come.
    kept: SortedMap<ObjectName, BTreeSet<PortConnection>>,
    /// Rises whenever a port is connected or disconnected.
    changes: watch::Sender<u64>,
}

impl Connections {
    /// Forgets the connections that this component made, unless it comes again.
    pub(super) fn remove(&mut self, component: &ObjectName) {
        if let Some(kept) = self.kept.get_mut(component) {
            let listening = self.listening.iter().filter(|known| known.to.object == *component);
            let leading = self.leading.iter().filter(|(from, _)| from.object == *component);
            let leading = leading.map(|(from, to)| (from.clone(), to.clone()));
            let leading = leading.map(|(from, to)| PortConnection { from, to });
            kept.extend(listening.cloned().chain(leading));
        }
        self.listening.retain(|known| known.to.object != *component);
        self.leading.retain(|from, _| from.object != *component);
    }
}

impl Inner {
    /// The port at one end of a connection; `None` on another node.
    fn port(
        &self,
        address: &PortAddress,
        is_out: bool,
    ) -> Result<Option<&DeclaredPort>, ConnectError> {
        if address.node.is_some() {
            return Ok(None);
        }
        let unknown = || ConnectError::Refused(self.misspelt(address.object.as_str()));
        let entry = self.objects.get(&address.object).ok_or_else(unknown)?;
        let mut ports = entry.declared.iter().filter(|port| port.role.is_out() == is_out);
        let declared = ports.clone().map(|port| port.name.to_string());
        let found = ports.find(|port| port.name == address.port.as_str());
        found.map(Some).ok_or_else(|| ConnectError::no_port(address, is_out, declared.collect()))
    }

    /// Checks that this node can make the connection. Returns whether it is a listener's.
    fn check_ends(&self, connection: &PortConnection) -> Result<bool, ConnectError> {
        let end = resolve(connection, |address, is_out| {
            let port = self.port(address, is_out)?;
            Ok(port.map(|port| Cow::Owned(port.describe())))
        })?;
        match &connection.end(end).node {
            None => Ok(end == ConnectionEnd::To),
            node => Err(ConnectError::Elsewhere { node: node.clone() }),
        }
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
            entry.declared = ports.into();
        }
        let kept = inner.connections.kept.get_mut(component).map(std::mem::take);
        drop(inner);
        for PortConnection { from, to } in kept.unwrap_or_default().iter() {
            if let Err(why) = self.connect_ports(&from.to_string(), &to.to_string()) {
                warn!(%from, %to, %why, "two ports are not connected again");
            }
        }
        Ok(())
    }

    /// Keeps the connections of a component that comes and goes: those that it makes are made again
    /// whenever it comes. They may be made before it comes at first.
    pub(crate) fn keep_connections(&self, component: &str) {
        // Another name is refused where the component is added.
        if let Ok(component) = ObjectName::new(component) {
            self.lock().connections.kept.entry(component).or_default();
        }
    }

    /// Checks that a component of this node has this out port.
    pub(crate) fn check_port(
        &self,
        port: &PortAddress,
        wanted: ConnectionRole,
        with: &ContractIdentity,
    ) -> Result<(), ConnectError> {
        let inner = self.lock();
        let Some(DeclaredPort { role, identity, .. }) = inner.port(port, true)? else {
            return Ok(());
        };
        if *role != wanted {
            return Err(ConnectError::Handle { port: port.clone(), declared: *role, wanted });
        }
        identity.check(&with.full()).map_err(ConnectError::Differ)
    }

    /// The topic of an out port.
    pub(crate) fn port_topic(&self, port: &PortAddress) -> Result<ObjectName, DeliveryError> {
        let topic = port.topic(self.lock().node.as_ref());
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
        let PortConnection { from, to } = &connection;
        let mut inner = self.lock();
        let Inner { objects, connections, .. } = &mut *inner;
        let waits = connections.kept.values().map(BTreeSet::len).sum::<usize>();
        if connections.listening.len() + connections.leading.len() + waits >= CONNECTION_LIMIT {
            return Err(ConnectError::TooMany { limit: CONNECTION_LIMIT });
        }
        for end in [from, to].into_iter().filter(|end| end.node.is_none()) {
            if let (false, Some(kept)) =
                (objects.contains_key(&end.object), connections.kept.get_mut(&end.object))
            {
                kept.insert(connection.clone());
                return Ok(());
            }
        }
        let is_listeners = inner.check_ends(&connection)?;
        let Connections { listening, leading, changes, .. } = &mut inner.connections;
        let first = leading.get(from).or(listening.get(&connection).map(|known| &known.to));
        if let Some(to) = first {
            return Err(ConnectError::Taken { to: to.clone() });
        }
        changes.send_modify(|times| *times += 1);
        if !is_listeners {
            leading.insert(from.clone(), to.clone());
            return Ok(());
        }
        listening.insert(connection.clone());
        let Some(entry) = inner.objects.get(&to.object) else { return Ok(()) };
        let mut ports = entry.declared.iter().filter(|port| port.role == ConnectionRole::Listens);
        let like = ports.position(|port| port.name == to.port.as_str()).unwrap_or_default();
        let listener = entry.watchable.clone();
        drop(inner);
        let topic = self.port_topic(from);
        let listening =
            topic.and_then(|topic| listener.clone().listen(like, &topic).map(|()| topic));
        let mut inner = self.lock();
        match listening {
            // It was disconnected, or the component removed, meanwhile.
            Ok(topic) if !inner.connections.listening.contains(&connection) => {
                drop(inner);
                listener.stop_listening(&topic);
            }
            Ok(_) => {}
            Err(why) => {
                inner.connections.listening.remove(&connection);
                return Err(ConnectError::Refused(why));
            }
        }
        Ok(())
    }

    /// Disconnects two ports, whether or not the other end is still there.
    pub(crate) fn disconnect_ports(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        let connection = self.parsed(from, to)?;
        let PortConnection { from, to } = &connection;
        let mut inner = self.lock();
        let Connections { listening, leading, kept, changes } = &mut inner.connections;
        let is_listeners = listening.remove(&connection);
        let waited = kept.values_mut().any(|kept| kept.remove(&connection));
        if leading.get(from) == Some(to) {
            leading.remove(from);
        } else if !is_listeners && !waited {
            inner.check_ends(&connection)?;
            return Err(ConnectError::NotConnected);
        }
        changes.send_modify(|times| *times += 1);
        let listener = inner.objects.get(&to.object).map(|entry| entry.watchable.clone());
        drop(inner);
        if let (true, Some(listener), Ok(topic)) = (is_listeners, listener, self.port_topic(from)) {
            listener.stop_listening(&topic);
        }
        Ok(())
    }

    /// The connections that this node makes: those of listeners, then those of out ports.
    pub(crate) fn connections(&self) -> Vec<PortConnection> {
        let inner = self.lock();
        let Connections { listening, leading, .. } = &inner.connections;
        let leading = leading.iter().map(|(from, to)| (from.clone(), to.clone()));
        let leading = leading.map(|(from, to)| PortConnection { from, to });
        listening.iter().cloned().chain(leading).collect()
    }
}

/// An out port of a component of this node, as a way to what it is connected to.
pub(crate) struct PortReceiver {
    pub(crate) registry: Registry,
    pub(crate) port: PortAddress,
}

impl CurrentReceiver for PortReceiver {
    fn current(&self) -> Result<(String, u64), DeliveryError> {
        let inner = self.registry.lock();
        let unconnected = || DeliveryError::Unconnected { port: self.port.to_string() };
        let to = inner.connections.leading.get(&self.port).ok_or_else(unconnected)?;
        // A component that was removed and added again has another queue.
        Ok((to.component(), inner.revision))
    }

    fn changes(&self) -> watch::Receiver<u64> {
        self.registry.lock().connections.changes.subscribe()
    }
}
