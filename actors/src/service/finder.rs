//! Finds the primary of a service.

use super::roster::Roster;
use super::types::WhoServes;
use crate::platform;
use crate::registry::Registry;
use blastema_core::{DeliveryError, Instant, NodeName, ObjectName};
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use std::sync::{Arc, Mutex};
use std::time::Duration;
use tracing::warn;

/// How long a caller waits before it asks the other nodes for the primary, and between two
/// attempts.
pub(super) const PROBE: Duration = Duration::from_millis(5);
/// How long a question waits: a node answers as soon as it knows of a primary. A shorter timeout
/// finds sooner that another node is reachable; a longer one costs fewer messages without a
/// primary.
const QUESTION_TIMEOUT: Duration = Duration::from_millis(100);
/// How long a caller does not accept a primary with a lower epoch than one that has answered. That
/// is much longer than a restarted node takes to meet the others. It is shorter than the default
/// deadline of five seconds, so that a service whose nodes all restarted is accepted in time.
const OUTDATED_TIMEOUT: Duration = Duration::from_secs(2);
/// How often a wait for a service is logged: after so long, the service may not exist or its name
/// may be wrong.
const WARN_INTERVAL: Duration = Duration::from_secs(10);

/// Why no primary was found.
pub(super) enum NoAnswer {
    /// There is none now.
    NoPrimary,
    /// There is only one with a lower epoch than a primary that has answered.
    Outdated,
    /// There is none until this difference of configurations is corrected.
    ConfigMismatch(String),
    /// The policy forbids this node to ask.
    Forbidden(DeliveryError),
}

impl NoAnswer {
    /// Returns how long to wait before all nodes are asked again.
    pub(super) fn pause(&self) -> Duration {
        match self {
            NoAnswer::NoPrimary => PROBE,
            // These are answered at once; the question does not wait for a primary.
            NoAnswer::Outdated | NoAnswer::ConfigMismatch(_) | NoAnswer::Forbidden(_) => {
                QUESTION_TIMEOUT
            }
        }
    }

    /// Returns whether this reason is at least as specific as the other.
    fn outranks(&self, other: &NoAnswer) -> bool {
        let rank = |missing: &NoAnswer| match missing {
            NoAnswer::NoPrimary => 0,
            NoAnswer::Outdated => 1,
            NoAnswer::ConfigMismatch(_) => 2,
            NoAnswer::Forbidden(_) => 3,
        };
        rank(self) >= rank(other)
    }
}

/// Finds the primary of one service. Clones share their state.
#[derive(Clone)]
pub(super) struct Finder {
    pub(super) name: ObjectName,
    pub(super) registry: Registry,
    roster: Roster,
    known: Arc<Mutex<FinderState>>,
}

/// What a finder knows of a service from answers.
#[derive(Default)]
struct FinderState {
    /// The node that answered last.
    primary: Option<NodeName>,
    /// The nodes that carry it, as one of them answered.
    members: Vec<NodeName>,
    /// The greatest epoch in which a node answered, and that node.
    answered: Option<(u64, NodeName)>,
    /// When a primary with a lower epoch was met, first and last, without another one since.
    outdated: Option<(Instant, Instant)>,
}

impl FinderState {
    /// Returns the lowest epoch in which this node may serve: one epoch has one primary.
    fn least_epoch(&self, node: &NodeName) -> u64 {
        match &self.answered {
            Some((epoch, by)) if by == node => *epoch,
            Some((epoch, _)) => epoch.saturating_add(1),
            None => 0,
        }
    }

    /// Returns whether this primary with its epoch is accepted.
    fn accepts(&mut self, node: &NodeName, epoch: u64, now: Instant) -> bool {
        if epoch >= self.least_epoch(node) {
            self.outdated = None;
            return true;
        }
        // A primary that was met long ago does not show that there was no other one since.
        let before = self.outdated.filter(|(_, last)| now - *last < OUTDATED_TIMEOUT);
        let first = before.map_or(now, |(first, _)| first);
        self.outdated = Some((first, now));
        if now - first < OUTDATED_TIMEOUT {
            return false;
        }
        (self.answered, self.outdated) = (None, None);
        true
    }
}

/// The primary, and whether the next one keeps its state.
pub(super) struct FoundPrimary {
    pub(super) primary: NodeName,
    pub(super) keeps: bool,
}

impl Finder {
    pub(super) fn new(name: ObjectName, registry: &Registry, roster: &Roster) -> Self {
        Finder { name, registry: registry.clone(), roster: roster.clone(), known: Arc::default() }
    }

    pub(super) fn primary(&self) -> Option<NodeName> {
        platform::lock(&self.known).primary.clone()
    }

    pub(super) fn note(&self, primary: NodeName) {
        platform::lock(&self.known).primary = Some(primary);
    }

    /// Returns the lowest epoch in which this node may answer.
    pub(super) fn least_epoch(&self, node: &NodeName) -> u64 {
        platform::lock(&self.known).least_epoch(node)
    }

    /// Notes that this node answered in that epoch.
    pub(super) fn note_answer(&self, node: NodeName, epoch: u64) {
        let mut known = platform::lock(&self.known);
        if epoch >= known.least_epoch(&node) {
            (known.answered, known.outdated) = (Some((epoch, node.clone())), None);
        }
        known.primary = Some(node);
    }

    /// Asks all carriers of the service for the primary, except the node `besides`, which does not
    /// count as an answer either.
    pub(super) async fn find(&self, besides: Option<&NodeName>) -> Result<FoundPrimary, NoAnswer> {
        let members = self.members();
        let others = members.iter().filter(|member| Some(*member) != besides);
        let mut answers: FuturesUnordered<_> =
            others.map(|member| self.who_serves(member, besides)).collect();
        let mut missing = NoAnswer::NoPrimary;
        while let Some(found) = answers.next().await {
            match found {
                Ok(found) => return Ok(found),
                Err(answers) if answers.outranks(&missing) => missing = answers,
                Err(_) => {}
            }
        }
        Err(missing)
    }

    /// Waits until there is a primary other than `besides`.
    pub(super) async fn follow(&self, besides: Option<&NodeName>) -> FoundPrimary {
        loop {
            match self.find(besides).await {
                Ok(found) => return found,
                Err(missing) => tokio::time::sleep(missing.pause()).await,
            }
        }
    }

    /// Returns the primary as soon as this node knows of one.
    async fn who_serves(
        &self,
        node: &NodeName,
        besides: Option<&NodeName>,
    ) -> Result<FoundPrimary, NoAnswer> {
        let address = format!("{node}:{}", self.name);
        let sender =
            self.registry.sender::<WhoServes>(&address).map_err(|_| NoAnswer::NoPrimary)?;
        let question = WhoServes { besides: besides.map(NodeName::to_string) };
        let serving = sender.ask_within(question, QUESTION_TIMEOUT).await.map_err(|error| {
            match error.kind {
                why @ DeliveryError::Forbidden { .. } => NoAnswer::Forbidden(why),
                _ => NoAnswer::NoPrimary,
            }
        })?;
        let primary = serving.primary.and_then(|primary| NodeName::new(&primary).ok());
        let primary = primary.filter(|primary| self.may_serve(primary));
        if let Some(primary) = &primary
            && !platform::lock(&self.known).accepts(primary, serving.epoch, platform::now())
        {
            return Err(NoAnswer::Outdated);
        }
        let members: Result<Vec<_>, _> = serving.members.iter().map(|n| NodeName::new(n)).collect();
        if let Ok(members) = members {
            platform::lock(&self.known).members = members;
        }
        match (primary.filter(|primary| Some(primary) != besides), serving.disputed) {
            (Some(primary), _) => Ok(FoundPrimary { primary, keeps: serving.keeps }),
            (None, Some(difference)) => Err(NoAnswer::ConfigMismatch(difference)),
            (None, None) => Err(NoAnswer::NoPrimary),
        }
    }

    /// Completes when a node answers that it is primary itself. The other nodes' answers may be
    /// outdated: they notice the end of a primary later.
    pub(super) async fn served(&self) {
        let warnings = async {
            loop {
                tokio::time::sleep(WARN_INTERVAL).await;
                warn!(service = %self.name, "this node waits for a service that has no primary");
            }
        };
        let found = async {
            let mut besides = None;
            loop {
                let primary = match self.find(besides.take().as_ref()).await {
                    Ok(FoundPrimary { primary, .. }) => primary,
                    Err(missing) => {
                        tokio::time::sleep(missing.pause()).await;
                        continue;
                    }
                };
                let own = self.who_serves(&primary, None);
                let other = async {
                    match self.find(Some(&primary)).await {
                        Ok(found) => found,
                        Err(_) => std::future::pending().await,
                    }
                };
                let answers = tokio::select! {
                    own = own => own,
                    found = other => Ok(found),
                };
                match answers {
                    Ok(answers) if answers.primary == primary => return,
                    Ok(_) => besides = Some(primary),
                    Err(_) => {}
                }
            }
        };
        tokio::select! {
            () = found => {}
            () = warnings => {}
        }
    }

    /// Returns the nodes that carry the service, as far as is known: each node sends its names when
    /// it connects, and each carrier knows the others.
    fn members(&self) -> Vec<NodeName> {
        let mut members = self.roster.members(&self.name);
        let known = platform::lock(&self.known);
        members.extend(known.members.iter().cloned());
        members.retain(|member| self.may_serve(member));
        members.sort();
        members.dedup();
        members
    }

    /// Returns whether this node may claim the service.
    pub(super) fn may_serve(&self, node: &NodeName) -> bool {
        self.registry.access().may_claim(node, &self.name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answered(epoch: u64, by: &str) -> FinderState {
        FinderState {
            answered: Some((epoch, NodeName::new(by).unwrap())),
            ..FinderState::default()
        }
    }

    #[test]
    fn in_one_epoch_only_the_node_that_answered_is_accepted() {
        let (n1, n2) = (NodeName::new("n1").unwrap(), NodeName::new("n2").unwrap());
        let now = Instant::from_millis(1000);
        for (node, epoch, expected) in
            [(&n1, 2, true), (&n2, 2, false), (&n2, 3, true), (&n1, 1, false), (&n1, 3, true)]
        {
            assert_eq!(answered(2, "n1").accepts(node, epoch, now), expected, "{node} {epoch}");
        }
        assert!(FinderState::default().accepts(&n2, 1, now));
    }

    #[test]
    fn an_outdated_primary_is_accepted_when_no_other_one_was_met_for_the_whole_timeout() {
        let n2 = NodeName::new("n2").unwrap();
        let at = Instant::from_millis;
        let mut known = answered(2, "n1");
        assert!(!known.accepts(&n2, 1, at(1000)));
        // The last meeting was too long ago.
        assert!(!known.accepts(&n2, 1, at(9000)));
        assert!(!known.accepts(&n2, 1, at(10_900)));
        // Another node knows of a later primary.
        assert!(known.accepts(&n2, 3, at(10_950)));
        assert!(!known.accepts(&n2, 1, at(11_000)));
        assert!(!known.accepts(&n2, 1, at(12_500)));
        assert!(known.accepts(&n2, 1, at(13_000)));
        assert_eq!(known.least_epoch(&n2), 0);
    }
}
