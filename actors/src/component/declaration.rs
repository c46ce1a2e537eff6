//! What a feature adds to a component while it is declared, and the notices that it gets of the
//! component afterwards.

use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::spec_error::SpecError;
use crate::liveness::limits::ComponentLimits;
use blastema_core::ObjectName;
use std::any::Any;
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

/// What one component declares of one feature.
pub(crate) trait Declarations<C: Component>: Any {
    /// Finds what contradicts itself, or a contract that the component serves.
    fn check(
        &self,
        component: &ObjectName,
        served: &BTreeSet<&'static str>,
    ) -> Result<(), SpecError>;

    /// All settings of a description that do not suit it.
    fn refused(&self, _component: &ObjectName, _limits: &ComponentLimits) -> Vec<SpecError> {
        Vec::new()
    }

    /// Makes it so. The component is registered already.
    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError>;
}

/// Gets a notice from the cell of a component of each change in its life.
pub(crate) trait CellListener: Send + Sync {
    /// An incarnation is active.
    fn activated(&self) {}
    /// An incarnation leaves work in order. Returns how long it may go on until it has settled.
    fn leaves_work(&self) -> Duration {
        Duration::ZERO
    }
    /// An incarnation that leaves work has settled.
    fn settled(&self) {}
    /// An incarnation has left work, its hook done, or its work has failed.
    fn left_work(&self, _hook_done: bool) {}
    /// An incarnation has ended, and none follows at once.
    fn deactivated(&self) {}
    /// An incarnation has ended, whether another one follows or not.
    fn ended(&self) {}

    /// The component leaves the node.
    fn removed(&self) {}
}
