//! Connections between the ports of components, as they are described and changed.

use super::builder::NodeBuilder;
use crate::node::Node;
use blastema_core::port::{ConnectError, PortConnection};

impl NodeBuilder {
    /// Connects the out port of a component to the port of another one: `laser#scan` to
    /// `planner#scan`. It is connected before the components start.
    ///
    /// One end may be on another node: `base:laser#scan`. The connection is given to one node: for
    /// events to that of the listener, for commands and requests to that of the component that
    /// sends them.
    pub fn connect(mut self, from: &str, to: &str) -> Self {
        self.connections.push((from.to_owned(), to.to_owned()));
        self
    }
}

/// Connections between ports.
impl Node {
    /// Connects the out port of a component to the port of another one while the node runs. The
    /// connection outlives the incarnations of both, and ends with the component that listens,
    /// commands or asks.
    ///
    /// # Errors
    /// There is no such component or port, the ports do not fit, or
    /// [another node](ConnectError::Elsewhere) makes the connection. What a port of another node
    /// takes is found when the first message goes there.
    pub fn connect(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        self.0.environment.registry.connect_ports(from, to)
    }

    /// Disconnects two ports. What has been accepted is still delivered.
    ///
    /// # Errors
    /// [`ConnectError::NotConnected`], or an address is wrong.
    pub fn disconnect(&self, from: &str, to: &str) -> Result<(), ConnectError> {
        self.0.environment.registry.disconnect_ports(from, to)
    }

    /// Returns the connections that this node makes. Its own name is left out of the addresses.
    pub fn connections(&self) -> Vec<PortConnection> {
        self.0.environment.registry.connections()
    }
}
