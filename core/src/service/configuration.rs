//! The part of a service's configuration that must be equal on all nodes that carry it.

use super::change::checksum;
use super::{HEARTBEAT_MAX, HEARTBEAT_MIN, MEMBERS_MAX, OnPartition, ReplicaConfig, StandbyKind};
use crate::NodeName;
use crate::contract::codec;
use serde::{Deserialize, Serialize};
use std::fmt::Debug;
use std::time::Duration;

/// The most bytes of a configuration: the longest list, with names of the greatest length.
pub(super) const CONFIGURATION_BYTES_MAX: usize = 2048;

/// The settings that the safety of an election depends on. Members that count majorities of
/// different lists, or leases of different lengths, can elect two primaries.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ServiceConfiguration {
    members: Vec<NodeName>,
    kind: StandbyKind,
    on_partition: OnPartition,
    heartbeat_interval: Duration,
}

impl ServiceConfiguration {
    pub(super) fn of(config: &ReplicaConfig) -> Self {
        let ReplicaConfig { members, kind, on_partition, heartbeat_interval, .. } = config.clone();
        ServiceConfiguration { members, kind, on_partition, heartbeat_interval }
    }

    pub(super) fn lists(&self, node: &NodeName) -> bool {
        self.members.contains(node)
    }

    /// Returns whether a primary with this configuration goes on when it meets one with the other:
    /// the longer list leads.
    pub(super) fn leads(&self, theirs: &ServiceConfiguration) -> bool {
        let rank = |config: &ServiceConfiguration| {
            let stops = config.on_partition == OnPartition::Stop;
            (stops, config.members.len(), config.fingerprint())
        };
        rank(self) > rank(theirs)
    }

    pub(super) fn encode(&self) -> Vec<u8> {
        codec::encode_unbounded(self)
    }

    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let decoded = codec::decode_bounded::<Self, CONFIGURATION_BYTES_MAX>(bytes).ok();
        decoded.filter(|configuration| {
            (HEARTBEAT_MIN..=HEARTBEAT_MAX).contains(&configuration.heartbeat_interval)
                && configuration.members.len() <= MEMBERS_MAX
        })
    }

    /// Returns a checksum that is the same for equal configurations on every node.
    pub(super) fn fingerprint(&self) -> u64 {
        checksum(&self.encode())
    }

    /// Returns how the configuration of `node` differs, and what to write; empty if they are equal.
    pub(super) fn difference(&self, node: &NodeName, theirs: &ServiceConfiguration) -> String {
        let differ = |what: &str, here: &dyn Debug, there: &dyn Debug, write: &str| {
            format!("{what} {here:?} here and {there:?} on {node}: write {write} on both")
        };
        let mut texts = Vec::new();
        if self.members != theirs.members {
            let (here, there) = (names(&self.members), names(&theirs.members));
            let (long, short) =
                if here.len() >= there.len() { (&here, &there) } else { (&there, &here) };
            let more = short.iter().filter(|name| !long.contains(name));
            let all: Vec<_> = long.iter().chain(more).collect();
            let write = format!("the same list, such as {all:?},");
            texts.push(differ("its nodes are", &here, &there, &write));
        }
        if self.kind != theirs.kind {
            let (here, there) = (self.kind, theirs.kind);
            let write = format!(".standby(StandbyKind::{here:?}) or (StandbyKind::{there:?})");
            texts.push(differ("its standbys are", &here, &there, &write));
        }
        if self.on_partition != theirs.on_partition {
            let (here, there) = (self.on_partition, theirs.on_partition);
            let write = format!(".on_partition(OnPartition::{here:?}) or (OnPartition::{there:?})");
            texts.push(differ("without a majority its rule is", &here, &there, &write));
        }
        if self.heartbeat_interval != theirs.heartbeat_interval {
            let (here, there) = (self.heartbeat_interval, theirs.heartbeat_interval);
            let write = "the same .heartbeat_every(..)";
            texts.push(differ("its primary sends a heartbeat every", &here, &there, write));
        }
        texts.join("; ")
    }
}

fn names(nodes: &[NodeName]) -> Vec<&str> {
    nodes.iter().map(NodeName::as_str).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn configuration(members: &[&str]) -> ServiceConfiguration {
        ServiceConfiguration {
            members: members.iter().map(|name| NodeName::new(name).unwrap()).collect(),
            kind: StandbyKind::Warm,
            on_partition: OnPartition::Stop,
            heartbeat_interval: Duration::from_millis(50),
        }
    }

    #[test]
    fn the_difference_of_two_configurations_is_shown_with_what_to_write() {
        let n2 = NodeName::new("n2").unwrap();
        let (ours, theirs) = (configuration(&["n1"]), configuration(&["n2", "n1", "n3"]));
        assert_eq!(
            ours.difference(&n2, &theirs),
            "its nodes are [\"n1\"] here and [\"n2\", \"n1\", \"n3\"] on n2: write the same list, such as \
             [\"n2\", \"n1\", \"n3\"], on both"
        );
        let hot = ServiceConfiguration { kind: StandbyKind::Hot, ..theirs.clone() };
        assert_eq!(
            theirs.difference(&n2, &hot),
            "its standbys are Warm here and Hot on n2: write .standby(StandbyKind::Warm) or \
             (StandbyKind::Hot) on both"
        );
        let both = ServiceConfiguration {
            on_partition: OnPartition::Continue,
            heartbeat_interval: Duration::ZERO,
            ..hot
        };
        let text = ours.difference(&n2, &both);
        assert_eq!(text.matches("; ").count(), 3, "{text}");
        assert!(text.contains("every 50ms here and 0ns on n2"), "{text}");
    }

    #[test]
    fn equal_configurations_have_no_difference_and_one_fingerprint() {
        let (one, other) = (configuration(&["n1", "n2"]), configuration(&["n2", "n1"]));
        assert_eq!(one.difference(&one.members[0], &one.clone()), "");
        assert_eq!(one.fingerprint(), configuration(&["n1", "n2"]).fingerprint());
        // The order of elections depends on the order of the list.
        assert_ne!(one.fingerprint(), other.fingerprint());
        assert!(one.difference(&one.members[1], &other).contains("such as [\"n1\", \"n2\"],"));
        assert_eq!(ServiceConfiguration::decode(&one.encode()), Some(one));
        assert_eq!(ServiceConfiguration::decode(&[1, 2, 3]), None);
    }
}
