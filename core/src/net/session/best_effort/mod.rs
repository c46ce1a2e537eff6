//! Messages that are sent once, if at all: of one channel, the newest that arrives counts.

mod inbound;
mod outbound;

pub(crate) use self::inbound::{BestEffortInbound, DatagramStatus};
pub(crate) use self::outbound::{BestEffortOutbound, DatagramProgress};
