//! Messages of other nodes to objects of this node: their delivery, and the backlog of full queues.

use super::ObjectGateway;
use super::local::LocalInput;
use crate::platform;
use crate::registry::{CapacityFuture, MessageMetadata, ReplyTo, Skeleton};
use blastema_core::net::NodeId;
use blastema_core::net::peer_protocol::SessionEpoch;
use blastema_core::net::peer_protocol::receive_backlog::{BacklogVerdict, ReceiveBacklog};
use blastema_core::net::refusal_alarms::RefusalAlarms;
use blastema_core::sorted::SortedMap;
use blastema_core::{Delivery, DeliveryError, FaultKind, Instant, ObjectName, PeerIdentity};
use bytes::Bytes;
use std::sync::Arc;
use std::task::{Context as Waiting, Waker};
use tracing::{debug, error, info, warn};

/// So many that waited are handed over in one turn; then the network has its own.
const AT_ONCE: usize = 64;

/// What a peer has bound here.
#[derive(Clone)]
pub(super) struct PeerBinding {
    object: ObjectName,
    skeleton: Arc<dyn Skeleton>,
    /// Of what comes this way the newest counts: it waits for nothing.
    newest: bool,
}

/// What waits for room with objects of this node.
#[derive(Default)]
pub(super) struct InboundBacklog {
    backlog: ReceiveBacklog<Held>,
    /// Who waits for room, for each line.
    watches: SortedMap<(NodeId, ObjectName), Watch>,
    alarms: RefusalAlarms<NodeId>,
}

/// A message that waits.
struct Held {
    binding: u32,
    payload: Bytes,
    metadata: MessageMetadata,
    arrived: Instant,
}

/// Waits for room until dropped: a receiver that hangs may never have any.
struct Watch(actix_rt::task::JoinHandle<()>);

impl Drop for Watch {
    fn drop(&mut self) {
        self.0.abort();
    }
}

impl ObjectGateway {
    pub(super) fn bind(
        &mut self,
        peer: NodeId,
        epoch: SessionEpoch,
        binding: u32,
        object: &ObjectName,
        identity: &PeerIdentity,
    ) {
        let newest = identity.delivery == Delivery::Newest;
        let mut open = |skeleton| {
            let bound = PeerBinding { object: object.clone(), skeleton, newest };
            self.skeletons.insert((peer, binding), bound);
        };
        let result = match self.setup.registry.skeleton(object, &identity.name) {
            Err(why) => Err((why, None)),
            Ok((known, skeleton)) => match (known.check(identity), skeleton.former(identity)) {
                (Ok(()), _) => {
                    open(skeleton);
                    Ok(())
                }
                (Err(_), Some(former)) => {
                    let (here, there) = (known.version, identity.version);
                    info!(%object, contract = known.name, here, there, "an earlier version");
                    open(former);
                    Ok(())
                }
                (Err(difference), None) => {
                    let difference = difference.to_string();
                    let record = self.protocol.peers.get_mut(peer);
                    if record.is_some_and(|record| record.differs(&difference)) {
                        error!(%object, "a peer's contract differs: {difference}");
                    }
                    skeleton.declare(FaultKind::ContractMismatch, difference.clone());
                    Err((DeliveryError::ContractDiffers { difference }, Some(known)))
                }
            },
        };
        self.protocol.handle_bound(peer, epoch, binding, result);
    }

    pub(super) fn serve(
        &mut self,
        peer: NodeId,
        binding: u32,
        payload: &Bytes,
        metadata: MessageMetadata,
        reply_to: Option<ReplyTo>,
    ) {
        let Some(bound) = self.skeletons.get(&(peer, binding)) else {
            match reply_to {
                Some(reply_to) => reply_to(Err(DeliveryError::Unknown { name: "binding".into() })),
                None => debug!(%peer, binding, "a message for what is not bound any more"),
            }
            return;
        };
        // A message does not overtake those that wait.
        let behind = self.queues.backlog.is_waiting(peer, &bound.object)
            && !bound.newest
            && bound.skeleton.space().is_some();
        match reply_to {
            Some(reply_to) if behind => reply_to(Err(DeliveryError::Full)),
            None if behind => self.hold(peer, binding, payload, metadata, &DeliveryError::Full),
            reply_to => {
                let is_tell = reply_to.is_none();
                match bound.skeleton.deliver(payload, metadata, reply_to) {
                    Err(why @ (DeliveryError::Full | DeliveryError::Restarting)) if is_tell => {
                        self.hold(peer, binding, payload, metadata, &why);
                    }
                    // The object's own dead letters tell of what it did not take.
                    Err(DeliveryError::Undecodable { .. }) => self.breaks_its_word(peer),
                    _ => {}
                }
            }
        }
    }

    /// The receiver has no room for this, for that reason: it waits, if it is to.
    fn hold(
        &mut self,
        peer: NodeId,
        binding: u32,
        payload: &Bytes,
        metadata: MessageMetadata,
        why: &DeliveryError,
    ) {
        let Some(bound) = self.skeletons.get(&(peer, binding)).cloned() else { return };
        let PeerBinding { object, skeleton, newest } = bound;
        let Some(space) = skeleton.space().filter(|_| !newest) else {
            return skeleton.record_dead_letter(why);
        };
        // A copy: what waits must not keep the whole frame that it came in.
        let payload = Bytes::copy_from_slice(payload);
        let bytes = payload.len();
        let held = Held { binding, payload, metadata, arrived: platform::now() };
        match self.queues.backlog.handle_full(peer, &object, binding, held, bytes) {
            BacklogVerdict::First => {
                debug!(%peer, %object, "full: the peer is told to stop");
                self.protocol.handle_full(peer, binding);
                self.watch(peer, object, space);
            }
            BacklogVerdict::Behind => {}
            BacklogVerdict::Refused(_) => skeleton.record_dead_letter(why),
        }
    }

    fn watch(&mut self, peer: NodeId, object: ObjectName, space: CapacityFuture) {
        let (stack, found) =
            (self.setup.stack.clone(), LocalInput::Capacity { peer, object: object.clone() });
        let waits = actix_rt::spawn(async move {
            space.await;
            stack.do_send(found);
        });
        self.queues.watches.insert((peer, object), Watch(waits));
    }

    /// Hands over what has waited, in order, as far as there is room.
    pub(super) fn hand_over(&mut self, peer: NodeId, object: ObjectName) {
        for _ in 0..AT_ONCE {
            let Some(Held { binding, payload, metadata, arrived }) =
                self.queues.backlog.first(peer, &object)
            else {
                return;
            };
            if let Some(PeerBinding { skeleton, .. }) = self.skeletons.get(&(peer, *binding))
                && let Some(mut space) = skeleton.space()
            {
                // Asked first, so that nothing is decoded in vain.
                if space.as_mut().poll(&mut Waiting::from_waker(Waker::noop())).is_pending() {
                    return self.watch(peer, object, space);
                }
                let age = metadata.age + (platform::now() - *arrived);
                match skeleton.deliver(payload, MessageMetadata { age, ..*metadata }, None) {
                    // Another sender has taken the capacity.
                    Err(DeliveryError::Full | DeliveryError::Restarting) => {
                        if let Some(space) = skeleton.space() {
                            self.watch(peer, object, space);
                        }
                        return;
                    }
                    Err(DeliveryError::Undecodable { .. }) => self.breaks_its_word(peer),
                    _ => {}
                }
            }
            if let Some(binding) = self.queues.backlog.handle_taken(peer, &object) {
                self.queues.watches.remove(&(peer, object));
                self.protocol.handle_capacity(peer, binding);
                return;
            }
        }
        self.watch(peer, object, Box::pin(std::future::ready(())));
    }

    /// The session with this peer is over: what waits is not served any more.
    pub(super) fn end_lines(&mut self, peer: NodeId, why: &DeliveryError) {
        for (object, held) in self.queues.backlog.handle_ended(peer) {
            self.queues.watches.remove(&(peer, object));
            if let Some(bound) = self.skeletons.get(&(peer, held.binding)) {
                bound.skeleton.record_dead_letter(why);
            }
        }
    }

    fn breaks_its_word(&self, peer: NodeId) {
        self.offends(peer, "it breaks a contract that it has agreed to");
    }

    /// Raises an alarm for a peer that sends on for seconds although it was told to stop, and
    /// clears it when none did for a while.
    pub(super) fn look_at_refusals(&mut self) {
        let InboundBacklog { backlog, alarms, .. } = &mut self.queues;
        for (peer, since) in alarms.handle_look(backlog.refusals()) {
            let node = self.protocol.peers.name(peer);
            let lost = since.too_large;
            let detail = format!(
                "{node} does not stop sending to objects that have no room, as it was told: {lost} \
                 messages of it were lost within a second"
            );
            warn!("{detail}");
            self.offends(peer, "it did not stop sending to what has no room");
            self.setup.faults.declare_passing(FaultKind::CheckFailed, detail);
        }
    }
}
