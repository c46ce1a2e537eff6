//! Objects of other nodes that an incarnation watches.

use crate::component::Component;
use crate::component::context::Context;
use crate::messaging::death_watch::Down;
use crate::registry::remote_watch;
use blastema_core::ObjectAddress;
use std::cell::Cell;
use std::rc::Rc;

/// The objects, and whether each still is watched.
pub(super) type FarWatches = Vec<(ObjectAddress, Rc<Cell<bool>>)>;

impl<C: Component> Context<C> {
    /// Watches an object of another node, unless it is watched already.
    pub(super) fn watch_elsewhere(&mut self, address: ObjectAddress, tell: Box<dyn Fn(Down)>) {
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
