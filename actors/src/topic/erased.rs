//! A topic without its event type: for the network and the snapshot.

use super::traffic::Traffic;
use super::{Latched, RemoteForward, Times, Topic, TopicKey, TopicRow, lock, nanos};
use crate::messaging::message_log;
use crate::platform;
use crate::platform::panics;
use crate::registry::encoding::read_result;
use blastema_core::contract::codec;
use blastema_core::{ContractIdentity, DeliveryError, Event, Instant};
use bytes::Bytes;
use std::sync::Arc;
use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;
use tracing::error;

/// A topic whose type is not known.
pub(super) trait AnyTopic: Send + Sync {
    fn key(&self) -> &TopicKey;
    fn identity(&self) -> ContractIdentity;
    /// The present version and the earlier ones that listeners here understand.
    fn identities(&self) -> Vec<ContractIdentity>;
    /// Sends events to these from now on; to the one that joins, first the event that the topic
    /// keeps.
    fn forward_to(&self, forwards: Arc<[RemoteForward]>, joins: Option<&RemoteForward>);
    fn publish_remote(
        &self,
        form: usize,
        event: &Bytes,
        age: Duration,
    ) -> Result<(), DeliveryError>;
    fn has_listeners(&self) -> bool;
    /// The same. Without a listener it forgets the event of another node that it keeps. One that
    /// joins is counted under the same lock: it gets the event that is kept, and the other node
    /// goes on, or the other node sends it again.
    fn settle_interest(&self) -> bool;
    /// What it carries, and for whom.
    fn traffic(&self) -> &Traffic;
    /// For display, without the other nodes that listen: the table knows them.
    fn row(&self, now: Instant) -> TopicRow;
}

impl<E: Event> AnyTopic for Topic<E> {
    fn key(&self) -> &TopicKey {
        &self.key
    }

    fn identity(&self) -> ContractIdentity {
        ContractIdentity::of::<E>()
    }

    fn identities(&self) -> Vec<ContractIdentity> {
        let former = self.former.iter().map(|former| former.identity().clone());
        std::iter::once(self.identity()).chain(former).collect()
    }

    fn forward_to(&self, forwards: Arc<[RemoteForward]>, joins: Option<&RemoteForward>) {
        let latch = joins.and_then(|joins| Some((joins, self.lock_latch()?)));
        self.forwards.change(|_| forwards);
        if let Some((joins, latch)) = latch
            && let Some(Latched { event, at, is_foreign: false }) = &*latch
            && let Ok(parcel) = codec::encode_parcel(event)
        {
            joins.forward(&parcel, at.captured_at());
        }
        self.renew_matched();
    }

    fn traffic(&self) -> &Traffic {
        &self.traffic
    }

    fn row(&self, now: Instant) -> TopicRow {
        self.traffic.row(&self.key, E::LATCHED, now)
    }

    fn publish_remote(
        &self,
        form: usize,
        event: &Bytes,
        age: Duration,
    ) -> Result<(), DeliveryError> {
        let former = form.checked_sub(1).and_then(|place| self.former.get(place));
        // To read it runs what is the user's, on the network's thread.
        let read = panics::caught(|| match former {
            None => codec::decode_shared::<E>(event),
            Some(former) => former.read(event),
        });
        if let Err(panicked) = &read {
            error!(
                topic = self.key.topic.as_str(),
                contract = E::NAME,
                "to read an event {panicked}"
            );
        }
        match read_result(read) {
            Ok(event) => {
                let now = platform::now();
                let captured_at = now.as_nanos().saturating_sub(nanos(age));
                let captured_at = Some(Instant::from_nanos(captured_at));
                self.traffic.count();
                message_log::sent(E::NAME, &self.key.topic, String::new);
                let times = Times { posted_at: now, captured_at };
                self.hand_out(event, times, true, self.lock_latch());
                Ok(())
            }
            Err(why) => {
                self.record_dead_letter(&why);
                Err(why)
            }
        }
    }

    fn settle_interest(&self) -> bool {
        let mut latch = lock(&self.latch);
        let listens = self.has_listeners();
        let foreign = latch.take_if(|last| !listens && last.is_foreign);
        drop(latch);
        self.discard(foreign.map(|last| last.event));
        listens
    }

    fn has_listeners(&self) -> bool {
        self.listeners.load(Relaxed) > 0
    }
}
