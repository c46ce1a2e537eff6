//! What the threads of one incarnation share, so that none of them acts after its end.

use crate::sync::atomic::AtomicBool;
use crate::sync::atomic::Ordering::Relaxed;
use blastema_core::DeliveryError;

/// Says to every thread whether an incarnation still lasts and may speak.
#[derive(Debug, Default)]
pub(crate) struct IncarnationToken {
    ended: AtomicBool,
    muted: AtomicBool,
}

impl IncarnationToken {
    pub(crate) fn end(&self) {
        self.ended.store(true, Relaxed);
    }

    #[inline]
    pub(crate) fn has_ended(&self) -> bool {
        self.ended.load(Relaxed)
    }

    pub(crate) fn mute(&self, muted: bool) {
        self.muted.store(muted, Relaxed);
    }

    #[inline]
    pub(crate) fn is_muted(&self) -> bool {
        self.muted.load(Relaxed)
    }

    /// Why this incarnation may send nothing, if that is so.
    pub(crate) fn forbidden(&self) -> Option<DeliveryError> {
        match (self.has_ended(), self.is_muted()) {
            (true, _) => Some(DeliveryError::Fenced),
            (false, true) => Some(DeliveryError::SenderIsolated),
            (false, false) => None,
        }
    }
}
