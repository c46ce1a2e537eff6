//! What shares capacity on its way to another node, and what goes first.

use super::Delivery;
use serde::{Deserialize, Serialize};
use std::fmt;

/// The traffic class of a message between nodes (IEEE 802.1Q, DiffServ).
///
/// From its sender to the peer's session each class has capacity of its own, so that no class fills
/// that of another. In a session each has its own ordered stream; messages of different classes
/// overtake each other. Control goes first, redundant messages take every path at once, and the
/// others share what is left by their [weights](TrafficClass::WEIGHTED).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum TrafficClass {
    /// What keeps the robot together: bindings, faults, commands, leases.
    Control,
    /// What is sent over every path at once: contracts with [`Delivery::Redundant`].
    Redundant,
    /// What the replicas of a service say to each other: hellos, and the state.
    Replication,
    /// Messages to objects, and replies.
    Request,
    /// Events of topics.
    Event,
    /// What may wait: images, maps, recordings.
    Bulk,
}

/// The contract of replicas.
const REPLICATION: &str = "blastema/replica";
/// The contracts that robots stand still without: commands and leases of actuators, who serves,
/// faults for a recoverer, and the watch of an object of another node.
/// All of them are small.
///
/// `blastema/serve` and the variables are not among them, for they carry what users send.
const CONTROL: [&str; 5] = [
    "blastema/await-end",
    "blastema/command",
    "blastema/recover",
    "blastema/service-configuration",
    "blastema/who-serves",
];

impl TrafficClass {
    /// How many there are.
    pub const COUNT: usize = 6;
    /// All, in the order of their numbers.
    pub const ALL: [TrafficClass; Self::COUNT] = [
        TrafficClass::Control,
        TrafficClass::Redundant,
        TrafficClass::Replication,
        TrafficClass::Request,
        TrafficClass::Event,
        TrafficClass::Bulk,
    ];
    /// Those that share a path, and by how many parts each: where requests, events and bulk wait,
    /// four parts of seven are of requests, two of events and one of bulk.
    pub const WEIGHTED: [(TrafficClass, i32); 4] = [
        (TrafficClass::Replication, 8),
        (TrafficClass::Request, 4),
        (TrafficClass::Event, 2),
        (TrafficClass::Bulk, 1),
    ];

    /// The class of messages of this contract to an object, and of the replies to them.
    pub fn of_message(contract: &str, delivery: Delivery, bulk: bool) -> Self {
        match delivery {
            Delivery::Redundant => TrafficClass::Redundant,
            Delivery::Reliable if CONTROL.contains(&contract) => TrafficClass::Control,
            Delivery::Reliable if contract == REPLICATION => TrafficClass::Replication,
            _ if bulk => TrafficClass::Bulk,
            _ => TrafficClass::Request,
        }
    }

    /// The class of events of a topic.
    pub fn of_event(delivery: Delivery, bulk: bool) -> Self {
        match delivery {
            Delivery::Redundant => TrafficClass::Redundant,
            _ if bulk => TrafficClass::Bulk,
            _ => TrafficClass::Event,
        }
    }

    /// It shares the path with others by its weight.
    pub fn is_weighted(self) -> bool {
        !matches!(self, TrafficClass::Control | TrafficClass::Redundant)
    }
}

impl fmt::Display for TrafficClass {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            TrafficClass::Control => "control messages",
            TrafficClass::Redundant => "redundant messages",
            TrafficClass::Replication => "what replicas say",
            TrafficClass::Request => "requests",
            TrafficClass::Event => "events",
            TrafficClass::Bulk => "bulk",
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn delivery_decides_before_bulk_and_commands_are_control() {
        use TrafficClass::*;
        assert_eq!(TrafficClass::of_message("map", Delivery::Reliable, true), Bulk);
        assert_eq!(TrafficClass::of_message("map", Delivery::Newest, false), Request);
        assert_eq!(TrafficClass::of_message("stop", Delivery::Redundant, true), Redundant);
        assert_eq!(TrafficClass::of_message("blastema/command", Delivery::Reliable, true), Control);
        let replica = TrafficClass::of_message("blastema/replica", Delivery::Reliable, false);
        assert_eq!(replica, Replication);
        assert_eq!(TrafficClass::of_event(Delivery::Reliable, false), Event);
        assert_eq!(TrafficClass::of_event(Delivery::Newest, true), Bulk);
        assert_eq!(TrafficClass::of_event(Delivery::Redundant, true), Redundant);
    }
}
