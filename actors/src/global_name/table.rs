//! The holders of global names known to this node, readable on every thread.

use super::{ClaimRow, ClaimState};
use crate::platform;
use crate::registry::lookup::NameResolver;
use actix::{Message, Recipient};
use blastema_core::global_name::{ClaimRequest, Holder};
use blastema_core::sorted::SortedMap;
use blastema_core::{Incarnation, Instant, ObjectName};
use std::sync::atomic::AtomicU64;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tokio::sync::watch;

/// What is wanted of the body.
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

struct Inner {
    /// As many as the machine takes.
    known: Mutex<SortedMap<ObjectName, HolderRecord>>,
    revision: watch::Sender<u64>,
    body: OnceLock<Recipient<ClaimCommand>>,
    next: AtomicU64,
}

/// The names of the whole robot. Clones share them.
#[derive(Clone)]
pub(crate) struct GlobalNameTable(Arc<Inner>);

impl Default for GlobalNameTable {
    fn default() -> Self {
        let (revision, _) = watch::channel(0);
        let (known, body, next) = (Mutex::default(), OnceLock::new(), AtomicU64::new(1));
        GlobalNameTable(Arc::new(Inner { known, revision, body, next }))
    }
}

impl NameResolver for GlobalNameTable {
    fn holder(&self, name: &ObjectName) -> Option<Holder> {
        self.lock().get(name).map(|known| known.holder.clone())
    }

    fn revision(&self) -> watch::Receiver<u64> {
        self.0.revision.subscribe()
    }
}

impl GlobalNameTable {
    fn lock(&self) -> MutexGuard<'_, SortedMap<ObjectName, HolderRecord>> {
        self.0.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Claims are made there from now on.
    pub(crate) fn lead_to(&self, body: Recipient<ClaimCommand>) {
        // Called once, when the node starts.
        let _ = self.0.body.set(body);
    }

    /// The body knows of another holder, or of none any more.
    pub(crate) fn note(&self, name: ObjectName, holder: Option<(Holder, Incarnation)>) {
        match holder {
            Some((holder, incarnation)) => {
                let since = platform::now();
                self.lock().insert(name, HolderRecord { holder, incarnation, since });
            }
            None => drop(self.lock().remove(&name)),
        }
        self.0.revision.send_modify(|revision| *revision += 1);
    }

    /// The actor restarts.
    pub(crate) fn forget_all(&self) {
        self.lock().clear();
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
        self.lock().iter().map(row).collect()
    }

    /// The number of one more claim.
    pub(crate) fn number(&self) -> u64 {
        self.0.next.fetch_add(1, Relaxed)
    }

    /// Claims a name, and tells how that stands.
    pub(crate) fn claim(&self, wanted: ClaimRequest, number: u64) -> watch::Receiver<ClaimState> {
        self.wish(wanted, number, false)
    }

    /// Claims a name for a component, whose incarnations have the same number.
    pub(crate) fn claim_unattended(&self, wanted: ClaimRequest, number: u64) {
        drop(self.wish(wanted, number, true));
    }

    fn wish(
        &self,
        wanted: ClaimRequest,
        number: u64,
        unattended: bool,
    ) -> watch::Receiver<ClaimState> {
        let (state_sender, state) = watch::channel(ClaimState::Waiting);
        if let Some(body) = self.0.body.get() {
            body.do_send(ClaimCommand::Claim { wanted, number, state_sender, unattended });
        }
        state
    }

    /// Gives it back.
    pub(crate) fn withdraw(&self, name: &ObjectName, number: u64) {
        if let Some(body) = self.0.body.get() {
            body.do_send(ClaimCommand::Withdraw { name: name.clone(), number });
        }
    }
}
