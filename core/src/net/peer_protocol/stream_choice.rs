//! Which stream of a session the messages of a contract take.

use crate::Delivery;
use crate::net::wire::segment::Stream;

/// The contracts that robots stand still without: commands and leases of actuators, what the
/// machines of services and of isolation say to their like, rosters, claims of names, and the watch
/// of an object of another node.
///
/// `blastema/serve` and the variables are not among them, for they carry what users send.
const CONTROL: [&str; 7] = [
    "blastema/actor-message",
    "blastema/await-end",
    "blastema/command",
    "blastema/replica",
    "blastema/service-terms",
    "blastema/votes",
    "blastema/who-serves",
];

/// The stream of a contract's messages and of the replies to them; `None` if only the newest
/// counts, which goes by none.
pub fn stream_of(contract: &str, delivery: Delivery) -> Option<Stream> {
    match delivery {
        Delivery::Newest => None,
        Delivery::Redundant => Some(Stream::Redundant),
        Delivery::Reliable if CONTROL.contains(&contract) => Some(Stream::Control),
        Delivery::Reliable => Some(Stream::Data),
    }
}
