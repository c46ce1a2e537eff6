//! What this node knows of the directory, readable on every thread.

use super::{ClaimRow, ClaimState, NodeRow};
use crate::platform::{self, lock};
use crate::registry::remote::NameResolver;
use actix::{Message, Recipient};
use blastema_core::directory::{ClaimRequest, Directory, DirectoryKey, DirectoryOutput, Holder};
use blastema_core::{Instant, Machine, NodeName, ObjectAddress, ObjectName};
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

struct Inner {
    /// That of the actor, which alone changes it; `None` until the actor has started.
    machine: Mutex<Option<Directory>>,
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
        let (machine, actor) = Default::default();
        DirectoryTable(Arc::new(Inner { machine, revision, actor, next: AtomicU64::new(1) }))
    }
}

impl NameResolver for DirectoryTable {
    fn holder(&self, name: &ObjectName) -> Option<Holder> {
        self.read(|directory| directory.holder(name))
    }

    fn revision(&self) -> watch::Receiver<u64> {
        self.0.revision.subscribe()
    }
}

/// The machine, as its actor drives it.
impl Machine for DirectoryTable {
    type Output = DirectoryOutput;

    fn poll_output(&mut self) -> Option<DirectoryOutput> {
        self.change(Directory::poll_output)
    }

    fn poll_timeout(&self) -> Option<Instant> {
        self.read(Directory::poll_timeout)
    }

    fn handle_timeout(&mut self, now: Instant) {
        self.change(|directory| directory.handle_timeout(now));
    }
}

impl DirectoryTable {
    /// The actor is about to begin, with this machine.
    pub(super) fn begin(&self, machine: Directory) {
        *lock(&self.0.machine) = Some(machine);
    }

    /// The actor has begun, and takes claims.
    pub(super) fn lead_to(&self, actor: Recipient<ClaimCommand>) {
        // Called once, when the node starts.
        let _ = self.0.actor.set(actor);
    }

    /// The machine has panicked: another is built of what it knew.
    pub(super) fn rebuild(&self) {
        let mut machine = lock(&self.0.machine);
        *machine = machine.take().map(|lost| lost.rebuilt(platform::now()));
    }

    /// Asks the machine.
    pub(super) fn read<T: Default>(&self, ask: impl FnOnce(&Directory) -> T) -> T {
        lock(&self.0.machine).as_ref().map(ask).unwrap_or_default()
    }

    /// Feeds the machine.
    pub(super) fn change<T>(&self, feed: impl FnOnce(&mut Directory) -> T) -> T {
        feed(lock(&self.0.machine).as_mut().expect("its actor has started"))
    }

    /// Another object holds a name, or none any more.
    pub(super) fn holder_changed(&self) {
        self.0.revision.send_modify(|revision| *revision += 1);
    }

    /// The nodes that can be reached and have this.
    pub(crate) fn nodes_with(&self, key: &DirectoryKey) -> Vec<NodeName> {
        self.read(|directory| directory.nodes_with(key))
    }

    /// Every node that can be reached, and its objects.
    pub(crate) fn node_rows(&self) -> Vec<NodeRow> {
        self.read(|directory| {
            let rows = directory.nodes().map(|(node, incarnation, keys)| {
                let objects = keys.filter_map(|key| match key {
                    DirectoryKey::Object(object) => {
                        Some(ObjectAddress::new(node.clone(), object.clone()))
                    }
                    DirectoryKey::Publisher { .. } | DirectoryKey::Name(_) => None,
                });
                NodeRow { node: node.clone(), incarnation, objects: objects.collect() }
            });
            rows.collect()
        })
    }

    /// Every name that is held.
    pub(crate) fn rows(&self) -> Vec<ClaimRow> {
        let now = platform::now();
        self.read(|directory| {
            let rows = directory.holders().map(|(name, holder, since)| ClaimRow {
                name: name.clone(),
                holder: holder.clone(),
                incarnation: directory.incarnation_of(&holder.node),
                age: now - since,
            });
            rows.collect()
        })
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
