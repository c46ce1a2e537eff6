//! The credits out of this node: what stands behind a `Sender` of a remote object.

use super::credit::{SendCredits, SenderCredit};
use super::gateway_messages::SendToPeer;
use crate::platform;
use crate::registry::remote::{OutgoingRequest, RemoteStub, StubFactory};
use actix::Recipient;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::net::session::PAYLOAD_MAX;
use blastema_core::sorted::SortedMap;
use blastema_core::{
    ContractIdentity, Delivery, DeliveryError, GatherBuffer, NodeName, ObjectAddress, ObjectName,
    TrafficClass,
};
use std::collections::BTreeSet;
use std::pin::Pin;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU8};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tokio::sync::Notify;

/// Makes stubs, and tells those behind them how their peer is.
pub(super) struct PeerStubs {
    gateway: OnceLock<Recipient<SendToPeer>>,
    send_states: Mutex<SortedMap<NodeName, Arc<PeerSendState>>>,
    ended: EndedFlag,
}

/// Whether this node takes nothing for others any more, since it ends. All send states have the
/// same.
type EndedFlag = Arc<AtomicBool>;

/// What all stubs to one peer share.
pub(super) struct PeerSendState {
    node: NodeName,
    ended: EndedFlag,
    condition: AtomicU8,
    /// A path leads there, or perhaps the session waits for one.
    path: AtomicBool,
    /// There was a session, or a path, at some time.
    met: AtomicBool,
    isolated: AtomicBool,
    credits: SendCredits,
    /// Its objects that have no room: as many as this node sends to at most.
    full: Mutex<BTreeSet<ObjectName>>,
    /// There are some; to be looked at without the lock.
    any_full: AtomicBool,
    /// In this session the peer has told what it listens to, and that its objects answer.
    told: AtomicBool,
    changed: Arc<Notify>,
}

/// How sending to a peer stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum PeerCondition {
    /// No path leads there.
    Unreachable,
    /// There is a path; the session is about to begin.
    Opening,
    /// There is a session.
    Open,
    /// Its node has ended in order.
    Left,
}

impl PeerSendState {
    fn condition(&self) -> PeerCondition {
        match self.condition.load(Relaxed) {
            0 => PeerCondition::Unreachable,
            1 => PeerCondition::Opening,
            2 => PeerCondition::Open,
            _ => PeerCondition::Left,
        }
    }

    pub(super) fn set(&self, condition: PeerCondition) {
        self.condition.store(condition as u8, Relaxed);
        self.changed.notify_waiters();
    }

    /// A session has begun: it takes messages, and knows of no binding.
    pub(super) fn begin(&self) {
        self.met.store(true, Relaxed);
        self.told.store(false, Relaxed);
        self.set(PeerCondition::Open);
    }

    /// The peer has told its topics, and its objects answer.
    pub(super) fn handle_announced(&self) {
        self.told.store(true, Relaxed);
        self.changed.notify_waiters();
    }

    /// A path leads there; to a newer incarnation than that of the session, which has told nothing
    /// yet, if so.
    pub(super) fn path_found(&self, is_newer: bool) {
        self.told.fetch_and(!is_newer, Relaxed);
        self.path.store(true, Relaxed);
        self.met.store(true, Relaxed);
        self.changed.notify_waiters();
    }

    pub(super) fn path_lost(&self) {
        self.path.store(false, Relaxed);
        self.changed.notify_waiters();
    }

    /// Sets whether nothing is sent there and nothing accepted from there.
    pub(super) fn set_isolated(&self, isolated: bool) {
        self.isolated.store(isolated, Relaxed);
        self.changed.notify_waiters();
    }

    pub(super) fn is_isolated(&self) -> bool {
        self.isolated.load(Relaxed)
    }

    /// A session is open, whether it has room or not.
    pub(super) fn has_session(&self) -> bool {
        self.condition() == PeerCondition::Open
    }

    fn lock_full(&self) -> MutexGuard<'_, BTreeSet<ObjectName>> {
        self.full.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// This object there has no room.
    pub(super) fn object_is_full(&self, object: ObjectName) {
        let mut full = self.lock_full();
        full.insert(object);
        self.any_full.store(true, Relaxed);
    }

    /// This object there has room again.
    pub(super) fn handle_object_ready(&self, object: &ObjectName) {
        let mut full = self.lock_full();
        full.remove(object);
        self.any_full.store(!full.is_empty(), Relaxed);
        drop(full);
        self.changed.notify_waiters();
    }

    /// What was said of objects there does not count any more.
    pub(super) fn forget_backlog(&self) {
        self.lock_full().clear();
        self.any_full.store(false, Relaxed);
        self.changed.notify_waiters();
    }

    fn is_full(&self, object: &ObjectName) -> bool {
        self.any_full.load(Relaxed) && self.lock_full().contains(object)
    }

    pub(super) fn credits(&self) -> &SendCredits {
        &self.credits
    }

    /// Whether a message may go to this object, credit apart.
    fn check(&self, object: &ObjectName) -> Result<(), DeliveryError> {
        if self.ended.load(Relaxed) {
            return Err(DeliveryError::Stopped);
        }
        if self.is_isolated() {
            return Err(DeliveryError::isolated(&self.node));
        }
        match self.condition() {
            PeerCondition::Unreachable => {
                Err(DeliveryError::Unreachable { node: self.node.to_string() })
            }
            PeerCondition::Opening => Err(DeliveryError::Restarting),
            PeerCondition::Left => Err(DeliveryError::Left { node: self.node.to_string() }),
            PeerCondition::Open if self.is_full(object) => Err(DeliveryError::Full),
            PeerCondition::Open => Ok(()),
        }
    }

    /// Why an event is not sent there now.
    pub(super) fn why_not(&self) -> DeadReason {
        match self.condition() {
            _ if self.is_isolated() => DeadReason::Isolated,
            PeerCondition::Open => DeadReason::WayFull,
            PeerCondition::Opening => DeadReason::Restarting,
            PeerCondition::Unreachable => DeadReason::Unreachable,
            PeerCondition::Left => DeadReason::Left,
        }
    }

    /// A session is open, a path leads there, and the peer has told what it listens to.
    fn is_opened(&self) -> bool {
        self.has_session() && self.told.load(Relaxed) && self.path.load(Relaxed)
    }

    /// Completes when that is so.
    async fn opened(&self) {
        loop {
            let changed = self.changed.notified();
            if self.is_opened() {
                return;
            }
            changed.await;
        }
    }

    /// Something can be sent to the peer at all.
    pub(super) fn takes_messages(&self) -> bool {
        self.has_session() && !self.is_isolated() && !self.ended.load(Relaxed)
    }

    pub(super) fn way_full(&self, class: TrafficClass) -> DeliveryError {
        DeliveryError::WayFull { node: self.node.to_string(), class }
    }

    /// Completes when there is credit, or nothing can be sent at all.
    pub(super) async fn capacity(&self, credit: &SenderCredit) {
        loop {
            let changed = self.changed.notified();
            if !self.takes_messages() || credit.is_open() {
                return;
            }
            changed.await;
        }
    }

    async fn space(&self, object: &ObjectName, credit: &SenderCredit) {
        loop {
            let changed = self.changed.notified();
            match self.check(object) {
                Err(DeliveryError::Full | DeliveryError::Restarting) => changed.await,
                Ok(()) if !credit.is_open() => changed.await,
                // Whatever else stands in the way is told by the next attempt.
                _ => return,
            }
        }
    }
}

impl PeerStubs {
    pub(super) fn new() -> Self {
        PeerStubs {
            gateway: OnceLock::new(),
            send_states: Mutex::default(),
            ended: EndedFlag::default(),
        }
    }

    /// This node ends: refuses messages, and wakes the senders that wait for credit.
    pub(super) fn end(&self) {
        self.ended.store(true, Relaxed);
        self.lock().values().for_each(|send_state| send_state.changed.notify_waiters());
    }

    pub(super) fn connect(&self, gateway: Recipient<SendToPeer>) {
        // Called once, when the network starts.
        let _ = self.gateway.set(gateway);
    }

    fn lock(&self) -> MutexGuard<'_, SortedMap<NodeName, Arc<PeerSendState>>> {
        self.send_states.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Completes when a session with this node is open, and a path leads there.
    pub(super) async fn opened(&self, node: &NodeName) {
        self.send_state(node).opened().await;
    }

    /// Whether a session with this node is open, a path leads there, and it has told what it
    /// listens to.
    pub(super) fn is_opened(&self, node: &NodeName) -> bool {
        self.lock().get(node).is_some_and(|send_state| send_state.is_opened())
    }

    /// Whether a path leads there now, to a node that has not left and is not isolated.
    pub(super) fn is_reachable(&self, node: &NodeName) -> bool {
        self.lock().get(node).is_some_and(|send_state| {
            let is_there = send_state.path.load(Relaxed) && !send_state.is_isolated();
            is_there && send_state.condition() != PeerCondition::Left
        })
    }

    /// Whether a path has led there, now or before.
    pub(super) fn has_met(&self, node: &NodeName) -> bool {
        self.lock().get(node).is_some_and(|send_state| send_state.met.load(Relaxed))
    }

    /// Those that a path leads to now, or did before, in the order of their names.
    pub(super) fn met(&self) -> Vec<NodeName> {
        let send_states = self.lock();
        let met = send_states.iter().filter(|(_, send_state)| send_state.met.load(Relaxed));
        met.map(|(node, _)| node.clone()).collect()
    }

    /// A peer is forgotten: so is how sending to it stands, unless something here sends to it.
    pub(super) fn forget(&self, node: &NodeName) {
        let mut send_states = self.lock();
        if send_states.get(node).is_some_and(|send_state| Arc::strong_count(send_state) == 1) {
            send_states.remove(node);
        }
    }

    /// As many as nodes that this program has named, or met and not forgotten.
    pub(super) fn send_state(&self, node: &NodeName) -> Arc<PeerSendState> {
        let mut send_states = self.lock();
        let send_state = send_states.entry(node.clone()).or_insert_with(|| {
            let changed = Arc::new(Notify::new());
            Arc::new(PeerSendState {
                node: node.clone(),
                ended: self.ended.clone(),
                condition: AtomicU8::new(PeerCondition::Unreachable as u8),
                path: AtomicBool::new(false),
                met: AtomicBool::new(false),
                isolated: AtomicBool::new(false),
                credits: SendCredits::new(&changed),
                full: Mutex::default(),
                any_full: AtomicBool::new(false),
                told: AtomicBool::new(false),
                changed,
            })
        });
        send_state.clone()
    }
}

impl StubFactory for PeerStubs {
    fn stub(&self, to: ObjectAddress, contract: ContractIdentity) -> Arc<dyn RemoteStub> {
        let send_state = self.send_state(&to.node);
        let gateway = self.gateway.get().cloned();
        let is_ordered = contract.delivery != Delivery::Newest;
        let class = is_ordered.then(|| contract.message_class());
        let (messages, requests) =
            (send_state.credits.sender(class), send_state.credits.caller(class));
        Arc::new(PeerStub { to, contract, send_state, messages, requests, gateway })
    }

    fn is_reachable(&self, node: &NodeName) -> bool {
        self.send_state(node).path.load(Relaxed)
    }

    fn opening(&self, node: &NodeName) -> Pin<Box<dyn Future<Output = ()> + Send>> {
        let send_state = self.send_state(node);
        if send_state.is_opened() {
            return Box::pin(std::future::pending());
        }
        Box::pin(async move { send_state.opened().await })
    }
}

/// The way to one object for one contract.
struct PeerStub {
    to: ObjectAddress,
    contract: ContractIdentity,
    send_state: Arc<PeerSendState>,
    /// The credit of its sender's messages without a reply, and of its requests.
    messages: Arc<SenderCredit>,
    requests: Arc<SenderCredit>,
    gateway: Option<Recipient<SendToPeer>>,
}

impl RemoteStub for PeerStub {
    fn send(
        &self,
        message: GatherBuffer,
        asked: Option<OutgoingRequest>,
    ) -> Result<(), DeliveryError> {
        if message.len() > PAYLOAD_MAX {
            return Err(DeliveryError::TooLargeForSession { limit: PAYLOAD_MAX });
        }
        self.send_state.check(&self.to.object)?;
        let gateway = self.gateway.as_ref().ok_or(DeliveryError::Stopped)?;
        let account = if asked.is_some() { &self.requests } else { &self.messages };
        let taken = account.take(message.len());
        let credit =
            taken.ok_or_else(|| self.send_state.way_full(self.contract.message_class()))?;
        let sent = platform::now();
        let (id, within, reply_to) = match asked {
            None => (None, None, None),
            Some(OutgoingRequest { id, within, reply_to }) => (id, within, Some(reply_to)),
        };
        gateway.do_send(SendToPeer {
            to: self.to.clone(),
            contract: self.contract.clone(),
            id,
            sent,
            until: within.map(|within| sent + within),
            payload: message,
            reply_to,
            credit,
        });
        Ok(())
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(self.send_state.space(&self.to.object, &self.messages))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::settle;

    const REQUEST: Option<TrafficClass> = Some(TrafficClass::Request);
    const BULK: Option<TrafficClass> = Some(TrafficClass::Bulk);

    fn send_state() -> (Arc<PeerSendState>, ObjectName) {
        let name = |name| NodeName::new(name).unwrap();
        let send_state = PeerStubs::new().send_state(&name("module2"));
        send_state.begin();
        (send_state, ObjectName::new("arm").unwrap())
    }

    #[test]
    fn a_forgotten_peer_is_kept_only_while_something_sends_to_it() {
        let (stubs, node) = (PeerStubs::new(), NodeName::new("module2").unwrap());
        let held = stubs.send_state(&node);
        held.path_found(true);
        stubs.forget(&node);
        assert!(stubs.has_met(&node));
        drop(held);
        stubs.forget(&node);
        assert!(!stubs.has_met(&node));
    }

    #[test]
    fn a_full_object_holds_up_no_other() {
        let (send_state, object) = send_state();
        assert_eq!(send_state.check(&object), Ok(()));
        send_state.object_is_full(object.clone());
        assert_eq!(send_state.check(&object), Err(DeliveryError::Full));
        assert_eq!(send_state.check(&"leg".parse().unwrap()), Ok(()));
        send_state.handle_object_ready(&object);
        assert_eq!(send_state.check(&object), Ok(()));
    }

    #[test]
    fn an_event_that_is_not_sent_is_counted_under_what_hinders_it() {
        let (send_state, _) = send_state();
        for (condition, reason) in [
            (PeerCondition::Open, DeadReason::WayFull),
            (PeerCondition::Opening, DeadReason::Restarting),
            (PeerCondition::Unreachable, DeadReason::Unreachable),
            (PeerCondition::Left, DeadReason::Left),
        ] {
            send_state.set(condition);
            assert_eq!(send_state.why_not(), reason);
        }
        send_state.set_isolated(true);
        assert_eq!(send_state.why_not(), DeadReason::Isolated);
    }

    #[blastema_macros::test(crate = "blastema_doubles")]
    async fn a_sender_that_waits_goes_on_when_there_is_credit_of_its_class_and_its_object_has_room()
    {
        let (send_state, object) = send_state();
        let [(requests, request), (bulk, image)] = [REQUEST, BULK].map(|class| {
            let (send_state, object) = (send_state.clone(), object.clone());
            let credit = send_state.credits.sender(class);
            let all = std::iter::from_fn(|| credit.take(64));
            let all: Vec<_> = all.collect();
            (all, actix_rt::spawn(async move { send_state.space(&object, &credit).await }))
        });
        settle().await;

        send_state.object_is_full(object.clone());
        drop(requests);
        settle().await;
        assert!(!request.is_finished(), "the object has no room");
        send_state.handle_object_ready(&object);
        settle().await;
        assert!(request.is_finished() && !image.is_finished());
        drop(bulk);
        settle().await;
        assert!(image.is_finished());
    }
}
