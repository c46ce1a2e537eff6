//! What this node knows of the directory, readable on every thread.

use super::{ClaimRow, ClaimState, NodeRow};
use crate::platform::{self, lock};
use crate::registry::remote::NameResolver;
use actix::{Message, Recipient};
use blastema_core::directory::{ClaimRequest, DirectoryKey, Holder};
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{Incarnation, Instant, NodeName, ObjectAddress, ObjectName};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, OnceLock};
use tokio::sync::watch;

/// A request of an object of this node to the directory's actor.
#[derive(Message)]
#[rtype(result = "()")]
pub(crate) enum ClaimCommand {
    /// An object here claims a name.
    Claim {
        wanted: ClaimRequest,
        /// Which claim it is, of all that were ever made here; a component has one for all its
        /// incarnations.
        number: u64,
        state_sender: watch::Sender<ClaimState>,
        /// A component claims: no caller waits for the result, so a refusal is a fault.
        unattended: bool,
    },
    /// That claim is given back.
    Withdraw { name: ObjectName, number: u64 },
}

/// Who holds a name, as this node knows it.
#[derive(Clone, Debug)]
struct HolderRecord {
    holder: Holder,
    incarnation: Incarnation,
    since: Instant,
}

/// Another node, and what it has.
#[derive(Clone, Debug, Default)]
struct NodeEntry {
    incarnation: Incarnation,
    /// A session with it is open.
    open: bool,
    /// Its objects and publishers: as many as the machine takes.
    records: SortedSet<DirectoryKey>,
}

struct Inner {
    /// As many as the machine takes.
    known: Mutex<SortedMap<ObjectName, HolderRecord>>,
    nodes: Mutex<SortedMap<NodeName, NodeEntry>>,
    revision: watch::Sender<u64>,
    actor: OnceLock<Recipient<ClaimCommand>>,
    next: AtomicU64,
}

/// The objects and publishers of other nodes, and the names of the whole robot. Clones share them.
#[derive(Clone)]
pub(crate) struct DirectoryTable(Arc<Inner>);

impl Default for DirectoryTable {
    fn default() -> Self {
        let (revision, _) = watch::channel(0);
        let (known, nodes, actor) = Default::default();
        DirectoryTable(Arc::new(Inner { known, nodes, revision, actor, next: AtomicU64::new(1) }))
    }
}

impl NameResolver for DirectoryTable {
    fn holder(&self, name: &ObjectName) -> Option<Holder> {
        lock(&self.0.known).get(name).map(|known| known.holder.clone())
    }

    fn revision(&self) -> watch::Receiver<u64> {
        self.0.revision.subscribe()
    }
}

impl DirectoryTable {
    /// A session with this node has begun.
    pub(crate) fn note_opened(&self, node: NodeName, incarnation: Incarnation) {
        let mut nodes = lock(&self.0.nodes);
        let entry = nodes.entry(node).or_default();
        (entry.incarnation, entry.open) = (incarnation, true);
    }

    /// The session with this node has ended.
    pub(crate) fn note_ended(&self, node: &NodeName) {
        self.change(node, |entry| entry.open = false);
    }

    /// This node has an object, or a publisher.
    pub(crate) fn add(&self, node: NodeName, key: DirectoryKey) {
        lock(&self.0.nodes).entry(node).or_default().records.insert(key);
    }

    /// This node has it no more.
    pub(crate) fn remove(&self, node: &NodeName, key: &DirectoryKey) {
        self.change(node, |entry| {
            entry.records.remove(key);
        });
    }

    fn change(&self, node: &NodeName, change: impl FnOnce(&mut NodeEntry)) {
        let mut nodes = lock(&self.0.nodes);
        let Some(entry) = nodes.get_mut(node) else { return };
        change(entry);
        if !entry.open && entry.records.is_empty() {
            nodes.remove(node);
        }
    }

    /// The nodes with an open session that have this.
    pub(crate) fn nodes_with(&self, key: &DirectoryKey) -> Vec<NodeName> {
        let nodes = lock(&self.0.nodes);
        let having = nodes.iter().filter(|(_, entry)| entry.open && entry.records.contains(key));
        having.map(|(node, _)| node.clone()).collect()
    }

    /// Every node that a session is open with, and its objects.
    pub(crate) fn node_rows(&self) -> Vec<NodeRow> {
        let nodes = lock(&self.0.nodes);
        let open = nodes.iter().filter(|(_, entry)| entry.open);
        let row = |(node, entry): (&NodeName, &NodeEntry)| {
            let objects = entry.records.iter().filter_map(|key| match key {
                DirectoryKey::Object(object) => {
                    Some(ObjectAddress::new(node.clone(), object.clone()))
                }
                DirectoryKey::Publisher { .. } | DirectoryKey::Name(_) => None,
            });
            let (incarnation, objects) = (entry.incarnation, objects.collect());
            NodeRow { node: node.clone(), incarnation, objects }
        };
        open.map(row).collect()
    }

    /// Claims are made there from now on.
    pub(crate) fn lead_to(&self, actor: Recipient<ClaimCommand>) {
        // Called once, when the node starts.
        let _ = self.0.actor.set(actor);
    }

    /// The actor knows of another holder, or of none any more.
    pub(crate) fn note(&self, name: ObjectName, holder: Option<(Holder, Incarnation)>) {
        match holder {
            Some((holder, incarnation)) => {
                let since = platform::now();
                lock(&self.0.known).insert(name, HolderRecord { holder, incarnation, since });
            }
            None => drop(lock(&self.0.known).remove(&name)),
        }
        self.0.revision.send_modify(|revision| *revision += 1);
    }

    /// The actor restarts, and is told again.
    pub(crate) fn forget_all(&self) {
        lock(&self.0.known).clear();
        lock(&self.0.nodes).values_mut().for_each(|entry| entry.records.clear());
    }

    /// All of them.
    pub(crate) fn rows(&self) -> Vec<ClaimRow> {
        let now = platform::now();
        let row =
            |(name, HolderRecord { holder, incarnation, since }): (&ObjectName, &HolderRecord)| {
                ClaimRow {
                    name: name.clone(),
                    holder: holder.clone(),
                    incarnation: *incarnation,
                    age: now - *since,
                }
            };
        lock(&self.0.known).iter().map(row).collect()
    }

    /// The number of one more claim.
    pub(crate) fn number(&self) -> u64 {
        self.0.next.fetch_add(1, Relaxed)
    }

    /// Claims a name, and tells how that stands. A component's claim is unattended, and has the
    /// same number in all its incarnations.
    pub(crate) fn claim(
        &self,
        wanted: ClaimRequest,
        number: u64,
        unattended: bool,
    ) -> watch::Receiver<ClaimState> {
        let (state_sender, state) = watch::channel(ClaimState::Waiting);
        if let Some(actor) = self.0.actor.get() {
            actor.do_send(ClaimCommand::Claim { wanted, number, state_sender, unattended });
        }
        state
    }

    /// Gives it back.
    pub(crate) fn withdraw(&self, name: &ObjectName, number: u64) {
        if let Some(actor) = self.0.actor.get() {
            actor.do_send(ClaimCommand::Withdraw { name: name.clone(), number });
        }
    }
}
