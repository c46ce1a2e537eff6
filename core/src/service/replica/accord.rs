//! Whether all who carry the service were told the same of it, and what follows where they were not.
//!
//! ```text
//!   one replica                                  the other
//!      │ compare: nodes, kind, rule, hello ────────► │  anybody who has an object of the service's name
//!      │ ◄────────────────────────────────── its own │
//! ```
//!
//! Each message between replicas carries the fingerprint of its sender's terms, and one of other terms is
//! refused: no majority is ever made of votes for different things. That alone does not keep two from
//! serving, of whom neither lists the other. So whoever finds that another one's terms differ resigns, makes
//! no promise, votes for nobody, and does not claim. It goes on as soon as the other says the same, in a life
//! that was told better; or has ended in order, or carries the service no more. That it is out of sight is no
//! reason: where it serves there, it may not here.

use super::super::terms::Terms;
use super::*;
use std::collections::BTreeSet;
use std::time::Duration;

/// How soon another one is asked again that has not answered, or differs. Shorter finds out sooner; each
/// question is a small message.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// The most others of whom it is remembered what they say: far more than carry one service.
const KNOWN_MAX: usize = 1024;

/// What is known of the others that carry the service.
#[derive(Clone, Debug)]
pub(super) struct Accord {
    terms: Terms,
    fingerprint: u64,
    known: BTreeMap<NodeName, Known>,
}

#[derive(Clone, Debug, Default)]
struct Known {
    asked: Option<Instant>,
    opinion: Opinion,
}

#[derive(Clone, Debug, Default)]
enum Opinion {
    #[default]
    Unheard,
    /// It was told the same; or it does not carry this service, but something else of its name.
    Agrees,
    /// In this.
    Differs(String),
}

impl Accord {
    pub(super) fn new(config: &ReplicaConfig) -> Self {
        let terms = Terms::of(config);
        Accord { fingerprint: terms.fingerprint(), terms, known: BTreeMap::new() }
    }

    /// What this replica was told, behind everything that it says to others.
    pub(super) fn sign(&self, mut message: Vec<u8>) -> Bytes {
        message.extend(self.fingerprint.to_le_bytes());
        message.into()
    }

    /// The message itself, and whether its sender was told the same.
    pub(super) fn read<'a>(&self, message: &'a [u8]) -> Option<(&'a [u8], bool)> {
        let (message, signed) = message.split_last_chunk()?;
        Some((message, u64::from_le_bytes(*signed) == self.fingerprint))
    }

    fn differences(&self) -> impl Iterator<Item = &str> {
        self.known.values().filter_map(|known| match &known.opinion {
            Opinion::Differs(text) => Some(text.as_str()),
            Opinion::Unheard | Opinion::Agrees => None,
        })
    }

    pub(super) fn is_disputed(&self) -> bool {
        self.differences().next().is_some()
    }

    /// Whether it is to be asked now.
    fn asks(&mut self, node: &NodeName, now: Instant) -> bool {
        if !self.known.contains_key(node) && self.known.len() >= KNOWN_MAX {
            return false;
        }
        let known = self.known.entry(node.clone()).or_default();
        let wanted = !matches!(known.opinion, Opinion::Agrees)
            && known.asked.is_none_or(|asked| now - asked >= ASK_AGAIN);
        if wanted {
            known.asked = Some(now);
        }
        wanted
    }
}

impl Replica {
    /// What this replica was told, for [`Replica::handle_terms`] of the others.
    pub fn terms(&self) -> Bytes {
        self.accord.terms.encode().into()
    }

    /// What others were told otherwise, and what is to be written; nobody is served meanwhile.
    pub fn dispute(&self) -> Option<String> {
        let differences: Vec<_> = self.accord.differences().collect();
        (!differences.is_empty()).then(|| {
            format!(
                "not all nodes were told the same of it, and it is not served until they are: {}",
                differences.join("; ")
            )
        })
    }

    /// These other nodes have an object of the service's name. To be told several times a second.
    pub fn handle_carriers(&mut self, found: &[NodeName], now: Instant) {
        // One that returns may return in another life.
        self.accord.known.retain(|node, known| {
            matches!(known.opinion, Opinion::Differs(_)) || found.contains(node)
        });
        let all: BTreeSet<_> = self.accord.known.keys().chain(found).cloned().collect();
        all.iter().for_each(|node| self.compare(node, now));
    }

    /// What another node was told of the service.
    pub fn handle_terms(&mut self, from: &NodeName, terms: &[u8], now: Instant) {
        let Some(theirs) = Terms::decode(terms).filter(|_| *from != self.config.own) else {
            self.refused += 1;
            return;
        };
        let opinion = match self.accord.terms.difference(from, &theirs) {
            same if same.is_empty() => Opinion::Agrees,
            text => Opinion::Differs(text),
        };
        self.note_opinion(from, opinion, now);
    }

    /// This node has ended in order, or does not carry the service.
    pub fn handle_no_terms(&mut self, of: &NodeName, now: Instant) {
        self.note_opinion(of, Opinion::Agrees, now);
    }

    /// A replica that begins with what this one knows of the others, after its body has failed.
    #[must_use]
    pub fn begun_anew(&self, now: Instant) -> Self {
        let mut next = Replica::new(self.config.clone(), self.initial.clone(), now);
        next.accord = self.accord.clone();
        next.tell_dispute();
        next
    }

    /// This node was told otherwise, as the fingerprint of its message says.
    pub(super) fn doubt(&mut self, from: &NodeName, now: Instant) {
        if let Some(known) = self.accord.known.get_mut(from)
            && let Opinion::Agrees = known.opinion
        {
            // It was another life that agreed.
            *known = Known::default();
        }
        if self.config.members.contains(from) {
            self.compare(from, now);
        }
    }

    fn compare(&mut self, node: &NodeName, now: Instant) {
        if *node != self.config.own && self.accord.asks(node, now) {
            self.outputs.push_back(ReplicaOutput::Compare { with: node.clone() });
        }
    }

    fn note_opinion(&mut self, of: &NodeName, opinion: Opinion, now: Instant) {
        let before = self.dispute();
        if !self.accord.known.contains_key(of) && self.accord.known.len() >= KNOWN_MAX {
            self.refused += 1;
            return;
        }
        self.accord.known.entry(of.clone()).or_default().opinion = opinion;
        if self.dispute() == before {
            return;
        }
        if before.is_some() {
            self.outputs.push_back(ReplicaOutput::Agreed);
        }
        self.tell_dispute();
        if self.accord.is_disputed() {
            self.resign(now);
        } else if let Acting::Standby(standby) = &mut self.role {
            standby.hurry(&self.config, now);
        }
    }

    fn tell_dispute(&mut self) {
        if let Some(detail) = self.dispute() {
            self.outputs.push_back(ReplicaOutput::Disputed { detail });
        }
    }
}
