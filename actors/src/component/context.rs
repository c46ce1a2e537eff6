//! What a component may ask of its host while it serves something.

use crate::arbiter::heartbeat;
use crate::component::cell::ComponentCell;
use crate::component::incarnation::{IncarnationState, TimerId, TimerMode};
use crate::component::long_operation::LongOperation;
use crate::component::{Component, Failure, Handle};
use crate::messaging::death_watch::{Down, Watcher};
use crate::messaging::sender::{DetachedSender, Sender};
use crate::messaging::sink::{MessageSink, Redirected};
use crate::platform;
use crate::registry::remote_watch;
use crate::settings::FAULT_HOLD;
use blastema_contract::reports::FaultDeclared;
use blastema_core::delivery::dead_letters::DeadReason;
use blastema_core::{
    Contract, DeliveryError, FaultKind, Incarnation, Instant, Lifecycle, NameError, ObjectAddress,
    ObjectName,
};
use std::any::{Any, TypeId};
use std::cell::{Cell, RefCell};
use std::fmt::Debug;
use std::ops::RangeBounds;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

/// So many faults of one kind in a second are told: more would hold up those of others.
const DECLARATIONS_MAX: u32 = 1_000;
/// Of so many failed checks is known which; a fault of more ends with these.
const FAILED_CHECKS_MAX: usize = 64;

/// The type of a handle, the port that it is for, and the handle.
pub(crate) type KeptHandle = (TypeId, Option<Box<str>>, Rc<dyn Any>);

/// The objects of other nodes that an incarnation watches, and whether each still is watched.
type FarWatches = Vec<(ObjectAddress, Rc<Cell<bool>>)>;

/// A component's way to its host, lent to every hook and handler.
///
/// What is started here, tasks and timers, belongs to the present incarnation: it ends with it, and
/// if it panics, the component has panicked.
pub struct Context<C: Component> {
    pub(crate) cell: Arc<ComponentCell<C>>,
    pub(crate) state: Rc<IncarnationState<C>>,
    /// Publishers on topics under their contract's own name, and the handles of out ports with the
    /// port's name: made once.
    pub(crate) handles: RefCell<Vec<KeptHandle>>,
    /// Boxed, since few components watch others.
    far_watches: Option<Box<FarWatches>>,
}

impl<C: Component> Context<C> {
    pub(crate) fn new(cell: Arc<ComponentCell<C>>, state: Rc<IncarnationState<C>>) -> Self {
        Context { cell, state, handles: RefCell::default(), far_watches: None }
    }

    /// The component's name.
    pub fn name(&self) -> &ObjectName {
        &self.cell.record.name
    }

    /// Which incarnation this is.
    pub fn incarnation(&self) -> Incarnation {
        self.state.incarnation
    }

    /// Where the component stands.
    pub fn state(&self) -> Lifecycle {
        self.cell.record.state()
    }

    /// Returns a sender to the object of this name: `arm/left` on this node, or `module2:arm/left`
    /// on another node.
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] if there is no such object,
    /// [`DeliveryError::NotServed`] if it does not serve the contract,
    /// [`DeliveryError::ContractDiffers`] if it knows another contract by this name.
    pub fn sender<M: Contract>(&self, name: &str) -> Result<Sender<M>, DeliveryError> {
        self.cell.record.environment.registry.sender(name)
    }

    /// A sender for threads and blocking tasks that this incarnation starts: what they still send
    /// after the incarnation has ended is refused as [`DeliveryError::Fenced`].
    pub fn detached<M: Contract>(&self, sender: &Sender<M>) -> Sender<M> {
        let detached =
            DetachedSender { inner: sender.clone(), incarnation: self.state.token.clone() };
        Sender(Arc::new(Redirected(detached)))
    }

    /// The time now, on the clock that all stamps of this computer share.
    pub fn now(&self) -> Instant {
        platform::now()
    }

    /// Returns the capture time of the data in the message in service, or in the last one: as its
    /// publisher set it by [`publish_captured_at`](Self::publish_captured_at), else when the
    /// message was sent, to the precision of 10 ms unless its contract has a `max_age`. `None`
    /// before the first message.
    ///
    /// Judge [freshness](crate::Freshness) and [rates](crate::Rate) by it, so that neither the way
    /// nor the queue of a message counts as a change of what it tells.
    pub fn captured_at(&self) -> Option<Instant> {
        self.state.captured_at.get()
    }

    /// Starts a task of this component's own, which runs beside its handlers.
    ///
    /// # Panics
    /// The component is ended if it holds 1024 tasks already: it has lost count of them.
    pub fn spawn(&mut self, task: impl Future<Output = ()> + 'static) {
        self.state.defer(|wishes| wishes.tasks.push(Box::pin(task)));
    }

    /// Calls the closure every `interval` while the component is active. It takes its turn between
    /// messages; where it comes late, what was missed is skipped.
    ///
    /// # Panics
    /// The component holds 1024 timers already: it has lost count of them.
    #[track_caller]
    pub fn every(
        &mut self,
        interval: Duration,
        tick: impl FnMut(&mut C, &mut Context<C>) + 'static,
    ) -> TimerId {
        self.state.set_timer(TimerMode::Every(interval), Box::new(tick))
    }

    /// Calls the closure once, after `delay`.
    ///
    /// # Panics
    /// As [`every`](Self::every).
    #[track_caller]
    pub fn after(
        &mut self,
        delay: Duration,
        fire: impl FnOnce(&mut C, &mut Context<C>) + 'static,
    ) -> TimerId {
        let mut fire = Some(fire);
        let fire = move |component: &mut C, cx: &mut Context<C>| {
            if let Some(fire) = fire.take() {
                fire(component, cx);
            }
        };
        self.state.set_timer(TimerMode::Once(delay), Box::new(fire))
    }

    /// Sends the component this message every `interval`, for work that awaits.
    ///
    /// # Panics
    /// As [`every`](Self::every).
    #[track_caller]
    pub fn tell_every<M: Contract + Clone>(&mut self, interval: Duration, message: M) -> TimerId
    where
        C: Handle<M>,
    {
        self.every(interval, move |_, cx| cx.post_to_myself(message.clone()))
    }

    /// Sends the component this message once, after `delay`.
    ///
    /// # Panics
    /// As [`every`](Self::every).
    #[track_caller]
    pub fn tell_after<M: Contract>(&mut self, delay: Duration, message: M) -> TimerId
    where
        C: Handle<M>,
    {
        self.after(delay, move |_, cx| cx.post_to_myself(message))
    }

    fn post_to_myself<M: Contract>(&self, message: M)
    where
        C: Handle<M>,
    {
        // A refusal is the queue's decision and counted there.
        if let Err(refused) = MessageSink::tell(&*self.cell, message) {
            self.cell.record.record_dead_letter(M::NAME, &refused.kind);
        }
    }

    /// Ends a timer, and drops its closure.
    pub fn cancel(&mut self, timer: TimerId) {
        self.state.cancel_timer(timer);
    }

    /// Reports a sign of life. A successful `on_execute` reports one by itself.
    #[inline]
    pub fn alive(&self) {
        if !self.cell.record.is_silent() {
            self.state.activity.give_sign();
        }
    }

    /// What a test has each handler and hook await before it begins.
    #[inline]
    pub(crate) fn before(&self) -> Option<Pin<Box<dyn Future<Output = ()>>>> {
        self.cell.record.cold_if_used()?.injected.before()
    }

    /// Whether a test has this initialisation fail.
    pub(crate) fn fails_initialization(&self) -> bool {
        let cold = self.cell.record.cold_if_used();
        cold.is_some_and(|cold| cold.injected.fails_initialization())
    }

    /// Announces that what is in service takes up to `span`: until the guard that is returned is
    /// dropped, it is taken neither for hanging nor for silent before that. Of operations that lie
    /// within one another the one that is to end last counts.
    pub fn long_operation(&self, span: Duration) -> LongOperation {
        self.state.operations().begin(span)
    }

    /// Changes how often `on_execute` is called; `None` for never. The interval is not checked: one
    /// that is shorter than the start [allows](crate::ChildSpec::rate_hz) is kept down to 1 µs, and
    /// costs the other components of the thread their time.
    pub fn set_interval(&mut self, interval: Option<Duration>) {
        self.state.defer(|wishes| wishes.interval = Some(interval));
    }

    /// Reports a fault that the component found in itself or in its data. It goes on working. The
    /// fault ends when it is [cleared](Self::clear_fault), when the next incarnation is at work, or
    /// ten minutes after it was declared last; see [`latch_fault`](Self::latch_fault).
    ///
    /// A code of the application's own that the plan has no answer to is reported with the codes
    /// that it has, and only observed: see [the manual](crate::manual::faults).
    pub fn declare_fault(&self, kind: FaultKind, detail: impl Into<String>) {
        self.declare(Some(FAULT_HOLD), kind, detail.into());
    }

    /// The same, where the fault does not end by itself: for one that is not looked for again and
    /// again.
    pub fn latch_fault(&self, kind: FaultKind, detail: impl Into<String>) {
        self.declare(None, kind, detail.into());
    }

    fn declare(&self, hold: Option<Duration>, kind: FaultKind, mut detail: String) {
        if heartbeat::send_refusal() == Some(DeliveryError::Fenced) {
            return;
        }
        if !self.may_declare(&kind) {
            return;
        }
        if let FaultKind::Custom(code) = &kind {
            detail = self.cell.record.environment.checked_detail(code, detail);
        }
        let (object, incarnation) = (self.name().clone(), self.incarnation());
        let declared = FaultDeclared { object, incarnation, kind, detail, hold };
        self.cell.record.environment.reports.send(declared);
    }

    /// Whether one more fault of this kind is told in this second.
    fn may_declare(&self, kind: &FaultKind) -> bool {
        let mut declared = self.state.declared.get_or_init(Box::default).counts.borrow_mut();
        let now = platform::now();
        let (since, count) = declared.entry(kind.clone()).or_insert((now, 0));
        if now - *since >= Duration::from_secs(1) {
            (*since, *count) = (now, 0);
        }
        *count += 1;
        *count <= DECLARATIONS_MAX
    }

    /// Ends a fault of this kind that the component has declared.
    pub fn clear_fault(&self, kind: FaultKind) {
        if let (FaultKind::CheckFailed, Some(declared)) = (&kind, self.state.declared.get()) {
            declared.failed_checks.borrow_mut().clear();
        }
        self.cell.record.clear(kind);
    }

    /// Counts messages of a contract that the component could not pass on, as one that speaks to
    /// other systems may have to, among the [dead letters](crate::Node::dead_letters) of its name.
    pub fn count_undelivered<M: Contract>(&self, why: &DeliveryError, many: u64) {
        if many > 0 {
            let record = &self.cell.record;
            let reason = DeadReason::from(why);
            record.environment.dead_letters.take_many(None, &record.name, M::NAME, reason, many);
        }
    }

    /// Reports [`FaultKind::CheckFailed`] unless the condition holds. Returns whether it holds. The
    /// fault ends when all checks that have failed pass again; a check is known by its text.
    pub fn check(&self, holds: bool, invariant: &str) -> bool {
        self.note_check(holds, invariant, || invariant.to_owned())
    }

    /// The same for a value that is to lie in the range; a check is known by `what`.
    pub fn check_range<T: PartialOrd + Debug>(
        &self,
        what: &str,
        value: &T,
        range: impl RangeBounds<T> + Debug,
    ) -> bool {
        let holds = range.contains(value);
        self.note_check(holds, what, || format!("{what} is {value:?}, outside of {range:?}"))
    }

    fn note_check(&self, holds: bool, check: &str, detail: impl FnOnce() -> String) -> bool {
        if !holds {
            let declared = self.state.declared.get_or_init(Box::default);
            let mut failed = declared.failed_checks.borrow_mut();
            if failed.len() < FAILED_CHECKS_MAX {
                failed.insert(check.to_owned());
            }
            drop(failed);
            self.declare_fault(FaultKind::CheckFailed, detail());
        } else if let Some(declared) = self.state.declared.get() {
            let mut failed = declared.failed_checks.borrow_mut();
            let passes_again = failed.remove(check);
            let is_last = failed.is_empty();
            drop(failed);
            if passes_again && is_last {
                self.clear_fault(FaultKind::CheckFailed);
            }
        }
        holds
    }

    /// Ends this incarnation in order after the present handler. Queued messages wait for the next
    /// incarnation, if the supervisor starts one.
    pub fn stop(&mut self) {
        self.state.defer(|wishes| wishes.stop = true);
    }

    /// Says that the component has come to rest after the stop command of its actuators, so that it
    /// is deactivated before [`settle_within`](crate::ActuatorSpec::settle_within) has passed.
    /// Without effect at other times.
    pub fn settled(&mut self) {
        self.state.settled.set(self.state.settled.get().map(|_| true));
    }

    /// Leaves work because of a failure, as if a hook had returned it.
    pub fn fail(&mut self, failure: impl Into<Failure>) {
        let failure = failure.into();
        self.state.defer(|wishes| wishes.failure = Some(failure));
    }

    /// Subscribes to the message [`Down`], sent whenever an incarnation of an object of this name
    /// ends. If it is not running or unknown, `Down` is sent at once. The object is a component, a
    /// supervisor or one of the middleware's own, here or, as `module2:arm`, on another node; of
    /// such a one it is also told when its node is lost, unless that node has said that no object
    /// has the name, and it is watched further when that is back. The name is watched: also an
    /// object that gets it later, or again after another one was removed. While no object of another
    /// node has the name, that node is asked once a second.
    ///
    /// A notice comes before the messages that wait, and though the queue is full. Of an object
    /// that ended twice before the component had its turn the last end is reported. The watch ends
    /// with the present incarnation, and so does what it has not taken.
    ///
    /// # Errors
    /// The name does not parse.
    pub fn watch(&mut self, name: &str) -> Result<(), NameError>
    where
        C: Handle<Down>,
    {
        let registry = self.cell.record.environment.registry.clone();
        let (node, object) = registry.parse(name)?;
        // Two that watch each other do not keep each other.
        let (watcher, incarnation) = (Arc::downgrade(&self.cell), self.state.incarnation);
        let tell = move |down: Down| {
            let Some(watcher) = watcher.upgrade() else { return };
            let node = down.node.as_ref().map(|node| format!("{node}:")).unwrap_or_default();
            watcher.notify(incarnation, &format!("{node}{}", down.object), down);
        };
        match node {
            None => {
                let (who, incarnation) = (self.name().clone(), self.state.token.clone());
                let tell = Box::new(tell);
                let watcher = Watcher { who, incarnation, outlasts_object: true, tell };
                registry.watch(object, watcher);
            }
            Some(node) => self.watch_elsewhere(ObjectAddress { node, object }, Box::new(tell)),
        }
        Ok(())
    }

    /// Watches an object of another node, unless it is watched already.
    fn watch_elsewhere(&mut self, address: ObjectAddress, tell: Box<dyn Fn(Down)>) {
        let watches = self.far_watches.get_or_insert_default();
        watches.retain(|(_, goes_on)| goes_on.get());
        if watches.iter().any(|(known, _)| *known == address) {
            return;
        }
        let goes_on = Rc::new(Cell::new(true));
        watches.push((address.clone(), goes_on.clone()));
        let registry = self.cell.record.environment.registry.clone();
        let follow = remote_watch::follow(registry, address, tell);
        self.spawn(async move {
            follow.await;
            goes_on.set(false);
        });
    }
}
