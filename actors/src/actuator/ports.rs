//! How components are commanded.

use super::ActuatorSpec;
use super::settings::{ActuatorSettings, apply};
use super::table::{ActuatorTable, DeclaredActuator, FieldError};
use crate::component::cell::ComponentCell;
use crate::component::declaration::{CellListener, Declarations};
use crate::component::ports::{PortConstructor, Ports};
use crate::component::spec_error::SpecError;
use crate::component::{Component, Handle};
use crate::host::spec::ChildSpec;
use crate::liveness::limits::ComponentLimits;
use crate::registry::ContractPort;
use crate::settings::{COMMAND_TIMEOUT, LEASE, SHUTDOWN_WITHIN};
use blastema_core::lease::Lease;
use blastema_core::port::ConnectionRole;
use blastema_core::suggestion::nearest;
use blastema_core::{Contract, DeliveryError, ObjectName};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::time::Duration;

/// An actuator, and its skeleton.
type ActuatorPort<C> = (Result<DeclaredActuator, DeliveryError>, PortConstructor<C>);

/// The actuators that a component declares.
struct ActuatorPorts<C: Component> {
    declared: Vec<ActuatorPort<C>>,
    /// The contracts of settings that do not apply, and why.
    refused: Vec<(String, FieldError)>,
}

impl<C: Component> Default for ActuatorPorts<C> {
    fn default() -> Self {
        ActuatorPorts { declared: Vec::new(), refused: Vec::new() }
    }
}

impl<C: Component> ActuatorPorts<C> {
    fn apply(
        &mut self,
        contract: &str,
        settings: &ActuatorSettings,
    ) -> Result<(), Vec<FieldError>> {
        let mut known = Vec::new();
        for (actuator, _) in &mut self.declared {
            let Ok(actuator) = actuator else { continue };
            if actuator.identity.name == contract {
                return apply(actuator, settings);
            }
            known.push(actuator.identity.name);
        }
        let why = match (nearest(contract, known.iter().copied()), known.is_empty()) {
            (Some(nearest), _) => format!("there is none: did you mean `{nearest}`?"),
            (None, true) => "there is none, as the component has no actuator".to_owned(),
            (None, false) => format!("there is none: there are `{}`", known.join("`, `")),
        };
        Err(vec![FieldError { field: None, why }])
    }

    /// The shortest command timeout that can be.
    fn shortest_timeout(&self) -> Option<Duration> {
        let declared = self.declared.iter().filter_map(|(actuator, ..)| actuator.as_ref().ok());
        let timeouts = declared.filter_map(|actuator| actuator.rules.command_timeout);
        timeouts.filter(|span| COMMAND_TIMEOUT.check(*span).is_ok()).min()
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
        served: &BTreeSet<&'static str>,
    ) -> Result<(), SpecError> {
        let twice = |contract, ports| {
            Err(SpecError::PortTwice { name: component.clone(), contract, ports })
        };
        let mut commanded = BTreeSet::new();
        for (actuator, ..) in &self.declared {
            let actuator = actuator
                .as_ref()
                .map_err(|why| SpecError::Actuator { name: component.clone(), why: why.clone() })?;
            let contract = actuator.identity.name;
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

    fn refused(&self, name: &ObjectName, limits: &ComponentLimits) -> Vec<SpecError> {
        let unknown = self.refused.iter().map(|(contract, FieldError { field, why })| {
            let (name, contract) = (name.clone(), contract.clone());
            let (field, why) = (field.clone(), why.clone());
            SpecError::ActuatorSettings { name, contract, field, why }
        });
        let declared = || self.declared.iter().filter_map(|(actuator, ..)| actuator.as_ref().ok());
        let settings = declared().flat_map(|actuator| {
            let timeout = actuator.rules.command_timeout;
            let timeout = timeout.and_then(|span| COMMAND_TIMEOUT.check(span).err());
            LEASE.check(actuator.rules.span).err().into_iter().chain(timeout)
        });
        let within = limits.shutdown_within;
        let settle_within = declared().map(|actuator| actuator.settle_within).max();
        let longer = settle_within.filter(|span| *span > within).map(|longer| {
            let value = format!("{within:?} with a settle_within of {longer:?}");
            SHUTDOWN_WITHIN.refuse(value, "write at least the settle_within")
        });
        let settings = settings.chain(longer);
        unknown.chain(settings.map(|error| SpecError::setting(name.as_str(), error))).collect()
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let (name, environment) = (&cell.record.name, &cell.record.environment);
        let table = environment.feature::<ActuatorTable>();
        // Those that could not be encoded were refused by the check.
        let declared = self.declared.into_iter();
        let declared = declared.filter_map(|(declared, open)| Some((declared.ok()?, open)));
        let max_wait = cell.record.limits.hang.max_wait;
        let declared: Vec<_> = declared
            .map(|(mut declared, open)| {
                declared.rules.max_wait = max_wait;
                (declared, open(cell).into_skeleton())
            })
            .collect();
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
        let port = (spec.declared(), ContractPort::open::<C, M> as PortConstructor<C>);
        self.feature::<ActuatorPorts<C>>().declared.push(port);
        self.max_wait = self.feature::<ActuatorPorts<C>>().shortest_timeout();
        self.declare::<M>(M::NAME.into(), ConnectionRole::Commanded)
    }

    /// Changes an actuator that is declared.
    fn change_actuator(&mut self, contract: &str, settings: &ActuatorSettings) {
        let actuators = self.feature::<ActuatorPorts<C>>();
        if let Err(refused) = actuators.apply(contract, settings) {
            actuators.refused.extend(refused.into_iter().map(|why| (contract.to_owned(), why)));
        }
        self.max_wait = self.feature::<ActuatorPorts<C>>().shortest_timeout();
    }
}

/// Actuators of a component whose code stays as it is.
impl<C: Component> ChildSpec<C> {
    /// Changes settings of the actuator whose commands are of this contract, over those that the
    /// component's [`ports`](crate::Component::ports) declare.
    pub fn actuator(self, contract: &str, settings: ActuatorSettings) -> Self {
        let contract = contract.to_owned();
        self.with_ports(move |ports| ports.change_actuator(&contract, &settings))
    }
}
