//! How a session behaves.

use crate::{Incarnation, NodeName};
use std::time::Duration;

/// The default idle timeout: how long a peer may leave segments unacknowledged, or be without a
/// path.
pub const IDLE_TIMEOUT: Duration = Duration::from_secs(2);
/// A mebibyte of the application's, and what says whose it is.
const MESSAGE_MAX: usize = (1 << 20) + 4096;
/// What an exchange puts before a message at most: its kind, four numbers and an identity.
const HEADER_MAX: usize = 64;

/// How many parts of a stream may be on their way, and may arrive ahead of their turn.
pub(super) const WINDOW: u32 = 256;
/// The largest part in bytes, however large the path's frames are: larger costs less per byte,
/// smaller lets control through sooner.
pub(super) const CHUNK_MAX: usize = 64 * 1024;
/// How long an acknowledgement may wait for something to travel with.
pub(super) const ACK_DELAY: Duration = Duration::from_millis(2);

/// The most bytes of a message of the application's that a session carries.
pub const PAYLOAD_MAX: usize = MESSAGE_MAX - HEADER_MAX;

/// How a session behaves.
#[derive(Clone, Debug)]
pub struct SessionConfig {
    /// Our own name.
    pub node: NodeName,
    /// Our own incarnation.
    pub incarnation: Incarnation,
    /// The peer's name.
    pub peer: NodeName,
    /// Sessions of this machine are numbered above this. A machine that is rebuilt within one
    /// incarnation of its node must be given a greater number than the one before ever used.
    pub number: u32,
    /// Of the system's random source. No other node can compute the tags of this machine's
    /// sessions.
    pub seed: u64,
    /// How long the peer may owe an answer, or be without a path, before the session ends. Longer
    /// rides out longer outages; shorter gives messages back sooner. While there is a path whose
    /// answers take long, it is three of the present timeouts instead, if these are longer.
    pub idle_timeout: Duration,
    /// The most bytes of one message. Bounds what a peer can make us collect.
    pub message_max: usize,
    /// The bytes of messages that may wait or be unacknowledged in one stream. Beyond, those
    /// without credit are refused.
    pub buffer_bytes: usize,
    /// The number of messages, likewise.
    pub buffer_messages: usize,
    /// The most best-effort channels of the peer that are remembered: those that were used last.
    pub channels_max: usize,
}

impl SessionConfig {
    /// The usual behaviour between these two.
    pub fn new(node: NodeName, incarnation: Incarnation, peer: NodeName) -> Self {
        SessionConfig {
            node,
            incarnation,
            peer,
            number: 0,
            seed: 0,
            idle_timeout: IDLE_TIMEOUT,
            message_max: MESSAGE_MAX,
            // Eight of the largest messages, or a second of 1 kB at 8 kHz.
            buffer_bytes: 8 << 20,
            buffer_messages: 8192,
            channels_max: 1024,
        }
    }
}
