//! How a bridge to plain keys of Zenoh is described.

use super::tree::SupervisorSpec;
use crate::bridge::{BridgedContract, InletQueue, ZenohConnection, ZenohInlet, ZenohOutlet};
use crate::component::spec_error::SpecError;
use crate::host::spec::ChildSpec;
use crate::messaging::queue::WhenFull;
use blastema_core::recovery::Strategy;
use blastema_core::{Delivery, Event};
use blastema_transports::{ZenohClient, ZenohClientConfig, ZenohKey, ZenohKeyUse};
use std::fmt;
use std::path::PathBuf;
use std::sync::Arc;

/// Adds the component of one topic, which has this number, to the bridge of this name.
type AddTopic =
    Box<dyn FnOnce(SupervisorSpec, &str, &Arc<ZenohClient>, usize) -> SupervisorSpec + Send>;

/// Publishes chosen topics as plain keys of Zenoh, as JSON with a schema, and takes others from
/// there: for programs that know nothing of Blastema, in whatever language has Zenoh.
///
/// It becomes a supervisor with a component for the connection and one for each topic.
/// [The manual](crate::manual::bridge) has a program in Python for the other side, and says what is
/// guaranteed.
///
/// ```
/// use blastema::prelude::*;
/// use blastema::ZenohBridge;
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
/// let builder = Node::builder("base").supervisor(bridge.into());
/// ```
#[must_use = "a bridge does nothing until it is given to a node or a supervisor"]
pub struct ZenohBridge {
    name: String,
    config: ZenohClientConfig,
    keys: Vec<ZenohKey>,
    topics: Vec<AddTopic>,
    objection: Option<String>,
}

impl fmt::Debug for ZenohBridge {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} to {} with {} topics", self.name, self.config.namespace, self.keys.len())
    }
}

impl ZenohBridge {
    /// A bridge without topics, whose keys begin with `namespace`, such as `ranger` or
    /// `fleet/ranger`.
    pub fn new(namespace: &str) -> Self {
        let mut config = ZenohClientConfig::default();
        namespace.clone_into(&mut config.namespace);
        ZenohBridge {
            name: "zenoh-bridge".to_owned(),
            config,
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
        self.config.connect.push(endpoint.to_owned());
        self
    }

    /// Listens itself, for clients without a router.
    pub fn listen(mut self, endpoint: &str) -> Self {
        self.config.listen.push(endpoint.to_owned());
        self
    }

    /// A configuration of Zenoh in JSON5 or YAML, for all else: certificates, users, timeouts.
    pub fn file(mut self, path: impl Into<PathBuf>) -> Self {
        self.config.file = Some(path.into());
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
                .queue(crate::settings::QUEUE.default, WhenFull::DropOldest)
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
        let whole = format!("{}/{key}", self.config.namespace);
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

impl From<ZenohBridge> for SupervisorSpec {
    /// What is wrong with the bridge is refused when the node starts.
    fn from(bridge: ZenohBridge) -> Self {
        let ZenohBridge { name, config, keys, topics, objection } = bridge;
        let objection =
            objection.or_else(|| config.objection(keys.iter().map(|key| key.key.as_str())));
        let mut supervisor = SupervisorSpec::new(&name, Strategy::OneForOne);
        if let Some(why) = objection {
            return supervisor.refused(SpecError::Bridge { name, why });
        }
        let client = ZenohClient::new(config, keys);
        let ours = client.clone();
        let connection = move || ZenohConnection::new(ours.clone());
        supervisor = supervisor.child(ChildSpec::new(&format!("{name}/connection"), connection));
        let topics = topics.into_iter().enumerate();
        topics.fold(supervisor, |supervisor, (number, add)| add(supervisor, &name, &client, number))
    }
}
