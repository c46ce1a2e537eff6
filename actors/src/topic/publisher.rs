//! What publishes on a topic.

use super::{ReservedForwards, Topic};
use crate::arbiter::heartbeat;
use crate::messaging::error::SendError;
use crate::messaging::incarnation::IncarnationToken;
use crate::platform;
use blastema_core::{DeliveryError, Event, Instant};
use std::fmt;
use std::sync::Arc;

/// Publishes events on one topic.
///
/// A publisher that a component got from its [`Context`](crate::Context) belongs to that
/// incarnation of the component, also when it is moved to a thread or a blocking task: once the
/// incarnation has ended, [`publish`](Self::publish) fails with
/// [`DeliveryError::Fenced`](crate::DeliveryError::Fenced).
#[derive(Clone)]
pub struct Publisher<E: Event> {
    /// The incarnation that publishes, if it is a component's.
    incarnation: Option<Arc<IncarnationToken>>,
    announced: Arc<Announced<E>>,
}

/// The topic knows of the publisher for as long as this lives.
struct Announced<E: Event> {
    topic: Arc<Topic<E>>,
    by: Box<str>,
}

impl<E: Event> Drop for Announced<E> {
    fn drop(&mut self) {
        self.topic.traffic.publishes(&self.by, false);
    }
}

impl<E: Event> fmt::Debug for Publisher<E> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Publisher of {} on {}", E::NAME, self.announced.topic.key.topic)
    }
}

impl<E: Event> Publisher<E> {
    pub(super) fn new(topic: Arc<Topic<E>>, by: &str) -> Self {
        topic.traffic.publishes(by, true);
        Publisher { incarnation: None, announced: Arc::new(Announced { topic, by: by.into() }) }
    }

    /// The same, for as long as this incarnation of a component lasts.
    pub(crate) fn of(mut self, incarnation: Arc<IncarnationToken>) -> Self {
        self.incarnation = Some(incarnation);
        self
    }

    /// Sends the event to every listener whose condition it meets. Never waits.
    ///
    /// # Errors
    /// [`DeliveryError::Fenced`](crate::DeliveryError::Fenced) if the component that publishes is
    /// fenced off, or the incarnation that made this publisher has ended;
    /// [`DeliveryError::SenderIsolated`](crate::DeliveryError::SenderIsolated) if the component is
    /// isolated; [`DeliveryError::ShutDown`](crate::DeliveryError::ShutDown) if the publisher is
    /// the node's, and the node was shut down;
    /// [`DeliveryError::WayFull`](crate::DeliveryError::WayFull) if the contract says
    /// `when_full = "refuse"` and another node that listens has no capacity. The event comes back,
    /// no listener gets it, and it is not counted among the dead letters.
    #[inline]
    pub fn publish(&self, event: E) -> Result<(), SendError<E>> {
        self.publish_stamped(event, None)
    }

    /// Publishes the event, and waits first while there is no capacity for it on the way to another
    /// node that listens: such nodes lose none of it while their sessions last. For data of which
    /// only the newest counts, it does not wait. The queues of listeners keep their policies.
    ///
    /// # Errors
    /// As [`publish`](Self::publish), also where it came to be so while this waited.
    pub async fn deliver(&self, event: E) -> Result<(), SendError<E>> {
        if let Some(why) = self.refusal() {
            return Err(SendError::new(why, event));
        }
        let captured_at = platform::now();
        let reserved = self.announced.topic.reserve(&event).await;
        self.publish_reserved(event, Some(captured_at), reserved)
    }

    /// Publishes an event whose data was captured at `captured_at`, by the clock of
    /// [`platform::now`](crate::platform::now): `max_age` counts from there, and listeners read it
    /// by [`Context::captured_at`](crate::Context::captured_at). A time that is still to come
    /// counts as now.
    ///
    /// # Errors
    /// As [`publish`](Self::publish).
    pub fn publish_captured_at(&self, event: E, captured_at: Instant) -> Result<(), SendError<E>> {
        self.publish_stamped(event, Some(captured_at))
    }

    #[inline]
    pub(crate) fn publish_stamped(
        &self,
        event: E,
        captured_at: Option<Instant>,
    ) -> Result<(), SendError<E>> {
        let reserved = match E::REFUSE_WHEN_FULL {
            true => self.announced.topic.reserve_now(&event),
            false => Ok(ReservedForwards::default()),
        };
        match reserved {
            Ok(reserved) => self.publish_reserved(event, captured_at, reserved),
            Err(why) => Err(SendError::new(why, event)),
        }
    }

    #[inline]
    fn publish_reserved(
        &self,
        event: E,
        captured_at: Option<Instant>,
        reserved: ReservedForwards,
    ) -> Result<(), SendError<E>> {
        match self.refusal() {
            Some(why) => Err(SendError::new(why, event)),
            None => {
                self.announced.topic.publish(event, captured_at, &self.announced.by, reserved);
                Ok(())
            }
        }
    }

    #[inline]
    fn refusal(&self) -> Option<DeliveryError> {
        // A component ends before its node.
        let ended = || match &self.incarnation {
            Some(incarnation) => incarnation.forbidden(),
            None => self.announced.topic.shut_down(),
        };
        heartbeat::send_refusal().or_else(ended)
    }

    /// The same, where the refusal cannot be returned: it is counted among the dead letters under
    /// the topic's name.
    pub(crate) fn publish_or_count(&self, event: E, captured_at: Option<Instant>) {
        if let Err(refused) = self.publish_stamped(event, captured_at) {
            self.announced.topic.record_dead_letter(&refused.kind);
        }
    }

    /// Returns the number of listeners that an event would reach now: those of this node,
    /// regardless of their conditions, and one for each other node that has listeners.
    pub fn matched(&self) -> usize {
        *self.announced.topic.matched.borrow()
    }

    /// Waits until an event would reach at least so many listeners, as [`matched`](Self::matched)
    /// counts them.
    pub async fn matched_at_least(&self, listeners: usize) {
        let mut matched = self.announced.topic.matched.subscribe();
        // The topic lives as long as this publisher.
        let _ = matched.wait_for(|matched| *matched >= listeners).await;
    }
}
