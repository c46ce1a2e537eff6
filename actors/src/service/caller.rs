//! Whoever asks a service, and follows it from node to node.

use super::finder::{Finder, Found, Missing, PROBE};
use super::roster::Roster;
use super::words::{Answered, AskService, Task};
use crate::messaging::error::{RequestError, decode_kind};
use crate::messaging::message_id::next_id;
use crate::platform;
use crate::registry::Registry;
use blastema_core::contract::codec;
use blastema_core::delivery::retry::FailedAttempt;
use blastema_core::sorted::SortedSet;
use blastema_core::{
    ContractIdentity, DeliveryError, Instant, MessageId, NameError, NodeName, ObjectName, Request,
    RetryPolicy,
};
use std::fmt;
use std::marker::PhantomData;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// Asks a service, whichever node serves it now. Clones share what they know of it.
pub struct ServiceRef<M: Request> {
    finder: Finder,
    asks: PhantomData<fn(M)>,
}

impl<M: Request> Clone for ServiceRef<M> {
    fn clone(&self) -> Self {
        ServiceRef { finder: self.finder.clone(), asks: PhantomData }
    }
}

impl<M: Request> fmt::Debug for ServiceRef<M> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} of service {}", M::NAME, self.finder.name)
    }
}

/// A request to a service that waits for its answer. Replies are kept for it no longer than it
/// waits.
struct Open(u64);

/// The requests of this process that wait, by number: as many as it has under way.
static OPEN: Mutex<SortedSet<u64>> = Mutex::new(SortedSet::new());

fn open() -> MutexGuard<'static, SortedSet<u64>> {
    OPEN.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Open {
    /// A new identity, and below which number all requests have their answers.
    fn begin() -> (MessageId, u64, Open) {
        let mut open = open();
        // Numbered under the lock: whoever looks meanwhile must not find a gap.
        let id = next_id();
        open.insert(id.sequence);
        let settled = open.first().copied().unwrap_or(id.sequence);
        (id, settled, Open(id.sequence))
    }
}

impl Drop for Open {
    fn drop(&mut self) {
        open().remove(&self.0);
    }
}

/// How far a request has come that has no answer yet.
#[derive(Default)]
struct Pursuit {
    begun: Begun,
    /// What the nodes of the service were told differently, if that was the last that was heard of
    /// it.
    difference: Option<String>,
}

impl Pursuit {
    /// Why there was no answer by the deadline.
    fn why(self) -> DeliveryError {
        match (self.difference, self.begun) {
            (Some(reason), Begun::Perhaps) => DeliveryError::OutcomeUnknown { reason },
            (Some(difference), Begun::No) => DeliveryError::ContractDiffers { difference },
            (None, _) => DeliveryError::DeadlinePassed,
        }
    }
}

/// Whether anybody may have begun what was asked for.
#[derive(Clone, Copy, Default)]
enum Begun {
    #[default]
    No,
    /// One was asked, and does not say.
    Perhaps,
}

impl Begun {
    /// What a caller is told that may not ask.
    fn refused(self, why: DeliveryError) -> DeliveryError {
        match self {
            Begun::No => why,
            Begun::Perhaps => DeliveryError::OutcomeUnknown { reason: why.to_string() },
        }
    }
}

/// What came of asking one node.
enum Turn {
    Answered(Answered),
    /// It did not answer, and why.
    Failed(DeliveryError),
    /// Another node serves meanwhile.
    Moved(Found),
}

impl<M: Request> ServiceRef<M> {
    pub(crate) fn new(registry: &Registry, roster: &Roster, name: &str) -> Result<Self, NameError> {
        let finder = Finder::new(ObjectName::new(name)?, registry, roster);
        Ok(ServiceRef { finder, asks: PhantomData })
    }

    /// The node that answered last.
    pub fn primary(&self) -> Option<NodeName> {
        self.finder.primary()
    }

    /// Asks, and waits for the reply for five seconds at most: long enough for a standby to take
    /// over.
    ///
    /// # Errors
    /// As [`ask_within`](Self::ask_within).
    pub async fn ask(&self, message: M) -> Result<M::Reply, RequestError<M>> {
        self.ask_within(message, Duration::from_secs(5)).await
    }

    /// Asks, and waits for the reply until the deadline. Where the node that serves fails, the
    /// request is sent to the one that follows, under the same identity: it takes effect once.
    ///
    /// # Errors
    /// [`DeliveryError::OutcomeUnknown`] where the primary of a service with cold standbys failed
    /// while it served, unless the contract is declared `idempotent`;
    /// [`DeliveryError::DeadlinePassed`] where nobody served in time; what the component's failure
    /// was, where it failed; [`DeliveryError::ContractDiffers`] where the service means another
    /// contract by that name.
    ///
    /// Where nobody serves because the service's nodes were told different things of it, that may
    /// end, as while a list is changed: it is asked on. At the deadline it is
    /// [`DeliveryError::ContractDiffers`] with what differs, or [`DeliveryError::OutcomeUnknown`]
    /// with that where somebody may have begun.
    pub async fn ask_within(
        &self,
        message: M,
        deadline: Duration,
    ) -> Result<M::Reply, RequestError<M>> {
        // A component that dies of it three times dies of it again.
        let rule = RetryPolicy { attempts: 3, within: deadline, ..RetryPolicy::default() };
        self.ask_by(message, &rule).await
    }

    /// Asks until the deadline of this rule. Whatever the rule says, the service is followed
    /// wherever it goes; the rule is for its component's failures: a request whose contract is
    /// declared `idempotent` is asked again where the component died while it served it.
    ///
    /// # Errors
    /// As [`ask_within`](Self::ask_within).
    pub async fn ask_by(
        &self,
        message: M,
        rule: &RetryPolicy,
    ) -> Result<M::Reply, RequestError<M>> {
        let mut payload = Vec::new();
        if codec::encode(&message, &mut payload).is_err() {
            let why = DeliveryError::TooLarge { limit: M::MAX_SIZE };
            return Err(RequestError::new(why, Some(message)));
        }
        let task = Task { identity: ContractIdentity::of::<M>().brief().encode(), payload };
        let until = platform::now() + rule.within;
        let failed = |why| RequestError::new(why, None);
        for asked in 1.. {
            // That a request has failed is remembered: asked again, it is another one.
            let (id, settled, _open) = Open::begin();
            let ask = AskService {
                sender: id.sender,
                sequence: id.sequence,
                settled,
                since: 0,
                task: task.clone(),
            };
            let mut pursuit = Pursuit::default();
            let pursued = self.pursue(ask, until, &mut pursuit);
            let pursued = tokio::time::timeout(until - platform::now(), pursued).await;
            let why = match pursued.unwrap_or_else(|_| Err(pursuit.why())) {
                Ok(reply) => {
                    return codec::decode_reply::<M>(&reply).map_err(|error| {
                        failed(DeliveryError::Undecodable { reason: error.to_string() })
                    });
                }
                Err(why) => why,
            };
            let attempt = FailedAttempt { asked, why: &why, idempotent: M::IDEMPOTENT };
            match rule.again(attempt, until.as_nanos()) {
                Some(wait) if platform::now() + wait < until => tokio::time::sleep(wait).await,
                _ => return Err(failed(why)),
            }
        }
        Err(failed(DeliveryError::DeadlinePassed))
    }

    /// Follows the service from node to node until it has answered.
    ///
    /// Where its nodes are at odds, it is asked on under the same identity, as after any other
    /// change of the primary: whoever serves next has the table of those that it follows, or none
    /// of their effects.
    async fn pursue(
        &self,
        mut ask: AskService,
        until: Instant,
        pursuit: &mut Pursuit,
    ) -> Result<Vec<u8>, DeliveryError> {
        let mut primary = self.primary();
        // Who has not answered, and what became of the request there if that is not known.
        let (mut failed, mut uncertain) = (None, None);
        loop {
            let node = match primary.take() {
                Some(node) => node,
                None => match self.finder.find(failed.take().as_ref()).await {
                    Ok(Found { keeps: false, .. }) if uncertain.is_some() && !M::IDEMPOTENT => {
                        return Err(DeliveryError::OutcomeUnknown {
                            reason: uncertain.unwrap_or_default(),
                        });
                    }
                    Ok(Found { primary, .. }) => {
                        pursuit.difference = None;
                        primary
                    }
                    Err(missing) => {
                        let pause = missing.pause();
                        pursuit.difference = match missing {
                            Missing::Nobody | Missing::Outdated => None,
                            Missing::Disputed(difference) => Some(difference),
                            Missing::Forbidden(why) => return Err(pursuit.begun.refused(why)),
                        };
                        tokio::time::sleep(pause).await;
                        continue;
                    }
                },
            };
            ask.since = self.finder.least(&node);
            match self.try_at(&node, &ask, until).await {
                Turn::Answered(Answered::Done { reply, epoch }) => {
                    self.finder.note_epoch(&node, epoch);
                    self.finder.note(node);
                    return Ok(reply);
                }
                Turn::Answered(Answered::Failed { why, epoch }) => {
                    self.finder.note_epoch(&node, epoch);
                    return Err(decode_kind(&why));
                }
                Turn::Answered(Answered::Refused { why }) => match decode_kind(&why) {
                    DeliveryError::Full | DeliveryError::Restarting => {
                        primary = Some(node);
                        tokio::time::sleep(PROBE).await;
                    }
                    // Its component means the same: it is the nodes that were told different
                    // things.
                    DeliveryError::ContractDiffers { difference } => {
                        pursuit.difference = Some(difference);
                        failed = Some(node);
                    }
                    why => return Err(why),
                },
                Turn::Answered(Answered::Elsewhere { primary: told }) => {
                    pursuit.begun = Begun::Perhaps;
                    primary = told.and_then(|told| self.finder.member(&told));
                    if primary.is_none() || primary.as_ref() == Some(&node) {
                        tokio::time::sleep(PROBE).await;
                    }
                }
                Turn::Moved(Found { primary, keeps: false }) if !M::IDEMPOTENT => {
                    self.finder.note(primary);
                    let reason = "the primary has changed, and its standbys are cold".into();
                    return Err(DeliveryError::OutcomeUnknown { reason });
                }
                Turn::Moved(found) => {
                    (primary, pursuit.begun) = (Some(found.primary), Begun::Perhaps);
                }
                Turn::Failed(why @ DeliveryError::Forbidden { .. }) => {
                    return Err(pursuit.begun.refused(why));
                }
                Turn::Failed(why) => {
                    pursuit.begun = Begun::Perhaps;
                    // It was taken there, perhaps; those that follow may not know.
                    if matches!(
                        why,
                        DeliveryError::PeerDied { .. } | DeliveryError::OutcomeUnknown { .. }
                    ) {
                        uncertain = Some(why.to_string());
                    }
                    failed = Some(node);
                }
            }
        }
    }

    /// Asks one node, and after a while the others whether it still serves.
    async fn try_at(&self, node: &NodeName, ask: &AskService, until: Instant) -> Turn {
        let address = format!("{node}:{}", self.finder.name);
        let sender = match self.finder.registry.sender::<AskService>(&address) {
            Ok(sender) => sender,
            Err(why) => return Turn::Failed(why),
        };
        let asking = sender.ask_within(ask.clone(), until - platform::now());
        let moved = async {
            tokio::time::sleep(PROBE).await;
            self.finder.follow(Some(node)).await
        };
        tokio::select! {
            biased;
            asked = asking => match asked {
                Ok(answered) => Turn::Answered(answered),
                Err(error) => Turn::Failed(error.kind),
            },
            found = moved => Turn::Moved(found),
        }
    }
}
