//! What all who carry a service must have been told alike.

use super::change::sum;
use super::{HELLO_MAX, HELLO_MIN, OnPartition, ReplicaConfig, StandbyKind};
use crate::NodeName;
use crate::contract::codec;
use serde::{Deserialize, Serialize};
use std::fmt::{self, Write};
use std::time::Duration;

/// The most bytes of terms: a service on a thousand nodes with names of the greatest length.
pub(super) const TERMS_MAX: usize = 48 * 1024;

/// The most nodes of a list that are shown: as many as a person compares at a glance, and few
/// enough for a fault's text.
const SHOWN: usize = 8;

/// On what the safety of an election rests. Members who count majorities of other lists, or leases
/// of other lengths, may each elect somebody.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Terms {
    members: Vec<NodeName>,
    kind: StandbyKind,
    on_partition: OnPartition,
    hello_interval: Duration,
}

impl Terms {
    pub(super) fn of(config: &ReplicaConfig) -> Self {
        let ReplicaConfig { members, kind, on_partition, hello_interval, .. } = config.clone();
        Terms { members, kind, on_partition, hello_interval }
    }

    pub(super) fn list(&self, node: &NodeName) -> bool {
        self.members.contains(node)
    }

    pub(super) fn members(&self) -> &[NodeName] {
        &self.members
    }

    /// How many of its nodes make one of them a primary.
    pub(super) fn quorum(&self) -> usize {
        match self.on_partition {
            OnPartition::Stop => self.members.len() / 2 + 1,
            OnPartition::Continue => 1,
        }
    }

    /// After so long nobody counts on a promise any more, whatever the clocks did.
    pub(super) fn promise(&self) -> Duration {
        let lease = self.hello_interval.saturating_mul(3);
        lease.saturating_add(lease / 10)
    }

    /// Whether each part of a divided network goes on by itself, as both were told.
    pub(super) fn divide(&self, theirs: &Terms) -> bool {
        self.on_partition == OnPartition::Continue && theirs.on_partition == OnPartition::Continue
    }

    /// Whether what is done by the one can be followed by the others: only their lists differ, and
    /// not in all. Or else they are two services that have one name by mistake.
    pub(super) fn shares_state(&self, theirs: &Terms) -> bool {
        let strict = |terms: &Terms| terms.on_partition == OnPartition::Stop;
        self.kind == theirs.kind
            && self.kind != StandbyKind::Cold
            && self.hello_interval == theirs.hello_interval
            && strict(self)
            && strict(theirs)
            && self.members.iter().any(|node| theirs.list(node))
    }

    /// Which of two, each of which knows of the other, may rely on that the other keeps back.
    pub(super) fn leads(&self, theirs: &Terms) -> bool {
        let rank = |terms: &Terms| {
            let strict = terms.on_partition == OnPartition::Stop;
            (strict, terms.members.len(), terms.fingerprint())
        };
        rank(self) > rank(theirs)
    }

    /// Whether nobody serves by the others' terms while all of these keep from it.
    pub(super) fn excludes(
        &self,
        theirs: &Terms,
        mut keeps: impl FnMut(&NodeName) -> bool,
    ) -> bool {
        // Whoever begins anew waits for what it may have promised before, as long as its new terms
        // say: where that was longer by the old ones, it may be counted by two.
        if self.hello_interval != theirs.hello_interval {
            return false;
        }
        let free = theirs.members.iter().filter(|node| !keeps(node)).count();
        free < theirs.quorum()
    }

    pub(super) fn encode(&self) -> Vec<u8> {
        codec::encode_unbounded(self)
    }

    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let terms = codec::decode_bounded::<Terms, TERMS_MAX>(bytes).ok();
        terms.filter(|terms| (HELLO_MIN..=HELLO_MAX).contains(&terms.hello_interval))
    }

    /// The same for the same terms, on every node.
    pub(super) fn fingerprint(&self) -> u64 {
        sum(&self.encode())
    }

    /// What `node` was told otherwise, and what is to be written; empty where it is the same.
    pub(super) fn difference(&self, node: &NodeName, theirs: &Terms) -> String {
        let mut text = String::new();
        let mut differ =
            |what: &str, here: &dyn fmt::Debug, there: &dyn fmt::Debug, write: &str| {
                let separator = if text.is_empty() { "" } else { "; " };
                // Into a string, nothing fails.
                let _ = write!(
                    text,
                    "{separator}{what} {here:?} here and {there:?} on {node}: write {write} on both"
                );
            };
        if self.members != theirs.members {
            let (one, other) = (&self.members, &theirs.members);
            // Of long lists, from where they part.
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
        if self.hello_interval != theirs.hello_interval {
            let (here, there) = (self.hello_interval, theirs.hello_interval);
            differ("its primary says hello every", &here, &there, "the same .hello_every(..)");
        }
        text
    }

    /// The members of both, in the order of the longer list.
    fn union(&self, theirs: &Terms) -> Vec<NodeName> {
        let (long, short) = match self.members.len() >= theirs.members.len() {
            true => (&self.members, &theirs.members),
            false => (&theirs.members, &self.members),
        };
        let more = short.iter().filter(|node| !long.contains(node));
        long.iter().chain(more).cloned().collect()
    }
}

/// Names as they are written in a program; of many, these and how many more.
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

    fn terms(members: &[&str]) -> Terms {
        Terms {
            members: members.iter().map(|name| NodeName::new(name).unwrap()).collect(),
            kind: StandbyKind::Warm,
            on_partition: OnPartition::Stop,
            hello_interval: Duration::from_millis(50),
        }
    }

    #[test]
    fn terms_that_differ_say_in_what_and_what_is_to_be_written() {
        let n2 = NodeName::new("n2").unwrap();
        let (ours, theirs) = (terms(&["n1"]), terms(&["n2", "n1", "n3"]));
        assert_eq!(
            ours.difference(&n2, &theirs),
            "its nodes are [\"n1\"] here and [\"n2\", \"n1\", \"n3\"] on n2: write the same list, such as \
             [\"n2\", \"n1\", \"n3\"], on both"
        );
        let hot = Terms { kind: StandbyKind::Hot, ..theirs.clone() };
        assert_eq!(
            theirs.difference(&n2, &hot),
            "its standbys are Warm here and Hot on n2: write .standby(StandbyKind::Warm) or \
             (StandbyKind::Hot) on both"
        );
        let both =
            Terms { on_partition: OnPartition::Continue, hello_interval: Duration::ZERO, ..hot };
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

        let text = terms(&ours).difference(&n2, &terms(&without));

        assert!(text.contains("[500 more, \"n500\", \"n501\","), "{text}");
        assert!(text.contains("\"n507\", 492 more] here and [500 more, \"n501\","), "{text}");
        assert!(text.len() < 512, "{text}");
        let text = terms(&ours[..10]).difference(&n2, &terms(&ours));
        assert!(text.contains("[2 more, \"n2\",") && text.contains("[10 more, \"n10\","), "{text}");
    }

    #[test]
    fn the_same_terms_have_no_difference_and_one_fingerprint() {
        let (one, other) = (terms(&["n1", "n2"]), terms(&["n2", "n1"]));
        assert_eq!(one.difference(&one.members[0], &one.clone()), "");
        assert_eq!(one.fingerprint(), terms(&["n1", "n2"]).fingerprint());
        // Whose turn is first depends on the order.
        assert_ne!(one.fingerprint(), other.fingerprint());
        assert!(one.difference(&one.members[1], &other).contains("such as [\"n1\", \"n2\"],"));
        assert_eq!(Terms::decode(&one.encode()), Some(one));
        assert_eq!(Terms::decode(&[1, 2, 3]), None);
    }
}
