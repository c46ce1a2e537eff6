//! How messages are cut into frames, and how long everything may take.

use super::super::frame::Format;
use super::pdu::SeparationTime;
use std::time::Duration;

/// How an [`IsoTp`](super::IsoTp) behaves. The times in brackets are called so in ISO 15765-2,
/// which puts each of them at one second.
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
    /// The least time between frames to all nodes, which do not say how fast they are.
    pub separation_to_all: Duration,
    /// How long a receiver may take for its word on how to go on (N_Bs). A node that is not there
    /// is noticed after this long; on a slow bus that others use, words take longer.
    pub flow_timeout: Duration,
    /// How long the next frame of a message may take (N_Cr).
    pub frame_timeout: Duration,
    /// How long a frame may wait for the bus to take it (N_As, N_Ar). A bus without another
    /// node never takes one.
    pub bus_timeout: Duration,
    /// How often in a row a receiver may let us wait (N_WFTmax): no sender waits for ever.
    pub waits_max: u8,
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
            // Slower than a classic frame on a bus of 250 kbit/s, so that no receiver's buffer
            // overflows.
            separation_to_all: Duration::from_micros(500),
            // As the standard has them: shorter ones break transfers on a bus that is full for a
            // while.
            flow_timeout: Duration::from_secs(1),
            frame_timeout: Duration::from_secs(1),
            bus_timeout: Duration::from_secs(1),
            waits_max: 10,
        }
    }
}
