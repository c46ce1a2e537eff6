//! How components own variables.

use super::VariableSpec;
use super::store::{DeclaredVariable, VariableStore};
use crate::component::Component;
use crate::component::cell::ComponentCell;
use crate::component::declaration::{CellListener, Declarations};
use crate::component::ports::Ports;
use crate::component::spec_error::SpecError;
use blastema_core::sorted::SortedSet;
use blastema_core::{ObjectName, Variable};
use std::sync::Arc;

/// Makes a variable once its component is registered.
type DeclareLater<C> =
    Box<dyn FnOnce(&Arc<ComponentCell<C>>) -> Result<DeclaredVariable, SpecError>>;

/// The variables that a component declares.
pub(crate) struct VariablePorts<C: Component> {
    declared: Vec<DeclaredVariable>,
    /// The parameters: their contract, and what makes the variable that holds them.
    parameters: Vec<(&'static str, DeclareLater<C>)>,
}

impl<C: Component> Default for VariablePorts<C> {
    fn default() -> Self {
        VariablePorts { declared: Vec::new(), parameters: Vec::new() }
    }
}

impl<C: Component> VariablePorts<C> {
    pub(crate) fn declare_parameters(&mut self, contract: &'static str, declare: DeclareLater<C>) {
        self.parameters.push((contract, declare));
    }
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

impl<C: Component> Declarations<C> for VariablePorts<C> {
    fn check(&self, component: &ObjectName, _: &SortedSet<&'static str>) -> Result<(), SpecError> {
        let twice = |contract, ports| {
            Err(SpecError::PortTwice { name: component.clone(), contract, ports })
        };
        if let [_, (contract, _), ..] = self.parameters[..] {
            return twice(contract, "a component has one set of parameters");
        }
        let mut known: SortedSet<_> = self.parameters.iter().map(|(name, _)| *name).collect();
        let mut names = self.declared.iter().map(|(name, _)| *name);
        match names.find(|name| !known.insert(*name)) {
            Some(contract) => twice(contract, "both by variable"),
            None => Ok(()),
        }
    }

    fn bind(self: Box<Self>, cell: &Arc<ComponentCell<C>>) -> Result<(), SpecError> {
        let VariablePorts { mut declared, parameters } = *self;
        for (_, declare) in parameters {
            declared.push(declare(cell)?);
        }
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
        self.feature::<VariablePorts<C>>().declared.push(spec.declared());
        self
    }
}
