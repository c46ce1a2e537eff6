//! The watch: who hangs, who waits too long, who is silent.

use super::pulse::Pulse;
use super::spec::Limits;
use super::stamp::Stamp;
use blastema_core::ObjectName;
use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

/// One component as the watch sees it.
pub(crate) struct Watched {
    pub(crate) object: ObjectName,
    pub(crate) pulse: Arc<Pulse>,
    pub(crate) stamp: &'static Stamp,
    pub(crate) limits: Limits,
}

/// Everything that is to be watched. Clones share it.
#[derive(Clone, Default)]
pub(crate) struct WatchList(Arc<Mutex<BTreeMap<u32, Watched>>>);

impl WatchList {
    pub(crate) fn enter(&self, slot: u32, watched: Watched) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).insert(slot, watched);
    }

    pub(crate) fn leave(&self, slot: u32) {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).remove(&slot);
    }
}
