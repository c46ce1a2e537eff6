//! Who may serve where not all were told the same.
//!
//! ```text
//!            promised to the primary, or bound
//!          ┌─────────────┐
//!   theirs │ a   b   c   │ d   e      too few are left for a primary of theirs
//!          └─────────────┘
//! ```
//!
//! By one list a majority elects, by another list another one. So a primary of one terms counts,
//! for every other terms that it has heard of, those nodes of theirs who may yet elect somebody; it
//! serves only while they are too few. Those who have promised itself elect nobody. (Raft's joint
//! consensus asks the same of a change of members: majorities of both.)
//!
//! Where that cannot be, as with a node that lists none but itself, one of the two leads: that of
//! the longer list. Whoever follows keeps back as said before, and is then *bound*: told the
//! leader's terms, it serves nobody without a majority of the leader's list, and votes for nobody
//! who does not reckon with the leader. The leader need not count those who are bound, a promise
//! after they were told. So that whoever dies, or is cut off, has no say any more; a new life of
//! it, out of sight and told the same wrong thing, is one that was never met. Whoever comes back
//! into sight has to say again that it was told.
//!
//! Where the lists alone differ, and overlap, whoever was told the other one follows the primary,
//! and its promise counts for nothing: it learns the state, so that a new list begins with what was
//! done by the old one. Epochs and positions of two lists are not compared: only a snapshot brings
//! whoever learns into step.
//!
//! Two primaries of different terms, p that leads and q, would have disjoint majorities, as nobody
//! is told two things. If q reckons with p's terms, too few of p's list are left to elect p. If it
//! does not, nobody who is bound has voted for q, and too few of q's list are left to elect q. So
//! one of them does not serve.

use super::super::terms::Terms;
use super::accord::{Accord, ConfigComparison, Known};
use super::*;
use crate::sorted::SortedSet;

/// The most terms that are told apart: far more than a change of lists makes. Beyond, this one
/// serves and elects nobody until its node begins anew: of what it has forgotten, it cannot tell
/// whether somebody still has it.
pub(super) const RIVALS_MAX: usize = 64;

/// Other terms than ours.
#[derive(Clone, Debug, Default)]
pub(super) struct Rivals {
    /// By their fingerprints.
    all: SortedMap<u64, Rival>,
    /// There were more than are remembered.
    pub(super) overflow: bool,
}

#[derive(Clone, Debug)]
struct Rival {
    terms: Terms,
    /// Until when they are reckoned with because another one knows of them.
    rumoured_until: Instant,
}

impl Rivals {
    /// These are somebody's. Answers their fingerprint.
    pub(super) fn note(&mut self, terms: Terms) -> u64 {
        let fingerprint = terms.fingerprint();
        if self.all.len() >= RIVALS_MAX && !self.all.contains_key(&fingerprint) {
            self.overflow = true;
        } else {
            let rumoured_until = Instant::ORIGIN;
            self.all.entry(fingerprint).or_insert(Rival { terms, rumoured_until });
        }
        fingerprint
    }
}

impl Accord {
    /// Nobody is known to have been told anything else.
    pub(super) fn is_undisputed(&self) -> bool {
        self.rivals.all.is_empty() && !self.rivals.overflow
    }

    /// Terms that nobody has any more are not reckoned with.
    pub(super) fn forget_rivals(&mut self, now: Instant) {
        let known = self.known.values();
        let had: SortedSet<u64> = known
            .filter_map(|known| match known.opinion {
                ConfigComparison::Differs { terms, .. } => Some(terms),
                _ => None,
            })
            .collect();
        self.rivals.all.retain(|terms, rival| had.contains(terms) || now < rival.rumoured_until);
    }

    /// Terms that somebody was told, as far as this replica itself has heard.
    fn held(&self) -> impl Iterator<Item = (u64, &Rival)> {
        let rivals = self.rivals.all.iter().map(|(fingerprint, rival)| (*fingerprint, rival));
        rivals.filter(|(fingerprint, rival)| {
            self.known.values().any(|known| {
                matches!(known.opinion, ConfigComparison::Differs { terms, .. } if terms == *fingerprint)
                    // Where each part goes on by itself, they concern each other where they meet.
                    && (known.seen || !self.terms.divide(&rival.terms))
            })
        })
    }

    /// All terms that are reckoned with.
    fn in_play(&self, now: Instant) -> impl Iterator<Item = (u64, &Rival)> {
        let rumoured = self.rivals.all.iter().filter(move |(_, rival)| now < rival.rumoured_until);
        self.held().chain(rumoured.map(|(fingerprint, rival)| (*fingerprint, rival)))
    }

    /// What others are told that this one reckons with.
    pub(super) fn reckons_with(&self, now: Instant) -> Vec<u64> {
        self.in_play(now).map(|(fingerprint, _)| fingerprint).collect()
    }

    /// Terms that somebody has who is to be primary does not reckon with.
    fn unheard_in(&self, heard: &[u64]) -> Option<&Terms> {
        let mut held = self.held();
        held.find(|(fingerprint, _)| !heard.contains(fingerprint)).map(|(_, rival)| &rival.terms)
    }

    /// Whether nobody else can serve while these support us.
    pub(super) fn allows(&self, supports: impl Fn(&NodeName) -> bool, now: Instant) -> bool {
        !self.rivals.overflow
            && self.in_play(now).all(|(fingerprint, Rival { terms: theirs, .. })| {
                let leads = self.terms.leads(theirs);
                self.terms.excludes(theirs, |node| {
                    supports(node) || leads && self.keeps(node, fingerprint, theirs, now)
                })
            })
    }

    /// Whether this node is bound for so long that it keeps back from these terms, which it was
    /// told.
    fn keeps(&self, node: &NodeName, fingerprint: u64, theirs: &Terms, now: Instant) -> bool {
        let known = self.known.get(node).filter(|known| holds(&known.opinion, fingerprint));
        let bound = known.and_then(|known| known.bound);
        // Until then it may have voted before it was told.
        bound.is_some_and(|at| now >= at + theirs.promise())
    }

    /// Whether nobody of these terms may serve, however many of those who agree are there.
    pub(super) fn is_fenced(&self) -> bool {
        if self.is_undisputed() {
            return false;
        }
        let supports = |node: &NodeName| self.may_support(node);
        // Who is there is about to be told, if it was not yet.
        let keeps = |node: &NodeName, fingerprint: u64| {
            let known = self.known.get(node).filter(|known| holds(&known.opinion, fingerprint));
            known.is_some_and(|known| known.seen || known.bound.is_some())
        };
        let excluded = self.held().all(|(fingerprint, Rival { terms: theirs, .. })| {
            let leads = self.terms.leads(theirs);
            self.terms.excludes(theirs, |node| supports(node) || leads && keeps(node, fingerprint))
        });
        self.rivals.overflow || self.agreeing() < self.terms.quorum() || !excluded
    }

    /// The members that may support whoever serves by our terms.
    pub(super) fn agreeing(&self) -> usize {
        self.terms.members().iter().filter(|node| self.may_support(node)).count()
    }

    /// More was met than can be reckoned with.
    pub(super) fn is_overfull(&self) -> bool {
        self.rivals.overflow
    }

    /// Whether whoever serves by our terms may do so in spite of these: each majority of ours
    /// leaves too few of theirs to elect somebody, whoever of them dies or comes back.
    pub(super) fn hinders_nobody(&self, fingerprint: u64, now: Instant) -> bool {
        let Some(Rival { terms: theirs, .. }) = self.rivals.all.get(&fingerprint) else {
            return false;
        };
        let ours = self.terms.members().iter().filter(|node| self.may_support(node));
        let elsewhere = ours.filter(|node| !theirs.list(node)).count();
        // So many of theirs are in each majority of ours; who keeps back is none of those.
        let mut supporting = self.terms.quorum().saturating_sub(elsewhere);
        let leads = self.terms.leads(theirs);
        self.terms.excludes(theirs, |node| {
            let takes = self.may_support(node) && supporting > 0;
            supporting -= usize::from(takes);
            takes || leads && self.keeps(node, fingerprint, theirs, now)
        })
    }

    /// Whether this node, which has said so itself, has terms that differ in their list alone.
    pub(super) fn shares_state(&self, node: &NodeName, fingerprint: u64) -> bool {
        let known = self.known.get(node).filter(|known| holds(&known.opinion, fingerprint));
        let rival = known.and_then(|_| self.rivals.all.get(&fingerprint));
        rival.is_some_and(|rival| self.terms.shares_state(&rival.terms))
    }

    /// All such nodes that we do not list: they are to hear of us, too.
    pub(super) fn unlisted(&self) -> Vec<NodeName> {
        let shares = |(node, known): &(&NodeName, &Known)| match known.opinion {
            ConfigComparison::Differs { terms, .. } => {
                !self.terms.list(node) && known.seen && self.shares_state(node, terms)
            }
            _ => false,
        };
        self.known.iter().filter(shares).map(|(node, _)| node.clone()).collect()
    }

    /// Those who agree, as far as is known.
    pub(super) fn may_support(&self, node: &NodeName) -> bool {
        let known = self.known.get(node);
        self.terms.list(node)
            && !known.is_some_and(|known| matches!(known.opinion, ConfigComparison::Differs { .. }))
    }
}

fn holds(opinion: &ConfigComparison, fingerprint: u64) -> bool {
    matches!(opinion, ConfigComparison::Differs { terms, .. } if *terms == fingerprint)
}

impl Replica {
    /// Whether whoever serves, or is to, reckons with all terms that this one has heard of. If not,
    /// it is told.
    pub(super) fn is_reckoned_with(&mut self, from: &NodeName, heard: &[u64]) -> bool {
        let Some(terms) = self.accord.unheard_in(heard).map(Terms::encode) else {
            // Whoever has forgotten some does not know.
            return !self.accord.rivals.overflow;
        };
        self.send(from, &Message::Rival { terms });
        false
    }

    /// One who was told the same knows of these other terms.
    pub(super) fn hear_rival(&mut self, terms: &[u8], now: Instant) {
        let Some(terms) = Terms::decode(terms) else {
            self.refused += 1;
            return;
        };
        let fingerprint = self.accord.rivals.note(terms);
        if let Some(rival) = self.accord.rivals.all.get_mut(&fingerprint) {
            // It is said again whenever that is over.
            rival.rumoured_until = now + self.config.patience();
        }
        if self.accord.rivals.overflow {
            self.settle_dispute(now);
        }
    }
}
