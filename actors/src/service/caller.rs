//! Sends requests to a service, and follows its primary from node to node.

use super::finder::{Finder, FoundPrimary, NoAnswer, PROBE};
use super::roster::Roster;
use super::types::{Answered, AskService, TASK_MAX, Task};
use crate::messaging::error::RequestError;
use crate::messaging::message_id::next_id;
use crate::platform;
use crate::registry::Registry;
use blastema_core::contract::codec;
use blastema_core::delivery::retry::FailedAttempt;
use blastema_core::service::ServiceOutcome;
use blastema_core::{
    ContractIdentity, DeliveryError, Instant, MessageId, NameError, NodeName, ObjectName, Request,
    RetryPolicy,
};
use std::collections::BTreeSet;
use std::fmt;
use std::marker::PhantomData;
use std::sync::Mutex;
use std::time::Duration;

/// Sends requests to a service, whichever node is primary. Clones share what they know of the
/// service.
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

/// The number of a request that waits for its reply. The service keeps the reply no longer than
/// that.
struct OpenRequest(u64);

/// The requests of this process that wait, by number: as many as it has in flight.
static OPEN: Mutex<BTreeSet<u64>> = Mutex::new(BTreeSet::new());

impl OpenRequest {
    /// Returns a new identity, and the number below which all requests have their replies.
    fn begin() -> (MessageId, u64, OpenRequest) {
        let mut open = platform::lock(&OPEN);
        // The number is taken under the lock, so that no other task computes `settled` without it.
        let id = next_id();
        open.insert(id.sequence);
        let settled = open.first().copied().unwrap_or(id.sequence);
        (id, settled, OpenRequest(id.sequence))
    }
}

impl Drop for OpenRequest {
    fn drop(&mut self) {
        platform::lock(&OPEN).remove(&self.0);
    }
}

/// The progress of a request that has no reply yet.
#[derive(Default)]
struct RequestProgress {
    /// A node received the request, and its outcome is unknown.
    perhaps_begun: bool,
    /// How the configurations of the service's nodes differ, if that was the last answer.
    difference: Option<String>,
}

impl RequestProgress {
    /// Returns the error for a request that is not sent again.
    fn refused(&self, why: DeliveryError) -> DeliveryError {
        match self.perhaps_begun {
            true => DeliveryError::OutcomeUnknown { reason: why.to_string() },
            false => why,
        }
    }

    /// Returns why there was no reply by the deadline.
    fn why(mut self) -> DeliveryError {
        match self.difference.take() {
            Some(difference) => self.refused(DeliveryError::ContractDiffers { difference }),
            None => DeliveryError::DeadlinePassed,
        }
    }
}

impl<M: Request> ServiceRef<M> {
    pub(crate) fn new(registry: &Registry, roster: &Roster, name: &str) -> Result<Self, NameError> {
        let finder = Finder::new(ObjectName::new(name)?, registry, roster);
        Ok(ServiceRef { finder, asks: PhantomData })
    }

    /// Returns the node that answered last.
    pub fn primary(&self) -> Option<NodeName> {
        self.finder.primary()
    }

    /// Sends a request, and waits at most five seconds for the reply: long enough for a standby to
    /// take over.
    ///
    /// # Errors
    /// As [`ask_within`](Self::ask_within).
    pub async fn ask(&self, message: M) -> Result<M::Reply, RequestError<M>> {
        self.ask_within(message, Duration::from_secs(5)).await
    }

    /// Sends a request, and waits for the reply until the deadline. If the primary's node fails,
    /// the request is sent to the next primary with the same identity, so it takes effect once.
    ///
    /// # Errors
    /// * [`DeliveryError::OutcomeUnknown`] if the primary of a service with cold standbys failed
    ///   while it served, unless the contract is declared `idempotent`.
    /// * [`DeliveryError::DeadlinePassed`] if there was no primary in time.
    /// * [`DeliveryError::ContractDiffers`] if the service has another contract of this name.
    /// * The component's error, if the component failed.
    ///
    /// Nodes with different configurations may prevent an election. That ends when the wrong node is
    /// corrected, so the request is tried until the deadline. The error is then
    /// [`DeliveryError::ContractDiffers`] with the difference, or [`DeliveryError::OutcomeUnknown`]
    /// with it if a node may have begun the request.
    pub async fn ask_within(
        &self,
        message: M,
        deadline: Duration,
    ) -> Result<M::Reply, RequestError<M>> {
        // A request that ends the component three times will end it again.
        let rule = RetryPolicy { attempts: 3, within: deadline, ..RetryPolicy::default() };
        self.ask_by(message, &rule).await
    }

    /// Sends a request until the deadline of this rule. The primary is followed from node to node
    /// whatever the rule says. The rule applies to the component's failures: a request with an
    /// `idempotent` contract is sent again if the component ended while it served it.
    ///
    /// # Errors
    /// As [`ask_within`](Self::ask_within).
    pub async fn ask_by(
        &self,
        message: M,
        rule: &RetryPolicy,
    ) -> Result<M::Reply, RequestError<M>> {
        let identity = ContractIdentity::of::<M>().brief().encode();
        let (mut payload, mut task) = (Vec::new(), Vec::new());
        let encoded = codec::encode(&message, &mut payload)
            .and_then(|()| codec::encode_bounded(&Task { identity, payload }, TASK_MAX, &mut task));
        if encoded.is_err() {
            let why = DeliveryError::TooLarge { limit: M::MAX_SIZE.min(TASK_MAX) };
            return Err(RequestError::new(why, Some(message)));
        }
        let until = platform::now() + rule.within;
        let failed = |why| RequestError::new(why, None);
        for asked in 1.. {
            // The service keeps the failure of a request: the next attempt is another request.
            let (id, settled, _open) = OpenRequest::begin();
            let ask = AskService {
                sender: id.sender,
                sequence: id.sequence,
                settled,
                since: 0,
                task: task.clone(),
            };
            let mut progress = RequestProgress::default();
            let pursued = self.pursue(ask, until, &mut progress);
            let pursued = tokio::time::timeout(until - platform::now(), pursued).await;
            let why = match pursued.unwrap_or_else(|_| Err(progress.why())) {
                Ok(reply) => {
                    return codec::decode_reply::<M>(&reply).map_err(|error| failed(error.into()));
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

    /// Follows the primary from node to node until it answers.
    ///
    /// While the configurations differ, the request is sent again with the same identity, as after
    /// any change of the primary. The next primary has the table of those that it follows, or none
    /// of their effects.
    async fn pursue(
        &self,
        mut ask: AskService,
        until: Instant,
        progress: &mut RequestProgress,
    ) -> Result<Vec<u8>, DeliveryError> {
        let mut primary = self.primary();
        // The node that did not answer, and why the outcome there is unknown.
        let (mut failed, mut uncertain) = (None, None);
        loop {
            let node = match primary.take() {
                Some(node) => node,
                None => match self.finder.find(failed.take().as_ref()).await {
                    Ok(FoundPrimary { keeps: false, .. })
                        if uncertain.is_some() && !M::IDEMPOTENT =>
                    {
                        return Err(DeliveryError::OutcomeUnknown {
                            reason: uncertain.unwrap_or_default(),
                        });
                    }
                    Ok(FoundPrimary { primary, .. }) => {
                        progress.difference = None;
                        primary
                    }
                    Err(missing) => {
                        let pause = missing.pause();
                        progress.difference = match missing {
                            NoAnswer::NoPrimary | NoAnswer::Outdated => None,
                            NoAnswer::ConfigMismatch(difference) => Some(difference),
                            NoAnswer::Forbidden(why) => return Err(progress.refused(why)),
                        };
                        tokio::time::sleep(pause).await;
                        continue;
                    }
                },
            };
            ask.since = self.finder.least_epoch(&node);
            let address = format!("{node}:{}", self.finder.name);
            let asking = async {
                let sender = self.finder.registry.sender::<AskService>(&address)?;
                let asked = sender.ask_within(ask.clone(), until - platform::now()).await;
                asked.map_err(|error| error.kind)
            };
            // After a while the others are asked whether this node still serves.
            let moved = async {
                tokio::time::sleep(PROBE).await;
                self.finder.follow(Some(&node)).await
            };
            let answered = tokio::select! {
                biased;
                answered = asking => answered,
                found = moved => {
                    if !found.keeps && !M::IDEMPOTENT {
                        self.finder.note(found.primary);
                        let reason = "the primary has changed, and its standbys are cold".into();
                        return Err(DeliveryError::OutcomeUnknown { reason });
                    }
                    (primary, progress.perhaps_begun) = (Some(found.primary), true);
                    continue;
                }
            };
            let (outcome, epoch) = match answered {
                Ok(Answered { outcome, epoch }) => (ServiceOutcome::decode(&outcome), epoch),
                Err(why @ DeliveryError::Forbidden { .. }) => return Err(progress.refused(why)),
                Err(why) => {
                    progress.perhaps_begun = true;
                    // The node may have executed it, and the next primary may not have it.
                    if matches!(
                        why,
                        DeliveryError::PeerDied { .. } | DeliveryError::OutcomeUnknown { .. }
                    ) {
                        uncertain = Some(why.to_string());
                    }
                    failed = Some(node);
                    continue;
                }
            };
            match outcome? {
                ServiceOutcome::Served(result) => {
                    self.finder.note_answer(node, epoch);
                    return result;
                }
                ServiceOutcome::Refused(DeliveryError::Full | DeliveryError::Restarting) => {
                    primary = Some(node);
                    tokio::time::sleep(PROBE).await;
                }
                // The component has the same contract: the nodes' configurations differ.
                ServiceOutcome::Refused(DeliveryError::ContractDiffers { difference }) => {
                    progress.difference = Some(difference);
                    failed = Some(node);
                }
                ServiceOutcome::Refused(why) => return Err(why),
                ServiceOutcome::Elsewhere(named) => {
                    progress.perhaps_begun = true;
                    primary = named.filter(|named| self.finder.may_serve(named));
                    if primary.is_none() || primary.as_ref() == Some(&node) {
                        tokio::time::sleep(PROBE).await;
                    }
                }
            }
        }
    }
}
