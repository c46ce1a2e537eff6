//! What all incarnations of one component share: it is what a reference refers to.
//!
//! The queue, the name and the record of messages that kill belong here, not to an incarnation, so
//! that they outlive panics and hung threads.

use super::environment::ComponentEnvironment;
use crate::arbiter::deadline::Cancel;
use crate::arbiter::heartbeat;
use crate::arbiter::pool::ArbiterSlot;
use crate::component::cold_state::ColdState;
use crate::component::control::{CommandQueue, HostCommand};
use crate::component::declaration::CellListener;
use crate::component::envelope::{BoxedEnvelope, Times, enqueue_time, seal_message};
use crate::component::ports::QueuePort;
use crate::component::subscription::Subscriptions;
use crate::component::{Component, Handle};
use crate::liveness::activity::ActivitySlotRef;
use crate::liveness::limits::ComponentLimits;
use crate::liveness::sampler::AliveSource;
use crate::messaging::death_watch::{Down, DownReason};
use crate::messaging::error::{Receiver, RequestError, SendError, Unavailable};
use crate::messaging::incarnation::IncarnationToken;
use crate::messaging::message_log;
use crate::messaging::queue::{BoundedQueue, WhenFull};
use crate::messaging::reply::{ReplyFuture, Responder};
use crate::messaging::sink::MessageSink;
use crate::platform;
use crate::platform::lock;
use crate::platform::panics;
use crate::settings::FAULT_HOLD;
use blastema_contract::reports::{DeclaredFaultCleared, FaultDeclared};
use blastema_core::detection::RoundLateness;
use blastema_core::detection::hang::QueueReading;
use blastema_core::sorted::SortedMap;
use blastema_core::{
    Contract, DeliveryError, FaultKind, Incarnation, Instant, Lifecycle, MessageId, ObjectName,
};
use std::any::TypeId;
use std::cell::Cell;
use std::pin::Pin;
use std::sync::atomic::Ordering::Relaxed;
use std::sync::atomic::{AtomicBool, AtomicU8, AtomicU64};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;
use tracing::warn;

/// Nothing comes in.
const ISOLATED: u8 = 1;
/// Some message is quarantined, so that identified ones are looked at.
const QUARANTINE: u8 = 2;

pub(crate) struct ComponentCell<C: Component> {
    pub(crate) queue: BoundedQueue<BoxedEnvelope<C>>,
    /// What has another port in the queue than the common one.
    ports: SortedMap<QueuePort, usize>,
    pub(crate) record: CellCore,
    pub(crate) factory: Box<dyn Fn() -> C + Send + Sync>,
    /// Of its present placement.
    control: Mutex<Option<Arc<CommandQueue>>>,
    subscriptions: Mutex<Subscriptions<C>>,
}

/// The part of an [`ComponentCell`] that does not depend on the component's type.
pub(crate) struct CellCore {
    pub(crate) name: ObjectName,
    pub(crate) limits: Arc<ComponentLimits>,
    pub(crate) environment: Arc<ComponentEnvironment>,
    flags: AtomicU8,
    state: Mutex<CellStatus>,
    /// The incarnation that began last.
    incarnation: AtomicU64,
    service: Mutex<MessageInService>,
    /// Its guard may restart it once by itself.
    granted: AtomicBool,
    cold: OnceLock<Box<ColdState>>,
}

/// Where a component stands, and where it lives.
struct CellStatus {
    state: Lifecycle,
    /// A hook waits for what is not there yet: since when, and why.
    unavailable: Option<Box<(Instant, String)>>,
    arbiter: Option<CurrentPlacement>,
}

/// One incarnation's place.
#[derive(Clone)]
pub(crate) struct CurrentPlacement {
    pub(crate) arbiter: ArbiterSlot,
    pub(crate) slot: ActivitySlotRef,
    pub(crate) token: Arc<IncarnationToken>,
}

/// The sender to notify if the message in service causes death. It is kept here and not with the
/// executor, so that a hung callee cannot keep it.
#[derive(Default)]
pub(crate) struct MessageInService {
    asker: Option<Arc<dyn Cancel>>,
    id: Option<MessageId>,
}

/// What becomes of a panic in a `Drop`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Blame {
    /// It is a fault of the component.
    Fault,
    /// The incarnation ends with a fault already: it is only logged.
    Log,
}

impl CellCore {
    pub(crate) fn new(
        name: ObjectName,
        limits: Arc<ComponentLimits>,
        environment: Arc<ComponentEnvironment>,
    ) -> Self {
        CellCore {
            name,
            limits,
            environment,
            flags: AtomicU8::new(0),
            state: Mutex::new(CellStatus {
                state: Lifecycle::Created,
                unavailable: None,
                arbiter: None,
            }),
            incarnation: AtomicU64::new(0),
            service: Mutex::default(),
            granted: AtomicBool::new(false),
            cold: OnceLock::new(),
        }
    }

    /// What the component seldom uses, for the first time perhaps.
    pub(crate) fn cold(&self) -> &ColdState {
        self.cold.get_or_init(Box::default)
    }

    /// What the component seldom uses, where it has used any.
    #[inline]
    pub(crate) fn cold_if_used(&self) -> Option<&ColdState> {
        self.cold.get().map(|cold| &**cold)
    }

    /// A round begins so long after it was due.
    pub(crate) fn begin_round(&self, late: Duration) {
        self.cold().lateness.get_or_init(Box::default).add(late);
    }

    /// Whether a test keeps its signs of life back.
    #[inline]
    pub(crate) fn is_silent(&self) -> bool {
        self.cold_if_used().is_some_and(|cold| cold.injected.is_silent())
    }

    /// Tells the watchers of the component, and the features, that its incarnation has ended.
    pub(crate) fn tell_watchers(&self, incarnation: Incarnation, ending: DownReason) {
        self.announce(|listener| listener.ended());
        let object = self.name.clone();
        self.environment.registry.deaths().tell(&Down { object, node: None, incarnation, ending });
    }

    /// Notifies a feature of what becomes of the component.
    pub(crate) fn listen(&self, listener: impl CellListener + 'static) {
        self.cold().listen(listener);
    }

    /// Notifies the features.
    pub(crate) fn announce(&self, what: impl Fn(&(dyn CellListener + 'static))) {
        if let Some(cold) = self.cold_if_used() {
            cold.announce(what);
        }
    }

    /// An incarnation leaves work in order. Returns how long it may go on until it has settled.
    pub(crate) fn leave_work(&self) -> Duration {
        let within = Cell::new(Duration::ZERO);
        self.announce(|listener| within.set(within.get().max(listener.leaves_work())));
        within.get()
    }

    pub(crate) fn incarnation(&self) -> Incarnation {
        Incarnation(self.incarnation.load(Relaxed))
    }

    /// This incarnation is about to begin; it never goes back.
    pub(crate) fn set_incarnation(&self, incarnation: Incarnation) {
        self.incarnation.fetch_max(incarnation.0, Relaxed);
    }

    /// An incarnation is in its place. False if a later one has begun elsewhere, whose place stays
    /// known.
    pub(crate) fn enter(&self, incarnation: Incarnation, placement: CurrentPlacement) -> bool {
        let mut status = lock(&self.state);
        let is_newest = incarnation >= self.incarnation();
        if is_newest {
            self.set_incarnation(incarnation);
            status.arbiter = Some(placement);
        }
        is_newest
    }

    pub(crate) fn state(&self) -> Lifecycle {
        lock(&self.state).state
    }

    pub(crate) fn set_state(&self, state: Lifecycle) {
        let mut status = lock(&self.state);
        status.state = state;
        // Between two hooks that wait for a device, the component may be initialized.
        if state != Lifecycle::Initialized {
            status.unavailable = None;
        }
    }

    /// A hook has failed because what it needs is not there yet.
    pub(crate) fn set_unavailable(&self, reason: &str) {
        let mut status = lock(&self.state);
        let since = status.unavailable.as_ref().map_or_else(platform::now, |known| known.0);
        status.unavailable = Some(Box::new((since, reason.to_owned())));
    }

    /// What the component waits for, and for how long it has.
    fn unavailable(&self) -> Option<Unavailable> {
        let status = lock(&self.state);
        let (since, reason) = *status.unavailable.clone()?;
        Some(Unavailable { reason, lasts: platform::now() - since })
    }

    pub(crate) fn arbiter(&self) -> Option<CurrentPlacement> {
        lock(&self.state).arbiter.clone()
    }

    pub(crate) fn take_placement(&self) -> Option<CurrentPlacement> {
        lock(&self.state).arbiter.take()
    }

    /// Whether its guard may restart it by itself, once.
    pub(crate) fn take_grant(&self) -> bool {
        self.granted.swap(false, Relaxed)
    }

    pub(crate) fn grant_restart(&self, granted: bool) {
        self.granted.store(granted, Relaxed);
    }

    #[inline]
    pub(crate) fn is_isolated(&self) -> bool {
        self.flags.load(Relaxed) & ISOLATED != 0
    }

    /// The message in service is one whose sender waits, or one that may come again. An asker may
    /// be left here: a request takes one result only, and it has it when it was served.
    #[inline]
    pub(crate) fn begin_service(&self, asker: Option<Arc<dyn Cancel>>, id: Option<MessageId>) {
        *lock(&self.service) = MessageInService { asker, id };
    }

    /// It has been served, and is not to be blamed for what comes after.
    #[inline]
    pub(crate) fn end_service(&self) {
        let followed = std::mem::take(&mut *lock(&self.service));
        drop(followed);
    }

    /// The incarnation ends with the message that it serves: its caller is notified, and the
    /// message is blamed.
    pub(crate) fn record_fatal_message(&self, incarnation: Incarnation) {
        let MessageInService { asker, id } = std::mem::take(&mut *lock(&self.service));
        if let Some(asker) = asker {
            asker.cancel(DeliveryError::PeerDied { incarnation });
        }
        if let Some(id) = id
            && self.cold().record_kill(id, incarnation)
        {
            self.flags.fetch_or(QUARANTINE, Relaxed);
        }
    }

    /// Says why this message is not let in.
    #[inline]
    pub(crate) fn refusal(&self, id: Option<MessageId>) -> Option<DeliveryError> {
        match self.flags.load(Relaxed) {
            0 => None,
            flags => self.check_flags(flags, id),
        }
    }

    #[cold]
    fn check_flags(&self, flags: u8, id: Option<MessageId>) -> Option<DeliveryError> {
        if flags & ISOLATED != 0 {
            let reason = self.cold_if_used().and_then(ColdState::isolated_because);
            return Some(match reason {
                Some(reason) => DeliveryError::Isolated { object: self.name.to_string(), reason },
                None => DeliveryError::isolated(&self.name),
            });
        }
        self.cold_if_used()?.refusal(id?)
    }

    pub(crate) fn record_dead_letter(&self, contract: &'static str, why: &DeliveryError) {
        self.environment.dead_letters.record(&self.name, contract, why);
    }

    /// A fault of the component, or of what was sent to it.
    pub(crate) fn declare(&self, kind: FaultKind, detail: String) {
        self.declare_for(None, kind, detail);
    }

    /// The same, where the fault ends so long after it was declared last.
    pub(crate) fn declare_for(&self, hold: Option<Duration>, kind: FaultKind, detail: String) {
        let (object, incarnation) = (self.name.clone(), self.incarnation());
        let declared = FaultDeclared { object, incarnation, kind, detail, hold };
        self.environment.reports.send(declared);
    }

    /// What the component had declared is over.
    pub(crate) fn clear(&self, kind: FaultKind) {
        let (object, incarnation) = (self.name.clone(), self.incarnation());
        self.environment.reports.send_cleared(DeclaredFaultCleared { object, incarnation, kind });
    }

    /// Drops a thing whose `Drop` is the user's. A panic there ends nothing else.
    pub(crate) fn dispose<T>(&self, what: &str, thing: T, blame: Blame) {
        let what = || format!("the Drop of {what}");
        let run = move || drop(thing);
        match blame {
            Blame::Fault => drop(self.guard(what, run)),
            Blame::Log => {
                if let Err(panicked) = panics::caught(run) {
                    warn!(object = %self.name, "{} {panicked}", what());
                }
            }
        }
    }

    /// Runs what is the user's outside of an incarnation. If it panics, that is a fault of the
    /// component, and nothing else.
    pub(crate) fn guard<T>(
        &self,
        what: impl FnOnce() -> String,
        run: impl FnOnce() -> T,
    ) -> Result<T, String> {
        panics::caught(run).map_err(|panicked| {
            let detail = format!("{} {panicked}", what());
            warn!(object = %self.name, "{detail}");
            self.declare_for(Some(FAULT_HOLD), FaultKind::CheckFailed, detail.clone());
            detail
        })
    }
}

impl<C: Component> ComponentCell<C> {
    /// The queue is for all that has none of its own among `queues`.
    pub(crate) fn new(
        record: CellCore,
        queue: (usize, WhenFull),
        queues: SortedMap<QueuePort, (usize, WhenFull)>,
        factory: Box<dyn Fn() -> C + Send + Sync>,
    ) -> Self {
        let bounds = [queue].into_iter().chain(queues.values().copied());
        ComponentCell {
            queue: BoundedQueue::with_ports(bounds.collect()),
            ports: queues.keys().cloned().zip(1..).collect(),
            record,
            factory,
            control: Mutex::default(),
            subscriptions: Mutex::default(),
        }
    }

    /// At which port of the queue messages of this contract wait.
    #[inline]
    pub(crate) fn port_of<M: Contract>(&self) -> usize {
        match self.ports.is_empty() {
            true => 0,
            false => self.ports.get(&(TypeId::of::<M>(), String::new())).copied().unwrap_or(0),
        }
    }

    /// At which port events of this topic wait.
    pub(crate) fn port_of_topic<M: Contract>(&self, topic: &str) -> usize {
        let own = self.ports.get(&(TypeId::of::<M>(), topic.to_owned()));
        own.copied().unwrap_or_else(|| self.port_of::<M>())
    }

    pub(crate) fn control(&self) -> Option<Arc<CommandQueue>> {
        lock(&self.control).clone()
    }

    pub(crate) fn set_control(&self, control: Option<Arc<CommandQueue>>) {
        *lock(&self.control) = control;
    }

    pub(crate) fn subscriptions(&self) -> Subscriptions<C> {
        lock(&self.subscriptions).clone()
    }

    pub(crate) fn set_subscriptions(&self, subscriptions: Subscriptions<C>) {
        *lock(&self.subscriptions) = subscriptions;
    }

    /// Has the hub of this arbiter deliver the events of the component's subscriptions, or of those
    /// that have no hub yet.
    pub(crate) fn attach(self: &Arc<Self>, only_new: bool) {
        for subscription in self.subscriptions().iter() {
            if only_new && subscription.is_attached() {
                continue;
            }
            subscription.attach(self);
            // It may have been disconnected meanwhile.
            if !self.subscriptions().iter().any(|kept| Arc::ptr_eq(kept, subscription)) {
                subscription.end(self);
            }
        }
    }

    /// Adds a subscription to this topic that is like the one of this number.
    pub(crate) fn add_subscription(
        &self,
        like: usize,
        topic: &ObjectName,
    ) -> Result<(), DeliveryError> {
        let declared = self.subscriptions();
        let added = declared[like].on(&self.record.environment, topic)?;
        let mut subscriptions = lock(&self.subscriptions);
        if subscriptions.iter().any(|known| known.topic() == topic) {
            let name = &self.record.name;
            let reason = format!("{name} listens to the topic {topic} of this port already");
            return Err(DeliveryError::InvalidName { reason });
        }
        *subscriptions = subscriptions.iter().cloned().chain([added]).collect();
        drop(subscriptions);
        // Its own arbiter attaches it. Without an incarnation, the next one does.
        if let Some(control) = self.control() {
            control.send(HostCommand::Attach);
        }
        Ok(())
    }

    /// Ends the subscription to this topic.
    pub(crate) fn remove_subscription(&self, topic: &ObjectName) {
        let mut subscriptions = lock(&self.subscriptions);
        let (ended, kept): (Vec<_>, Vec<_>) =
            subscriptions.iter().cloned().partition(|known| known.topic() == topic);
        *subscriptions = kept.into();
        drop(subscriptions);
        ended.iter().for_each(|subscription| subscription.end(self));
    }

    /// Forbids the component to send and receive, or allows it again.
    pub(crate) fn isolate(&self, isolated: bool) {
        if isolated {
            self.record.flags.fetch_or(ISOLATED, Relaxed);
        } else {
            self.record.flags.fetch_and(!ISOLATED, Relaxed);
            self.record.cold_if_used().inspect(|cold| cold.explain_isolation(None));
        }
        if let Some(placement) = self.record.arbiter() {
            placement.token.mute(isolated);
        }
        self.queue.hold(isolated);
    }

    /// An event for a component that is busy, or has just been. It waits at this port. False where
    /// it does not fit and the queue's policy is not to drop.
    pub(crate) fn queue_event<M: Contract>(&self, port: usize, event: M, times: Times) -> bool
    where
        C: Handle<M>,
    {
        let refused = match self.record.refusal(None) {
            Some(why) => why,
            None => {
                let pushed = self.push(port, event, |m| seal_message::<C, M>(m, None, None, times));
                let Err((_, why)) = pushed else { return true };
                why
            }
        };
        self.record.record_dead_letter(M::NAME, &refused);
        refused != DeliveryError::Full || self.queue.bound(port).1 == WhenFull::DropNewest
    }
}

impl<C: Component> AliveSource for ComponentCell<C> {
    fn incarnation(&self) -> Incarnation {
        self.record.incarnation()
    }

    fn queue(&self) -> QueueReading {
        let queued = self.queue.depth();
        let looked = (queued > 0).then(|| self.queue.with_oldest(|first| first.header().posted_at));
        let posted_at = looked.flatten();
        let oldest = posted_at.map_or(Duration::ZERO, |posted_at| platform::now() - posted_at);
        QueueReading { queued, oldest }
    }

    fn is_held(&self) -> bool {
        self.record.is_isolated()
    }

    fn askers(&self) -> Vec<u32> {
        let served = lock(&self.record.service).asker.as_ref().and_then(|served| served.asker());
        let waiting = self.queue.select(|envelope| envelope.revocable()?.asker());
        waiting.into_iter().chain(served).collect()
    }

    fn round_lateness(&self) -> Option<RoundLateness> {
        self.record.cold_if_used()?.lateness.get()?.read()
    }
}

impl<C: Handle<M>, M: Contract> MessageSink<M> for ComponentCell<C> {
    #[inline]
    fn tell(&self, message: M) -> Result<(), SendError<M>> {
        self.tell_at(message, enqueue_time::<M>())
    }

    #[inline]
    fn offer(&self, message: M) -> Result<(), SendError<M>> {
        self.post(message, None, None, enqueue_time::<M>())
    }

    fn space(&self) -> Pin<Box<dyn Future<Output = ()> + Send + '_>> {
        Box::pin(self.queue.space(self.port_of::<M>()))
    }

    fn overdue(&self) {
        self.record.environment.report_circle(&self.record.name);
    }

    fn receiver(&self) -> Option<Receiver> {
        Some(Receiver {
            node: self.record.environment.registry.node(),
            object: self.record.name.clone(),
            contract: M::NAME,
            queue: Some(self.queue.bound(self.port_of::<M>()).0),
            unavailable: self.record.unavailable(),
            deadline: None,
        })
    }

    #[inline]
    fn ask(
        &self,
        message: M,
        id: Option<MessageId>,
        // The caller is in this process: its responder shows whether it still waits.
        _: Option<Duration>,
    ) -> Result<ReplyFuture<M>, RequestError<M>> {
        let (responder, reply) = Responder::awaited();
        match self.post(message, Some(responder), id, enqueue_time::<M>()) {
            Ok(()) => Ok(reply),
            Err(error) => Err(error.into()),
        }
    }
}

impl<C: Component> ComponentCell<C> {
    /// Sends the component what was posted then.
    #[inline]
    pub(crate) fn tell_at<M: Contract>(
        &self,
        message: M,
        posted_at: blastema_core::Instant,
    ) -> Result<(), SendError<M>>
    where
        C: Handle<M>,
    {
        match self.post(message, None, None, posted_at) {
            Err(SendError {
                kind: why @ (DeliveryError::Full | DeliveryError::Restarting),
                message,
                ..
            }) if self.queue.bound(self.port_of::<M>()).1 == WhenFull::DropNewest => {
                self.record.record_dead_letter(M::NAME, &why);
                drop(message);
                Ok(())
            }
            other => other,
        }
    }

    /// Enqueues a message, a request with the responder for its reply. A refusal resolves the
    /// responder, too.
    #[inline]
    pub(crate) fn post<M: Contract>(
        &self,
        message: M,
        mut responder: Option<Responder<M>>,
        id: Option<MessageId>,
        posted_at: Instant,
    ) -> Result<(), SendError<M>>
    where
        C: Handle<M>,
    {
        let (name, environment) = (&self.record.name, &self.record.environment);
        message_log::sent(M::NAME, name, || environment.watch_list.name_here());
        let posted = match heartbeat::send_refusal().or_else(|| self.record.refusal(id)) {
            None => {
                let (port, times) = (self.port_of::<M>(), Times::from(posted_at));
                self.push(port, message, |m| seal_message::<C, M>(m, responder.take(), id, times))
            }
            Some(why) => Err((message, why)),
        };
        posted.map_err(|(message, why)| {
            message_log::refused(M::NAME, name, &why);
            if let DeliveryError::Quarantined { .. } = why {
                self.record.record_dead_letter(M::NAME, &why);
            }
            if let Some(responder) = responder {
                responder.refuse(why.clone(), None);
            }
            SendError::new(why, message)
        })
    }

    /// Puts a message into the queue at this port. Where it has no room, what has expired leaves its
    /// place, and the oldest one is returned where it has to give way.
    #[inline]
    fn push<M: Contract>(
        &self,
        port: usize,
        message: M,
        seal: impl FnOnce(M) -> BoxedEnvelope<C>,
    ) -> Result<(), (M, DeliveryError)> {
        if self.queue.is_at_bound(port) {
            self.return_those_over();
        }
        if let Some(oldest) = self.queue.push_with(port, message, seal)? {
            self.return_envelope(oldest, DeliveryError::Full);
        }
        Ok(())
    }

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
    pub(crate) fn post_first<M: Contract>(&self, command: M, responder: Responder<M>)
    where
        C: Handle<M>,
    {
        let Some(owner) = self.queue.owner() else {
            return responder.refuse(DeliveryError::Restarting, None);
        };
        let is_command = |envelope: &BoxedEnvelope<C>| {
            (envelope.header().contract == TypeId::of::<M>()).then(|| envelope.revocable())
        };
        for waiting in self.queue.select(is_command).into_iter().flatten() {
            waiting.cancel(DeliveryError::Expired);
        }
        // No name of an object contains a blank, and no safe command grows old.
        let (about, never) = (format!("command {}", M::NAME), Instant::from_nanos(u64::MAX));
        let command = seal_message::<C, M>(command, Some(responder), None, never);
        drop(self.queue.notify(owner, &about, command));
    }

    /// The component is not started again for now: closes its queue and its subscriptions.
    pub(crate) fn end(self: &Arc<Self>) {
        self.close(&self.record.refusal(None).unwrap_or(DeliveryError::Stopped));
        self.subscriptions().iter().for_each(|subscription| subscription.end(self));
    }

    /// The same, by the incarnation that ends in order.
    pub(crate) fn end_by(&self, incarnation: Incarnation) {
        if self.queue.owner() == Some(incarnation) {
            self.close_by(incarnation);
            self.subscriptions().iter().for_each(|subscription| subscription.end(self));
        }
    }

    /// Closes the queue until the next incarnation; what was in it is returned or counted.
    pub(crate) fn close(&self, why: &DeliveryError) {
        self.queue.stop().into_iter().for_each(|left| self.return_envelope(left, why.clone()));
    }

    /// The same, by the incarnation that ends; without effect when it was given up and another has
    /// begun.
    pub(crate) fn close_by(&self, incarnation: Incarnation) {
        let left = self.queue.stop_by(incarnation);
        left.into_iter()
            .for_each(|envelope| self.return_envelope(envelope, DeliveryError::Stopped));
    }

    /// A message that is not going to be served is returned to its sender, or dropped and counted.
    /// Its `Drop` is the user's: a supervisor that closes a queue runs it on the fault chain's
    /// thread. A `Drop` that blocks there stalls the chain, which the
    /// [thread outside](crate::fault_chain::outside) finds.
    pub(crate) fn return_envelope(&self, mut envelope: BoxedEnvelope<C>, why: DeliveryError) {
        let contract = envelope.header().name;
        self.record.record_dead_letter(contract, &why);
        let give_back = move || {
            envelope.give_back(why);
            drop(envelope);
        };
        let _ = self.record.guard(|| format!("the Drop of a message of {contract}"), give_back);
    }

    /// Returns what waits although it has expired, or its caller has stopped waiting.
    #[cold]
    fn return_those_over(&self) {
        let is_over =
            |envelope: &BoxedEnvelope<C>| envelope.is_void() || envelope.header().is_expired();
        for over in self.queue.purge(is_over) {
            let why = match over.is_void() {
                true => DeliveryError::DeadlinePassed,
                false => DeliveryError::Expired,
            };
            self.return_envelope(over, why);
        }
    }
}
