//! Compares this replica's configuration with that of every other replica of the service.
//!
//! ```text
//!   one replica                                  the other
//!      │ compare: nodes, kind, rule, heartbeat ────► │  each node with an object of the service's name
//!      │ ◄────────────────────────────────── its own │
//! ```
//!
//! Each message between replicas carries the fingerprint of the sender's configuration. A message
//! with another fingerprint is refused, so no majority mixes configurations. Majorities of two
//! lists could still each elect a primary. Three rules prevent that for nodes that have met:
//!
//! * A replica that has met another configuration neither stands for election nor votes. A primary
//!   goes on, and keeps the promises of its standbys.
//! * A replica that needs no vote does not stand before it has had the time to meet others: until the
//!   poll after its start and the answers of the nodes in sight then, or one poll longer.
//! * If two primaries meet, the one whose configuration leads goes on. The other one resigns.
//!
//! Another configuration counts until the node that had it sends this replica's own, ends in order,
//! or no longer carries the service. Being out of sight is no reason to drop it: the node may be cut
//! off and alive, and two parts that had dropped each other's configurations would both serve.
//!
//! A member that is in sight and does not carry the service is part of the fault as well. It counts
//! as one that has failed.

use super::super::configuration::{CONFIGURATION_BYTES_MAX, ServiceConfiguration};
use super::*;
use std::time::Duration;

/// The interval at which a node is asked again that does not agree. A shorter one finds differences
/// sooner. Each question is a small message, and none without a path.
const COMPARE_INTERVAL: Duration = Duration::from_millis(500);
/// The most nodes, beside the members, whose configurations are kept: as many as one network has.
const REPLICAS_MAX: usize = 256;
/// The most bytes of an answer: a configuration, and whether its node serves.
const ANSWER_BYTES_MAX: usize = CONFIGURATION_BYTES_MAX + 32;
/// The most differences that a text has. The correction for the first ones applies to all, and
/// callers on other nodes receive the text in one small message.
pub(super) const NAMED_MAX: usize = 8;

/// The poll of the directory after which a replica that needs no vote waits for no answer any more.
/// The first poll is at the start, when no node is connected; the second one asks those in sight.
const POLLS_MAX: u8 = 3;

/// What a replica knows of the configurations of the other nodes that carry the service.
#[derive(Clone, Debug)]
pub(super) struct ConfigAgreement {
    configuration: ServiceConfiguration,
    pub(super) fingerprint: u64,
    pub(super) known: SortedMap<NodeName, KnownReplica>,
    /// The polls of the directory since the start, up to [`POLLS_MAX`].
    polls: u8,
}

/// What a replica knows of another node's configuration.
#[derive(Clone, Debug, Default)]
pub(super) struct KnownReplica {
    /// When it was last asked.
    asked_at: Option<Instant>,
    pub(super) comparison: ConfigComparison,
    /// A path led to it at the last poll of the directory.
    pub(super) seen: bool,
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
    /// The configurations differ, in what the text says.
    Differs { text: String },
}

impl ConfigAgreement {
    pub(super) fn new(config: &ReplicaConfig) -> Self {
        let configuration = ServiceConfiguration::of(config);
        let fingerprint = configuration.fingerprint();
        let others = config.members.iter().filter(|member| **member != config.own);
        let known = others.map(|member| (member.clone(), KnownReplica::default())).collect();
        ConfigAgreement { configuration, fingerprint, known, polls: 0 }
    }

    pub(super) fn encode(&self, serves: bool) -> Bytes {
        codec::encode_unbounded(&(self.configuration.encode(), serves)).into()
    }

    /// Compares the configuration that another node sent. Returns the result, and whether that node
    /// serves with another configuration, and goes on if this one serves as well.
    pub(super) fn compare(
        &self,
        from: &NodeName,
        bytes: &[u8],
    ) -> Option<(ConfigComparison, bool)> {
        let (theirs, serves) =
            codec::decode_bounded::<(Vec<u8>, bool), ANSWER_BYTES_MAX>(bytes).ok()?;
        let theirs = ServiceConfiguration::decode(&theirs)?;
        Some(match self.configuration.difference(from, &theirs) {
            same if same.is_empty() => (ConfigComparison::Agrees, false),
            text => {
                (ConfigComparison::Differs { text }, serves && theirs.leads(&self.configuration))
            }
        })
    }

    /// Sets the carriers of the service in sight, and forgets those that do not count any more.
    pub(super) fn see(&mut self, found: &[NodeName], may_claim: impl Fn(&NodeName) -> bool) {
        self.polls = POLLS_MAX.min(self.polls + 1);
        for (node, known) in &mut self.known {
            let seen = found.contains(node);
            // A node that agreed may have restarted when it comes back.
            if !seen && known.comparison == ConfigComparison::Agrees || !may_claim(node) {
                *known = KnownReplica::default();
            }
            known.seen = seen;
        }
        self.known
            .retain(|node, known| known.seen || known.differs() || self.configuration.lists(node));
        for node in found {
            if let Some(known) = self.record(node) {
                known.seen = true;
            }
        }
    }

    /// A message of this member carries the fingerprint of another configuration.
    pub(super) fn note_foreign(&mut self, from: &NodeName) {
        if let Some(known) = self.known.get_mut(from)
            && known.comparison == ConfigComparison::Agrees
        {
            // The process that agreed has been replaced.
            *known = KnownReplica { seen: known.seen, ..KnownReplica::default() };
        }
    }

    /// Returns whether this node is to be asked for its configuration now.
    pub(super) fn is_due(&mut self, node: &NodeName, now: Instant) -> bool {
        let Some(known) = self.known.get_mut(node) else { return false };
        let due = known.comparison != ConfigComparison::Agrees
            && known.asked_at.is_none_or(|asked| now - asked >= COMPARE_INTERVAL);
        if due {
            known.asked_at = Some(now);
        }
        due
    }

    /// Appends the fingerprint of this replica's configuration to a message.
    pub(super) fn sign(&self, mut message: Vec<u8>) -> Bytes {
        message.extend(self.fingerprint.to_le_bytes());
        message.into()
    }

    /// Returns whether this replica has met another configuration.
    pub(super) fn is_disputed(&self) -> bool {
        self.known.values().any(|known| known.differs())
    }

    /// Returns whether a replica that needs no vote may stand for election: it has polled the
    /// directory after its start, and the nodes in sight have had the time to answer.
    pub(super) fn has_asked(&self) -> bool {
        let waits =
            |known: &KnownReplica| known.seen && known.comparison == ConfigComparison::Unknown;
        self.polls == POLLS_MAX || self.polls > 1 && !self.known.values().any(waits)
    }

    /// Returns how the configurations differ: first those of members, which certainly belong to the
    /// service.
    pub(super) fn differences(&self) -> Option<String> {
        let differing = self.known.iter().filter_map(|(node, known)| match &known.comparison {
            ConfigComparison::Differs { text } => {
                Some((!self.configuration.lists(node), text.as_str()))
            }
            _ => None,
        });
        let mut differing: Vec<_> = differing.collect();
        differing.sort_by_key(|(is_stranger, _)| *is_stranger);
        let texts: Vec<_> = differing.iter().take(NAMED_MAX).map(|(_, text)| *text).collect();
        (!texts.is_empty()).then(|| {
            format!(
                "not all nodes have the same configuration of it, and no further node begins to serve until they \
                 have: {}",
                texts.join("; ")
            )
        })
    }

    /// Returns the detail of the fault: the differences, and the members without the service.
    pub(super) fn describe(&self) -> Option<String> {
        let is_absent = |(node, known): &(&NodeName, &KnownReplica)| {
            known.comparison == ConfigComparison::Absent { confirmed: true }
                && self.configuration.lists(node)
        };
        let absent = self.known.iter().filter(is_absent);
        let absent: Vec<_> = absent.map(|(node, _)| node.as_str()).collect();
        let absent = (!absent.is_empty()).then(|| {
            format!(
                "listed, but without this service: {}; add the service there, or remove the node from all lists: \
                 it counts as one that has failed",
                absent.join(", ")
            )
        });
        let texts: Vec<_> = self.differences().into_iter().chain(absent).collect();
        (!texts.is_empty()).then(|| texts.join("; "))
    }

    /// Returns the record of this node, unless there are too many.
    pub(super) fn record(&mut self, node: &NodeName) -> Option<&mut KnownReplica> {
        let has_capacity = self.known.len() < REPLICAS_MAX
            || self.known.contains_key(node)
            || self.configuration.lists(node);
        has_capacity.then(|| self.known.entry(node.clone()).or_default())
    }
}

impl KnownReplica {
    pub(super) fn differs(&self) -> bool {
        matches!(self.comparison, ConfigComparison::Differs { .. })
    }
}

/// Returns a text for each list of nodes that is not empty: what is wrong with them, and what helps.
pub(super) fn describe_lists<const N: usize>(lists: [(&str, Vec<&str>, &str); N]) -> Vec<String> {
    let lists = lists.into_iter().filter(|(_, nodes, _)| !nodes.is_empty());
    lists.map(|(what, nodes, help)| format!("{what}: {} ({help})", nodes.join(", "))).collect()
}
