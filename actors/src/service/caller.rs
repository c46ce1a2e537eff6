//! Whoever asks a service, and follows it from node to node.

use super::read_why;
use super::roster::Roster;
use super::words::{Answered, AskService, Task, WhoServes};
use crate::registry::Registry;
use crate::sender::{RequestError, next_id};
use blastema_core::{ContractIdentity, NameError, NodeName, ObjectName, Request, Why, codec};
use futures_util::StreamExt;
use futures_util::stream::FuturesUnordered;
use std::fmt;
use std::marker::PhantomData;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// How long a caller waits before it asks other nodes who serves, and before it tries again.
const PROBE: Duration = Duration::from_millis(5);
/// How long they are asked at a time: they answer as soon as they know. Shorter notices sooner that
/// another node can be reached; longer costs fewer messages while nobody serves.
const HELD: Duration = Duration::from_millis(100);

/// Asks a service, whichever node serves it now. Clones share what they know of it.
pub struct ServiceRef<M: Request> {
    name: ObjectName,
    registry: Registry,
    roster: Roster,
    known: Arc<Mutex<Known>>,
    asks: PhantomData<fn(M)>,
}

/// What was learnt of a service by asking it.
#[derive(Default)]
struct Known {
    /// Who answered last.
    primary: Option<NodeName>,
    /// Who carries it, as one of them said.
    members: Vec<NodeName>,
}

impl<M: Request> Clone for ServiceRef<M> {
    fn clone(&self) -> Self {
        ServiceRef {
            name: self.name.clone(),
            registry: self.registry.clone(),
            roster: self.roster.clone(),
            known: self.known.clone(),
            asks: PhantomData,
        }
    }
}

impl<M: Request> fmt::Debug for ServiceRef<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of service {}", M::NAME, self.name)
    }
}

/// What came of asking one node.
enum Turn {
    Answered(Answered),
    /// It did not answer, and why.
    Failed(Why),
    /// Another node serves meanwhile.
    Moved(Found),
}

/// Who serves, and whether whoever follows keeps what was served.
struct Found {
    primary: NodeName,
    keeps: bool,
}

impl<M: Request> ServiceRef<M> {
    pub(crate) fn new(registry: &Registry, roster: &Roster, name: &str) -> Result<Self, NameError> {
        Ok(ServiceRef {
            name: ObjectName::new(name)?,
            registry: registry.clone(),
            roster: roster.clone(),
            known: Arc::default(),
            asks: PhantomData,
        })
    }

    fn lock(&self) -> MutexGuard<'_, Known> {
        self.known.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The node that answered last.
    pub fn primary(&self) -> Option<NodeName> {
        self.lock().primary.clone()
    }

    /// Asks, and waits for the reply for five seconds at most: long enough for a standby to take over.
    ///
    /// # Errors
    /// As [`ask_within`](Self::ask_within).
    pub async fn ask(&self, message: M) -> Result<M::Reply, RequestError<M>> {
        self.ask_within(message, Duration::from_secs(5)).await
    }

    /// Asks, and waits for the reply until the deadline. Where the node that serves fails, the request is
    /// sent to the one that follows, under the same identity: it takes effect once.
    ///
    /// # Errors
    /// [`Why::OutcomeUnknown`] where the primary of a service with cold standbys failed while it served,
    /// unless the contract is declared `idempotent`; [`Why::DeadlinePassed`] where nobody served in time;
    /// what the component's failure was, where it failed.
    pub async fn ask_within(
        &self,
        message: M,
        deadline: Duration,
    ) -> Result<M::Reply, RequestError<M>> {
        let mut payload = Vec::new();
        if codec::encode(&message, &mut payload).is_err() {
            let why = Why::TooLarge { limit: M::MAX_SIZE };
            return Err(RequestError { why, message: Some(message) });
        }
        let id = next_id();
        let task = Task { identity: ContractIdentity::of::<M>().brief().encode(), payload };
        let ask = AskService { sender: id.sender, sequence: id.sequence, task };
        let asked = tokio::time::timeout(deadline, self.pursue(ask)).await;
        let failed = |why| RequestError { why, message: None };
        let reply = asked.map_err(|_| failed(Why::DeadlinePassed))?.map_err(failed)?;
        codec::decode_reply::<M>(&reply)
            .map_err(|error| failed(Why::Undecodable { reason: error.to_string() }))
    }

    /// Follows the service from node to node until it has answered.
    async fn pursue(&self, ask: AskService) -> Result<Vec<u8>, Why> {
        let mut primary = self.primary();
        // Who has not answered, and what became of the request there if that is not known.
        let (mut failed, mut uncertain) = (None, None);
        loop {
            let node = match primary.take() {
                Some(node) => node,
                None => match self.find(failed.take().as_ref()).await {
                    Some(Found { keeps: false, .. }) if uncertain.is_some() && !M::IDEMPOTENT => {
                        return Err(Why::OutcomeUnknown { reason: uncertain.unwrap_or_default() });
                    }
                    Some(Found { primary, .. }) => primary,
                    None => {
                        tokio::time::sleep(PROBE).await;
                        continue;
                    }
                },
            };
            match self.try_at(&node, &ask).await {
                Turn::Answered(Answered::Done(reply)) => {
                    self.lock().primary = Some(node);
                    return Ok(reply);
                }
                Turn::Answered(Answered::Failed { why }) => return Err(read_why(&why)),
                Turn::Answered(Answered::Refused { why }) => match read_why(&why) {
                    Why::Full | Why::Restarting => {
                        primary = Some(node);
                        tokio::time::sleep(PROBE).await;
                    }
                    why => return Err(why),
                },
                Turn::Answered(Answered::Elsewhere { primary: told }) => {
                    primary = told.and_then(|told| NodeName::new(&told).ok());
                    if primary.is_none() || primary.as_ref() == Some(&node) {
                        tokio::time::sleep(PROBE).await;
                    }
                }
                Turn::Moved(Found { primary, keeps: false }) if !M::IDEMPOTENT => {
                    self.lock().primary = Some(primary);
                    let reason = "the primary has changed, and its standbys are cold".into();
                    return Err(Why::OutcomeUnknown { reason });
                }
                Turn::Moved(found) => primary = Some(found.primary),
                Turn::Failed(why) => {
                    // It was taken there, perhaps; those that follow may not know.
                    if matches!(why, Why::PeerDied { .. } | Why::OutcomeUnknown { .. }) {
                        uncertain = Some(why.to_string());
                    }
                    failed = Some(node);
                }
            }
        }
    }

    /// Asks one node, and after a while the others whether it still serves.
    async fn try_at(&self, node: &NodeName, ask: &AskService) -> Turn {
        let address = format!("{node}:{}", self.name);
        let sender = match self.registry.sender::<AskService>(&address) {
            Ok(sender) => sender,
            Err(why) => return Turn::Failed(why),
        };
        // Whoever asks sets the deadline, around all of this.
        let asking = sender.ask_within(ask.clone(), Duration::from_secs(3600));
        let moved = async {
            loop {
                tokio::time::sleep(PROBE).await;
                if let Some(found) = self.find(Some(node)).await {
                    return found;
                }
            }
        };
        tokio::select! {
            biased;
            asked = asking => match asked {
                Ok(answered) => Turn::Answered(answered),
                Err(error) => Turn::Failed(error.why),
            },
            found = moved => Turn::Moved(found),
        }
    }

    /// Asks all who carry the service who serves; `besides` is no answer, and is not asked.
    async fn find(&self, besides: Option<&NodeName>) -> Option<Found> {
        let members = self.members().await;
        let others = members.iter().filter(|member| Some(*member) != besides);
        let mut told: FuturesUnordered<_> =
            others.map(|member| self.who_serves(member, besides)).collect();
        while let Some(found) = told.next().await {
            if found.is_some() {
                return found;
            }
        }
        None
    }

    /// Who serves, as soon as that node knows of anybody.
    async fn who_serves(&self, node: &NodeName, besides: Option<&NodeName>) -> Option<Found> {
        let sender = self.registry.sender::<WhoServes>(&format!("{node}:{}", self.name)).ok()?;
        let question = WhoServes { besides: besides.map(NodeName::to_string) };
        let serving = sender.ask_within(question, HELD).await.ok()?;
        let members: Result<Vec<_>, _> = serving.members.iter().map(|n| NodeName::new(n)).collect();
        if let Ok(members) = members {
            self.lock().members = members;
        }
        let primary = NodeName::new(&serving.primary?).ok()?;
        (Some(&primary) != besides).then_some(Found { primary, keeps: serving.keeps })
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
