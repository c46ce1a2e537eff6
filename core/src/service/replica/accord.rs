//! Whether all who carry the service were told the same of it, and what follows where they were
//! not.
//!
//! ```text
//!   one replica                                  the other
//!      │ compare: nodes, kind, rule, hello ────────► │  anybody who has an object of the service's name
//!      │ ◄────────────────────────────────── its own │
//! ```
//!
//! Each message between replicas carries the fingerprint of its sender's terms, and no vote or
//! promise of other terms counts: no majority is ever made of votes for different things. That
//! alone does not keep two from serving; what does is in [`rivals`](super::rivals). Other terms are
//! reckoned with until all who were told them say the same as this one, in a life that was told
//! better; or have ended in order, or carry the service no more. That somebody is out of sight is
//! no reason: it may be cut off and alive, and of two parts that had forgotten each other, both
//! would serve. But whoever was not seen for a minute, perhaps for good, is told of no more where
//! what it was told hinders nobody here; it is still reckoned with, so that who may serve is the
//! same.
//!
//! A member that is there and does not carry the service is told as well, and does no harm: it is
//! one that has failed.

use super::super::terms::{TERMS_MAX, Terms};
use super::rivals::{RIVALS_MAX, Rivals};
use super::*;
use crate::sorted::SortedSet;
use std::time::Duration;

/// How soon another one is asked again that has not answered, or is out of sight. Shorter finds out
/// sooner; each question is a small message, and none where no path leads there.
const ASK_AGAIN: Duration = Duration::from_millis(500);
/// And one that has answered, and differs: another life of it says by itself what it was told.
/// Shorter would load slow lines.
const LOOK_AGAIN: Duration = Duration::from_secs(5);
/// Whoever differs, hinders nobody, and was not seen for so long is told of no more: as long as
/// other faults last after what caused them. Shorter would tell of it anew with each longer cut.
const QUIET: Duration = Duration::from_secs(60);
/// The most others, beside the members, of whom it is remembered what they say: far more than carry
/// one service.
const KNOWN_MAX: usize = 1024;
/// The most bytes of what is remembered of one: the whole of what differs, unless names are very
/// long.
const TEXT_MAX: usize = 1024;
/// The most bytes of an answer: terms, and a position.
const TOLD_MAX: usize = TERMS_MAX + 32;
/// The most others that are named: what is written for the first ones is wanted of all, and callers
/// on other nodes are told in one small message.
const NAMED_MAX: usize = 8;

/// What is known of the others that carry the service.
#[derive(Clone, Debug)]
pub(super) struct Accord {
    pub(super) terms: Terms,
    fingerprint: u64,
    pub(super) known: SortedMap<NodeName, Known>,
    pub(super) rivals: Rivals,
    /// To these a path leads: some of those who carry the service.
    pub(super) reached: SortedSet<NodeName>,
    /// What the others were told otherwise, and whether anybody serves all the same.
    dispute: Option<String>,
    /// Nobody of these terms serves until that is mended.
    hopeless: bool,
    /// What was said of it last.
    told: Option<String>,
}

#[derive(Clone, Debug, Default)]
pub(super) struct Known {
    asked: Option<Instant>,
    pub(super) opinion: ConfigComparison,
    /// Since when it is known to have been told our terms.
    pub(super) bound: Option<Instant>,
    /// It was seen when this replica last looked around.
    pub(super) seen: bool,
    /// It was seen once, and then was not.
    gone: bool,
    /// No path leads there since then.
    away_since: Option<Instant>,
    /// It differs, and is told of no more.
    quiet: bool,
}

#[derive(Clone, Debug, Default, PartialEq)]
pub(super) enum ConfigComparison {
    #[default]
    Unheard,
    /// It was told the same.
    Agrees,
    /// It does not carry this service; said once, it may just begin.
    Absent { twice: bool },
    /// In this, by these terms.
    Differs { text: String, terms: u64 },
}

/// Who is there of a service.
#[derive(Default)]
pub(super) struct Roll<'a> {
    /// So many members, this one included, who were told the same as far as is known.
    pub(super) there: usize,
    /// Members who are not.
    pub(super) unheard: Vec<&'a str>,
    /// Members who do not carry it.
    pub(super) without: Vec<&'a str>,
    /// Those who were told otherwise.
    pub(super) differing: Vec<&'a str>,
}

impl Accord {
    pub(super) fn new(config: &ReplicaConfig) -> Self {
        let terms = Terms::of(config);
        Accord {
            fingerprint: terms.fingerprint(),
            terms,
            known: SortedMap::new(),
            rivals: Rivals::default(),
            reached: SortedSet::new(),
            dispute: None,
            hopeless: false,
            told: None,
        }
    }

    /// What this replica was told, behind everything that it says to others.
    pub(super) fn sign(&self, mut message: Vec<u8>) -> Bytes {
        message.extend(self.fingerprint.to_le_bytes());
        message.into()
    }

    /// The message itself, and what its sender was told.
    pub(super) fn read<'a>(&self, message: &'a [u8]) -> Option<(&'a [u8], u64)> {
        let (message, signed) = message.split_last_chunk()?;
        Some((message, u64::from_le_bytes(*signed)))
    }

    /// These are our own terms.
    pub(super) fn is_ours(&self, fingerprint: u64) -> bool {
        fingerprint == self.fingerprint
    }

    /// What differs: first of members, who are sure to be meant.
    fn differences(&self) -> Vec<&str> {
        let (mut members, mut others) = (Vec::new(), Vec::new());
        for (node, known) in &self.known {
            if let ConfigComparison::Differs { text, .. } = &known.opinion
                && !known.quiet
            {
                let texts = if self.terms.list(node) { &mut members } else { &mut others };
                texts.push(text.as_str());
            }
        }
        members.append(&mut others);
        members
    }

    /// Writes down what is disputed now.
    fn note_dispute(&mut self) {
        self.hopeless = self.is_fenced();
        let differences = self.differences();
        let what = match self.hopeless {
            true => "and it is not served by these terms until they are",
            false => "and those who agree go on while enough of them are there",
        };
        let too_many = self.rivals.overflow.then(|| {
            format!(
                "more than {RIVALS_MAX} different terms were met, or terms of more than {KNOWN_MAX} others, which \
                 are too many to tell who else may serve: tell all the same, and start this node anew"
            )
        });
        let differences = (!differences.is_empty()).then(|| {
            let differences = some_of(&differences, "; ");
            format!("not all nodes were told the same of it, {what}: {differences}")
        });
        let dispute: Vec<_> = too_many.into_iter().chain(differences).collect();
        self.dispute = (!dispute.is_empty()).then(|| dispute.join("; "));
    }

    /// Somebody is to be told of this one.
    fn is_wrong(&self, node: &NodeName, opinion: &ConfigComparison) -> bool {
        match opinion {
            ConfigComparison::Differs { .. } => true,
            ConfigComparison::Absent { twice } => *twice && self.terms.list(node),
            ConfigComparison::Unheard | ConfigComparison::Agrees => false,
        }
    }

    /// Who was told nothing at all.
    fn absent(&self) -> Option<String> {
        let absent = self.known.iter().filter(|(node, known)| {
            matches!(known.opinion, ConfigComparison::Absent { .. })
                && self.is_wrong(node, &known.opinion)
        });
        let absent: Vec<_> = absent.map(|(node, _)| node.as_str()).collect();
        (!absent.is_empty()).then(|| {
            format!(
                "listed, but without this service: {}; give it there too, or leave it out of all lists: \
                 so it counts as one that has failed",
                some_of(&absent, ", ")
            )
        })
    }

    /// Who of the members is there, and who was told otherwise, member or not.
    pub(super) fn roll(&self, config: &ReplicaConfig) -> Roll<'_> {
        let mut roll = Roll::default();
        for (node, known) in &self.known {
            if matches!(known.opinion, ConfigComparison::Differs { .. }) && !known.quiet {
                roll.differing.push(node.as_str());
            }
        }
        for member in self.terms.members() {
            let known = self.known.get(member);
            match known.map(|known| (&known.opinion, self.reached.contains(member))) {
                _ if *member == config.own => roll.there += 1,
                Some((ConfigComparison::Differs { .. }, _))
                    if known.is_some_and(|known| !known.quiet) => {}
                Some((ConfigComparison::Differs { .. }, _)) => roll.unheard.push(member.as_str()),
                Some((opinion @ ConfigComparison::Absent { .. }, _))
                    if self.is_wrong(member, opinion) =>
                {
                    roll.without.push(member.as_str());
                }
                Some((_, true)) => roll.there += 1,
                Some((_, false)) | None => roll.unheard.push(member.as_str()),
            }
        }
        roll
    }

    /// Nobody of these terms serves until others say the same, or have gone.
    pub(super) fn is_hopeless(&self) -> bool {
        self.hopeless
    }

    /// Whoever differs and has not been seen for long is told of no more where it hinders nobody.
    fn quieten(&mut self, now: Instant) {
        let away = |known: &Known| known.away_since.is_some_and(|since| now - since >= QUIET);
        let differing = |known: &Known| match known.opinion {
            ConfigComparison::Differs { terms, .. } => Some(terms),
            _ => None,
        };
        let terms: SortedSet<u64> =
            self.known.values().filter(|known| away(known)).filter_map(differing).collect();
        // Who is kept out by it is to be told why.
        let enough = self.agreeing() >= self.terms.quorum();
        let is_harmless = |terms: &u64| enough && self.hinders_nobody(*terms, now);
        let harmless: SortedSet<u64> = terms.into_iter().filter(is_harmless).collect();
        for known in self.known.values_mut() {
            let terms = differing(known).filter(|terms| harmless.contains(terms));
            known.quiet = terms.is_some() && away(known);
        }
    }

    /// What is known of this one, unless that would be one too many.
    fn known(&mut self, node: &NodeName) -> Option<&mut Known> {
        // The members are in one message of terms: not more than fit there.
        let room =
            self.known.len() < KNOWN_MAX || self.known.contains_key(node) || self.terms.list(node);
        room.then(|| self.known.entry(node.clone()).or_default())
    }
}

/// The first ones, and how many more there are.
pub(super) fn some_of(texts: &[&str], separator: &str) -> String {
    let named = texts[..texts.len().min(NAMED_MAX)].join(separator);
    match texts.len().saturating_sub(NAMED_MAX) {
        0 => named,
        more => format!("{named}{separator}and {more} more"),
    }
}

/// As much of it as is remembered.
fn cut(mut text: String) -> String {
    if text.len() > TEXT_MAX {
        let end = (0..=TEXT_MAX).rev().find(|end| text.is_char_boundary(*end));
        text.truncate(end.unwrap_or(0));
        text.push('…');
    }
    text
}

impl Replica {
    /// What this replica was told, and how far it knows callers to be answered, for
    /// [`Replica::handle_terms`] of the others.
    pub fn terms(&self) -> Bytes {
        codec::encode_unbounded(&(self.accord.terms.encode(), self.answered)).into()
    }

    /// What others were told otherwise, and what is to be written, where nobody is served
    /// meanwhile.
    pub fn dispute(&self) -> Option<&str> {
        self.accord.dispute.as_deref().filter(|_| self.accord.hopeless)
    }

    /// A path leads to these, of those that [`Replica::handle_carriers`] is going to be told of.
    pub fn handle_reached(&mut self, reached: &[NodeName]) {
        self.accord.reached = reached.iter().cloned().collect();
    }

    /// What was heard of nodes that may not claim the service, or may no more, does not count. To
    /// be told before [`Replica::handle_carriers`], as the policy of the robot may change.
    pub fn handle_claimants(&mut self, may_claim: impl Fn(&NodeName) -> bool, now: Instant) {
        let counts = |node: &NodeName, known: &Known| {
            known.opinion == ConfigComparison::Unheard || may_claim(node)
        };
        let before = self.accord.known.len();
        self.accord.known.retain(|node, known| counts(node, known));
        if self.accord.known.len() != before {
            self.accord.forget_rivals(now);
            self.settle_dispute(now);
        }
    }

    /// These other nodes have an object of the service's name, be there a path to them or not. To
    /// be told several times a second.
    pub fn handle_carriers(&mut self, found: &[NodeName], now: Instant) {
        // One that returns may return in another life.
        let members = &self.config.members;
        let concerns = |node: &NodeName| found.contains(node) || members.contains(node);
        self.accord.known.retain(|node, known| match &known.opinion {
            ConfigComparison::Differs { .. } => true,
            ConfigComparison::Unheard | ConfigComparison::Absent { .. } => concerns(node),
            ConfigComparison::Agrees => found.contains(node),
        });
        for (node, known) in &mut self.accord.known {
            let seen = found.contains(node);
            if seen && known.gone {
                // In another life it knows of nobody.
                (known.bound, known.asked) = (None, None);
            }
            known.gone = !seen && (known.seen || known.gone);
            known.seen = seen;
            known.away_since = match self.accord.reached.contains(node) {
                true => None,
                false => known.away_since.or(Some(now)),
            };
        }
        self.accord.quieten(now);
        let known = self.accord.known.keys();
        let all: SortedSet<_> = known.chain(found).chain(members).cloned().collect();
        all.iter().for_each(|node| self.compare(node, now));
        self.settle_dispute(now);
    }

    /// What another node was told of the service, as it answers; so it has heard what this one was
    /// told.
    pub fn handle_terms(&mut self, from: &NodeName, terms: &[u8], now: Instant) {
        self.hear_terms(from, terms, true, now);
    }

    /// What another node was told of the service, as it asks. It is going to be asked in its turn.
    pub fn handle_asked(&mut self, from: &NodeName, terms: &[u8], now: Instant) {
        if self.hear_terms(from, terms, false, now)
            && let Some(known) = self.accord.known.get_mut(from)
        {
            known.asked = None;
            self.compare(from, now);
        }
    }

    /// Answers whether it has not said so before.
    fn hear_terms(&mut self, from: &NodeName, terms: &[u8], answers: bool, now: Instant) -> bool {
        let told = codec::decode_bounded::<(Vec<u8>, Position), TOLD_MAX>(terms).ok();
        let told = told.filter(|_| *from != self.config.own);
        let told = told.and_then(|(terms, answered)| Some((Terms::decode(&terms)?, answered)));
        let Some((theirs, answered)) = told else {
            self.refused += 1;
            return false;
        };
        if theirs != self.accord.terms && self.accord.terms.shares_state(&theirs) {
            self.hear_answered(answered, now);
        }
        let opinion = match self.accord.terms.difference(from, &theirs) {
            same if same.is_empty() => ConfigComparison::Agrees,
            text => ConfigComparison::Differs {
                text: cut(text),
                terms: self.accord.rivals.note(theirs),
            },
        };
        let before = self.accord.known.get(from).map(|known| known.opinion.clone());
        self.note_opinion(from, opinion.clone(), now);
        if let Some(known) = self.accord.known.get_mut(from) {
            if std::mem::take(&mut known.gone) {
                (known.bound, known.asked) = (None, None);
            }
            (known.away_since, known.quiet) = (None, false);
            if answers {
                known.bound.get_or_insert(now);
            }
        }
        self.settle_dispute(now);
        before.as_ref() != Some(&opinion)
    }

    /// This node is there, and does not carry the service.
    pub fn handle_no_terms(&mut self, of: &NodeName, now: Instant) {
        let before = self.accord.known.get(of).map(|known| &known.opinion);
        let twice = matches!(before, Some(ConfigComparison::Absent { .. }));
        self.note_opinion(of, ConfigComparison::Absent { twice }, now);
        self.settle_dispute(now);
    }

    /// This node has ended in order.
    pub fn handle_left(&mut self, node: &NodeName, now: Instant) {
        self.note_opinion(node, ConfigComparison::Unheard, now);
        self.settle_dispute(now);
    }

    /// A replica that begins with what this one knows of the others, after its body has failed.
    #[must_use]
    pub fn begun_anew(&self, now: Instant) -> Self {
        let mut next = Replica::new(self.config.clone(), self.initial.clone(), now);
        next.accord = self.accord.clone();
        next.answered = self.answered;
        next.faults = self.faults.clone();
        next.end_faults();
        // If it still stands, it is found again.
        next.set_fault(FaultKind::ServiceUnavailable, None);
        next.accord.told = None;
        next.settle_dispute(now);
        next
    }

    /// This node was told otherwise, as the fingerprint of its message says.
    pub(super) fn doubt(&mut self, from: &NodeName, now: Instant) {
        if let Some(known) = self.accord.known.get_mut(from)
            && known.opinion == ConfigComparison::Agrees
        {
            // It was another life that agreed.
            *known = Known { seen: known.seen, ..Known::default() };
        }
        if self.config.members.contains(from) {
            self.compare(from, now);
        }
    }

    fn compare(&mut self, node: &NodeName, now: Instant) {
        let Some(known) = self.accord.known(node).filter(|_| *node != self.config.own) else {
            return;
        };
        let again = match known.opinion {
            ConfigComparison::Agrees => return,
            ConfigComparison::Unheard | ConfigComparison::Absent { twice: false } => ASK_AGAIN,
            // Whoever is out of sight may have left, which costs the line nothing to find out.
            ConfigComparison::Differs { .. } if known.bound.is_none() || !known.seen => ASK_AGAIN,
            ConfigComparison::Absent { twice: true } | ConfigComparison::Differs { .. } => {
                LOOK_AGAIN
            }
        };
        if known.asked.is_none_or(|asked| now - asked >= again) {
            known.asked = Some(now);
            self.outputs.push_back(ReplicaOutput::Compare { with: node.clone() });
        }
    }

    fn note_opinion(&mut self, of: &NodeName, opinion: ConfigComparison, now: Instant) {
        let Some(known) = self.accord.known(of) else {
            self.refused += 1;
            // Whoever is not remembered may be anybody.
            self.accord.rivals.overflow |= matches!(opinion, ConfigComparison::Differs { .. });
            return;
        };
        if known.opinion == opinion {
            return;
        }
        let before = std::mem::replace(&mut known.opinion, opinion.clone());
        known.bound = None;
        // One more is more of the same.
        if self.accord.is_wrong(of, &before) {
            self.accord.told = None;
            self.outputs.push_back(ReplicaOutput::Agreed);
        }
        self.accord.forget_rivals(now);
        if let Acting::Standby(standby) = &mut self.role {
            standby.hurry(&self.config, now);
        }
    }

    /// Says what is disputed, where that is something else than before, and serves no more where it
    /// may not.
    pub(super) fn settle_dispute(&mut self, now: Instant) {
        self.accord.note_dispute();
        let dispute = self.accord.dispute.clone();
        let wrong: Vec<_> = dispute.into_iter().chain(self.accord.absent()).collect();
        let wrong = (!wrong.is_empty()).then(|| wrong.join("; "));
        if wrong != self.accord.told {
            self.accord.told.clone_from(&wrong);
            self.outputs.push_back(match wrong {
                Some(detail) => ReplicaOutput::Disputed { detail },
                None => ReplicaOutput::Agreed,
            });
        }
        if let Acting::Primary(primary) = &self.role
            && !primary.holds(&self.config, &self.accord, now)
        {
            self.resign(now);
        }
    }
}
