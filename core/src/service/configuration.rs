//! The part of a service's configuration that must be equal on all nodes that carry it.

use super::change::checksum;
use super::{HEARTBEAT_MAX, HEARTBEAT_MIN, OnPartition, ReplicaConfig, StandbyKind};
use crate::NodeName;
use crate::contract::codec;
use serde::{Deserialize, Serialize};
use std::fmt::{self, Write};
use std::time::Duration;

/// The most bytes of a configuration: a service on a thousand nodes with names of the greatest
/// length.
pub(super) const CONFIGURATION_BYTES_MAX: usize = 48 * 1024;

/// The most nodes of a list that are shown: as many as a person compares at a glance, and few
/// enough for a fault's text.
const SHOWN: usize = 8;

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
        let bounds = HEARTBEAT_MIN..=HEARTBEAT_MAX;
        decoded.filter(|configuration| bounds.contains(&configuration.heartbeat_interval))
    }

    /// Returns a checksum that is the same for equal configurations on every node.
    pub(super) fn fingerprint(&self) -> u64 {
        checksum(&self.encode())
    }

    /// Returns how the configuration of `node` differs, and what to write; empty if they are equal.
    pub(super) fn difference(&self, node: &NodeName, theirs: &ServiceConfiguration) -> String {
        let mut text = String::new();
        let mut differ =
            |what: &str, here: &dyn fmt::Debug, there: &dyn fmt::Debug, write: &str| {
                let separator = if text.is_empty() { "" } else { "; " };
                // Writing into a string cannot fail.
                let _ = write!(
                    text,
                    "{separator}{what} {here:?} here and {there:?} on {node}: write {write} on both"
                );
            };
        if self.members != theirs.members {
            let (one, other) = (&self.members, &theirs.members);
            // Long lists are shown from their first difference.
            let from = one.iter().zip(other).take_while(|(one, other)| one == other).count();
            let (here, there) = (Quoted::from(one, from), Quoted::from(other, from));
            let union = self.union(theirs);
            let all = Quoted::from(&union, from);
            differ("its nodes are", &here, &there, &format!("the same list, such as {all:?},"));
        }
        if self.kind != theirs.kind {
            let (here, there) = (self.kind, theirs.kind);
            let write = format!(".standby(StandbyKind::{here:?}) or (StandbyKind::{there:?})");
            differ("its standbys are", &here, &there, &write);
        }
        if self.on_partition != theirs.on_partition {
            let (here, there) = (self.on_partition, theirs.on_partition);
            let write = format!(".on_partition(OnPartition::{here:?}) or (OnPartition::{there:?})");
            differ("without a majority its rule is", &here, &there, &write);
        }
        if self.heartbeat_interval != theirs.heartbeat_interval {
            let (here, there) = (self.heartbeat_interval, theirs.heartbeat_interval);
            differ(
                "its primary sends a heartbeat every",
                &here,
                &there,
                "the same .heartbeat_every(..)",
            );
        }
        text
    }

    /// Returns the members of both lists, in the order of the longer one.
    fn union(&self, theirs: &ServiceConfiguration) -> Vec<NodeName> {
        let (long, short) = match self.members.len() >= theirs.members.len() {
            true => (&self.members, &theirs.members),
            false => (&theirs.members, &self.members),
        };
        let more = short.iter().filter(|node| !long.contains(node));
        long.iter().chain(more).cloned().collect()
    }
}

/// Displays names as they are written in a program; of a long list, a part and how many more.
struct Quoted<'a> {
    before: usize,
    shown: &'a [NodeName],
    after: usize,
}

impl<'a> Quoted<'a> {
    fn from(names: &'a [NodeName], from: usize) -> Self {
        let before = from.min(names.len().saturating_sub(SHOWN));
        let shown = &names[before..names.len().min(before + SHOWN)];
        Quoted { before, shown, after: names.len() - before - shown.len() }
    }
}

impl fmt::Debug for Quoted<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut list = f.debug_list();
        if self.before > 0 {
            list.entry(&format_args!("{} more", self.before));
        }
        list.entries(self.shown.iter().map(NodeName::as_str));
        if self.after > 0 {
            list.entry(&format_args!("{} more", self.after));
        }
        list.finish()
    }
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
    fn of_long_lists_it_is_shown_where_they_part() {
        let names: Vec<_> = (0..1000).map(|n| format!("n{n}")).collect();
        let ours: Vec<_> = names.iter().map(String::as_str).collect();
        let without: Vec<_> = ours.iter().copied().filter(|name| *name != "n500").collect();
        let n2 = NodeName::new("n2").unwrap();

        let text = configuration(&ours).difference(&n2, &configuration(&without));

        assert!(text.contains("[500 more, \"n500\", \"n501\","), "{text}");
        assert!(text.contains("\"n507\", 492 more] here and [500 more, \"n501\","), "{text}");
        assert!(text.len() < 512, "{text}");
        let text = configuration(&ours[..10]).difference(&n2, &configuration(&ours));
        assert!(text.contains("[2 more, \"n2\",") && text.contains("[10 more, \"n10\","), "{text}");
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
