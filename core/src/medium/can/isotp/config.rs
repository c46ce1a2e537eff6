//! How messages are cut into frames, and how long everything may take.

use super::super::frame::Format;
use super::pdu::SeparationTime;
use std::time::Duration;

/// How long the other end, and the bus, may take: for the word on how to go on (N_Bs), for the next
/// frame of a message (N_Cr), and for the bus to take a frame (N_As, N_Ar). ISO 15765-2 puts each
/// at one second; less breaks transfers on a bus that is full for a while.
pub(super) const TIMEOUT: Duration = Duration::from_secs(1);

/// How an [`IsoTp`](super::IsoTp) behaves.
#[derive(Clone, Copy, Debug)]
#[non_exhaustive]
pub struct IsoTpConfig {
    /// Classic or FD, for what is sent; both are understood.
    pub format: Format,
    /// The longest message, both ways. Longer ones keep others, and hellos, waiting longer behind
    /// them.
    pub message_max: usize,
    /// How many messages wait for each target; beyond, they are dropped.
    pub queue_messages: usize,
    /// How many messages may be under way to us at one time; the senders of others are told that
    /// they are too long. With `message_max` it bounds the memory that a flood can take.
    pub receptions_max: usize,
    /// After so many frames our senders wait for our next word; 0 for never. Smaller gives a slow
    /// receiver more to say, and costs a round trip each time.
    pub block_size: u8,
    /// The least time that our senders leave between frames (STmin). Larger spares a slow receiver,
    /// and slows every long message down.
    pub separation: SeparationTime,
}

impl Default for IsoTpConfig {
    fn default() -> Self {
        IsoTpConfig {
            format: Format::Classic,
            // 147 classic frames: 35 ms of a bus of 500 kbit/s.
            message_max: 1024,
            // What a busy object says in a second; more would only be older when it is out.
            queue_messages: 64,
            receptions_max: 64,
            block_size: 0,
            separation: SeparationTime(0),
        }
    }
}
