//! How components are commanded, and command.

use super::table::{ActuatorTable, DeclaredActuator};
use super::{ActuatorSpec, Commander};
use crate::component::cell::ComponentCell;
use crate::component::context::Context;
use crate::component::declaration::{CellListener, Declarations};
use crate::component::environment::ComponentEnvironment;
use crate::component::extension::Extension;
use crate::component::ports::{PortConstructor, Ports};
use crate::component::spec_error::SpecError;
use crate::component::{Component, Handle};
use crate::registry::ContractPort;
use crate::settings::{COMMAND_TIMEOUT, LEASE, SHUTDOWN_WITHIN};
use blastema_core::lease::Lease;
use blastema_core::sorted::SortedSet;
use blastema_core::{Contract, DeliveryError, ObjectName};
use std::sync::Arc;
use std::time::Duration;

impl Extension for ActuatorTable {}

impl ComponentEnvironment {
    /// The actuators of the node.
    pub(crate) fn actuators(&self) -> &ActuatorTable {
        self.extensions.get()
    }
}

/// The actuators that a component declares.
struct ActuatorPorts<C: Component>(
    Vec<(Result<DeclaredActuator, DeliveryError>, PortConstructor<C>)>,
);

impl<C: Component> Default for ActuatorPorts<C> {
    fn default() -> Self {
        ActuatorPorts(Vec::new())
    }
}

/// Tells the actuators of a component what becomes of it, and withdraws them with it.
struct Withdrawal {
    table: ActuatorTable,
    owner: ObjectName,
}

impl CellListener for Withdrawal {
    fn activated(&self) {
        self.table.handle_work(&self.owner, Lease::handle_at_work);
    }

    fn leaves_work(&self) -> Duration {
        self.table.handle_work(&self.owner, Lease::handle_leaving)
    }

    fn settled(&self) {
        self.table.handle_work(&self.owner, Lease::handle_settled);
    }

    fn left_work(&self, hook_done: bool) {
        self.table.handle_work(&self.owner, |lease| lease.handle_left(hook_done));
    }

    fn deactivated(&self) {
        self.table.handle_work(&self.owner, Lease::handle_ended);
    }

    fn removed(&self) {
        self.table.withdraw(&self.owner);
    }
}

impl<C: Component> Declarations<C> for ActuatorPorts<C> {
    fn check(
        &self,
        component: &ObjectName,
        served: &SortedSet<&'static str>,
    ) -> Result<(), SpecError> {
        let twice = |contract, ports| {
            Err(SpecError::PortTwice { name: component.clone(), contract, ports })
        };
        let mut commanded = SortedSet::new();
        for (actuator, _) in &self.0 {
            let actuator = actuator
                .as_ref()
                .map_err(|why| SpecError::Actuator { name: component.clone(), why: why.clone() })?;
            let contract = actuator.identity.name;
            let refused = |error| SpecError::setting(component.as_str(), error);
            LEASE.check(actuator.rules.span).map_err(refused)?;
            let timeout = actuator.rules.command_timeout;
            timeout.map_or(Ok(()), |span| COMMAND_TIMEOUT.check(span)).map_err(refused)?;
            // A message that needs no lease would move the actuator.
            if served.contains(contract) {
                return twice(contract, "one for every sender and one for the commander");
            }
            if !commanded.insert(contract) {
                return twice(contract, "both by actuator");
            }
        }
        Ok(())
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let (name, environment) = (&cell.record.name, &cell.record.environment);
        let table = environment.actuators();
        // Those that could not be encoded were refused by the check.
        let declared =
            self.0.into_iter().filter_map(|(declared, open)| Some((declared.ok()?, open)));
        let max_wait = cell.record.limits.hang.max_wait;
        let declared: Vec<_> = declared
            .map(|(mut declared, open)| {
                declared.rules.max_wait = max_wait;
                (declared, open(cell).into_skeleton())
            })
            .collect();
        let within = cell.record.limits.shutdown_within;
        let settle_within = declared.iter().map(|(actuator, _)| actuator.settle_within).max();
        if let Some(longer) = settle_within.filter(|span| *span > within) {
            let value = format!("{within:?} with a settle_within of {longer:?}");
            let error = SHUTDOWN_WITHIN.refuse(value, "write at least the settle_within");
            return Err(SpecError::setting(name.as_str(), error));
        }
        cell.record.listen(Withdrawal { table: table.clone(), owner: name.clone() });
        let port = table.declare(name, declared, environment.registry.access());
        environment.registry.open(name, port);
        Ok(())
    }
}

impl<C: Component> Ports<C> {
    /// Accepts commands from the holder of the lease only. When the commander is gone, the
    /// component gets the safe command.
    pub fn actuator<M: Contract>(&mut self, spec: ActuatorSpec<M>) -> &mut Self
    where
        C: Handle<M>,
    {
        self.max_wait = self.max_wait.into_iter().chain(spec.rules.command_timeout).min();
        self.feature::<ActuatorPorts<C>>().0.push((spec.declared(), ContractPort::open::<C, M>));
        self
    }
}

impl<C: Component> Context<C> {
    /// Commands the actuator of this name, here or on another node. The lease is renewed by a task
    /// of this incarnation: it ends with the incarnation, and when the component hangs.
    ///
    /// # Errors
    /// [`DeliveryError::Misspelt`] or [`DeliveryError::Unknown`] where no object here has the name,
    /// [`DeliveryError::NotServed`] where it is no actuator.
    pub fn commander<M: Contract>(
        &mut self,
        actuator: &str,
    ) -> Result<Commander<M>, DeliveryError> {
        let environment = &self.cell.record.environment;
        let own = environment.registry.full_name(self.name());
        let who = (own, self.incarnation());
        let (commander, renewing) = super::commander(&environment.registry, actuator, who)?;
        self.spawn(renewing);
        Ok(commander)
    }
}
