//! How components own variables.

use super::VariableSpec;
use super::store::{DeclaredVariable, VariableStore};
use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::declaration::{CellListener, Declarations};
use crate::component::ports::Ports;
use crate::component::spec_error::SpecError;
use blastema_core::{ObjectName, Variable};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Makes a variable once its component is registered.
type DeclareLater<C> =
    Box<dyn FnOnce(&Arc<ComponentCell<C>>) -> Result<DeclaredVariable, SpecError>>;

/// A variable that a component declares.
pub(crate) struct VariablePort<C: Component> {
    pub(crate) contract: &'static str,
    /// It holds the component's parameters.
    pub(crate) is_parameters: bool,
    /// Makes it once the component is registered.
    pub(crate) declare: DeclareLater<C>,
}

/// Applies the policies of a component's variables, and withdraws them with it.
struct Withdrawal {
    store: VariableStore,
    owner: ObjectName,
}

impl CellListener for Withdrawal {
    fn ended(&self) {
        self.store.end_incarnation(&self.owner);
    }

    fn removed(&self) {
        self.store.withdraw(&self.owner);
    }
}

impl<C: Component> Declarations<C> for Vec<VariablePort<C>> {
    fn check(&self, component: &ObjectName, _: &BTreeSet<&'static str>) -> Result<(), SpecError> {
        let twice = |contract, ports| {
            Err(SpecError::PortTwice { name: component.clone(), contract, ports })
        };
        let mut sets = self.iter().filter(|port| port.is_parameters);
        if let Some(second) = sets.nth(1) {
            return twice(second.contract, "a component has one set of parameters");
        }
        let mut known = BTreeSet::new();
        match self.iter().map(|port| port.contract).find(|name| !known.insert(*name)) {
            Some(contract) => twice(contract, "both by variable"),
            None => Ok(()),
        }
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let declared: Result<Vec<_>, _> =
            self.into_iter().map(|port| (port.declare)(cell)).collect();
        let declared = declared?;
        let (name, environment) = (&cell.record.name, &cell.record.environment);
        let store = environment.feature::<VariableStore>();
        cell.record.listen(Withdrawal { store: store.clone(), owner: name.clone() });
        let owner = cell.clone();
        let isolated = move || owner.record.is_isolated();
        let refused = |why| SpecError::Variable { name: name.clone(), why };
        let rights = environment.registry.access();
        let port = store.declare(name, declared, isolated, rights).map_err(refused)?;
        environment.registry.open(name, port);
        Ok(())
    }
}

impl<C: Component> Ports<C> {
    /// Owns a variable: a value that any node may read, write and watch at the component's name. It
    /// outlives the component's incarnations.
    pub fn variable<V: Variable>(&mut self, spec: VariableSpec<V>) -> &mut Self {
        let declared = spec.declared();
        let declare = Box::new(move |_: &_| Ok(declared));
        let port = VariablePort { contract: V::NAME, is_parameters: false, declare };
        self.feature::<Vec<VariablePort<C>>>().push(port);
        self
    }
}
