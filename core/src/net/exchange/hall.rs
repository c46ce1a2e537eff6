//! How much waits for bindings that a peer has not agreed to yet.

/// The messages that should wait: one round trip's worth of a fast sender. Beyond, senders are told to stop.
pub(super) const MESSAGES: usize = 1024;
/// Their bytes, likewise: with what is on its way here meanwhile, a session takes all of it at once.
pub(super) const BYTES: usize = 1 << 20;
/// So many times as much waits at most, whatever senders were told.
const TIMES: usize = 4;

/// The count of what waits for all bindings to one peer.
#[derive(Debug, Default)]
pub(super) struct Hall {
    messages: usize,
    bytes: usize,
    is_full: bool,
}

/// Whether one more may wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Entrance {
    /// It may.
    Open,
    /// It may, and was the last that should: senders are to be told to stop.
    Closing,
    /// There is no room.
    Shut,
}

impl Hall {
    /// Counts one in, unless there is no room.
    pub(super) fn enter(&mut self, bytes: usize) -> Entrance {
        let (messages, bytes) = (self.messages + 1, self.bytes + bytes);
        if messages > TIMES * MESSAGES || bytes > TIMES * BYTES {
            return Entrance::Shut;
        }
        (self.messages, self.bytes) = (messages, bytes);
        if self.is_full || messages < MESSAGES && bytes < BYTES {
            return Entrance::Open;
        }
        self.is_full = true;
        Entrance::Closing
    }

    /// Counts out so many. Answers whether senders that were told to stop may go on.
    pub(super) fn leave(&mut self, messages: usize, bytes: usize) -> bool {
        self.messages -= messages;
        self.bytes -= bytes;
        let again = self.is_full && self.messages < MESSAGES && self.bytes < BYTES;
        self.is_full &= !again;
        again
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn few_large_messages_close_it_as_many_small_ones_do_and_it_opens_when_they_have_gone() {
        for (messages, each) in [(MESSAGES, 8), (4, BYTES / 4), (1, BYTES)] {
            let mut hall = Hall::default();
            for _ in 1..messages {
                assert_eq!(hall.enter(each), Entrance::Open);
            }
            assert_eq!(hall.enter(each), Entrance::Closing);
            for _ in 0..3 * messages {
                assert_eq!(hall.enter(each), Entrance::Open, "it was on its way");
            }
            assert_eq!(hall.enter(each), Entrance::Shut);

            assert!(!hall.leave(2 * messages, 2 * messages * each), "half has gone");
            assert!(hall.leave(2 * messages, 2 * messages * each));
            assert!(!hall.leave(0, 0), "it is told once");
        }
    }
}
