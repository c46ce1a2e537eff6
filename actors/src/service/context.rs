//! How components reach services.

use super::ServiceRef;
use super::roster::Roster;
use crate::component::Component;
use crate::component::context::Context;
use crate::component::environment::ComponentEnvironment;
use crate::component::extension::Extension;
use blastema_core::{NameError, Request};

impl Extension for Roster {}

impl ComponentEnvironment {
    /// The services of the robot.
    pub(crate) fn services(&self) -> &Roster {
        self.extensions.get()
    }
}

impl<C: Component> Context<C> {
    /// Asks the service of this name, whichever node serves it.
    ///
    /// # Errors
    /// The name does not parse. Whether there is such a service is found out when it is asked.
    pub fn service<M: Request>(&self, name: &str) -> Result<ServiceRef<M>, NameError> {
        let environment = &self.cell.record.environment;
        ServiceRef::new(&environment.registry, environment.services(), name)
    }
}
