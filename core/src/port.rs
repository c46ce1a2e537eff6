//! Ports of components, and which of them can be connected.
//!
//! ```text
//!  publishes ─► listens      a subscription; the listener's node makes the connection
//!  commands  ─► commanded    the actuator that a commander leads to; the commander's node makes it
//!  asks      ─► serves       the object that a sender leads to; the asker's node makes it
//! ```
//!
//! A component declares its ports. Connections are made from outside, so that a component does not
//! know which components are at the other ends.

use crate::contract::layout::fields::FieldDescription;
use crate::parameters::ParameterDescription;
use crate::suggestion::nearest;
use crate::{
    ContractIdentity, DeliveryError, Difference, NameError, NodeName, ObjectName, PeerIdentity,
};
use serde::{Deserialize, Serialize};
use std::borrow::Cow;
use std::fmt;
use std::str::FromStr;

/// What passes through a port, and in which direction.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum ConnectionRole {
    /// Gives events to those that listen.
    Publishes,
    /// Gives commands to one actuator.
    Commands,
    /// Gives requests, or other messages, to one object.
    Asks,
    /// Takes the events of a publisher.
    Listens,
    /// Takes commands: an actuator.
    Commanded,
    /// Takes requests, or other messages.
    Serves,
}

impl ConnectionRole {
    /// Whether messages leave the component here, so that a connection begins at it.
    pub fn is_out(self) -> bool {
        matches!(self, ConnectionRole::Publishes | ConnectionRole::Commands | ConnectionRole::Asks)
    }

    /// Whether the node of this end makes the connection.
    pub fn connects(self) -> bool {
        matches!(self, ConnectionRole::Listens | ConnectionRole::Commands | ConnectionRole::Asks)
    }

    /// The role at the other end of a connection.
    pub fn other_end(self) -> ConnectionRole {
        match self {
            ConnectionRole::Publishes => ConnectionRole::Listens,
            ConnectionRole::Listens => ConnectionRole::Publishes,
            ConnectionRole::Commands => ConnectionRole::Commanded,
            ConnectionRole::Commanded => ConnectionRole::Commands,
            ConnectionRole::Asks => ConnectionRole::Serves,
            ConnectionRole::Serves => ConnectionRole::Asks,
        }
    }
}

impl fmt::Display for ConnectionRole {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            ConnectionRole::Publishes => "publishes",
            ConnectionRole::Commands => "commands",
            ConnectionRole::Asks => "asks",
            ConnectionRole::Listens => "listens to",
            ConnectionRole::Commanded => "is commanded by",
            ConnectionRole::Serves => "serves",
        })
    }
}

/// Where a port is: `laser#scan` on the own node, or `base:laser#scan`.
///
/// ```
/// use blastema_core::port::PortAddress;
///
/// let scan: PortAddress = "base:laser#scan".parse()?;
/// assert_eq!((scan.object.as_str(), scan.port.as_str()), ("laser", "scan"));
/// assert_eq!(scan.to_string(), "base:laser#scan");
/// # Ok::<(), blastema_core::port::ConnectError>(())
/// ```
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct PortAddress {
    /// The node, if it is named.
    pub node: Option<NodeName>,
    /// The name of the component.
    pub object: ObjectName,
    /// The port of the component.
    pub port: ObjectName,
}

impl PortAddress {
    /// The same port, with its node left out where that is `own`.
    #[must_use]
    pub fn seen_from(mut self, own: Option<&NodeName>) -> Self {
        self.node = self.node.filter(|node| Some(node) != own);
        self
    }

    /// The component, with its node in front where that is named.
    pub fn component(&self) -> String {
        match &self.node {
            Some(node) => format!("{node}:{}", self.object),
            None => self.object.to_string(),
        }
    }

    /// The topic of the events of an out port: `base/laser/scan`. No other port has it.
    ///
    /// # Errors
    /// The names are too long together, or that of the port has a `/`: the port `scan` of the
    /// component `laser/left` would have the topic of the port `left/scan` of `laser`.
    pub fn topic(&self, own: Option<&NodeName>) -> Result<ObjectName, NameError> {
        if let Some(at) = self.port.as_str().find('/') {
            return Err(NameError::Character { text: self.port.to_string(), found: '/', at });
        }
        let node = self.node.as_ref().or(own);
        let node = node.map(|node| format!("{node}/")).unwrap_or_default();
        ObjectName::new(&format!("{node}{}/{}", self.object, self.port))
    }
}

impl FromStr for PortAddress {
    type Err = ConnectError;

    fn from_str(text: &str) -> Result<Self, ConnectError> {
        let address = || ConnectError::Address { text: text.to_owned() };
        let (object, port) = text.split_once('#').ok_or_else(address)?;
        let (node, object) = match object.split_once(':') {
            Some((node, object)) => (Some(NodeName::new(node)?), object),
            None => (None, object),
        };
        Ok(PortAddress { node, object: ObjectName::new(object)?, port: ObjectName::new(port)? })
    }
}

impl TryFrom<String> for PortAddress {
    type Error = ConnectError;

    fn try_from(text: String) -> Result<Self, ConnectError> {
        text.parse()
    }
}

impl From<PortAddress> for String {
    fn from(address: PortAddress) -> String {
        address.to_string()
    }
}

impl fmt::Display for PortAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#{}", self.component(), self.port)
    }
}

impl fmt::Debug for PortAddress {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}

/// A connection between two ports.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct PortConnection {
    /// The out port, where its messages come from.
    pub from: PortAddress,
    /// The port where they go.
    pub to: PortAddress,
}

impl PortConnection {
    /// The port at one end.
    pub fn end(&self, end: ConnectionEnd) -> &PortAddress {
        match end {
            ConnectionEnd::From => &self.from,
            ConnectionEnd::To => &self.to,
        }
    }
}

impl fmt::Display for PortConnection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} -> {}", self.from, self.to)
    }
}

/// A port of a type of components.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PortDescription {
    /// Its name in addresses.
    pub name: String,
    /// The direction, and what passes through the port.
    pub role: ConnectionRole,
    /// The contract of its messages.
    pub contract: PeerIdentity,
    /// The fields of a message.
    pub fields: Vec<FieldDescription>,
    /// The fields of a reply; none where there is no reply.
    pub reply: Vec<FieldDescription>,
}

impl PortDescription {
    /// Describes a port.
    pub fn new(name: &str, role: ConnectionRole, contract: &ContractIdentity) -> Self {
        let contract = contract.full();
        let structure = contract.structure.as_ref();
        PortDescription {
            name: name.to_owned(),
            role,
            fields: structure.map(|known| known.message.fields()).unwrap_or_default(),
            reply: structure.map(|known| known.reply.fields()).unwrap_or_default(),
            contract,
        }
    }
}

/// What a type of components takes and gives, and how it is set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TypeDescription {
    /// The parameters of its components.
    pub parameters: Vec<ParameterDescription>,
    /// The ports by which messages reach it.
    pub takes: Vec<PortDescription>,
    /// The out ports; `None` where the type declares none, so that it is not known what it gives.
    pub gives: Option<Vec<PortDescription>>,
}

impl TypeDescription {
    /// The ports where connections begin, or where they end.
    pub fn ports(&self, is_out: bool) -> &[PortDescription] {
        if is_out { self.gives.as_deref().unwrap_or_default() } else { &self.takes }
    }

    /// The port at this address, which is of a component of this type: an out port where the
    /// connection begins, another one where it ends.
    ///
    /// # Errors
    /// [`ConnectError::NoPort`] names those that there are.
    pub fn port(
        &self,
        address: &PortAddress,
        is_out: bool,
    ) -> Result<&PortDescription, ConnectError> {
        let ports = self.ports(is_out);
        let found = ports.iter().find(|port| port.name == address.port.as_str());
        let declared = || ports.iter().map(|port| port.name.clone()).collect();
        found.ok_or_else(|| ConnectError::no_port(address, is_out, declared()))
    }
}

/// The two ends of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConnectionEnd {
    /// The out port.
    From,
    /// The port where its messages go.
    To,
}

/// Decides whether a connection can be, and which end makes it: the one that listens, commands or
/// asks. `port` finds the out port at an address, or, where that is false, another one; it returns
/// `None` for what is not known here, such as a port of another node, which is taken to fit.
///
/// # Errors
/// Those of `port`; the roles do not fit, or the contracts differ.
pub fn resolve<'p>(
    PortConnection { from, to }: &PortConnection,
    mut port: impl FnMut(&PortAddress, bool) -> Result<Option<Cow<'p, PortDescription>>, ConnectError>,
) -> Result<ConnectionEnd, ConnectError> {
    let (from, to) = (port(from, true)?, port(to, false)?);
    if let (Some(from), Some(to)) = (&from, &to) {
        if !from.role.is_out() || to.role != from.role.other_end() {
            return Err(ConnectError::Roles { from: from.role, to: to.role });
        }
        from.contract.check(&to.contract).map_err(ConnectError::Differ)?;
    }
    let listens = to.map(|to| to.role.connects());
    match listens.or(from.map(|from| !from.role.connects())) {
        Some(false) => Ok(ConnectionEnd::From),
        Some(true) | None => Ok(ConnectionEnd::To),
    }
}

/// Why ports cannot be connected, or a port not be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ConnectError {
    /// The text names no port.
    #[error("`{text}` names no port: write `COMPONENT#PORT`, as in `laser#scan`")]
    Address {
        /// The text that was given.
        text: String,
    },
    /// A part of an address is no name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The component has no such port in this direction.
    #[error(
        "{component} {verb} no port `{port}`: {}{}",
        listed(.verb, .declared),
        meant(.nearest.as_ref())
    )]
    NoPort {
        /// The name of the component.
        component: String,
        /// `gives` for out ports, `takes` for the others.
        verb: &'static str,
        /// The port that was looked for.
        port: ObjectName,
        /// The port that may have been meant.
        nearest: Option<String>,
        /// All that there are.
        declared: Vec<String>,
    },
    /// Messages do not pass from a port of the first role to one of the second.
    #[error(
        "a port that {from} something cannot be connected to one that {to} something: {}",
        fitting(*.from)
    )]
    Roles {
        /// What the port does at which the connection begins.
        from: ConnectionRole,
        /// The role of the other port.
        to: ConnectionRole,
    },
    /// The contracts of the two ports differ; "here" is where the connection begins.
    #[error("the ports do not fit: {0}")]
    Differ(Difference),
    /// The handle is for a port that does something else.
    #[error(
        "{port} {declared} what it sends, and is not one that {wanted}: take it as `{}<…>`",
        handle(*.declared)
    )]
    Handle {
        /// The port that the handle is for.
        port: PortAddress,
        /// The role of the port.
        declared: ConnectionRole,
        /// The role that the handle needs.
        wanted: ConnectionRole,
    },
    /// Another node makes this connection: that of the end that listens, commands or asks.
    #[error(
        "the end that listens, commands or asks is on {}: connect them there",
        of(.node.as_ref())
    )]
    Elsewhere {
        /// The node of that end, if it is known.
        node: Option<NodeName>,
    },
    /// The two ports are connected; or the out port, which leads to one port at a time, is.
    #[error("the port is connected to {to}: disconnect it first")]
    Taken {
        /// The port that it is connected to.
        to: PortAddress,
    },
    /// The two ports are not connected.
    #[error("they are not connected")]
    NotConnected,
    /// The node makes as many connections as a node may.
    #[error("this node makes {limit} connections, and no node makes more")]
    TooMany {
        /// The most connections of a node.
        limit: usize,
    },
    /// There is no such component, or what the port leads to refuses it.
    #[error("{0}")]
    Refused(DeliveryError),
}

impl ConnectError {
    /// The component at this address has no such port in this direction.
    pub fn no_port(address: &PortAddress, is_out: bool, declared: Vec<String>) -> Self {
        let nearest = nearest(address.port.as_str(), declared.iter().map(String::as_str));
        ConnectError::NoPort {
            component: address.component(),
            verb: if is_out { "gives" } else { "takes" },
            port: address.port.clone(),
            nearest: nearest.map(str::to_owned),
            declared,
        }
    }
}

fn meant(nearest: Option<&String>) -> String {
    nearest.map(|nearest| format!("; did you mean `{nearest}`?")).unwrap_or_default()
}

fn listed(verb: &str, declared: &[String]) -> String {
    match (declared, verb) {
        ([], "gives") => {
            "it declares none; write `ports.publishes::<…>(…)`, `commands` or `asks` in its `fn ports`"
                .into()
        }
        ([], _) => "it declares none".into(),
        (declared, verb) => format!("it {verb} `{}`", declared.join("`, `")),
    }
}

fn of(node: Option<&NodeName>) -> String {
    node.map_or("another node".to_owned(), |node| format!("node {node}"))
}

fn fitting(from: ConnectionRole) -> String {
    match from.is_out() {
        true => format!("this one leads to a port that {} them", from.other_end()),
        false => "a connection begins at a port that publishes, commands or asks".into(),
    }
}

fn handle(role: ConnectionRole) -> &'static str {
    match role {
        ConnectionRole::Publishes => "Publisher",
        ConnectionRole::Commands => "Commander",
        _ => "Sender",
    }
}

#[cfg(test)]
mod tests {
    use super::ConnectionRole::{Asks, Commanded, Commands, Listens, Publishes, Serves};
    use super::*;
    use crate::Delivery;

    fn port(name: &str, role: ConnectionRole, contract: &str) -> PortDescription {
        let contract = PeerIdentity {
            name: contract.into(),
            version: 1,
            delivery: Delivery::Reliable,
            bulk: false,
            fingerprint: 7,
            structure: None,
        };
        PortDescription { name: name.into(), role, contract, fields: vec![], reply: vec![] }
    }

    fn connected(
        from: &PortDescription,
        to: &PortDescription,
    ) -> Result<ConnectionEnd, ConnectError> {
        let address = |text: &str| text.parse().expect("an address");
        let connection = PortConnection { from: address("a#a"), to: address("b#b") };
        resolve(&connection, |_, is_out| Ok(Some(Cow::Borrowed(if is_out { from } else { to }))))
    }

    #[test]
    fn an_address_names_a_component_and_its_port() {
        let check = |text: &str, said: &str| match text.parse::<PortAddress>() {
            Ok(address) => assert_eq!(address.to_string(), said),
            Err(error) => assert!(error.to_string().contains(said), "{error}"),
        };

        check("laser#scan", "laser#scan");
        check("base:arm/left.1#laser/scan", "base:arm/left.1#laser/scan");
        check("laser.scan", "write `COMPONENT#PORT`");
        check("laser#", "is empty");
        check("#scan", "is empty");
        check("ba se:laser#scan", "holds ' '");
        check("laser#a#b", "holds '#'");
    }

    #[test]
    fn an_out_port_has_a_topic_of_its_own_on_its_node() {
        let own = NodeName::new("base").ok();
        let address = |text: &str| text.parse::<PortAddress>().expect("an address");
        let topic = |text: &str| address(text).topic(own.as_ref()).map(String::from);

        assert_eq!(topic("laser#scan").as_deref(), Ok("base/laser/scan"));
        assert_eq!(topic("arm:eye/left#image").as_deref(), Ok("arm/eye/left/image"));
        assert_eq!(topic("eye/left#image").as_deref(), Ok("base/eye/left/image"));
        let same = topic("eye#left/image").expect_err("it would be that of eye/left#image");
        assert!(same.to_string().contains("\"left/image\" holds '/' at byte 4"), "{same}");
        let long = format!("{}#scan", "l".repeat(128));
        assert!(matches!(topic(&long), Err(NameError::TooLong { .. })));
        let seen = |text: &str| address(text).seen_from(own.as_ref()).to_string();
        assert_eq!((seen("base:a#b"), seen("arm:a#b")), ("a#b".into(), "arm:a#b".into()));
    }

    #[test]
    fn ports_are_connected_where_messages_of_one_contract_pass() {
        let roles = [Publishes, Commands, Asks, Listens, Commanded, Serves];

        for from in roles {
            for to in roles {
                let made = connected(&port("a", from, "Scan"), &port("b", to, "Scan"));
                let fits = [(Publishes, Listens), (Commands, Commanded), (Asks, Serves)];
                assert_eq!(made.is_ok(), fits.contains(&(from, to)), "{from} {to}");
                let end = if from.connects() { ConnectionEnd::From } else { ConnectionEnd::To };
                assert!(made.is_err() || made == Ok(end), "{from} {to}");
                assert!(!from.is_out() || from.connects() != from.other_end().connects());
                assert_eq!(from.other_end().other_end(), from);
            }
        }
        let differs = connected(&port("a", Asks, "Scan"), &port("b", Serves, "Range"));
        let text = differs.expect_err("two contracts").to_string();
        assert!(text.contains("name `Scan` here, `Range` there"), "{text}");
    }

    #[test]
    fn a_missing_port_is_named_with_those_that_there_are() {
        let takes = vec![port("scan", Listens, "Scan"), port("stop", Serves, "Stop")];
        let planner = TypeDescription { parameters: vec![], takes, gives: None };
        let at = |text: &str| text.parse::<PortAddress>().expect("an address");
        let missing = |text, is_out| planner.port(&at(text), is_out).unwrap_err().to_string();

        assert_eq!(planner.port(&at("planner#stop"), false).map(|port| port.role), Ok(Serves));
        assert_eq!(
            missing("base:planner#scna", false),
            "base:planner takes no port `scna`: it takes `scan`, `stop`; did you mean `scan`?"
        );
        assert!(
            missing("planner#path", true).contains("planner gives no port `path`: it declares")
        );
    }
}
