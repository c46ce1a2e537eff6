//! Who is called what on this node, and what they take.
//!
//! Local parties bind by type; the network binds through a [`Skeleton`], which knows the contract
//! but not the type behind it. Both compare the contract's identity first.

pub(crate) mod access;
pub(crate) mod encoding;
pub(crate) mod lookup;
pub(crate) mod ports;
pub(crate) mod remote;
pub(crate) mod remote_watch;
pub(crate) mod service_fn;

use crate::messaging::death_watch::{Deaths, Down, DownReason, NumberedEnd, Watchable, Watcher};
use crate::messaging::reply::Responder;
use crate::messaging::sender::Sender;
use crate::platform::lock;
use access::{AccessControl, MessageOrigin};
use blastema_core::net::NodeId;
use blastema_core::sorted::SortedMap;
use blastema_core::{
    Contract, ContractIdentity, DeliveryError, FaultKind, GatherBuffer, Incarnation, Instant,
    MessageId, NameError, NodeName, ObjectAddress, ObjectName, PeerIdentity, suggestion,
};
use bytes::Bytes;
use ports::{Connections, DeclaredPort};
use remote::RemoteNames;
use std::any::{Any, type_name};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, Weak};
use std::time::Duration;

/// Gets the encoded reply, or the reason why there is none. Called once, on any thread.
pub(crate) type ReplyTo = Box<dyn FnOnce(Result<GatherBuffer, DeliveryError>) + Send>;

/// What is known of a message that comes from outside, beside its contents.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct MessageMetadata {
    pub(crate) id: Option<MessageId>,
    /// How long it has been on its way.
    pub(crate) age: Duration,
    /// It is a safe command: it comes before all that waits, and needs no room.
    pub(crate) is_first: bool,
    /// A request is not to be begun after this.
    pub(crate) until: Option<Instant>,
    /// The node that it comes from, if it is another.
    pub(crate) from: Option<NodeId>,
}

/// Waits for room.
pub(crate) type CapacityFuture = Pin<Box<dyn Future<Output = ()> + Send>>;

/// The way into an object for messages that come from outside the process.
pub(crate) trait Skeleton: Send + Sync {
    /// Decodes the message and hands it over. Where `reply_to` is given it is called in every case;
    /// the error then repeats what it was told. Where it is not, and there is
    /// [`space`](Self::space) to wait for, a message that is refused as [`DeliveryError::Full`] or
    /// [`DeliveryError::Restarting`] remains the caller's: to be tried again, or
    /// [recorded](Self::record_dead_letter).
    fn deliver(
        &self,
        message: &Bytes,
        metadata: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) -> Result<(), DeliveryError>;

    /// The number of what the object serves, odd while it serves something.
    fn turn(&self) -> u64 {
        0
    }

    /// Completes when there may be room for a message that was refused; `None` where nothing waits.
    fn space(&self) -> Option<CapacityFuture> {
        None
    }

    /// Counts a message that was refused for want of room, and is given up.
    fn record_dead_letter(&self, _why: &DeliveryError) {}

    /// The way for a sender with an earlier version of the contract, if it is understood.
    fn former(&self, _theirs: &PeerIdentity) -> Option<Arc<dyn Skeleton>> {
        None
    }

    /// Reports a fault that was found at the skeleton, such as a caller with another contract.
    fn declare(&self, kind: FaultKind, detail: String);

    /// What was declared of the object is over.
    fn clear_fault(&self, _kind: FaultKind) {}

    /// Whether the object is at work, so that what is delivered is served at once.
    fn is_at_work(&self) -> bool {
        true
    }
}

/// One contract that one object takes.
pub(crate) struct ContractPort {
    pub(crate) identity: ContractIdentity,
    /// Its type, for display.
    named: &'static str,
    /// A `Sender<M>` for messages `M` of this contract.
    sender: Box<dyn Any + Send + Sync>,
    skeleton: Arc<dyn Skeleton>,
}

impl ContractPort {
    /// A contract that is sent to here by `sender`, and from other nodes by way of `skeleton`.
    pub(crate) fn new<M: Contract>(sender: Sender<M>, skeleton: Arc<dyn Skeleton>) -> Self {
        ContractPort {
            identity: ContractIdentity::of::<M>(),
            named: type_name::<M>(),
            sender: Box::new(sender),
            skeleton,
        }
    }

    /// The way from outside.
    pub(crate) fn into_skeleton(self) -> Arc<dyn Skeleton> {
        self.skeleton
    }
}

/// A name that is taken already.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the name {name} is taken by {by} of this node: names are given once")]
pub struct NameTaken {
    /// The name that was to be registered.
    pub name: ObjectName,
    /// The kind of its holder: a component, a service, a supervisor, or an object of the
    /// middleware.
    pub by: &'static str,
}

struct Entry {
    ports: SortedMap<&'static str, ContractPort>,
    watchable: Arc<dyn Watchable>,
    /// What can be connected.
    declared: Box<[DeclaredPort]>,
}

impl Entry {
    fn kind(&self) -> &'static str {
        if self.watchable.component_type().is_some() { "a component" } else { "a service" }
    }

    fn not_served(&self, object: &ObjectName, contract: &str) -> DeliveryError {
        DeliveryError::NotServed {
            object: object.to_string(),
            contract: contract.to_owned(),
            served: self.ports.keys().map(|&name| name.to_owned()).collect(),
        }
    }
}

#[derive(Default)]
struct Inner {
    /// As many as the node has objects.
    objects: SortedMap<ObjectName, Entry>,
    /// What nodes say to each other, and no object does: one contract each.
    hidden: SortedMap<ObjectName, ContractPort>,
    /// Names of supervisors and of the middleware's own objects, at which nothing can be sent, and
    /// which of these they are.
    reserved: SortedMap<ObjectName, &'static str>,
    /// Rises whenever a name is given or taken away.
    revision: u64,
    connections: Connections,
    node: Option<NodeName>,
    /// The node was shut down.
    is_shut_down: bool,
    remote: RemoteNames,
    deaths: Deaths,
    access: AccessControl,
}

impl Inner {
    /// Refuses a name that is given already.
    fn check_free(&self, name: &ObjectName) -> Result<(), NameTaken> {
        let known = self.objects.get(name).map(Entry::kind);
        match known.or_else(|| self.reserved.get(name).copied()) {
            Some(by) => Err(NameTaken { name: name.clone(), by }),
            None => Ok(()),
        }
    }

    /// What to say of a name that no object of this node has.
    fn misspelt(&self, name: &str) -> DeliveryError {
        if let Some(why) = self.refusal() {
            return why;
        }
        let known = self.objects.keys().map(ObjectName::as_str);
        let object = name.split_once(':').map_or(name, |(_, object)| object);
        let name = name.to_owned();
        match suggestion::nearest(object, known) {
            // It is there, and the wrong one for what is asked.
            Some(nearest) if nearest == object => DeliveryError::Unknown { name },
            Some(nearest) => DeliveryError::Misspelt { nearest: nearest.to_owned(), name },
            None => DeliveryError::Unknown { name },
        }
    }

    /// Nothing is sent from a node that was shut down.
    fn refusal(&self) -> Option<DeliveryError> {
        let node = self.node.as_ref().filter(|_| self.is_shut_down)?;
        Some(DeliveryError::ShutDown { node: node.to_string() })
    }

    /// The object of this node that is called so, also with the node's name in front.
    fn own(&self, name: &str) -> Result<ObjectName, DeliveryError> {
        if !name.contains(':') {
            return ObjectName::new(name).map_err(|_| self.misspelt(name));
        }
        let unknown = |_| DeliveryError::Unknown { name: name.to_owned() };
        let address: ObjectAddress = name.parse().map_err(unknown)?;
        match self.node.as_ref() == Some(&address.node) {
            true => Ok(address.object),
            false => Err(self.out_of_reach(&address)),
        }
    }

    /// What to say of an object of another node where there is no network.
    fn out_of_reach(&self, to: &ObjectAddress) -> DeliveryError {
        let own = suggestion::nearest(to.node.as_str(), self.node.iter().map(NodeName::as_str));
        let objects = self.objects.keys().map(ObjectName::as_str);
        match (own, suggestion::nearest(to.object.as_str(), objects)) {
            (Some(node), Some(object)) => {
                let nearest = format!("{node}:{object}");
                DeliveryError::Misspelt { name: to.to_string(), nearest }
            }
            _ => DeliveryError::Unreachable { node: to.node.to_string() },
        }
    }
}

/// The names of one node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Registry(Arc<Mutex<Inner>>);

impl Registry {
    fn lock(&self) -> MutexGuard<'_, Inner> {
        lock(&self.0)
    }

    /// Names of this node may be written with `node` in front.
    pub(crate) fn set_node(&self, node: NodeName) {
        self.lock().node = Some(node);
    }

    /// The ends of objects are told there.
    pub(crate) fn watch_in(&self, deaths: Deaths) {
        self.lock().deaths = deaths;
    }

    /// What other nodes may do with the objects.
    pub(crate) fn access(&self) -> AccessControl {
        self.lock().access.clone()
    }

    /// Gives a name to an object.
    pub(crate) fn register(
        &self,
        name: &ObjectName,
        ports: SortedMap<&'static str, ContractPort>,
        watchable: Arc<dyn Watchable>,
    ) -> Result<(), NameTaken> {
        let mut inner = self.lock();
        inner.check_free(name)?;
        inner.objects.insert(name.clone(), Entry { ports, watchable, declared: Box::default() });
        inner.revision += 1;
        Ok(())
    }

    /// What kind of object has this name, where something can be sent to it.
    pub(crate) fn kind_of(&self, name: &ObjectName) -> Option<&'static str> {
        self.lock().objects.get(name).map(Entry::kind)
    }

    /// Keeps a name for an object at which nothing can be sent, of this kind.
    pub(crate) fn reserve(&self, name: &ObjectName, kind: &'static str) -> Result<(), NameTaken> {
        let mut inner = self.lock();
        inner.check_free(name)?;
        inner.reserved.insert(name.clone(), kind);
        Ok(())
    }

    /// Keeps a name for a supervisor, until what is returned is dropped.
    pub(crate) fn reserve_for_supervisor(
        &self,
        name: &ObjectName,
    ) -> Result<ReservedName, NameTaken> {
        self.reserve(name, "a supervisor")?;
        Ok(ReservedName { registry: self.downgrade(), name: name.clone() })
    }

    /// Accepts a contract from other nodes under a name that no object has and no list shows.
    pub(crate) fn serve_hidden<M: Contract>(
        &self,
        name: &str,
        serve: impl Fn(M, MessageOrigin, Responder<M>) + Send + Sync + 'static,
    ) {
        let name = ObjectName::new(name).expect("a name of letters");
        self.lock().hidden.insert(name, ContractPort::served_by(serve));
    }

    /// One more contract is taken at an object's name.
    pub(crate) fn open(&self, name: &ObjectName, port: ContractPort) {
        if let Some(entry) = self.lock().objects.get_mut(name) {
            entry.ports.insert(port.identity.name, port);
        }
    }

    /// Takes the name away.
    pub(crate) fn unregister(&self, name: &ObjectName) {
        let mut inner = self.lock();
        let released = inner.objects.remove(name);
        inner.connections.remove(name);
        inner.revision += 1;
        let deaths = inner.deaths.clone();
        drop(inner);
        deaths.forget(name);
        drop(released);
    }

    /// Where messages of contract `M` can be sent to the object of this name.
    pub(crate) fn sender<M: Contract>(&self, name: &str) -> Result<Sender<M>, DeliveryError> {
        let inner = self.lock();
        if let Some(why) = inner.refusal() {
            return Err(why);
        }
        if let Some(way) = inner.way_elsewhere(name)? {
            drop(inner);
            return Ok(way.sender(self));
        }
        let object = inner.own(name)?;
        let entry = inner.objects.get(&object).ok_or_else(|| inner.misspelt(name))?;
        let port = entry.ports.get(M::NAME).ok_or_else(|| entry.not_served(&object, M::NAME))?;
        match port.sender.downcast_ref::<Sender<M>>() {
            Some(sender) => Ok(sender.clone()),
            None => {
                let difference = difference(&port.identity, &ContractIdentity::of::<M>());
                let (known, wanted) = (port.named, type_name::<M>());
                let difference = format!("{object} takes {known}, and not {wanted}: {difference}");
                Err(DeliveryError::ContractDiffers { difference })
            }
        }
    }

    /// The way from outside into the object, for the contract of this name.
    pub(crate) fn skeleton(
        &self,
        object: &ObjectName,
        contract: &str,
    ) -> Result<(ContractIdentity, Arc<dyn Skeleton>), DeliveryError> {
        let inner = self.lock();
        let entry = inner.objects.get(object);
        let port = entry.and_then(|entry| entry.ports.get(contract));
        let port = port.or_else(|| inner.hidden.get(object));
        let port = port.ok_or_else(|| match entry {
            Some(entry) => entry.not_served(object, contract),
            None => DeliveryError::Unknown { name: object.to_string() },
        })?;
        Ok((port.identity.clone(), port.skeleton.clone()))
    }

    /// The node was shut down: whom an object is looked for is told so.
    pub(crate) fn shut_down(&self) {
        self.lock().is_shut_down = true;
    }

    /// What to say of a name that no object of this node has.
    pub(crate) fn misspelt(&self, name: &str) -> DeliveryError {
        self.lock().misspelt(name)
    }

    /// The node whose names these are, once that is known.
    pub(crate) fn node(&self) -> Option<NodeName> {
        self.lock().node.clone()
    }

    /// The object's name with its node's in front, where that is known.
    pub(crate) fn full_name(&self, object: &ObjectName) -> String {
        match &self.lock().node {
            Some(node) => format!("{node}:{object}"),
            None => object.to_string(),
        }
    }

    /// The object that is called so, and its node where that is another one.
    pub(crate) fn parse(&self, name: &str) -> Result<(Option<NodeName>, ObjectName), NameError> {
        if !name.contains(':') {
            return Ok((None, ObjectName::new(name)?));
        }
        let ObjectAddress { node, object } = name.parse()?;
        Ok((self.elsewhere(node), object))
    }

    /// This node, unless it is our own.
    pub(crate) fn elsewhere(&self, node: NodeName) -> Option<NodeName> {
        (self.lock().node.as_ref() != Some(&node)).then_some(node)
    }

    /// Tells by a greater number that names were given or taken away.
    pub(crate) fn revision(&self) -> u64 {
        self.lock().revision
    }

    /// All objects of this node, and the contracts that they take.
    pub(crate) fn objects(&self) -> Vec<(ObjectName, Vec<ContractIdentity>)> {
        let inner = self.lock();
        let identities = |entry: &Entry| entry.ports.values().map(|p| p.identity.clone()).collect();
        inner.objects.iter().map(|(name, entry)| (name.clone(), identities(entry))).collect()
    }

    /// The cell of the component of this name.
    pub(crate) fn cell(&self, object: &ObjectName) -> Option<Arc<dyn Any + Send + Sync>> {
        let watchable = self.lock().objects.get(object)?.watchable.clone();
        watchable.cell()
    }

    /// The type of the component of this name.
    pub(crate) fn component_type(&self, object: &ObjectName) -> Option<&'static str> {
        let inner = self.lock();
        inner.objects.get(object).and_then(|entry| entry.watchable.component_type())
    }

    /// The object of this name.
    pub(crate) fn watchable(&self, name: &str) -> Result<Arc<dyn Watchable>, DeliveryError> {
        let inner = self.lock();
        let object = ObjectName::new(name).ok();
        let entry = object.and_then(|object| inner.objects.get(&object));
        Ok(entry.ok_or_else(|| inner.misspelt(name))?.watchable.clone())
    }

    /// Tells `watcher` whenever an incarnation of an object of this name ends, and at once if none
    /// lives. Returns the object's last end.
    pub(crate) fn watch(&self, object: ObjectName, watcher: Watcher) -> Option<NumberedEnd> {
        let watcher = Arc::new(watcher);
        let is_known = !matches!(self.absence(&object), Some((_, DownReason::Unknown)));
        let last = match is_known || watcher.outlasts_object {
            true => self.deaths().join(&object, watcher.clone()),
            false => None,
        };
        // Joined first: what ends from here on is told.
        if let Some((incarnation, ending)) = self.absence(&object) {
            (watcher.tell)(Down { object, node: None, incarnation, ending });
        }
        last
    }

    /// The last incarnation of an object of this name, and why none is there, if so.
    fn absence(&self, object: &ObjectName) -> Option<(Incarnation, DownReason)> {
        let inner = self.lock();
        let watchable = inner.objects.get(object).map(|entry| entry.watchable.clone());
        let is_reserved = inner.reserved.contains_key(object);
        let actor = inner.deaths.actor(object);
        drop(inner);
        match (watchable, actor) {
            (Some(watchable), _) => Some((watchable.absent()?, DownReason::NotAlive)),
            (None, Some((_, true))) => None,
            (None, Some((incarnation, false))) => Some((incarnation, DownReason::NotAlive)),
            (None, None) if is_reserved => Some((Incarnation(0), DownReason::NotAlive)),
            (None, None) => Some((Incarnation(0), DownReason::Unknown)),
        }
    }

    /// The ends of all objects of this node.
    pub(crate) fn deaths(&self) -> Deaths {
        self.lock().deaths.clone()
    }

    /// The same names, for what they own themselves.
    pub(crate) fn downgrade(&self) -> WeakRegistry {
        WeakRegistry(Arc::downgrade(&self.0))
    }
}

/// The name of a supervisor, for as long as that is there.
pub(crate) struct ReservedName {
    registry: WeakRegistry,
    name: ObjectName,
}

impl Drop for ReservedName {
    fn drop(&mut self) {
        if let Some(registry) = self.registry.upgrade() {
            registry.lock().reserved.remove(&self.name);
        }
    }
}

/// The names of a node, which it does not keep.
#[derive(Clone)]
pub(crate) struct WeakRegistry(Weak<Mutex<Inner>>);

impl WeakRegistry {
    pub(crate) fn upgrade(&self) -> Option<Registry> {
        self.0.upgrade().map(Registry)
    }
}

/// Two contracts of one name that are not the same Rust type.
pub(crate) fn difference(known: &ContractIdentity, wanted: &ContractIdentity) -> String {
    match known.check(&wanted.full()) {
        Err(difference) => difference.to_string(),
        Ok(()) => "same name and structure, but two types: share one of them".to_owned(),
    }
}
