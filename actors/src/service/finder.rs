//! Finds out who serves.

use super::roster::Roster;
use super::words::WhoServes;
use crate::platform;
use crate::registry::Registry;
use blastema_core::{DeliveryError, Instant, NodeName, ObjectName};
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tracing::warn;

/// How long a caller waits before it asks other nodes who serves, and before it tries again.
pub(super) const PROBE: Duration = Duration::from_millis(5);
/// How long they are asked at a time: they answer as soon as they know. Shorter notices sooner that
/// another node can be reached; longer costs fewer messages while nobody serves.
const HELD: Duration = Duration::from_millis(100);
/// So long nobody is followed who serves under a lower epoch than one that has answered: much
/// longer than a new life takes to meet the others, and short enough that whoever asks for five
/// seconds follows a service that has begun again as a whole.
const LAPSE: Duration = Duration::from_secs(2);
/// Whoever waits so long for a service waits for one that is not there, or has a wrong name.
const STRANGE: Duration = Duration::from_secs(10);

/// Why nobody was found who serves.
pub(super) enum Missing {
    /// Nobody does now.
    Nobody,
    /// Nobody does but under an epoch lower than one that has answered.
    Outdated,
    /// Nobody does before this is mended.
    Disputed(String),
    /// This node may not ask.
    Forbidden(DeliveryError),
}

impl Missing {
    /// How long to wait before all are asked again.
    pub(super) fn pause(&self) -> Duration {
        match self {
            Missing::Nobody => PROBE,
            // That is answered at once, and not held back until somebody serves.
            Missing::Outdated | Missing::Disputed(_) | Missing::Forbidden(_) => HELD,
        }
    }

    /// Whether this tells a caller more than the other.
    fn tells_more_than(&self, other: &Missing) -> bool {
        let rank = |missing: &Missing| match missing {
            Missing::Nobody => 0,
            Missing::Outdated => 1,
            Missing::Disputed(_) => 2,
            Missing::Forbidden(_) => 3,
        };
        rank(self) >= rank(other)
    }
}

/// Finds out who serves a service. Clones share what was learnt.
#[derive(Clone)]
pub(super) struct Finder {
    pub(super) name: ObjectName,
    pub(super) registry: Registry,
    roster: Roster,
    known: Arc<Mutex<Known>>,
}

/// What was learnt of a service by asking.
#[derive(Default)]
struct Known {
    /// Who answered last.
    primary: Option<NodeName>,
    /// Who carries it, as one of them said.
    members: Vec<NodeName>,
    /// The greatest epoch under which one of them answered, and which.
    answered: Option<(u64, NodeName)>,
    /// When somebody was met who serves under a lower one, first and last, and nobody else since.
    outdated: Option<(Instant, Instant)>,
}

impl Known {
    /// The lowest epoch under which this one may serve: under one epoch nobody serves but who has
    /// answered.
    fn least(&self, node: &NodeName) -> u64 {
        match &self.answered {
            Some((epoch, by)) if by == node => *epoch,
            Some((epoch, _)) => epoch.saturating_add(1),
            None => 0,
        }
    }

    /// Whether this one, who serves under that epoch, is followed.
    fn follows(&mut self, node: &NodeName, epoch: u64, now: Instant) -> bool {
        if epoch >= self.least(node) {
            self.outdated = None;
            return true;
        }
        // What was met long ago says nothing of who has been there meanwhile.
        let before = self.outdated.filter(|(_, last)| now - *last < LAPSE);
        let first = before.map_or(now, |(first, _)| first);
        self.outdated = Some((first, now));
        if now - first < LAPSE {
            return false;
        }
        (self.answered, self.outdated) = (None, None);
        true
    }
}

/// Who serves, and whether whoever follows keeps what was served.
pub(super) struct Found {
    pub(super) primary: NodeName,
    pub(super) keeps: bool,
}

impl Finder {
    pub(super) fn new(name: ObjectName, registry: &Registry, roster: &Roster) -> Self {
        Finder { name, registry: registry.clone(), roster: roster.clone(), known: Arc::default() }
    }

    fn lock(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn primary(&self) -> Option<NodeName> {
        self.lock().primary.clone()
    }

    pub(super) fn note(&self, primary: NodeName) {
        self.lock().primary = Some(primary);
    }

    /// The lowest epoch under which this one is to answer.
    pub(super) fn least(&self, node: &NodeName) -> u64 {
        self.lock().least(node)
    }

    /// This one has answered under that epoch.
    pub(super) fn note_epoch(&self, node: &NodeName, epoch: u64) {
        let mut known = self.lock();
        if epoch >= known.least(node) {
            (known.answered, known.outdated) = (Some((epoch, node.clone())), None);
        }
    }

    /// Asks all who carry the service who serves; `besides` is no answer, and is not asked.
    pub(super) async fn find(&self, besides: Option<&NodeName>) -> Result<Found, Missing> {
        let members = self.members();
        let others = members.iter().filter(|member| Some(*member) != besides);
        let mut told: FuturesUnordered<_> =
            others.map(|member| self.who_serves(member, besides)).collect();
        let mut missing = Missing::Nobody;
        while let Some(found) = told.next().await {
            match found {
                Ok(found) => return Ok(found),
                Err(told) if told.tells_more_than(&missing) => missing = told,
                Err(_) => {}
            }
        }
        Err(missing)
    }

    /// Finds somebody who serves now, however long that takes.
    pub(super) async fn follow(&self, besides: Option<&NodeName>) -> Found {
        loop {
            match self.find(besides).await {
                Ok(found) => return found,
                Err(missing) => tokio::time::sleep(missing.pause()).await,
            }
        }
    }

    /// Who serves, as soon as that node knows of anybody.
    async fn who_serves(
        &self,
        node: &NodeName,
        besides: Option<&NodeName>,
    ) -> Result<Found, Missing> {
        let address = format!("{node}:{}", self.name);
        let sender = self.registry.sender::<WhoServes>(&address).map_err(|_| Missing::Nobody)?;
        let question = WhoServes { besides: besides.map(NodeName::to_string) };
        let serving =
            sender.ask_within(question, HELD).await.map_err(|error| match error.kind {
                why @ DeliveryError::Forbidden { .. } => Missing::Forbidden(why),
                _ => Missing::Nobody,
            })?;
        let primary = serving.primary.and_then(|primary| self.member(&primary));
        if let Some(primary) = &primary
            && !self.lock().follows(primary, serving.epoch, platform::now())
        {
            return Err(Missing::Outdated);
        }
        let members: Result<Vec<_>, _> = serving.members.iter().map(|n| NodeName::new(n)).collect();
        if let Ok(members) = members {
            self.lock().members = members;
        }
        match (primary.filter(|primary| Some(primary) != besides), serving.disputed) {
            (Some(primary), _) => Ok(Found { primary, keeps: serving.keeps }),
            (None, Some(difference)) => Err(Missing::Disputed(difference)),
            (None, None) => Err(Missing::Nobody),
        }
    }

    /// Completes when somebody says of itself that it serves. What others say of it may be past:
    /// they notice later than itself that it has stopped, or died.
    pub(super) async fn served(&self) {
        let patience = async {
            loop {
                tokio::time::sleep(STRANGE).await;
                warn!(service = %self.name, "others wait for this service, and nobody serves it");
            }
        };
        let found = async {
            let mut besides = None;
            loop {
                let primary = match self.find(besides.take().as_ref()).await {
                    Ok(Found { primary, .. }) => primary,
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
                let told = tokio::select! {
                    own = own => own,
                    found = other => Ok(found),
                };
                match told {
                    Ok(told) if told.primary == primary => return,
                    Ok(_) => besides = Some(primary),
                    Err(_) => {}
                }
            }
        };
        tokio::select! {
            () = found => {}
            () = patience => {}
        }
    }

    /// The nodes that carry the service, as far as is known: each tells its names when it is met,
    /// and any of them knows the others.
    fn members(&self) -> Vec<NodeName> {
        let mut members = self.roster.members(&self.name);
        let known = self.lock();
        members.extend(known.members.iter().cloned());
        members.retain(|member| self.registry.access().may_claim(member, &self.name));
        members.sort();
        members.dedup();
        members
    }

    /// The node of this name, if it may serve.
    pub(super) fn member(&self, name: &str) -> Option<NodeName> {
        let node = NodeName::new(name).ok()?;
        self.registry.access().may_claim(&node, &self.name).then_some(node)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn answered(epoch: u64, by: &str) -> Known {
        Known { answered: Some((epoch, NodeName::new(by).unwrap())), ..Known::default() }
    }

    #[test]
    fn under_one_epoch_nobody_is_followed_but_who_has_answered() {
        let (n1, n2) = (NodeName::new("n1").unwrap(), NodeName::new("n2").unwrap());
        let now = Instant::from_millis(1000);
        for (node, epoch, expected) in
            [(&n1, 2, true), (&n2, 2, false), (&n2, 3, true), (&n1, 1, false), (&n1, 3, true)]
        {
            assert_eq!(answered(2, "n1").follows(node, epoch, now), expected, "{node} {epoch}");
        }
        assert!(Known::default().follows(&n2, 1, now));
    }

    #[test]
    fn what_is_outdated_is_followed_when_nobody_else_was_met_all_the_while() {
        let n2 = NodeName::new("n2").unwrap();
        let at = Instant::from_millis;
        let mut known = answered(2, "n1");
        assert!(!known.follows(&n2, 1, at(1000)));
        // Long ago: it has not been asked meanwhile.
        assert!(!known.follows(&n2, 1, at(9000)));
        assert!(!known.follows(&n2, 1, at(10_900)));
        // Somebody knows of a follower.
        assert!(known.follows(&n2, 3, at(10_950)));
        assert!(!known.follows(&n2, 1, at(11_000)));
        assert!(!known.follows(&n2, 1, at(12_500)));
        assert!(known.follows(&n2, 1, at(13_000)));
        assert_eq!(known.least(&n2), 0);
    }
}
