//! What a component takes before its queue, whether that has room or not: notices of ends that it
//! watches, latched events, and safe commands.

use super::cell::ComponentCell;
use super::envelope::{BoxedEnvelope, seal_message};
use super::{Component, Handle};
use crate::arbiter::heartbeat;
use crate::messaging::reply::Responder;
use blastema_core::{Contract, DeliveryError, Incarnation, Instant};
use std::any::TypeId;

impl<C: Component> ComponentCell<C> {
    /// Gives a notice to the incarnation `owner`, whether its queue is full or not. An earlier one
    /// about the same thing that it has not taken yet is replaced.
    pub(crate) fn notify<M: Contract>(&self, owner: Incarnation, about: &str, notice: M)
    where
        C: Handle<M>,
    {
        let notice = seal_message::<C, M>(notice, None, None, heartbeat::coarse_now());
        drop(self.queue.notify(owner, &format!("{} {about}", M::NAME), notice));
    }

    /// Puts a safe command before all that waits, whether there is room or not. It ends with the
    /// present incarnation. Commands of its contract that still wait are not begun any more.
    pub(crate) fn post_first<M: Contract>(&self, command: M, answer: Responder<M>)
    where
        C: Handle<M>,
    {
        let Some(owner) = self.queue.owner() else {
            return answer.refuse(DeliveryError::Restarting, None);
        };
        let is_command = |envelope: &BoxedEnvelope<C>| {
            (envelope.header().contract == TypeId::of::<M>()).then(|| envelope.revocable())
        };
        for waiting in self.queue.select(is_command).into_iter().flatten() {
            waiting.cancel(DeliveryError::Expired);
        }
        // No name of an object contains a blank, and no safe command grows old.
        let (about, never) = (format!("command {}", M::NAME), Instant::from_nanos(u64::MAX));
        let command = seal_message::<C, M>(command, Some(answer), None, never);
        drop(self.queue.notify(owner, &about, command));
    }
}
