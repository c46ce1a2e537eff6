//! How far a hub has come with the events that it gives to its listeners.

use crate::sync::atomic::AtomicU64;
use crate::sync::atomic::Ordering::Relaxed;

/// How far a hub has come with a batch. Other threads read it, so that it is one word.
#[derive(Default)]
pub(super) struct BatchPosition(AtomicU64);

/// What a [`BatchPosition`] says.
pub(super) struct BatchProgress {
    /// The last entry that was offered the batch; entries have their turn by rising numbers.
    pub(super) entry: u64,
    /// How many of the events that entry has begun.
    pub(super) begun: usize,
    /// That entry's condition has not decided on the last of them.
    pub(super) is_undecided: bool,
}

impl BatchPosition {
    /// The lowest bit is `is_undecided`, and 24 bits are `begun`: a listener brings some thousand
    /// events along at most.
    const STEP: u64 = 1 << 1;
    const ENTRY_SHIFT: u32 = 25;

    #[inline]
    pub(super) fn read(&self) -> BatchProgress {
        let word = self.0.load(Relaxed);
        let entry = word >> Self::ENTRY_SHIFT;
        let begun = (word & ((1 << Self::ENTRY_SHIFT) - 1)) / Self::STEP;
        BatchProgress { entry, begun: begun as usize, is_undecided: word & 1 > 0 }
    }

    /// This entry has its turn. Like the other changes, this is a plain store: the hub is the only
    /// writer.
    #[inline]
    pub(super) fn begin(&self, entry: u64) {
        self.0.store(entry << Self::ENTRY_SHIFT, Relaxed);
    }

    #[inline]
    pub(super) fn step(&self) {
        self.0.store(self.0.load(Relaxed) + Self::STEP, Relaxed);
    }

    pub(super) fn set_undecided(&self, is_undecided: bool) {
        self.0.store(self.0.load(Relaxed) & !1 | u64::from(is_undecided), Relaxed);
    }
}
