//! The subscriptions of a component, kept in its cell.

use crate::component::Component;
use crate::component::cell::ComponentCell;
use std::sync::Arc;

/// A component's subscription to one topic, for all its incarnations.
pub(crate) trait Subscription<C: Component>: Send + Sync {
    /// From now on events are delivered by the hub of the present arbiter.
    fn attach(&self, cell: &Arc<ComponentCell<C>>);
    /// Another incarnation of the component has begun where the one before it ended: it is given
    /// what the topic keeps for listeners that join.
    fn catch_up(&self, cell: &Arc<ComponentCell<C>>);
    /// From now on none are.
    fn end(&self, cell: &ComponentCell<C>);
}

/// A component's subscriptions.
pub(crate) type Subscriptions<C> = Arc<[Arc<dyn Subscription<C>>]>;
