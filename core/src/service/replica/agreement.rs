//! Compares this replica's configuration with that of every other replica of the service.
//!
//! ```text
//!   one replica                                  the other
//!      │ compare: nodes, kind, rule, heartbeat ────► │  each node with an object of the service's name
//!      │ ◄────────────────────────────────── its own │
//! ```
//!
//! Each message between replicas carries the fingerprint of the sender's configuration. A vote or
//! lease promise with another fingerprint is not counted. A majority therefore never mixes
//! configurations. That alone does not prevent two primaries; the rules in
//! [`other_configurations`](super::other_configurations) do.
//!
//! A replica takes another configuration into account until each node that had it sends this
//! replica's own, ends in order, or no longer carries the service. Being out of sight is no reason
//! to drop it: the node may be cut off and alive, and two parts that had dropped each other's
//! configurations would both serve.
//!
//! A node without a path to it for a minute may never return. If its configuration is harmless here,
//! it is no longer part of the fault. It still counts for the decision who may serve.
//!
//! A member that is in sight and does not carry the service is part of the fault as well. It counts
//! as one that has failed.

use super::super::configuration::{CONFIGURATION_BYTES_MAX, ServiceConfiguration};
use super::other_configurations::{CONFIGURATIONS_MAX, OtherConfigurations};
use super::*;
use crate::sorted::SortedSet;
use std::time::Duration;

/// The interval at which a node is asked again that has not answered, or is out of sight. A shorter
/// one finds differences sooner. Each question is a small message, and none without a path.
const COMPARE_RETRY: Duration = Duration::from_millis(500);
/// The interval for a node whose configuration differs. When it restarts, it sends its configuration
/// by itself. A shorter one would load slow lines.
const COMPARE_INTERVAL: Duration = Duration::from_secs(5);
/// How long a node with a harmless configuration is unreachable before it is no longer part of the
/// fault: as long as other faults last after their cause. A shorter one would declare the fault
/// again after each longer cut.
const SUPPRESS_AFTER: Duration = Duration::from_secs(60);
/// The most nodes, beside the members, whose configurations are kept: far more than carry one
/// service.
const REPLICAS_MAX: usize = 1024;
/// The most bytes of the text of one difference: all of it, unless names are very long.
const DIFFERENCE_MAX: usize = 1024;
/// The most bytes of an answer: a configuration and a position.
const ANSWER_BYTES_MAX: usize = CONFIGURATION_BYTES_MAX + 32;
/// The most nodes that a text names. The correction for the first ones applies to all, and callers
/// on other nodes receive the text in one small message.
const NAMED_MAX: usize = 8;

/// What a replica knows of the configurations of the other nodes that carry the service.
#[derive(Clone, Debug)]
pub(super) struct ConfigAgreement {
    pub(super) configuration: ServiceConfiguration,
    fingerprint: u64,
    pub(super) known: SortedMap<NodeName, KnownReplica>,
    pub(super) others: OtherConfigurations,
    /// The carriers of the service to which a path leads.
    pub(super) reachable: SortedSet<NodeName>,
    /// How the configurations differ, and whether a node may serve nevertheless.
    mismatch: Option<String>,
    /// No node with this configuration may serve until the mismatch is over.
    fenced: bool,
    /// The detail of the fault as it was declared last.
    reported: Option<String>,
}

/// What a replica knows of another node's configuration.
#[derive(Clone, Debug, Default)]
pub(super) struct KnownReplica {
    /// When it was last asked.
    asked_at: Option<Instant>,
    pub(super) comparison: ConfigComparison,
    /// Since when it is known to have received this replica's configuration.
    pub(super) bound_since: Option<Instant>,
    /// It was in the directory at the last poll.
    pub(super) seen: bool,
    /// It was in the directory before, and has not been since.
    gone: bool,
    /// Since when no path leads to it.
    unreachable_since: Option<Instant>,
    /// Its configuration differs, and is no longer part of the fault.
    suppressed: bool,
}

/// How another node's configuration compares with this replica's.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) enum ConfigComparison {
    #[default]
    Unknown,
    /// The configurations are equal.
    Agrees,
    /// The node does not carry the service. After its first such answer it may still be starting;
    /// the second one confirms it.
    Absent { confirmed: bool },
    /// The configurations differ: in what, and the fingerprint of the other one.
    Differs { text: String, fingerprint: u64 },
}

/// The nodes of a service, by what is known of them.
#[derive(Default)]
pub(super) struct MemberSummary<'a> {
    /// How many members, this one included, are reachable and agree as far as is known.
    pub(super) available: usize,
    /// The members that are not reachable.
    pub(super) unreachable: Vec<&'a str>,
    /// The members that do not carry the service.
    pub(super) without_service: Vec<&'a str>,
    /// The nodes, members or not, whose configurations differ.
    pub(super) differing: Vec<&'a str>,
}

impl ConfigAgreement {
    pub(super) fn new(config: &ReplicaConfig) -> Self {
        let configuration = ServiceConfiguration::of(config);
        ConfigAgreement {
            fingerprint: configuration.fingerprint(),
            configuration,
            known: SortedMap::new(),
            others: OtherConfigurations::default(),
            reachable: SortedSet::new(),
            mismatch: None,
            fenced: false,
            reported: None,
        }
    }

    /// Appends the fingerprint of this replica's configuration to a message.
    pub(super) fn sign(&self, mut message: Vec<u8>) -> Bytes {
        message.extend(self.fingerprint.to_le_bytes());
        message.into()
    }

    /// Returns the message without the fingerprint, and the fingerprint of the sender's
    /// configuration.
    pub(super) fn read<'a>(&self, message: &'a [u8]) -> Option<(&'a [u8], u64)> {
        let (message, fingerprint) = message.split_last_chunk()?;
        Some((message, u64::from_le_bytes(*fingerprint)))
    }

    /// Returns whether this is the fingerprint of this replica's configuration.
    pub(super) fn is_ours(&self, fingerprint: u64) -> bool {
        fingerprint == self.fingerprint
    }

    /// Returns the differences: first those of members, which certainly belong to the service.
    fn differences(&self) -> Vec<&str> {
        let (mut members, mut others) = (Vec::new(), Vec::new());
        for (node, known) in &self.known {
            if let ConfigComparison::Differs { text, .. } = &known.comparison
                && !known.suppressed
            {
                let texts = if self.configuration.lists(node) { &mut members } else { &mut others };
                texts.push(text.as_str());
            }
        }
        members.append(&mut others);
        members
    }

    /// Updates the text of the mismatch, and whether this replica is fenced.
    fn update_mismatch(&mut self) {
        self.fenced = self.must_be_fenced();
        let differences = self.differences();
        let what = match self.fenced {
            true => "and no node with this configuration serves until they have",
            false => "and the nodes that agree go on while enough of them are reachable",
        };
        let too_many = self.has_overflowed().then(|| {
            format!(
                "more than {CONFIGURATIONS_MAX} different configurations, or those of more than {REPLICAS_MAX} other \
                 nodes, were received, which are too many to decide which node may serve: make them the same \
                 everywhere, and restart this node"
            )
        });
        let differences = (!differences.is_empty()).then(|| {
            let differences = some_of(&differences, "; ");
            format!("not all nodes have the same configuration of it, {what}: {differences}")
        });
        let mismatch: Vec<_> = too_many.into_iter().chain(differences).collect();
        self.mismatch = (!mismatch.is_empty()).then(|| mismatch.join("; "));
    }

    /// Returns whether this comparison is part of the fault.
    fn is_mismatch(&self, node: &NodeName, comparison: &ConfigComparison) -> bool {
        match comparison {
            ConfigComparison::Differs { .. } => true,
            ConfigComparison::Absent { confirmed } => *confirmed && self.configuration.lists(node),
            ConfigComparison::Unknown | ConfigComparison::Agrees => false,
        }
    }

    /// Returns the text about members that do not carry the service.
    fn absent(&self) -> Option<String> {
        let absent = self.known.iter().filter(|(node, known)| {
            matches!(known.comparison, ConfigComparison::Absent { .. })
                && self.is_mismatch(node, &known.comparison)
        });
        let absent: Vec<_> = absent.map(|(node, _)| node.as_str()).collect();
        (!absent.is_empty()).then(|| {
            format!(
                "listed, but without this service: {}; add the service there, or remove the node from all lists: \
                 it counts as one that has failed",
                some_of(&absent, ", ")
            )
        })
    }

    /// Returns which members are reachable, and which nodes have other configurations.
    pub(super) fn summarize_members(&self, config: &ReplicaConfig) -> MemberSummary<'_> {
        let mut summary = MemberSummary::default();
        for (node, known) in &self.known {
            if known.comparison.other().is_some() && !known.suppressed {
                summary.differing.push(node.as_str());
            }
        }
        for member in self.configuration.members() {
            let known = self.known.get(member);
            match known.map(|known| (&known.comparison, self.reachable.contains(member))) {
                _ if *member == config.own => summary.available += 1,
                Some((ConfigComparison::Differs { .. }, _))
                    if known.is_some_and(|known| !known.suppressed) => {}
                Some((ConfigComparison::Differs { .. }, _)) => {
                    summary.unreachable.push(member.as_str());
                }
                Some((comparison @ ConfigComparison::Absent { .. }, _))
                    if self.is_mismatch(member, comparison) =>
                {
                    summary.without_service.push(member.as_str());
                }
                Some((_, true)) => summary.available += 1,
                Some((_, false)) | None => summary.unreachable.push(member.as_str()),
            }
        }
        summary
    }

    /// Returns whether no node with this configuration may serve until the mismatch is over.
    pub(super) fn is_fenced(&self) -> bool {
        self.fenced
    }

    /// Removes nodes from the fault that are unreachable for long and whose configurations are
    /// harmless here.
    fn suppress_absent(&mut self, now: Instant) {
        let is_away = |known: &KnownReplica| {
            known.unreachable_since.is_some_and(|since| now - since >= SUPPRESS_AFTER)
        };
        let away = self.known.values().filter(|known| is_away(known));
        let fingerprints: SortedSet<u64> =
            away.filter_map(|known| known.comparison.other()).collect();
        // While too few members agree, the fault has to say why no node serves.
        let enough = self.agreeing() >= self.configuration.quorum();
        let is_harmless = |fingerprint: &u64| enough && self.is_harmless(*fingerprint, now);
        let harmless: SortedSet<u64> = fingerprints.into_iter().filter(is_harmless).collect();
        for known in self.known.values_mut() {
            let other = known.comparison.other();
            known.suppressed =
                is_away(known) && other.is_some_and(|other| harmless.contains(&other));
        }
    }

    /// Returns the record of this node, unless there are too many.
    fn known(&mut self, node: &NodeName) -> Option<&mut KnownReplica> {
        // A configuration fits into one message, which bounds the number of members.
        let has_capacity = self.known.len() < REPLICAS_MAX
            || self.known.contains_key(node)
            || self.configuration.lists(node);
        has_capacity.then(|| self.known.entry(node.clone()).or_default())
    }
}

/// Returns the first texts, and how many more there are.
pub(super) fn some_of(texts: &[&str], separator: &str) -> String {
    let named = texts[..texts.len().min(NAMED_MAX)].join(separator);
    match texts.len().saturating_sub(NAMED_MAX) {
        0 => named,
        more => format!("{named}{separator}and {more} more"),
    }
}

/// Returns a text for each list of nodes that is not empty: what is wrong with them, and what helps.
pub(super) fn describe_lists<const N: usize>(lists: [(&str, Vec<&str>, &str); N]) -> Vec<String> {
    let lists = lists.into_iter().filter(|(_, nodes, _)| !nodes.is_empty());
    lists.map(|(what, nodes, help)| format!("{what}: {} ({help})", some_of(&nodes, ", "))).collect()
}

/// Returns the text, cut at [`DIFFERENCE_MAX`] bytes.
fn cut(mut text: String) -> String {
    if text.len() > DIFFERENCE_MAX {
        let end = (0..=DIFFERENCE_MAX).rev().find(|end| text.is_char_boundary(*end));
        text.truncate(end.unwrap_or(0));
        text.push('…');
    }
    text
}

impl Replica {
    /// Returns this replica's configuration and the last position whose reply was sent, encoded for
    /// [`Replica::handle_configuration`] of the other replicas.
    pub fn configuration(&self) -> Bytes {
        codec::encode_unbounded(&(self.agreement.configuration.encode(), self.answered)).into()
    }

    /// Returns how the configurations differ and what to write, if no node may serve until then.
    pub fn mismatch(&self) -> Option<&str> {
        self.agreement.mismatch.as_deref().filter(|_| self.agreement.fenced)
    }

    /// Sets the nodes to which a path leads, of those that the next [`Replica::handle_carriers`] is
    /// given.
    pub fn handle_reachable(&mut self, reachable: &[NodeName]) {
        self.agreement.reachable = reachable.iter().cloned().collect();
    }

    /// Drops the configurations of nodes that may not claim the service. Call it before
    /// [`Replica::handle_carriers`], as the policy of the robot may change.
    pub fn handle_claimants(&mut self, may_claim: impl Fn(&NodeName) -> bool, now: Instant) {
        let counts = |node: &NodeName, known: &KnownReplica| {
            known.comparison == ConfigComparison::Unknown || may_claim(node)
        };
        let before = self.agreement.known.len();
        self.agreement.known.retain(|node, known| counts(node, known));
        if self.agreement.known.len() != before {
            self.agreement.forget_unused(now);
            self.report_mismatch(now);
        }
    }

    /// Sets the other nodes that have an object of the service's name, with a path to them or not.
    /// Call it several times a second.
    pub fn handle_carriers(&mut self, found: &[NodeName], now: Instant) {
        // A node that agreed may have restarted when it comes back.
        let members = &self.config.members;
        let concerns = |node: &NodeName| found.contains(node) || members.contains(node);
        self.agreement.known.retain(|node, known| match &known.comparison {
            ConfigComparison::Differs { .. } => true,
            ConfigComparison::Unknown | ConfigComparison::Absent { .. } => concerns(node),
            ConfigComparison::Agrees => found.contains(node),
        });
        for (node, known) in &mut self.agreement.known {
            let seen = found.contains(node);
            if seen && known.gone {
                known.unbind();
            }
            known.gone = !seen && (known.seen || known.gone);
            known.seen = seen;
            known.unreachable_since = match self.agreement.reachable.contains(node) {
                true => None,
                false => known.unreachable_since.or(Some(now)),
            };
        }
        self.agreement.suppress_absent(now);
        let known = self.agreement.known.keys();
        let all: SortedSet<_> = known.chain(found).chain(members).cloned().collect();
        all.iter().for_each(|node| self.compare(node, now));
        self.report_mismatch(now);
    }

    /// Handles the configuration that another node sends as its answer. That node has received this
    /// replica's configuration with the question.
    pub fn handle_configuration(&mut self, from: &NodeName, bytes: &[u8], now: Instant) {
        self.note_config(from, bytes, true, now);
    }

    /// Handles the configuration that another node sends with its question. If it is new, this
    /// replica asks in its turn.
    pub fn handle_comparison_request(&mut self, from: &NodeName, bytes: &[u8], now: Instant) {
        if self.note_config(from, bytes, false, now)
            && let Some(known) = self.agreement.known.get_mut(from)
        {
            known.asked_at = None;
            self.compare(from, now);
        }
    }

    /// Stores a node's configuration, and returns whether its comparison has changed. If the node
    /// `answers`, it is bound from now on.
    fn note_config(&mut self, from: &NodeName, bytes: &[u8], answers: bool, now: Instant) -> bool {
        let received = codec::decode_bounded::<(Vec<u8>, Position), ANSWER_BYTES_MAX>(bytes).ok();
        let received = received.filter(|_| *from != self.config.own);
        let received = received.and_then(|(configuration, answered)| {
            Some((ServiceConfiguration::decode(&configuration)?, answered))
        });
        let Some((theirs, answered)) = received else {
            self.refused += 1;
            return false;
        };
        let ours = &self.agreement.configuration;
        if theirs != *ours && ours.shares_state(&theirs) {
            self.note_answered(answered, now);
        }
        let comparison = match self.agreement.configuration.difference(from, &theirs) {
            same if same.is_empty() => ConfigComparison::Agrees,
            text => ConfigComparison::Differs {
                text: cut(text),
                fingerprint: self.agreement.others.note(theirs),
            },
        };
        let before = self.agreement.known.get(from).map(|known| known.comparison.clone());
        self.note_comparison(from, comparison.clone(), now);
        if let Some(known) = self.agreement.known.get_mut(from) {
            if std::mem::take(&mut known.gone) {
                known.unbind();
            }
            (known.unreachable_since, known.suppressed) = (None, false);
            if answers {
                known.bound_since.get_or_insert(now);
            }
        }
        self.report_mismatch(now);
        before.as_ref() != Some(&comparison)
    }

    /// A node is there, and does not carry the service.
    pub fn handle_no_service(&mut self, of: &NodeName, now: Instant) {
        let before = self.agreement.known.get(of).map(|known| &known.comparison);
        let confirmed = matches!(before, Some(ConfigComparison::Absent { .. }));
        self.note_comparison(of, ConfigComparison::Absent { confirmed }, now);
        self.report_mismatch(now);
    }

    /// A node has ended in order.
    pub fn handle_left(&mut self, node: &NodeName, now: Instant) {
        self.note_comparison(node, ConfigComparison::Unknown, now);
        self.report_mismatch(now);
    }

    /// Returns a replica that starts with what this one knows of the others, after its actor has
    /// failed.
    #[must_use]
    pub fn restarted(&self, now: Instant) -> Self {
        let mut next = Replica::new(self.config.clone(), self.initial.clone(), now);
        next.agreement = self.agreement.clone();
        next.answered = self.answered;
        next.faults = self.faults.clone();
        next.clear_faults();
        // If the service is still unavailable, the new replica finds that again.
        next.set_fault(FaultKind::ServiceUnavailable, None);
        next.agreement.reported = None;
        next.report_mismatch(now);
        next
    }

    /// A message of this node carries the fingerprint of another configuration.
    pub(super) fn recheck(&mut self, from: &NodeName, now: Instant) {
        if let Some(known) = self.agreement.known.get_mut(from)
            && known.comparison == ConfigComparison::Agrees
        {
            // The process that agreed has been replaced.
            *known = KnownReplica { seen: known.seen, ..KnownReplica::default() };
        }
        if self.config.members.contains(from) {
            self.compare(from, now);
        }
    }

    /// Asks a node for its configuration, if that is due.
    fn compare(&mut self, node: &NodeName, now: Instant) {
        let Some(known) = self.agreement.known(node).filter(|_| *node != self.config.own) else {
            return;
        };
        let interval = match known.comparison {
            ConfigComparison::Agrees => return,
            ConfigComparison::Unknown | ConfigComparison::Absent { confirmed: false } => {
                COMPARE_RETRY
            }
            // A node out of sight may have left. Without a path the question sends nothing.
            ConfigComparison::Differs { .. } if known.bound_since.is_none() || !known.seen => {
                COMPARE_RETRY
            }
            ConfigComparison::Absent { confirmed: true } | ConfigComparison::Differs { .. } => {
                COMPARE_INTERVAL
            }
        };
        if known.asked_at.is_none_or(|asked| now - asked >= interval) {
            known.asked_at = Some(now);
            self.outputs.push_back(ReplicaOutput::Compare { with: node.clone() });
        }
    }

    fn note_comparison(&mut self, of: &NodeName, comparison: ConfigComparison, now: Instant) {
        let Some(known) = self.agreement.known(of) else {
            self.refused += 1;
            // The replica cannot tell later whether this node still has its configuration.
            self.agreement.others.overflow |= comparison.other().is_some();
            return;
        };
        if known.comparison == comparison {
            return;
        }
        let before = std::mem::replace(&mut known.comparison, comparison.clone());
        known.bound_since = None;
        // A further mismatch changes the fault's detail only. One that is over clears the fault, and
        // what is left is declared again.
        if self.agreement.is_mismatch(of, &before) {
            self.agreement.reported = None;
            self.outputs.push_back(ReplicaOutput::MismatchCleared);
        }
        self.agreement.forget_unused(now);
        if let RoleState::Standby(standby) = &mut self.role {
            standby.advance_election(&self.config, now);
        }
    }

    /// Reports the mismatch if it has changed. A primary that may not serve any more resigns.
    pub(super) fn report_mismatch(&mut self, now: Instant) {
        self.agreement.update_mismatch();
        let mismatch = self.agreement.mismatch.clone();
        let texts: Vec<_> = mismatch.into_iter().chain(self.agreement.absent()).collect();
        let detail = (!texts.is_empty()).then(|| texts.join("; "));
        if detail != self.agreement.reported {
            self.agreement.reported.clone_from(&detail);
            self.outputs.push_back(match detail {
                Some(detail) => ReplicaOutput::ConfigMismatch { detail },
                None => ReplicaOutput::MismatchCleared,
            });
        }
        if let RoleState::Primary(primary) = &self.role
            && !primary.has_lease(&self.config, &self.agreement, now)
        {
            self.resign(now);
        }
    }
}

impl KnownReplica {
    /// Forgets that the node received this replica's configuration: it may be a new process.
    fn unbind(&mut self) {
        (self.bound_since, self.asked_at) = (None, None);
    }
}
