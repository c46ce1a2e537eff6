//! How much waits for bindings that a peer has not agreed to yet.

use crate::net::session::size_class::SizeClass;

/// The messages that should wait: one round trip's worth of a fast sender. Beyond, senders are told
/// to stop.
pub(super) const MESSAGES: usize = 1024;
/// The bytes of small ones, likewise; of bulk half as many, beside them: for it that is one round
/// trip's worth, and the first large one closes the budget in any case.
const BYTES: usize = 1 << 20;
/// So many times as much of either waits at most, whatever senders were told: what should, the one
/// that was too much, and what is on its way here meanwhile, by two ways (`redundant` has its own)
/// of 1 MiB and one message more each. Of bulk that is at most 1/2 + 1 + 2 * (1 + 1) MiB; of
/// messages 1024 + 2 * 2048.
pub(super) const TIMES: usize = 6;

/// The count of what waits for all bindings to one peer.
#[derive(Debug, Default)]
pub(super) struct PendingBudget {
    /// Of what is small, and of bulk.
    halves: [Half; 2],
}

#[derive(Debug, Default)]
struct Half {
    messages: usize,
    bytes: usize,
    is_full: bool,
}

/// Whether one more may wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum BudgetVerdict {
    /// It may.
    Open,
    /// It may, and was the last of its load that should: senders are to be told to stop.
    Closing(SizeClass),
    /// There is no room.
    Shut(SizeClass),
}

impl PendingBudget {
    /// Counts one in, unless there is no room.
    pub(super) fn enter(&mut self, bytes: usize) -> BudgetVerdict {
        let load = SizeClass::of(bytes);
        let half = &mut self.halves[load as usize];
        let (messages, bytes) = (half.messages + 1, half.bytes + bytes);
        if messages > TIMES * MESSAGES || bytes > TIMES * BYTES {
            return BudgetVerdict::Shut(load);
        }
        (half.messages, half.bytes) = (messages, bytes);
        if half.is_full || half.has_capacity(load) {
            return BudgetVerdict::Open;
        }
        half.is_full = true;
        BudgetVerdict::Closing(load)
    }

    /// Counts out messages of so many bytes each. Answers with what senders that were told to stop
    /// may go on.
    pub(super) fn leave(&mut self, all: impl Iterator<Item = usize>) -> Vec<SizeClass> {
        for bytes in all {
            let half = &mut self.halves[SizeClass::of(bytes) as usize];
            half.messages -= 1;
            half.bytes -= bytes;
        }
        let halves = SizeClass::ALL.into_iter().zip(&mut self.halves);
        let mut again: Vec<_> =
            halves.filter(|(load, half)| half.is_full && half.has_capacity(*load)).collect();
        again.iter_mut().for_each(|(_, half)| half.is_full = false);
        again.into_iter().map(|(load, _)| load).collect()
    }
}

impl Half {
    fn has_capacity(&self, load: SizeClass) -> bool {
        let bytes = match load {
            SizeClass::Small => BYTES,
            SizeClass::Bulk => BYTES / 2,
        };
        self.messages < MESSAGES && self.bytes < bytes
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_large_messages_close_it_as_many_small_ones_do_and_it_opens_when_they_have_gone() {
        let (small, bulk) = (SizeClass::Small, SizeClass::Bulk);
        for (load, messages, each) in [
            (small, MESSAGES, 8),
            (small, 64, BYTES / 64),
            (bulk, 4, BYTES / 8),
            (bulk, 2, BYTES / 4),
        ] {
            let mut budget = PendingBudget::default();
            for _ in 1..messages {
                assert_eq!(budget.enter(each), BudgetVerdict::Open);
            }
            assert_eq!(budget.enter(each), BudgetVerdict::Closing(load));
            for _ in 0..(TIMES - 1) * messages {
                assert_eq!(budget.enter(each), BudgetVerdict::Open, "it was on its way");
            }

            let half = || std::iter::repeat_n(each, TIMES / 2 * messages);
            assert_eq!(budget.leave(half()), [], "half has gone");
            assert_eq!(budget.leave(half()), [load]);
            assert_eq!(budget.leave(std::iter::empty()), [], "it is told once");
        }
    }

    #[test]
    fn what_is_on_its_way_when_senders_are_told_to_stop_has_room() {
        let mut budget = PendingBudget::default();
        assert_eq!(budget.enter(BYTES / 2 - 1), BudgetVerdict::Open);
        assert_eq!(budget.enter(1 << 20), BudgetVerdict::Closing(SizeClass::Bulk));
        for n in 1..=4 {
            assert_eq!(budget.enter(1 << 20), BudgetVerdict::Open, "{n} MiB were on their way");
        }
    }

    #[test]
    fn what_is_small_enters_however_much_bulk_waits_and_the_other_way_round() {
        let mut budget = PendingBudget::default();
        let fill = |budget: &mut PendingBudget, each| {
            while !matches!(budget.enter(each), BudgetVerdict::Shut(_)) {}
        };
        fill(&mut budget, BYTES);
        assert_eq!(budget.enter(20), BudgetVerdict::Open);

        fill(&mut budget, SizeClass::SMALL_MAX);
        assert_eq!(budget.enter(BYTES), BudgetVerdict::Shut(SizeClass::Bulk));
        assert_eq!(budget.leave([BYTES; TIMES].into_iter()), [SizeClass::Bulk]);
        assert_eq!(budget.enter(BYTES), BudgetVerdict::Closing(SizeClass::Bulk));
    }
}
