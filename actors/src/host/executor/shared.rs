//! The executor as a future, and as something that the arbiter's hubs can reach.

use super::ComponentExecutor;
use crate::component::Component;
use crate::component::cell::ComponentCell;
use blastema_core::sorted::SortedMap;
use std::any::Any;
use std::cell::RefCell;
use std::pin::Pin;
use std::rc::{Rc, Weak};
use std::sync::Arc;
use std::task::{self, Poll};

type Executors = SortedMap<usize, Weak<dyn Any>>;

thread_local! {
    /// The executors of this arbiter that have subscriptions, by the cell that they serve, for its
    /// hubs.
    static EXECUTORS: RefCell<Executors> = const { RefCell::new(SortedMap::new()) };
}

/// The executor of a component that lives on this arbiter.
pub(crate) fn executor_here<C: Component>(
    cell: &Arc<ComponentCell<C>>,
) -> Option<Weak<RefCell<ComponentExecutor<C>>>> {
    let key = Arc::as_ptr(cell).addr();
    let executor = EXECUTORS.with_borrow(|executors| executors.get(&key)?.upgrade())?;
    let executor: Rc<RefCell<ComponentExecutor<C>>> = executor.downcast().ok()?;
    Some(Rc::downgrade(&executor))
}

/// The executor as a future, and as something that the arbiter's hubs can reach.
pub(crate) struct SharedExecutor<C: Component>(pub(crate) Rc<RefCell<ComponentExecutor<C>>>);

impl<C: Component> SharedExecutor<C> {
    pub(crate) fn new(executor: ComponentExecutor<C>) -> Self {
        let key = Arc::as_ptr(&executor.cell).addr();
        let hears = !executor.cell.subscriptions().is_empty();
        let executor = Rc::new(RefCell::new(executor));
        let erased: Rc<dyn Any> = executor.clone();
        if hears {
            EXECUTORS.with_borrow_mut(|executors| executors.insert(key, Rc::downgrade(&erased)));
        }
        SharedExecutor(executor)
    }
}

impl<C: Component> Future for SharedExecutor<C> {
    type Output = ();

    fn poll(self: Pin<&mut Self>, cx: &mut task::Context<'_>) -> Poll<()> {
        let mut executor = self.0.borrow_mut();
        let polled = executor.run(cx);
        if polled.is_ready() {
            executor.arbiter.vacate();
        }
        polled
    }
}

impl<C: Component> Drop for SharedExecutor<C> {
    fn drop(&mut self) {
        let mut executor = self.0.borrow_mut();
        let key = Arc::as_ptr(&executor.cell).addr();
        let _ = EXECUTORS.try_with(|executors| {
            let mut executors = executors.borrow_mut();
            let mine = Rc::as_ptr(&self.0).addr();
            let mine = executors.get(&key).is_some_and(|known| {
                known.upgrade().is_none_or(|known| Rc::as_ptr(&known).cast::<()>().addr() == mine)
            });
            if mine {
                executors.remove(&key);
            }
        });
        executor.cell.record.environment.watch_list.leave(executor.service.slot.index);
        executor.control.commands.set_waker(None);
        executor.drop_before_the_end();
    }
}
