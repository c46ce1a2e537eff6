//! The ways out of this node: what stands behind a `Sender` of a remote object.

use super::gateway::Ship;
use super::outcast::Outcast;
use crate::platform;
use crate::registry::{Asked, RemoteDoor, RemoteDoors};
use actix::Recipient;
use blastema_contract::session::{Credit, Lender};
use blastema_core::net::segment::Stream;
use blastema_core::net::session::PAYLOAD_MAX;
use blastema_core::{ContractIdentity, Delivery, NodeName, ObjectAddress, ObjectName, Parcel, Why};
use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, OnceLock, PoisonError};
use tokio::sync::Notify;

/// Messages to one peer that may be on their way to its session: what a burst sends before the network's
/// arbiter has its turn. A session takes as many again once it has said that it is full.
const UNDER_WAY_MAX: usize = 2048;
/// Their bytes, likewise. One message more may be on its way, whose bytes go beyond this.
const BYTES_UNDER_WAY_MAX: usize = 1 << 20;

/// By which stream messages go that are to travel so.
pub(super) fn stream_of(delivery: Delivery) -> Stream {
    match delivery {
        Delivery::Reliable | Delivery::Newest => Stream::Data,
        Delivery::Redundant => Stream::Redundant,
    }
}

/// Redundant messages, such as stops, have as much room again, which nothing else takes.
fn times(stream: Stream) -> usize {
    if stream == Stream::Redundant { 2 } else { 1 }
}

/// Makes doors, and tells those behind them how their peer is.
pub(super) struct Doors {
    gateway: OnceLock<Recipient<Ship>>,
    gates: Mutex<BTreeMap<NodeName, Arc<Gate>>>,
    outcast: Outcast,
}

/// What all doors to one peer share.
pub(super) struct Gate {
    node: NodeName,
    outcast: Outcast,
    condition: AtomicU8,
    /// A path leads there, or perhaps the session waits for one.
    path: AtomicBool,
    /// There was a session, or a path, at some time.
    met: AtomicBool,
    isolated: AtomicBool,
    /// Of which streams the session holds all that it should, a bit each.
    full_streams: AtomicU8,
    /// Of what waits for bindings there. It has nothing to do with what the session holds.
    hall_is_full: AtomicBool,
    under_way: AtomicUsize,
    bytes_under_way: AtomicUsize,
    /// Its objects that have no room: as many as this node sends to at most.
    full: Mutex<BTreeSet<ObjectName>>,
    /// There are some; to be looked at without the lock.
    any_full: AtomicBool,
    changed: Notify,
}

/// How sending to a peer stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub(super) enum Condition {
    /// No path leads there.
    Unreachable,
    /// There is a path; the session is about to begin.
    Opening,
    /// There is a session.
    Open,
    /// Its node has ended in order.
    Left,
}

impl Gate {
    fn condition(&self) -> Condition {
        match self.condition.load(Relaxed) {
            0 => Condition::Unreachable,
            1 => Condition::Opening,
            2 => Condition::Open,
            _ => Condition::Left,
        }
    }

    pub(super) fn set(&self, condition: Condition) {
        self.condition.store(condition as u8, Relaxed);
        self.changed.notify_waiters();
    }

    /// A session has begun: it takes messages, and knows of no binding.
    pub(super) fn begin(&self) {
        self.outcast.let_in();
        self.met.store(true, Relaxed);
        self.hall_is_full.store(false, Relaxed);
        self.full_streams.store(0, Relaxed);
        self.set(Condition::Open);
    }

    /// The session holds all that it should of this stream.
    pub(super) fn stream_is_full(&self, stream: Stream) {
        self.full_streams.fetch_or(1 << stream as u8, Relaxed);
    }

    pub(super) fn stream_has_room(&self, stream: Stream) {
        self.full_streams.fetch_and(!(1 << stream as u8), Relaxed);
        self.changed.notify_waiters();
    }

    /// Whether what goes in this stream has to wait. Nothing goes where the words that keep the session
    /// together do not; of the others, one does not hold up the other.
    fn is_held(&self, stream: Stream) -> bool {
        let holding = 1 << Stream::Control as u8 | 1 << stream as u8;
        self.full_streams.load(Relaxed) & holding != 0 || self.hall_is_full.load(Relaxed)
    }

    /// What waits for bindings is as much as should.
    pub(super) fn hall_is_full(&self) {
        self.hall_is_full.store(true, Relaxed);
    }

    pub(super) fn hall_has_room(&self) {
        self.hall_is_full.store(false, Relaxed);
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

    pub(super) fn is_open(&self, stream: Stream) -> bool {
        self.has_session() && !self.is_held(stream) && !self.is_isolated()
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
        self.condition() == Condition::Open
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
    pub(super) fn object_has_room(&self, object: &ObjectName) {
        let mut full = self.lock_full();
        full.remove(object);
        self.any_full.store(!full.is_empty(), Relaxed);
        drop(full);
        self.changed.notify_waiters();
    }

    /// What was said of objects there does not count any more.
    pub(super) fn forget_rooms(&self) {
        self.lock_full().clear();
        self.any_full.store(false, Relaxed);
        self.changed.notify_waiters();
    }

    fn is_full(&self, object: &ObjectName) -> bool {
        self.any_full.load(Relaxed) && self.lock_full().contains(object)
    }

    /// More may be under way, up to this share of all.
    fn has_room(&self, stream: Stream, share: usize) -> bool {
        let times = times(stream);
        self.under_way.load(Relaxed) < times * UNDER_WAY_MAX / share
            && self.bytes_under_way.load(Relaxed) < times * BYTES_UNDER_WAY_MAX / share
    }

    /// Takes room for an event, which never waits, and leaves half to what does.
    pub(super) fn lend_to_event(self: &Arc<Self>, bytes: usize, stream: Stream) -> Option<Credit> {
        if self.has_room(stream, 2) { self.lend(bytes, stream) } else { None }
    }

    fn lend(self: &Arc<Self>, bytes: usize, stream: Stream) -> Option<Credit> {
        let messages = self.under_way.fetch_add(1, Relaxed);
        let before = self.bytes_under_way.fetch_add(bytes, Relaxed);
        // Many threads may have found room for one.
        let credit = Credit::new(self.clone(), bytes);
        let times = times(stream);
        (messages < times * UNDER_WAY_MAX && before < times * BYTES_UNDER_WAY_MAX).then_some(credit)
    }

    fn check(&self, object: &ObjectName, stream: Stream) -> Result<(), Why> {
        if self.is_isolated() {
            return Err(Why::Isolated);
        }
        match self.condition() {
            Condition::Unreachable => Err(Why::Unreachable { node: self.node.to_string() }),
            Condition::Opening => Err(self.outcast.why()),
            Condition::Left => Err(Why::Left { node: self.node.to_string() }),
            Condition::Open if self.is_held(stream) => Err(Why::Full),
            Condition::Open if !self.has_room(stream, 1) || self.is_full(object) => Err(Why::Full),
            Condition::Open => Ok(()),
        }
    }

    /// Completes when a session is open, and a path leads there.
    async fn opened(&self) {
        loop {
            let changed = self.changed.notified();
            if self.has_session() && self.path.load(Relaxed) {
                return;
            }
            changed.await;
        }
    }

    async fn room(&self, object: &ObjectName, stream: Stream) {
        loop {
            let changed = self.changed.notified();
            match self.check(object, stream) {
                Err(Why::Full | Why::Restarting) => changed.await,
                // Whatever else stands in the way is told by the next attempt.
                _ => return,
            }
        }
    }
}

impl Lender for Gate {
    fn give_back(&self, bytes: usize) {
        let room = || [Stream::Data, Stream::Redundant].map(|stream| self.has_room(stream, 1));
        let had_room = room();
        self.under_way.fetch_sub(1, Relaxed);
        self.bytes_under_way.fetch_sub(bytes, Relaxed);
        if had_room != room() {
            self.changed.notify_waiters();
        }
    }
}

impl Doors {
    pub(super) fn new(outcast: Outcast) -> Self {
        Doors { gateway: OnceLock::new(), gates: Mutex::default(), outcast }
    }

    pub(super) fn lead_to(&self, gateway: Recipient<Ship>) {
        // Called once, when the network starts.
        let _ = self.gateway.set(gateway);
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<NodeName, Arc<Gate>>> {
        self.gates.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Completes when a session with this node is open, and a path leads there.
    pub(super) async fn opened(&self, node: &NodeName) {
        self.gate(node).opened().await;
    }

    /// Whether a path has led there, now or before.
    pub(super) fn has_met(&self, node: &NodeName) -> bool {
        self.lock().get(node).is_some_and(|gate| gate.met.load(Relaxed))
    }

    /// Those that a path leads to now, or did before, in the order of their names.
    pub(super) fn met(&self) -> Vec<NodeName> {
        let gates = self.lock();
        let met = gates.iter().filter(|(_, gate)| gate.met.load(Relaxed));
        met.map(|(node, _)| node.clone()).collect()
    }

    /// As many as nodes that this program has named, or met.
    pub(super) fn gate(&self, node: &NodeName) -> Arc<Gate> {
        let mut gates = self.lock();
        let gate = gates.entry(node.clone()).or_insert_with(|| {
            Arc::new(Gate {
                node: node.clone(),
                outcast: self.outcast.clone(),
                condition: AtomicU8::new(Condition::Unreachable as u8),
                path: AtomicBool::new(false),
                met: AtomicBool::new(false),
                isolated: AtomicBool::new(false),
                full_streams: AtomicU8::new(0),
                hall_is_full: AtomicBool::new(false),
                under_way: AtomicUsize::new(0),
                bytes_under_way: AtomicUsize::new(0),
                full: Mutex::default(),
                any_full: AtomicBool::new(false),
                changed: Notify::new(),
            })
        });
        gate.clone()
    }
}

impl RemoteDoors for Doors {
    fn door(&self, to: ObjectAddress, contract: ContractIdentity) -> Arc<dyn RemoteDoor> {
        let gate = self.gate(&to.node);
        let gateway = self.gateway.get().cloned();
        Arc::new(Door { to, contract, gate, gateway })
    }
}

/// The way to one object for one contract.
struct Door {
    to: ObjectAddress,
    contract: ContractIdentity,
    gate: Arc<Gate>,
    gateway: Option<Recipient<Ship>>,
}

impl RemoteDoor for Door {
    fn send(&self, message: Parcel, asked: Option<Asked>) -> Result<(), Why> {
        if message.len() > PAYLOAD_MAX {
            return Err(Why::TooLargeForSession { limit: PAYLOAD_MAX });
        }
        let object = &self.to.object;
        let stream = stream_of(self.contract.delivery);
        match self.gate.check(object, stream) {
            // What waits in order keeps nobody who does not.
            Err(Why::Full)
                if self.contract.delivery == Delivery::Newest
                    && self.gate.has_room(stream, 1)
                    && !self.gate.is_full(object) => {}
            checked => checked?,
        }
        let gateway = self.gateway.as_ref().ok_or(Why::Stopped)?;
        let credit = self.gate.lend(message.len(), stream).ok_or(Why::Full)?;
        let sent = platform::now();
        let (id, within, reply_to) = match asked {
            None => (None, None, None),
            Some(Asked { id, within, reply_to }) => (id, within, Some(reply_to)),
        };
        gateway.do_send(Ship {
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

    fn room(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(self.gate.room(&self.to.object, stream_of(self.contract.delivery)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gate_is_open_when_neither_the_session_nor_what_waits_for_bindings_is_full() {
        let name = |name| NodeName::new(name).unwrap();
        let doors = Doors::new(Outcast::new(name("module1")));
        let (gate, object) = (doors.gate(&name("module2")), ObjectName::new("arm").unwrap());
        let check = |stream| gate.check(&object, stream);
        gate.begin();
        assert_eq!(check(Stream::Data), Ok(()));

        gate.stream_is_full(Stream::Data);
        gate.hall_is_full();
        gate.hall_has_room();
        assert_eq!(check(Stream::Data), Err(Why::Full), "the session is");

        gate.hall_is_full();
        gate.stream_has_room(Stream::Data);
        assert_eq!(check(Stream::Data), Err(Why::Full), "what waits is as much as should");
        assert!(!gate.is_open(Stream::Data));

        gate.begin();
        assert_eq!(check(Stream::Data), Ok(()));
    }

    #[test]
    fn what_fills_the_way_to_a_node_leaves_redundant_messages_theirs_and_the_other_way_round() {
        let name = |name| NodeName::new(name).unwrap();
        let doors = Doors::new(Outcast::new(name("module1")));
        let (gate, object) = (doors.gate(&name("module2")), ObjectName::new("arm").unwrap());
        let check = |stream| gate.check(&object, stream);
        gate.begin();

        let images: Vec<_> = (0..8).map_while(|_| gate.lend(1 << 19, Stream::Data)).collect();
        assert_eq!((images.len(), check(Stream::Data)), (2, Err(Why::Full)));
        assert_eq!(check(Stream::Redundant), Ok(()), "a stop goes");
        let stops: Vec<_> = (0..9_999).map_while(|_| gate.lend(64, Stream::Redundant)).collect();
        assert!((1_000..9_999).contains(&stops.len()), "{}", stops.len());
        drop((images, stops));

        gate.stream_is_full(Stream::Data);
        assert_eq!((check(Stream::Data), check(Stream::Redundant)), (Err(Why::Full), Ok(())));
        gate.stream_is_full(Stream::Redundant);
        gate.stream_has_room(Stream::Data);
        assert_eq!((check(Stream::Data), check(Stream::Redundant)), (Ok(()), Err(Why::Full)));
        gate.stream_is_full(Stream::Control);
        assert_eq!(check(Stream::Data), Err(Why::Full), "nothing could be bound");
    }
}
