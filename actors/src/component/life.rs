//! What one life's context and its pump share, and what its threads are given.

use crate::component::context::Context;
use crate::component::long_operation::LongOperations;
use crate::component::{Component, Failure};
use crate::liveness::activity::ActivityRecord;
use crate::messaging::incarnation::IncarnationToken;
use blastema_core::{Incarnation, Instant};
use std::cell::{Cell, RefCell};
use std::future::Future;
use std::pin::Pin;
use std::sync::Arc;
use std::time::Duration;

/// Names one timer of one life.
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

/// What a handler or hook asked of its host; the pump fulfils it when they have had their turn.
pub(crate) struct DeferredCommands<C: Component> {
    pub(crate) stop: bool,
    pub(crate) failure: Option<Failure>,
    pub(crate) tasks: Vec<ComponentFuture>,
    pub(crate) timers: Vec<(TimerId, TimerMode, TimerAction<C>)>,
    pub(crate) cancelled: Vec<TimerId>,
    pub(crate) interval: Option<Option<Duration>>,
}

impl<C: Component> Default for DeferredCommands<C> {
    fn default() -> Self {
        DeferredCommands {
            stop: false,
            failure: None,
            tasks: Vec::new(),
            timers: Vec::new(),
            cancelled: Vec::new(),
            interval: None,
        }
    }
}

pub(crate) struct IncarnationState<C: Component> {
    pub(crate) incarnation: Incarnation,
    pub(crate) token: Arc<IncarnationToken>,
    pub(crate) stamp: &'static ActivityRecord,
    pub(crate) operations: Arc<LongOperations>,
    /// Of the message that is served, or was last.
    pub(crate) captured_at: Cell<Option<Instant>>,
    wishes: RefCell<DeferredCommands<C>>,
    wished: Cell<bool>,
    next_timer: Cell<u64>,
}

impl<C: Component> IncarnationState<C> {
    pub(crate) fn new(incarnation: Incarnation, stamp: &'static ActivityRecord) -> Self {
        let token: Arc<IncarnationToken> = Arc::default();
        IncarnationState {
            incarnation,
            operations: Arc::new(LongOperations::new(stamp, token.clone())),
            token,
            stamp,
            captured_at: Cell::new(None),
            wishes: RefCell::default(),
            wished: Cell::new(false),
            next_timer: Cell::new(0),
        }
    }

    pub(crate) fn defer(&self, make: impl FnOnce(&mut DeferredCommands<C>)) {
        self.wished.set(true);
        make(&mut self.wishes.borrow_mut());
    }

    pub(crate) fn next_timer(&self) -> TimerId {
        self.next_timer.set(self.next_timer.get() + 1);
        TimerId(self.next_timer.get())
    }

    /// Something was asked for.
    #[inline]
    pub(crate) fn has_wishes(&self) -> bool {
        self.wished.get()
    }

    pub(crate) fn take_wishes(&self) -> DeferredCommands<C> {
        self.wished.set(false);
        self.wishes.take()
    }
}
