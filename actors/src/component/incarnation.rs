//! What one incarnation's context and its executor share, and what its threads are given.

use crate::component::context::Context;
use crate::component::long_operation::LongOperations;
use crate::component::{Component, Failure};
use crate::liveness::activity::ActivityRecord;
use crate::messaging::incarnation::IncarnationToken;
use crate::platform;
use blastema_core::sorted::SortedMap;
use blastema_core::{FaultKind, Incarnation, Instant};
use std::cell::{Cell, OnceCell, RefCell};
use std::collections::BTreeSet;
use std::pin::Pin;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

/// Names one timer of one incarnation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TimerId(pub(crate) u64);

/// What a timer does when it fires.
pub(crate) type TimerAction<C> = Box<dyn FnMut(&mut C, &mut Context<C>)>;
/// A future that a component started and owns.
pub(crate) type ComponentFuture = Pin<Box<dyn Future<Output = ()>>>;

/// How a timer fires.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum TimerMode {
    Once(Duration),
    Every(Duration),
}

/// When an entry of the schedule is due, and which of those of one instant it is.
pub(crate) type ScheduleEntry = (Instant, u64);

/// Timers of one component at one time. A component with more has lost count of them.
const TIMERS: usize = 1024;

/// A timer that stands.
pub(crate) struct Timer<C: Component> {
    pub(crate) mode: TimerMode,
    /// Its entry in the schedule, from when it was taken over until it is due, and again from when
    /// it is run.
    pub(crate) entry: Option<ScheduleEntry>,
    /// Since when it waits for its turn.
    pub(crate) due: Option<Instant>,
    /// Lifted out while it runs.
    pub(crate) action: Option<TimerAction<C>>,
}

/// The timers of one incarnation, under their numbers: those that the schedule has taken over, and
/// behind them those that were set since.
pub(crate) struct TimerTable<C: Component> {
    pub(crate) active: RefCell<SortedMap<u64, Timer<C>>>,
    last: Cell<u64>,
    /// The last one that was taken over.
    taken: Cell<u64>,
}

impl<C: Component> Default for TimerTable<C> {
    fn default() -> Self {
        TimerTable { active: RefCell::default(), last: Cell::new(0), taken: Cell::new(0) }
    }
}

impl<C: Component> TimerTable<C> {
    /// The numbers of those that were set since this was asked before.
    pub(crate) fn take_new(&self) -> Vec<TimerId> {
        let new = self.taken.replace(self.last.get()) + 1;
        self.active.borrow().range(new..).map(|(id, _)| TimerId(*id)).collect()
    }
}

/// What a handler or hook asked of its host; the executor fulfils it when they have had their turn.
#[derive(Default)]
pub(crate) struct DeferredCommands {
    pub(crate) stop: bool,
    pub(crate) failure: Option<Failure>,
    pub(crate) tasks: Vec<ComponentFuture>,
    /// What the schedule has of timers that were cancelled.
    pub(crate) cancelled: Vec<Option<ScheduleEntry>>,
    pub(crate) interval: Option<Option<Duration>>,
}

/// What an incarnation has declared.
#[derive(Default)]
pub(crate) struct DeclaredFaults {
    /// How many faults of each kind were declared within a second, which began then.
    pub(crate) counts: RefCell<SortedMap<FaultKind, (Instant, u32)>>,
    /// Checks that failed and have not passed since.
    pub(crate) failed_checks: RefCell<BTreeSet<String>>,
}

pub(crate) struct IncarnationState<C: Component> {
    pub(crate) incarnation: Incarnation,
    pub(crate) token: Arc<IncarnationToken>,
    pub(crate) activity: &'static ActivityRecord,
    /// There only where one was announced.
    operations: OnceCell<Arc<LongOperations>>,
    /// When it began, until it first awaits something.
    pub(crate) began: Cell<Option<Instant>>,
    /// Of the message that is served, or was last.
    pub(crate) captured_at: Cell<Option<Instant>>,
    /// It was ordered to end.
    pub(crate) is_leaving: Cell<bool>,
    /// While the incarnation leaves work: whether it has settled.
    pub(crate) settled: Cell<Option<bool>>,
    /// There only where something was asked for.
    wishes: Cell<Option<Box<DeferredCommands>>>,
    wished: Cell<bool>,
    /// There only where one was set.
    pub(crate) timers: OnceCell<Rc<TimerTable<C>>>,
    /// There only where a fault was declared.
    pub(crate) declared: OnceCell<Box<DeclaredFaults>>,
}

impl<C: Component> IncarnationState<C> {
    pub(crate) fn new(incarnation: Incarnation, activity: &'static ActivityRecord) -> Self {
        IncarnationState {
            incarnation,
            operations: OnceCell::new(),
            token: Arc::default(),
            activity,
            began: Cell::new(Some(platform::now())),
            captured_at: Cell::new(None),
            is_leaving: Cell::new(false),
            settled: Cell::new(None),
            wishes: Cell::default(),
            wished: Cell::new(false),
            timers: OnceCell::new(),
            declared: OnceCell::new(),
        }
    }

    pub(crate) fn operations(&self) -> &Arc<LongOperations> {
        let fresh = || Arc::new(LongOperations::new(self.activity, self.token.clone()));
        self.operations.get_or_init(fresh)
    }

    pub(crate) fn defer(&self, make: impl FnOnce(&mut DeferredCommands)) {
        self.wished.set(true);
        let mut wishes = self.wishes.take().unwrap_or_default();
        make(&mut wishes);
        self.wishes.set(Some(wishes));
    }

    #[track_caller]
    pub(crate) fn set_timer(&self, mode: TimerMode, action: TimerAction<C>) -> TimerId {
        let table = self.timers.get_or_init(Rc::default);
        let held = table.active.borrow().len();
        assert!(held < TIMERS, "the component holds {TIMERS} timers and sets yet another");
        table.last.set(table.last.get() + 1);
        let timer = Timer { mode, entry: None, due: None, action: Some(action) };
        table.active.borrow_mut().insert(table.last.get(), timer);
        self.wished.set(true);
        TimerId(table.last.get())
    }

    pub(crate) fn cancel_timer(&self, id: TimerId) {
        let Some(table) = self.timers.get() else { return };
        let timer = table.active.borrow_mut().remove(&id.0);
        let Some(Timer { entry, .. }) = &timer else { return };
        if id.0 <= table.taken.get() {
            self.defer(|wishes| wishes.cancelled.push(*entry));
        }
    }

    /// Something was asked for.
    #[inline]
    pub(crate) fn has_wishes(&self) -> bool {
        self.wished.get()
    }

    pub(crate) fn take_wishes(&self) -> DeferredCommands {
        self.wished.set(false);
        self.wishes.take().map(|wishes| *wishes).unwrap_or_default()
    }
}
