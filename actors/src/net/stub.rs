//! The credits out of this node: what stands behind a `Sender` of a remote object.

use super::credit::{CreditClass, SendCredits};
use super::gateway::SendToPeer;
use super::own_isolation::OwnIsolation;
use crate::platform;
use crate::registry::remote::{OutgoingRequest, RemoteStub, StubFactory};
use actix::Recipient;
use blastema_contract::session::Credit;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::net::SizeClass;
use blastema_core::net::peer_protocol::stream_of;
use blastema_core::net::session::PAYLOAD_MAX;
use blastema_core::net::wire::segment::Stream;
use blastema_core::sorted::{SortedMap, SortedSet};
use blastema_core::{
    ContractIdentity, DeliveryError, GatherBuffer, NodeName, ObjectAddress, ObjectName,
};
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU8};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tokio::sync::Notify;

/// Makes stubs, and tells those behind them how their peer is.
pub(super) struct PeerStubs {
    gateway: OnceLock<Recipient<SendToPeer>>,
    send_states: Mutex<SortedMap<NodeName, Arc<PeerSendState>>>,
    own_isolation: OwnIsolation,
    ended: EndedFlag,
}

/// Whether this node takes nothing for others any more, since it ends. All send states have the
/// same.
type EndedFlag = Arc<AtomicBool>;

/// What all stubs to one peer share.
pub(super) struct PeerSendState {
    node: NodeName,
    own_isolation: OwnIsolation,
    ended: EndedFlag,
    condition: AtomicU8,
    /// A path leads there, or perhaps the session waits for one.
    path: AtomicBool,
    /// There was a session, or a path, at some time.
    met: AtomicBool,
    isolated: AtomicBool,
    /// Of what the session holds all that it should: a bit for each stream and load.
    full_streams: AtomicU8,
    /// Of what as much waits for bindings there as should, a bit for each load. It has nothing to
    /// do with what the session holds.
    full_budget: AtomicU8,
    credits: SendCredits,
    /// Its objects that have no room: as many as this node sends to at most.
    full: Mutex<SortedSet<ObjectName>>,
    /// There are some; to be looked at without the lock.
    any_full: AtomicBool,
    /// In this session the peer has told what it listens to, and which objects it has.
    told: AtomicBool,
    changed: Arc<Notify>,
}

/// The bit of what a stream carries of this load.
fn bit(stream: Stream, load: SizeClass) -> u8 {
    1 << (2 * stream as u8 + load as u8)
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
        self.own_isolation.let_in();
        self.met.store(true, Relaxed);
        self.full_budget.store(0, Relaxed);
        self.full_streams.store(0, Relaxed);
        self.told.store(false, Relaxed);
        self.set(PeerCondition::Open);
    }

    /// The peer has told its topics, and then its objects.
    pub(super) fn handle_announced(&self) {
        self.told.store(true, Relaxed);
        self.changed.notify_waiters();
    }

    /// The session holds all that it should of this stream and load.
    pub(super) fn stream_is_full(&self, stream: Stream, load: SizeClass) {
        self.full_streams.fetch_or(bit(stream, load), Relaxed);
    }

    pub(super) fn handle_stream_ready(&self, stream: Stream, load: SizeClass) {
        self.full_streams.fetch_and(!bit(stream, load), Relaxed);
        self.changed.notify_waiters();
    }

    /// Whether this has to wait. Data does not go where the words that keep the session together do
    /// not: they are small, and control. Otherwise one stream does not hold up another, so that a
    /// stop goes however many commands wait; and what waits for bindings holds up data alone.
    /// Where there is no room for what is small, bulk waits too: what is bulk here may be small to
    /// the session.
    fn is_held(&self, class: CreditClass) -> bool {
        // Of which only the newest counts, nothing waits behind what does.
        let CreditClass { stream: Some(stream), load } = class else { return false };
        let full = self.full_streams.load(Relaxed);
        let mine = bit(stream, SizeClass::Small) | bit(stream, load);
        let words = match stream {
            Stream::Data => bit(Stream::Control, SizeClass::Small),
            Stream::Control | Stream::Redundant => 0,
        };
        let waits = 1 << SizeClass::Small as u8 | 1 << load as u8;
        let budget = stream == Stream::Data && self.full_budget.load(Relaxed) & waits != 0;
        full & (words | mine) != 0 || budget
    }

    /// What waits for bindings is as much as should, of this load.
    pub(super) fn budget_is_full(&self, load: SizeClass) {
        self.full_budget.fetch_or(1 << load as u8, Relaxed);
    }

    pub(super) fn handle_budget_ready(&self, load: SizeClass) {
        self.full_budget.fetch_and(!(1 << load as u8), Relaxed);
        self.changed.notify_waiters();
    }

    pub(super) fn path_found(&self) {
        self.path.store(true, Relaxed);
        self.met.store(true, Relaxed);
        self.changed.notify_waiters();
    }

    pub(super) fn path_lost(&self) {
        self.path.store(false, Relaxed);
        self.changed.notify_waiters();
    }

    pub(super) fn is_open(&self, class: CreditClass) -> bool {
        self.has_session() && !self.is_held(class) && !self.is_isolated()
    }

    /// Nothing is sent there and nothing taken from there.
    pub(super) fn isolate(&self) {
        self.isolated.store(true, Relaxed);
        self.changed.notify_waiters();
    }

    /// All is well again.
    pub(super) fn admit(&self) {
        self.isolated.store(false, Relaxed);
        self.changed.notify_waiters();
    }

    pub(super) fn is_isolated(&self) -> bool {
        self.isolated.load(Relaxed)
    }

    /// A session is open, whether it has room or not.
    pub(super) fn has_session(&self) -> bool {
        self.condition() == PeerCondition::Open
    }

    fn lock_full(&self) -> MutexGuard<'_, SortedSet<ObjectName>> {
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

    /// Takes room for an event, which never waits.
    pub(super) fn take_for_event(&self, bytes: usize, class: CreditClass) -> Option<Credit> {
        self.credits.take_for_event(bytes, class)
    }

    fn check(&self, object: &ObjectName, class: CreditClass) -> Result<(), DeliveryError> {
        if self.ended.load(Relaxed) {
            return Err(DeliveryError::Stopped);
        }
        if self.is_isolated() {
            return Err(DeliveryError::Isolated { object: self.node.to_string() });
        }
        match self.condition() {
            PeerCondition::Unreachable => {
                Err(DeliveryError::Unreachable { node: self.node.to_string() })
            }
            PeerCondition::Opening => Err(self.own_isolation.why()),
            PeerCondition::Left => Err(DeliveryError::Left { node: self.node.to_string() }),
            PeerCondition::Open if self.is_full(object) => Err(DeliveryError::Full),
            PeerCondition::Open if self.is_held(class) || !self.credits.have_capacity(class) => {
                Err(self.way_full(class))
            }
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

    fn way_full(&self, CreditClass { load, .. }: CreditClass) -> DeliveryError {
        DeliveryError::WayFull { node: self.node.to_string(), bulk: load == SizeClass::Bulk }
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

    /// Takes room for so many bytes as soon as there is some; `None` where nothing can be sent to
    /// the peer at all.
    pub(super) async fn credit(&self, bytes: usize, class: CreditClass) -> Option<Credit> {
        loop {
            let changed = self.changed.notified();
            if !self.has_session() || self.is_isolated() || self.ended.load(Relaxed) {
                return None;
            }
            let taken = (!self.is_held(class)).then(|| self.credits.take_credit(bytes, class));
            if let Some(credit) = taken.flatten() {
                return Some(credit);
            }
            changed.await;
        }
    }

    async fn space(&self, object: &ObjectName, class: CreditClass) {
        loop {
            let changed = self.changed.notified();
            match self.check(object, class) {
                Err(
                    DeliveryError::Full | DeliveryError::WayFull { .. } | DeliveryError::Restarting,
                ) => changed.await,
                // Whatever else stands in the way is told by the next attempt.
                _ => return,
            }
        }
    }
}

impl PeerStubs {
    pub(super) fn new(own_isolation: OwnIsolation) -> Self {
        PeerStubs {
            gateway: OnceLock::new(),
            send_states: Mutex::default(),
            own_isolation,
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

    /// As many as nodes that this program has named, or met.
    pub(super) fn send_state(&self, node: &NodeName) -> Arc<PeerSendState> {
        let mut send_states = self.lock();
        let send_state = send_states.entry(node.clone()).or_insert_with(|| {
            let changed = Arc::new(Notify::new());
            Arc::new(PeerSendState {
                node: node.clone(),
                own_isolation: self.own_isolation.clone(),
                ended: self.ended.clone(),
                condition: AtomicU8::new(PeerCondition::Unreachable as u8),
                path: AtomicBool::new(false),
                met: AtomicBool::new(false),
                isolated: AtomicBool::new(false),
                full_streams: AtomicU8::new(0),
                full_budget: AtomicU8::new(0),
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
        Arc::new(PeerStub { to, contract, send_state, gateway })
    }
}

/// The way to one object for one contract.
struct PeerStub {
    to: ObjectAddress,
    contract: ContractIdentity,
    send_state: Arc<PeerSendState>,
    gateway: Option<Recipient<SendToPeer>>,
}

impl PeerStub {
    fn stream(&self) -> Option<Stream> {
        stream_of(self.contract.name, self.contract.delivery)
    }
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
        let class = CreditClass::of(self.stream(), message.len());
        self.send_state.check(&self.to.object, class)?;
        let gateway = self.gateway.as_ref().ok_or(DeliveryError::Stopped)?;
        let taken = self.send_state.credits.take_credit(message.len(), class);
        let credit = taken.ok_or_else(|| self.send_state.way_full(class))?;
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

    fn space<'a>(
        &'a self,
        refused: &DeliveryError,
    ) -> Pin<Box<dyn Future<Output = ()> + Send + 'a>> {
        let load = match refused {
            DeliveryError::WayFull { bulk: true, .. } => SizeClass::Bulk,
            _ => SizeClass::Small,
        };
        let class = CreditClass { stream: self.stream(), load };
        Box::pin(self.send_state.space(&self.to.object, class))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_doubles::{paused, settle};

    const SMALL: CreditClass = CreditClass { stream: Some(Stream::Data), load: SizeClass::Small };
    const BULK: CreditClass = CreditClass { load: SizeClass::Bulk, ..SMALL };
    const COMMAND: CreditClass = CreditClass { stream: Some(Stream::Control), ..SMALL };
    const STOP: CreditClass = CreditClass { stream: Some(Stream::Redundant), ..SMALL };
    const NEWEST: CreditClass = CreditClass { stream: None, ..SMALL };

    fn send_state() -> (Arc<PeerSendState>, ObjectName) {
        let name = |name| NodeName::new(name).unwrap();
        let send_state =
            PeerStubs::new(OwnIsolation::new(name("module1"))).send_state(&name("module2"));
        send_state.begin();
        (send_state, ObjectName::new("arm").unwrap())
    }

    /// What finds room, of a small message, bulk, a stop, and a reading of which the newest counts.
    fn space(send_state: &PeerSendState) -> [bool; 4] {
        let object = ObjectName::new("arm").unwrap();
        [SMALL, BULK, STOP, NEWEST].map(|class| {
            let checked = send_state.check(&object, class);
            assert!(matches!(checked, Ok(()) | Err(DeliveryError::WayFull { .. })), "{checked:?}");
            checked.is_ok()
        })
    }

    #[test]
    fn a_gate_is_open_when_neither_the_session_nor_what_waits_for_bindings_is_full() {
        let (send_state, _) = send_state();
        assert_eq!(space(&send_state), [true; 4]);

        send_state.stream_is_full(Stream::Data, SizeClass::Small);
        send_state.budget_is_full(SizeClass::Small);
        send_state.handle_budget_ready(SizeClass::Small);
        assert_eq!(space(&send_state), [false, false, true, true], "the session is full");

        send_state.budget_is_full(SizeClass::Small);
        send_state.handle_stream_ready(Stream::Data, SizeClass::Small);
        assert_eq!(
            space(&send_state),
            [false, false, true, true],
            "what waits is as much as should"
        );
        assert!(!send_state.is_open(SMALL));

        send_state.begin();
        assert_eq!(space(&send_state), [true; 4]);
    }

    #[test]
    fn what_fills_the_way_to_a_node_leaves_redundant_messages_theirs_and_the_other_way_round() {
        let (send_state, _) = send_state();
        send_state.stream_is_full(Stream::Data, SizeClass::Small);
        assert_eq!(space(&send_state), [false, false, true, true], "a stop goes");
        send_state.stream_is_full(Stream::Redundant, SizeClass::Small);
        send_state.handle_stream_ready(Stream::Data, SizeClass::Small);
        assert_eq!(space(&send_state), [true, true, false, true]);
        send_state.stream_is_full(Stream::Control, SizeClass::Bulk);
        assert_eq!(space(&send_state), [true, true, false, true], "the state of a service");
        send_state.stream_is_full(Stream::Control, SizeClass::Small);
        assert_eq!(space(&send_state), [false, false, false, true], "it is full itself");
        send_state.handle_stream_ready(Stream::Redundant, SizeClass::Small);
        assert_eq!(space(&send_state), [false, false, true, true], "a stop goes");
    }

    #[test]
    fn bulk_that_fills_its_room_leaves_what_is_small_its_own() {
        let (send_state, _) = send_state();
        let taken = send_state.credits.take_credit(1 << 20, BULK);
        assert_eq!(
            space(&send_state),
            [true, false, true, true],
            "it is on its way to the session"
        );
        drop(taken);
        assert_eq!(space(&send_state), [true; 4]);

        send_state.stream_is_full(Stream::Data, SizeClass::Bulk);
        assert_eq!(space(&send_state), [true, false, true, true], "the session holds it");
        send_state.handle_stream_ready(Stream::Data, SizeClass::Bulk);
        send_state.budget_is_full(SizeClass::Bulk);
        assert_eq!(space(&send_state), [true, false, true, true], "it waits for bindings");
        send_state.handle_budget_ready(SizeClass::Bulk);
        assert_eq!(space(&send_state), [true; 4]);
    }

    #[test]
    fn commands_have_room_however_much_data_waits_anywhere() {
        let (send_state, object) = send_state();
        let _small = send_state.credits.take_credit(1 << 20, SMALL);
        for load in SizeClass::ALL {
            send_state.stream_is_full(Stream::Data, load);
            send_state.budget_is_full(load);
        }
        assert!(send_state.check(&object, SMALL).is_err());
        assert_eq!(send_state.check(&object, COMMAND), Ok(()));
    }

    #[test]
    fn a_full_object_and_a_full_way_are_told_apart() {
        let (send_state, object) = send_state();
        send_state.stream_is_full(Stream::Data, SizeClass::Bulk);
        let node = || "module2".to_owned();
        let full = DeliveryError::WayFull { node: node(), bulk: true };
        assert_eq!(send_state.check(&object, BULK), Err(full));
        send_state.object_is_full(object.clone());
        assert_eq!(send_state.check(&object, BULK), Err(DeliveryError::Full));
        send_state.handle_object_ready(&object);
        send_state.stream_is_full(Stream::Data, SizeClass::Small);
        let full = DeliveryError::WayFull { node: node(), bulk: false };
        assert_eq!(send_state.check(&object, SMALL), Err(full));
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
        send_state.isolate();
        assert_eq!(send_state.why_not(), DeadReason::Isolated);
    }

    #[test]
    fn whoever_waits_with_bulk_is_not_woken_by_room_for_what_is_small() {
        paused(async {
            let (send_state, object) = send_state();
            send_state.stream_is_full(Stream::Data, SizeClass::Small);
            send_state.stream_is_full(Stream::Data, SizeClass::Bulk);
            let [small, bulk] = [SMALL, BULK].map(|class| {
                let (send_state, object) = (send_state.clone(), object.clone());
                actix_rt::spawn(async move { send_state.space(&object, class).await })
            });
            settle().await;

            send_state.handle_stream_ready(Stream::Data, SizeClass::Small);
            settle().await;
            assert!(small.is_finished() && !bulk.is_finished());
            send_state.handle_stream_ready(Stream::Data, SizeClass::Bulk);
            settle().await;
            assert!(bulk.is_finished());
        });
    }
}
