//! Finds out who serves.

use super::roster::Roster;
use super::words::WhoServes;
use crate::registry::Registry;
use blastema_core::{NodeName, ObjectName};
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
/// Whoever waits so long for a service waits for one that is not there, or has a wrong name.
const STRANGE: Duration = Duration::from_secs(10);

/// Why nobody was found who serves.
pub(super) enum Missing {
    /// Nobody does now.
    Nobody,
    /// Nobody does before this is mended.
    Disputed(String),
}

impl Missing {
    /// How long to wait before all are asked again.
    pub(super) fn pause(&self) -> Duration {
        match self {
            Missing::Nobody => PROBE,
            // That is answered at once, and not held back until somebody serves.
            Missing::Disputed(_) => HELD,
        }
    }

    /// In what the nodes of the service were told different things.
    pub(super) fn difference(self) -> Option<String> {
        match self {
            Missing::Nobody => None,
            Missing::Disputed(difference) => Some(difference),
        }
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

    /// Asks all who carry the service who serves; `besides` is no answer, and is not asked.
    pub(super) async fn find(&self, besides: Option<&NodeName>) -> Result<Found, Missing> {
        let members = self.members().await;
        let others = members.iter().filter(|member| Some(*member) != besides);
        let mut told: FuturesUnordered<_> =
            others.map(|member| self.who_serves(member, besides)).collect();
        let mut missing = Missing::Nobody;
        while let Some(found) = told.next().await {
            match found {
                Ok(found) => return Ok(found),
                Err(Missing::Nobody) => {}
                Err(disputed) => missing = disputed,
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
        let serving = sender.ask_within(question, HELD).await.map_err(|_| Missing::Nobody)?;
        let members: Result<Vec<_>, _> = serving.members.iter().map(|n| NodeName::new(n)).collect();
        if let Ok(members) = members {
            self.lock().members = members;
        }
        let primary = serving.primary.and_then(|primary| NodeName::new(&primary).ok());
        match (primary.filter(|primary| Some(primary) != besides), serving.disputed) {
            (Some(primary), _) => Ok(Found { primary, keeps: serving.keeps }),
            (None, Some(difference)) => Err(Missing::Disputed(difference)),
            (None, None) => Err(Missing::Nobody),
        }
    }

    /// Completes when somebody says of itself that it serves. What others say of it may be past: they
    /// notice later than itself that it has stopped, or died.
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

    /// The nodes that carry the service, as far as is known: each tells its names when it is met, and any
    /// of them knows the others.
    async fn members(&self) -> Vec<NodeName> {
        let mut members = self.roster.members(&self.name).await;
        let known = self.lock();
        members.extend(known.members.iter().cloned());
        members.sort();
        members.dedup();
        members
    }
}
