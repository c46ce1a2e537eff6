//! The subscriptions of a component, kept in its cell.

use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::environment::ComponentEnvironment;
use blastema_core::{DeliveryError, ObjectName};
use std::sync::Arc;

/// A component's subscription to one topic, for all its incarnations.
pub(crate) trait Subscription<C: Component>: Send + Sync {
    /// An incarnation begins: from now on events are delivered by the hub of its arbiter, first the
    /// one that the topic keeps for those who join.
    fn attach(&self, cell: &Arc<ComponentCell<C>>);
    /// From now on none are.
    fn end(&self, cell: &ComponentCell<C>);
    fn topic(&self) -> &ObjectName;
    /// Whether events are delivered.
    fn is_attached(&self) -> bool;
    /// A subscription of the same contract and condition to another topic.
    fn on(
        &self,
        environment: &ComponentEnvironment,
        topic: &ObjectName,
    ) -> Result<Arc<dyn Subscription<C>>, DeliveryError>;
}

/// A component's subscriptions.
pub(crate) type Subscriptions<C> = Arc<[Arc<dyn Subscription<C>>]>;
