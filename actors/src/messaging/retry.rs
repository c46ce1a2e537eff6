//! Asking more than once, where that can do no harm.

use crate::messaging::error::RequestError;
use crate::messaging::message_id::next_id;
use crate::messaging::sink::MessageSink;
use crate::platform;
use blastema_core::contract::codec;
use blastema_core::delivery::retry::FailedAttempt;
use blastema_core::{Contract, DeliveryError, Instant, MessageId, RetryPolicy};
use std::time::Duration;

/// Asks by this rule.
pub(crate) async fn ask_by<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
    rule: &RetryPolicy,
) -> Result<M::Reply, RequestError<M>> {
    pursue(inlet, message, rule, |_| true).await
}

/// Asks once; where the receiver has died of something else's fault while it served the request,
/// and that does no harm, the next incarnation is asked.
pub(crate) async fn ask_idempotent<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
    within: Duration,
) -> Result<M::Reply, RequestError<M>> {
    let rule = RetryPolicy { within, ..RetryPolicy::default() };
    pursue(inlet, message, &rule, |why| matches!(why, DeliveryError::PeerDied { .. })).await
}

async fn pursue<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
    rule: &RetryPolicy,
    concerns: impl Fn(&DeliveryError) -> bool,
) -> Result<M::Reply, RequestError<M>> {
    let until = platform::now() + rule.within;
    // One identity for all attempts: a request that kills one incarnation after the other is
    // quarantined.
    let id = M::IDEMPOTENT.then(next_id);
    // What the receiver takes up does not come back.
    let mut copy = Vec::new();
    let copied = M::IDEMPOTENT && codec::encode(&message, &mut copy).is_ok();
    let (mut message, mut asked) = (message, 0);
    loop {
        let RequestError { kind: why, message: back, .. } =
            match attempt(inlet, message, id, until).await {
                Ok(reply) => return Ok(reply),
                Err(error) => error,
            };
        asked += 1;
        let attempt = FailedAttempt { asked, why: &why, idempotent: M::IDEMPOTENT };
        let wait = rule.again(attempt, until.as_nanos());
        let wait = wait.filter(|wait| concerns(&why) && platform::now() + *wait < until);
        let Some(wait) = wait else { return Err(RequestError::new(why, back)) };
        let kept = || codec::decode::<M>(&copy).ok().filter(|_| copied);
        match back.or_else(kept) {
            Some(back) => message = back,
            None => return Err(RequestError::new(why, None)),
        }
        if !wait.is_zero() {
            tokio::time::sleep(wait).await;
        }
    }
}

async fn attempt<M: Contract>(
    inlet: &(impl MessageSink<M> + ?Sized),
    message: M,
    id: Option<MessageId>,
    until: Instant,
) -> Result<M::Reply, RequestError<M>> {
    let left = until - platform::now();
    inlet.ask(message, id, Some(left))?.within(left).await
}
