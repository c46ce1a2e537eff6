//! Heartbeats: the events by which a sender shows that it is there.

use crate::platform;
use crate::settings::{HEARTBEAT_INTERVAL, SettingError};
use crate::topic::Publisher;
use blastema_core::DeliveryError;
use blastema_macros::Event;
use std::time::Duration;

/// A sign of life on a topic. [`Connected::heartbeat`](crate::Connected::heartbeat) listens to it.
///
/// Of heartbeats on their way only the newest counts, and none is retransmitted: a gap in their
/// numbers is a loss.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Event)]
#[contract(crate = "crate", name = "blastema/heartbeat", version = 1, delivery = "newest")]
pub struct Heartbeat {
    /// One more than that of the sender's heartbeat before. Each sender begins with a number by
    /// chance, by which senders on one topic are told apart.
    pub sequence: u64,
    /// When it was sent, by the wall clock of its sender, in microseconds since 1970.
    pub stamp_us: u64,
}

impl Heartbeat {
    /// The heartbeat of this number, sent now.
    pub fn new(sequence: u64) -> Self {
        Heartbeat { sequence, stamp_us: platform::stamp_us() }
    }
}

/// Publishes heartbeats until it is dropped.
///
/// # Errors
/// The interval is out of range.
pub(crate) fn publish(
    publisher: Publisher<Heartbeat>,
    interval: Duration,
) -> Result<impl Future<Output = ()>, DeliveryError> {
    let refused = |error: SettingError| DeliveryError::CheckFailed { reason: error.to_string() };
    HEARTBEAT_INTERVAL.check(interval).map_err(refused)?;
    Ok(async move {
        // As many again are left to count.
        for sequence in platform::random_seed() / 2.. {
            // An incarnation that was fenced off gives no sign of life.
            if publisher.publish(Heartbeat::new(sequence)).is_err() {
                return;
            }
            platform::sleep(interval).await;
        }
    })
}
