//! A typed reference to one component.

use crate::component::cell::ComponentCell;
use crate::component::context::Context;
use crate::component::{Component, Handle};
use crate::messaging::death_watch::Watchable;
use crate::messaging::error::{RequestError, SendError};
use crate::messaging::sender::{Sender, ask_within, deliver};
use crate::messaging::sink::MessageSink;
use crate::settings::DEFAULT_DEADLINE;
use blastema_core::{Contract, Incarnation, Lifecycle, ObjectName};
use std::fmt;
use std::sync::Arc;
use std::time::Duration;

/// A reference to a component on this node. It stays valid across restarts. [`Sender`] describes
/// delivery.
pub struct ActorRef<C: Component>(pub(crate) Arc<ComponentCell<C>>);

impl<C: Component> Clone for ActorRef<C> {
    fn clone(&self) -> Self {
        ActorRef(self.0.clone())
    }
}

impl<C: Component> fmt::Debug for ActorRef<C> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}{}", self.name(), self.incarnation())
    }
}

impl<C: Component> ActorRef<C> {
    /// Hands the message to the component's queue. Never waits.
    ///
    /// # Errors
    /// The reason, and the message as it was.
    #[inline]
    pub fn tell<M: Contract>(&self, message: M) -> Result<(), SendError<M>>
    where
        C: Handle<M>,
    {
        let result = MessageSink::tell(&*self.0, message);
        result.map_err(|error| error.at(|| MessageSink::<M>::receiver(&*self.0)))
    }

    /// Hands the message to the component's queue, and waits while it has no room.
    ///
    /// # Errors
    /// As [`Sender::deliver`].
    pub async fn deliver<M: Contract>(&self, message: M) -> Result<(), SendError<M>>
    where
        C: Handle<M>,
    {
        let delivered = deliver(&*self.0, message).await;
        delivered.map_err(|error| error.at(|| MessageSink::<M>::receiver(&*self.0)))
    }

    /// Sends a request and waits up to one second for the reply.
    ///
    /// # Errors
    /// As [`Sender::ask`].
    pub async fn ask<M: Contract>(&self, message: M) -> Result<M::Reply, RequestError<M>>
    where
        C: Handle<M>,
    {
        self.ask_within(message, DEFAULT_DEADLINE).await
    }

    /// Asks, and waits for the reply until the deadline.
    ///
    /// # Errors
    /// As [`Sender::ask`].
    #[inline]
    pub async fn ask_within<M: Contract>(
        &self,
        message: M,
        deadline: Duration,
    ) -> Result<M::Reply, RequestError<M>>
    where
        C: Handle<M>,
    {
        ask_within(&*self.0, message, deadline).await
    }

    /// Returns a sender for one contract, without the component's type.
    pub fn sender<M: Contract>(&self) -> Sender<M>
    where
        C: Handle<M>,
    {
        Sender(self.0.clone())
    }

    /// Asks the component to leave work in order; messages wait until it returns. Without effect
    /// unless it is active.
    pub fn deactivate(&self) {
        Watchable::activate(&*self.0, false);
    }

    /// Asks the component to return to work. Without effect unless it is initialised and not
    /// active.
    pub fn activate(&self) {
        Watchable::activate(&*self.0, true);
    }

    /// The component's name.
    pub fn name(&self) -> &ObjectName {
        &self.0.record.name
    }

    /// The incarnation that began last.
    pub fn incarnation(&self) -> Incarnation {
        self.0.record.incarnation()
    }

    /// Where the component stands.
    pub fn state(&self) -> Lifecycle {
        self.0.record.state()
    }

    /// How many messages wait.
    pub fn queued(&self) -> usize {
        self.0.queue.depth()
    }
}

impl<C: Component> Context<C> {
    /// A reference to this component, which outlives its restarts.
    pub fn me(&self) -> ActorRef<C> {
        ActorRef(self.cell.clone())
    }
}
