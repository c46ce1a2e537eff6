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
//! lists could still each elect a primary. Two rules prevent that for nodes that have met:
//!
//! * A replica that has met another configuration neither stands for election nor votes. A primary
//!   goes on, and keeps the promises of its standbys.
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

/// The interval at which a node is asked again that has not answered, or serves beside this one. A
/// shorter one finds differences sooner. Each question is a small message, and none without a path.
const COMPARE_RETRY: Duration = Duration::from_millis(500);
/// The interval for a node whose configuration differs. When it restarts, it sends its configuration
/// by itself. A shorter one would load slow lines.
const COMPARE_INTERVAL: Duration = Duration::from_secs(5);
/// The most nodes, beside the members, whose configurations are kept: far more than carry one
/// service.
const REPLICAS_MAX: usize = 1024;
/// The most bytes of the text of one difference: all of it, unless names are very long.
const DIFFERENCE_MAX: usize = 1024;
/// The most bytes of an answer: a configuration, and whether its node serves.
const ANSWER_BYTES_MAX: usize = CONFIGURATION_BYTES_MAX + 32;
/// The most nodes that a text names. The correction for the first ones applies to all, and callers
/// on other nodes receive the text in one small message.
const NAMED_MAX: usize = 8;

/// What a replica knows of the configurations of the other nodes that carry the service.
#[derive(Clone, Debug)]
pub(super) struct ConfigAgreement {
    configuration: ServiceConfiguration,
    pub(super) fingerprint: u64,
    pub(super) known: SortedMap<NodeName, KnownReplica>,
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
        ConfigAgreement { configuration, fingerprint, known }
    }

    pub(super) fn encode(&self, serves: bool) -> Bytes {
        codec::encode_unbounded(&(self.configuration.encode(), serves)).into()
    }

    /// Compares the configuration that another node sent. Returns the result, and, if that node
    /// serves with another configuration, whether it goes on where this one serves as well.
    pub(super) fn compare(
        &self,
        from: &NodeName,
        bytes: &[u8],
    ) -> Option<(ConfigComparison, Option<bool>)> {
        let (theirs, serves) =
            codec::decode_bounded::<(Vec<u8>, bool), ANSWER_BYTES_MAX>(bytes).ok()?;
        let theirs = ServiceConfiguration::decode(&theirs)?;
        Some(match self.configuration.difference(from, &theirs) {
            same if same.is_empty() => (ConfigComparison::Agrees, None),
            text => {
                let other_goes_on = serves.then(|| theirs.leads(&self.configuration));
                (ConfigComparison::Differs { text: cut(text) }, other_goes_on)
            }
        })
    }

    /// Sets the carriers of the service in sight, and forgets those that do not count any more.
    pub(super) fn see(&mut self, found: &[NodeName], may_claim: impl Fn(&NodeName) -> bool) {
        self.known.retain(|node, known| {
            let seen = found.contains(node);
            // A node that agreed may have restarted when it comes back.
            if !seen && known.comparison == ConfigComparison::Agrees || !may_claim(node) {
                *known = KnownReplica::default();
            }
            known.seen = seen;
            seen || known.differs() || self.configuration.lists(node)
        });
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

    /// Asks this node at the next poll of the directory.
    pub(super) fn ask_again(&mut self, node: &NodeName) {
        if let Some(known) = self.known.get_mut(node) {
            known.asked_at = None;
        }
    }

    /// Returns whether this node is to be asked for its configuration now.
    pub(super) fn is_due(&mut self, node: &NodeName, now: Instant) -> bool {
        let Some(known) = self.known.get_mut(node) else { return false };
        let interval = match known.comparison {
            ConfigComparison::Agrees => return false,
            ConfigComparison::Unknown | ConfigComparison::Absent { confirmed: false } => {
                COMPARE_RETRY
            }
            // It may have left.
            ConfigComparison::Differs { .. } if !known.seen => COMPARE_RETRY,
            ConfigComparison::Absent { confirmed: true } | ConfigComparison::Differs { .. } => {
                COMPARE_INTERVAL
            }
        };
        let due = known.asked_at.is_none_or(|asked| now - asked >= interval);
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

    /// Returns how the configurations differ: first those of members, which certainly belong to the
    /// service.
    pub(super) fn differences(&self) -> Option<String> {
        let (mut members, mut others) = (Vec::new(), Vec::new());
        for (node, known) in &self.known {
            if let ConfigComparison::Differs { text } = &known.comparison {
                let texts = if self.configuration.lists(node) { &mut members } else { &mut others };
                texts.push(text.as_str());
            }
        }
        members.append(&mut others);
        (!members.is_empty()).then(|| {
            format!(
                "not all nodes have the same configuration of it, and no further node begins to serve until they \
                 have: {}",
                some_of(&members, "; ")
            )
        })
    }

    /// Returns the detail of the fault: the differences, and the members without the service.
    pub(super) fn describe(&self) -> Option<String> {
        let absent = self.known.iter().filter(|(node, known)| self.is_absent(node, known));
        let absent: Vec<_> = absent.map(|(node, _)| node.as_str()).collect();
        let absent = (!absent.is_empty()).then(|| {
            format!(
                "listed, but without this service: {}; add the service there, or remove the node from all lists: \
                 it counts as one that has failed",
                some_of(&absent, ", ")
            )
        });
        let texts: Vec<_> = self.differences().into_iter().chain(absent).collect();
        (!texts.is_empty()).then(|| texts.join("; "))
    }

    /// Returns whether this is a member that does not carry the service.
    pub(super) fn is_absent(&self, node: &NodeName, known: &KnownReplica) -> bool {
        known.comparison == ConfigComparison::Absent { confirmed: true }
            && self.configuration.lists(node)
    }

    /// Returns the record of this node, unless there are too many.
    pub(super) fn record(&mut self, node: &NodeName) -> Option<&mut KnownReplica> {
        // A configuration fits into one message, which bounds the number of members.
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
