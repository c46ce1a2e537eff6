//! How a bridge to plain keys of Zenoh is described.

use super::BridgedContract;
use super::connection::ZenohConnection;
use super::inlet::{InletQueue, ZenohInlet};
use super::outlet::ZenohOutlet;
use crate::client::{ZenohClient, ZenohKey, ZenohKeyUse, objection};
use crate::ends::Ends;
use blastema::core::Delivery;
use blastema::prelude::*;
use blastema::recovery::Strategy;
use blastema::{SupervisorSpec, WhenFull};
use std::error::Error;
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

/// Why a bridge cannot be as it is described, and what to write.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BridgeError(String);

impl fmt::Display for BridgeError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

impl Error for BridgeError {}

/// Adds the component of one topic, which has this number, to the bridge of this name.
type AddTopic =
    Box<dyn FnOnce(SupervisorSpec, &str, &Arc<ZenohClient>, usize) -> SupervisorSpec + Send>;

/// Publishes chosen topics as plain keys of Zenoh, as JSON with a schema, and takes others from
/// there: for programs that know nothing of Blastema, in whatever language has Zenoh.
///
/// It becomes a supervisor with a component for the connection and one for each topic.
/// The page of the crate has a program in Python for the other side, and says what is guaranteed.
///
/// ```
/// use blastema::prelude::*;
/// use blastema_zenoh::ZenohBridge;
///
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "demo/pose")]
/// struct Pose {
///     #[contract(unit = "m")]
///     x: f64,
/// }
///
/// #[derive(Clone, Debug, Event)]
/// #[contract(name = "demo/goal")]
/// struct Goal {
///     #[contract(unit = "m")]
///     x: f64,
/// }
///
/// let bridge = ZenohBridge::new("ranger")
///     .connect("tcp/10.0.0.1:7447")
///     .publish::<Pose>("pose", "pose")        // the topic `pose` is the key `ranger/pose`
///     .subscribe::<Goal>("goal", "goal");     // what is written to `ranger/goal` is published
/// let builder = Node::builder("base").supervisor(bridge.try_into()?);
/// # Ok::<(), blastema_zenoh::BridgeError>(())
/// ```
#[must_use = "a bridge does nothing until it is given to a node or a supervisor"]
pub struct ZenohBridge {
    name: String,
    namespace: String,
    ends: Ends,
    keys: Vec<ZenohKey>,
    topics: Vec<AddTopic>,
    objection: Option<String>,
}

impl fmt::Debug for ZenohBridge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} to {} with {} topics", self.name, self.namespace, self.keys.len())
    }
}

impl ZenohBridge {
    /// A bridge without topics, whose keys begin with `namespace`, such as `ranger` or
    /// `fleet/ranger`.
    pub fn new(namespace: &str) -> Self {
        ZenohBridge {
            name: "zenoh-bridge".to_owned(),
            namespace: namespace.to_owned(),
            ends: Ends::default(),
            keys: Vec::new(),
            topics: Vec::new(),
            objection: None,
        }
    }

    /// Names its supervisor, and what is below it; `zenoh-bridge` unless set. The components are
    /// `zenoh-bridge/connection`, `zenoh-bridge/out/<topic>` and `zenoh-bridge/in/<topic>`.
    pub fn name(mut self, name: &str) -> Self {
        name.clone_into(&mut self.name);
        self
    }

    /// Connects to a router, or another client, as Zenoh writes it: `tcp/10.0.0.1:7447`. Of
    /// several, the first that answers is used.
    pub fn connect(mut self, endpoint: &str) -> Self {
        self.ends.connect.push(endpoint.to_owned());
        self
    }

    /// Listens itself, for clients without a router.
    pub fn listen(mut self, endpoint: &str) -> Self {
        self.ends.listen.push(endpoint.to_owned());
        self
    }

    /// A configuration of Zenoh in JSON5 or YAML, for all else: certificates, users, timeouts.
    pub fn file(mut self, path: impl Into<PathBuf>) -> Self {
        self.ends.file = Some(path.into());
        self
    }

    /// Writes the events of a topic to a key below the namespace. The last event of a latched topic
    /// is answered to those who ask for the key.
    pub fn publish<E: Event>(mut self, topic: &str, key: &str) -> Self {
        let waits = E::DELIVERY == Delivery::Reliable;
        let used = ZenohKeyUse::Written { latched: E::LATCHED, waits };
        let Some(contract) = self.contract::<E>() else { return self };
        self.add_key(key, &contract, used);
        let topic = topic.to_owned();
        self.topics.push(Box::new(move |supervisor, name, client, number| {
            let client = client.clone();
            let outlet = move || ZenohOutlet::<E>::new(client.clone(), number);
            // The newest events count, where they cannot all be written.
            let spec = ChildSpec::new(&format!("{name}/out/{topic}"), outlet)
                .queue(ChildSpec::<ZenohOutlet<E>>::QUEUE, WhenFull::DropOldest)
                .with_ports(move |ports| drop(ports.listen::<E>().on(&topic)));
            supervisor.child(spec)
        }));
        self
    }

    /// Publishes on a topic what others write to a key below the namespace. A client that may write
    /// there, may publish on this topic: the access control of Zenoh's router decides it, not the
    /// keys and the policy of the robot.
    pub fn subscribe<E: Event>(mut self, topic: &str, key: &str) -> Self {
        let Some(contract) = self.contract::<E>() else { return self };
        let whole = format!("{}/{key}", self.namespace);
        let queue = Arc::new(InletQueue::<E>::new(&whole, contract.clone()));
        self.add_key(key, &contract, ZenohKeyUse::Read(queue.clone()));
        let topic = topic.to_owned();
        self.topics.push(Box::new(move |supervisor, name, _, _| {
            let name = format!("{name}/in/{topic}");
            let inlet = move || ZenohInlet::new(queue.clone(), &topic);
            supervisor.child(ChildSpec::new(&name, inlet))
        }));
        self
    }

    /// The contract as JSON, if JSON can hold it.
    fn contract<E: Event>(&mut self) -> Option<BridgedContract> {
        BridgedContract::of::<E>().map_err(|why| self.objection.get_or_insert(why)).ok()
    }

    fn add_key(&mut self, key: &str, contract: &BridgedContract, used: ZenohKeyUse) {
        let (key, encoding) = (key.to_owned(), contract.encoding());
        self.keys.push(ZenohKey { key, encoding, schema: contract.schema.clone().into(), used });
    }
}

impl TryFrom<ZenohBridge> for SupervisorSpec {
    type Error = BridgeError;

    fn try_from(bridge: ZenohBridge) -> Result<Self, BridgeError> {
        let ZenohBridge { name, namespace, ends, keys, topics, objection: of_contract } = bridge;
        let of_keys = || objection(&namespace, &ends, keys.iter().map(|key| key.key.as_str()));
        if let Some(why) = of_contract.or_else(of_keys) {
            return Err(BridgeError(format!("the bridge {name} cannot be: {why}")));
        }
        let client = ZenohClient::new(namespace, ends, keys);
        let ours = client.clone();
        let connection = move || ZenohConnection::new(ours.clone());
        let supervisor = SupervisorSpec::new(&name, Strategy::OneForOne)
            .child(ChildSpec::new(&format!("{name}/connection"), connection));
        let topics = topics.into_iter().enumerate();
        let add =
            |supervisor, (number, add): (usize, AddTopic)| add(supervisor, &name, &client, number);
        Ok(topics.fold(supervisor, add))
    }
}
