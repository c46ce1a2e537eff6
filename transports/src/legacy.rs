//! What one life of a transport leaves to the next.

use blastema_contract::transport::{Attach, TransportCounters};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

/// Shared between a transport and the factory that would build its successor.
#[derive(Clone, Default)]
pub(crate) struct Legacy(Arc<Inheritance>);

#[derive(Default)]
struct Inheritance {
    attach: Mutex<Option<Attach>>,
    #[cfg(any(feature = "udp", feature = "tcp"))]
    local: Mutex<Option<std::net::SocketAddr>>,
    counts: [AtomicU64; 5],
}

/// One of the counters of [`TransportCounters`].
#[derive(Clone, Copy)]
pub(crate) enum Count {
    Sent,
    Received,
    Dropped,
    Refused,
    Errors,
}

impl Legacy {
    /// Who was attached last.
    pub(crate) fn attached(&self) -> Option<Attach> {
        // A panic while the lock was held leaves a whole value behind: it is only ever replaced.
        self.0.attach.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    pub(crate) fn remember_attached(&self, attach: &Attach) {
        *self.0.attach.lock().unwrap_or_else(PoisonError::into_inner) = Some(attach.clone());
    }

    /// The address that was taken last: peers know it, so the next life wants the same.
    #[cfg(any(feature = "udp", feature = "tcp"))]
    pub(crate) fn local(&self) -> Option<std::net::SocketAddr> {
        *self.0.local.lock().unwrap_or_else(PoisonError::into_inner)
    }

    #[cfg(any(feature = "udp", feature = "tcp"))]
    pub(crate) fn remember_local(&self, local: std::net::SocketAddr) {
        *self.0.local.lock().unwrap_or_else(PoisonError::into_inner) = Some(local);
    }

    pub(crate) fn count(&self, count: Count) {
        self.count_many(count, 1);
    }

    pub(crate) fn count_many(&self, count: Count, by: usize) {
        self.0.counts[count as usize].fetch_add(by as u64, Ordering::Relaxed);
    }

    pub(crate) fn counters(&self) -> TransportCounters {
        let read = |count: Count| self.0.counts[count as usize].load(Ordering::Relaxed);
        let mut counters = TransportCounters::default();
        counters.sent = read(Count::Sent);
        counters.received = read(Count::Received);
        counters.dropped = read(Count::Dropped);
        counters.refused = read(Count::Refused);
        counters.errors = read(Count::Errors);
        counters
    }
}
