//! The pump as a future, and as something that the arbiter's hubs can reach.

use super::ComponentExecutor;
use crate::component::Component;
use crate::component::cell::ComponentCell;
use std::any::Any;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::future::Future;
use std::pin::Pin;
use std::rc::{Rc, Weak};
use std::sync::Arc;
use std::task::{self, Poll};

thread_local! {
    /// The pumps of this arbiter that have subscriptions, by the anchor that they serve, for its
    /// hubs.
    static PUMPS: RefCell<BTreeMap<usize, Weak<dyn Any>>> = const { RefCell::new(BTreeMap::new()) };
}

/// The pump of a component that lives on this arbiter.
pub(crate) fn executor_here<C: Component>(
    anchor: &Arc<ComponentCell<C>>,
) -> Option<Weak<RefCell<ComponentExecutor<C>>>> {
    let key = Arc::as_ptr(anchor).addr();
    let pump = PUMPS.with_borrow(|pumps| pumps.get(&key)?.upgrade())?;
    let pump: Rc<RefCell<ComponentExecutor<C>>> = pump.downcast().ok()?;
    Some(Rc::downgrade(&pump))
}

/// The pump as a future, and as something that the arbiter's hubs can reach.
pub(crate) struct SharedExecutor<C: Component>(pub(crate) Rc<RefCell<ComponentExecutor<C>>>);

impl<C: Component> SharedExecutor<C> {
    pub(crate) fn new(pump: ComponentExecutor<C>) -> Self {
        let key = Arc::as_ptr(&pump.anchor).addr();
        let hears = !pump.anchor.subscriptions().is_empty();
        let pump = Rc::new(RefCell::new(pump));
        let erased: Rc<dyn Any> = pump.clone();
        if hears {
            PUMPS.with_borrow_mut(|pumps| pumps.insert(key, Rc::downgrade(&erased)));
        }
        SharedExecutor(pump)
    }
}

impl<C: Component> Future for SharedExecutor<C> {
    type Output = ();

    fn poll(self: Pin<&mut Self>, cx: &mut task::Context<'_>) -> Poll<()> {
        let mut pump = self.0.borrow_mut();
        let polled = pump.run(cx);
        if polled.is_ready() {
            pump.seat.vacate();
        }
        polled
    }
}

impl<C: Component> Drop for SharedExecutor<C> {
    fn drop(&mut self) {
        let mut pump = self.0.borrow_mut();
        let key = Arc::as_ptr(&pump.anchor).addr();
        let _ = PUMPS.try_with(|pumps| {
            let mut pumps = pumps.borrow_mut();
            let mine = Rc::as_ptr(&self.0).addr();
            let mine = pumps.get(&key).is_some_and(|known| {
                known.upgrade().is_none_or(|known| Rc::as_ptr(&known).cast::<()>().addr() == mine)
            });
            if mine {
                pumps.remove(&key);
            }
        });
        pump.anchor.record.environment.watch_list.leave(pump.slot.index);
        pump.commands.set_waker(None);
        pump.drop_before_the_end();
    }
}
