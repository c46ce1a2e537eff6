//! Where the component of one incarnation lives.

use crate::component::Component;
use crate::component::context::Context;
use std::cell::RefCell;

/// Where the component lives. A running handler borrows it for as long as it runs; since the guard
/// holds the other `Rc`, a handler that unwinds never drops the component.
pub(crate) struct ComponentSlot<C: Component> {
    pub(crate) contents: RefCell<ComponentAndContext<C>>,
}

impl<C: Component> ComponentSlot<C> {
    pub(crate) fn new(component: C, cx: Context<C>) -> Self {
        ComponentSlot { contents: RefCell::new(ComponentAndContext { component, cx }) }
    }
}

/// The component and its context, which a handler borrows together.
pub(crate) struct ComponentAndContext<C: Component> {
    component: C,
    cx: Context<C>,
}

impl<C: Component> ComponentAndContext<C> {
    #[inline]
    pub(crate) fn both(&mut self) -> (&mut C, &mut Context<C>) {
        (&mut self.component, &mut self.cx)
    }
}
