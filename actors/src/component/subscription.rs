//! The subscriptions of a component, kept in its cell.

use crate::component::Component;
use crate::component::cell::ComponentCell;
use std::sync::Arc;

/// A component's subscription to one topic, for all its incarnations.
pub(crate) trait Subscription<C: Component>: Send + Sync {
    /// An incarnation begins: from now on events are delivered by the hub of its arbiter, first the
    /// one that the topic keeps for those who join.
    fn attach(&self, cell: &Arc<ComponentCell<C>>);
    /// From now on none are.
    fn end(&self, cell: &ComponentCell<C>);
}

/// A component's subscriptions.
pub(crate) type Subscriptions<C> = Arc<[Arc<dyn Subscription<C>>]>;
