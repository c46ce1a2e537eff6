//! Decides whether this replica may serve while nodes have different configurations.
//!
//! ```text
//!            promised to the primary, or bound
//!          ┌─────────────┐
//!   theirs │ a   b   c   │ d   e      too few are left for a primary of theirs
//!          └─────────────┘
//! ```
//!
//! Majorities of two lists of members can each elect a primary. For each other configuration that
//! it knows, a primary therefore counts the members that are still free to elect a primary by it.
//! It serves only while they are fewer than the quorum of that configuration. Members that have
//! promised this primary a lease are not free. (Raft's joint consensus requires the same of a
//! change of members: majorities of both lists.)
//!
//! If both configurations lack such a majority, as with a node that lists only itself, one of them
//! leads: that of the longer list. A node with the other configuration becomes *bound* when it
//! receives the leader's configuration. A bound node does not serve without a majority of the
//! leader's list, and votes only for candidates that take the leader's configuration into account.
//! One lease promise later the leader does not count bound nodes as free. A bound node that ends or
//! is cut off remains bound. When a node comes back into sight, it may be a new process, so it has
//! to confirm again that it received the leader's configuration.
//!
//! If only the lists differ, and overlap, a node with the other list follows the primary as a
//! *learner*. It has no vote there, and receives the state, so that a new list begins with the
//! state of the old one. Epochs and positions of two lists are not comparable: only a snapshot
//! brings a learner into step.
//!
//! Why one of two primaries with different configurations, p that leads and q, does not serve: no
//! node has two configurations, so their majorities would be disjoint. If q takes p's configuration
//! into account, too few members of p's list are free to elect p. If q does not, no bound node has
//! voted for q, and too few members of q's list are free to elect q.

use super::super::configuration::ServiceConfiguration;
use super::agreement::{ConfigAgreement, ConfigComparison, KnownReplica};
use super::*;
use crate::sorted::SortedSet;

/// The most other configurations that a replica keeps: far more than a change of lists makes. If
/// there are more, the replica neither serves nor votes until its node restarts: it cannot tell
/// whether a node still has one of the configurations that it did not keep.
pub(super) const CONFIGURATIONS_MAX: usize = 64;

/// The configurations of other nodes that differ from this replica's.
#[derive(Clone, Debug, Default)]
pub(super) struct OtherConfigurations {
    /// By fingerprint.
    all: SortedMap<u64, OtherConfiguration>,
    /// There were more than the replica keeps.
    pub(super) overflow: bool,
}

#[derive(Clone, Debug)]
struct OtherConfiguration {
    configuration: ServiceConfiguration,
    /// Until when it counts because another replica reported it.
    reported_until: Instant,
}

impl OtherConfigurations {
    /// Stores a configuration and returns its fingerprint.
    pub(super) fn note(&mut self, configuration: ServiceConfiguration) -> u64 {
        let fingerprint = configuration.fingerprint();
        if self.all.len() >= CONFIGURATIONS_MAX && !self.all.contains_key(&fingerprint) {
            self.overflow = true;
        } else {
            let other = OtherConfiguration { configuration, reported_until: Instant::ORIGIN };
            self.all.entry(fingerprint).or_insert(other);
        }
        fingerprint
    }
}

impl ConfigAgreement {
    /// Returns whether this replica knows of no other configuration.
    pub(super) fn is_unanimous(&self) -> bool {
        self.others.all.is_empty() && !self.others.overflow
    }

    /// Removes configurations that no known node has.
    pub(super) fn forget_unused(&mut self, now: Instant) {
        let used: SortedSet<u64> =
            self.known.values().filter_map(|known| known.comparison.other()).collect();
        self.others
            .all
            .retain(|fingerprint, other| used.contains(fingerprint) || now < other.reported_until);
    }

    /// Returns the configurations that nodes have sent to this replica itself.
    fn received(&self) -> impl Iterator<Item = (u64, &OtherConfiguration)> {
        let others = self.others.all.iter().map(|(fingerprint, other)| (*fingerprint, other));
        others.filter(|(fingerprint, other)| {
            self.known.values().any(|known| {
                known.comparison.other() == Some(*fingerprint)
                    // With `Continue`, parts of a network affect each other only where they meet.
                    && (known.seen || !self.configuration.both_continue(&other.configuration))
            })
        })
    }

    /// Returns the configurations that this replica takes into account: those received, and those
    /// reported by other replicas.
    fn relevant(&self, now: Instant) -> impl Iterator<Item = (u64, &OtherConfiguration)> {
        let reported = self.others.all.iter().filter(move |(_, other)| now < other.reported_until);
        self.received().chain(reported.map(|(fingerprint, other)| (*fingerprint, other)))
    }

    /// Returns the fingerprints of the configurations that this replica takes into account.
    pub(super) fn relevant_fingerprints(&self, now: Instant) -> Vec<u64> {
        self.relevant(now).map(|(fingerprint, _)| fingerprint).collect()
    }

    /// Returns a received configuration whose fingerprint is not in `known`.
    fn first_missing_in(&self, known: &[u64]) -> Option<&ServiceConfiguration> {
        let mut received = self.received();
        let missing = received.find(|(fingerprint, _)| !known.contains(fingerprint));
        missing.map(|(_, other)| &other.configuration)
    }

    /// Returns whether no replica with another configuration can serve while the nodes for which
    /// `supports` holds support this one.
    pub(super) fn permits(&self, supports: impl Fn(&NodeName) -> bool, now: Instant) -> bool {
        !self.others.overflow
            && self.relevant(now).all(|(fingerprint, other)| {
                let theirs = &other.configuration;
                let leads = self.configuration.leads(theirs);
                self.configuration.excludes(theirs, |node| {
                    supports(node) || leads && self.defers(node, fingerprint, theirs, now)
                })
            })
    }

    /// Returns what this replica knows of a node, if the node has the configuration of this
    /// fingerprint.
    fn known_with(&self, node: &NodeName, fingerprint: u64) -> Option<&KnownReplica> {
        self.known.get(node).filter(|known| known.comparison.other() == Some(fingerprint))
    }

    /// Returns whether this node, which has the configuration `theirs`, has been bound for one
    /// lease promise. Before that, it may have voted without the leader's configuration.
    fn defers(
        &self,
        node: &NodeName,
        fingerprint: u64,
        theirs: &ServiceConfiguration,
        now: Instant,
    ) -> bool {
        let bound_since = self.known_with(node, fingerprint).and_then(|known| known.bound_since);
        bound_since.is_some_and(|since| now >= since + theirs.promise_duration())
    }

    /// Returns whether no replica with this configuration may serve, even if all nodes that agree
    /// were available.
    pub(super) fn must_be_fenced(&self) -> bool {
        if self.is_unanimous() {
            return false;
        }
        // A node in sight that is not bound yet is about to be.
        let defers = |node: &NodeName, fingerprint: u64| {
            self.known_with(node, fingerprint)
                .is_some_and(|known| known.seen || known.bound_since.is_some())
        };
        let excluded = self.received().all(|(fingerprint, other)| {
            let theirs = &other.configuration;
            let leads = self.configuration.leads(theirs);
            self.configuration.excludes(theirs, |node| {
                self.may_support(node) || leads && defers(node, fingerprint)
            })
        });
        self.others.overflow || self.agreeing() < self.configuration.quorum() || !excluded
    }

    /// Returns how many members may support a primary with this configuration.
    pub(super) fn agreeing(&self) -> usize {
        self.configuration.members().iter().filter(|node| self.may_support(node)).count()
    }

    /// Returns whether there were more configurations than this replica keeps.
    pub(super) fn has_overflowed(&self) -> bool {
        self.others.overflow
    }

    /// Returns whether every majority of this configuration excludes a primary of the other one,
    /// whichever of its nodes fail or return.
    pub(super) fn is_harmless(&self, fingerprint: u64, now: Instant) -> bool {
        let Some(other) = self.others.all.get(&fingerprint) else { return false };
        let theirs = &other.configuration;
        let supporters = |list: &[NodeName], counts: &dyn Fn(&NodeName) -> bool| {
            list.iter().filter(|node| self.may_support(node) && counts(node)).count()
        };
        let elsewhere = supporters(self.configuration.members(), &|node| !theirs.lists(node));
        // Each majority of this configuration has at least so many members of theirs.
        let in_each_majority = self.configuration.quorum().saturating_sub(elsewhere);
        let supporting = supporters(theirs.members(), &|_| true).min(in_each_majority);
        // A node that defers has their configuration, and is none of the supporting ones.
        let defers = |node: &&NodeName| self.defers(node, fingerprint, theirs, now);
        let deferring = match self.configuration.leads(theirs) {
            true => theirs.members().iter().filter(defers).count(),
            false => 0,
        };
        self.configuration.excludes_without(theirs, supporting + deferring)
    }

    /// Returns whether this node has sent a configuration that differs in the list alone.
    pub(super) fn shares_state(&self, node: &NodeName, fingerprint: u64) -> bool {
        let known = self.known_with(node, fingerprint);
        let other = known.and_then(|_| self.others.all.get(&fingerprint));
        other.is_some_and(|other| self.configuration.shares_state(&other.configuration))
    }

    /// Returns the learners: nodes in sight that this replica does not list, and whose
    /// configurations differ in the list alone.
    pub(super) fn unlisted(&self) -> Vec<NodeName> {
        let learns = |(node, known): &(&NodeName, &KnownReplica)| {
            known.comparison.other().is_some_and(|fingerprint| {
                !self.configuration.lists(node)
                    && known.seen
                    && self.shares_state(node, fingerprint)
            })
        };
        self.known.iter().filter(learns).map(|(node, _)| node.clone()).collect()
    }

    /// Returns whether this node is a member that has the same configuration, as far as is known.
    pub(super) fn may_support(&self, node: &NodeName) -> bool {
        let known = self.known.get(node);
        self.configuration.lists(node) && known.and_then(|known| known.comparison.other()).is_none()
    }
}

impl ConfigComparison {
    /// Returns the fingerprint of the node's configuration, if it differs.
    pub(super) fn other(&self) -> Option<u64> {
        match self {
            ConfigComparison::Differs { fingerprint, .. } => Some(*fingerprint),
            ConfigComparison::Unknown
            | ConfigComparison::Agrees
            | ConfigComparison::Absent { .. } => None,
        }
    }
}

impl Replica {
    /// Returns whether the sender of `known` takes into account all configurations that this
    /// replica has received. If not, sends it one that it lacks.
    pub(super) fn knows_all_configurations(&mut self, from: &NodeName, known: &[u64]) -> bool {
        let missing = self.agreement.first_missing_in(known).map(ServiceConfiguration::encode);
        let Some(configuration) = missing else {
            // A replica that has not kept all configurations cannot tell.
            return !self.agreement.others.overflow;
        };
        self.send(from, &Message::OtherConfiguration(configuration));
        false
    }

    /// A replica with the same configuration reports another configuration.
    pub(super) fn handle_other_configuration(&mut self, configuration: &[u8], now: Instant) {
        let Some(configuration) = ServiceConfiguration::decode(configuration) else {
            self.refused += 1;
            return;
        };
        let fingerprint = self.agreement.others.note(configuration);
        if let Some(other) = self.agreement.others.all.get_mut(&fingerprint) {
            // After that, the replica that has it reports it again.
            other.reported_until = now + self.config.state_timeout();
        }
        if self.agreement.others.overflow {
            self.report_mismatch(now);
        }
    }
}
