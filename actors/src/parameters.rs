//! The parameters of a node's components: read from a file at the start, set while they run.
//!
//! They are a variable of their component, so that they are read, written and watched as variables
//! are; this adds where their first values come from, and that the component is told of every
//! change.

use crate::component::cell::ComponentCell;
use crate::component::environment::ComponentEnvironment;
use crate::component::ports::{ParameterValues, ParametersType, Ports};
use crate::component::spec_error::SpecError;
use crate::component::{Component, Handle};
use crate::variable::VariableStore;
use crate::variable::ports::VariablePort;
use crate::variable::{DeclaredVariable, RestorePolicy, VariableRef, declared};
use blastema_core::contract::codec;
use blastema_core::parameters::{ParameterError, ParameterValue, Parameters};
use blastema_core::sorted::SortedMap;
use blastema_core::{DeliveryError, ObjectName, suggestion};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use toml::{Table, Value};

/// Returns the values that the parameters `P` do not take, each by itself.
fn refused_by<P: Parameters>(values: &ParameterValues) -> Vec<ParameterError> {
    let refused = |(key, value): (&String, _)| P::from_values([(key.as_str(), value)]).err();
    let mut refused: Vec<_> = values.iter().filter_map(refused).collect();
    // A default that is wrong is so for each of them.
    refused.dedup();
    refused
}

/// The values that the robot's configuration gives to the components of a node. Clones share them.
#[derive(Clone, Default)]
pub(crate) struct Configured(Arc<Mutex<Inner>>);

#[derive(Default)]
struct Inner {
    given: SortedMap<String, ParameterValues>,
    /// The file that each value stands in, by component and key, where it is from one.
    files: SortedMap<(String, String), PathBuf>,
    /// Components that have parameters.
    takers: BTreeSet<String>,
}

impl Inner {
    fn refuse(&self, component: &ObjectName, error: ParameterError) -> SpecError {
        let file = self.files.get(&(component.to_string(), error.key().to_owned())).cloned();
        SpecError::Parameters { name: component.clone(), file, error }
    }
}

impl Configured {
    /// Takes the values of a configuration in TOML, perhaps of this file: one table for each
    /// component.
    pub(crate) fn take(&self, text: &str, file: Option<&Path>) -> Result<(), String> {
        let document: Table = text.parse().map_err(|error| format!("{error}"))?;
        let mut inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        for (component, table) in document {
            let Value::Table(table) = table else {
                return Err(format!(
                    "`{component}` stands outside of a table: write it below the name of its \
                     component, as in [arm]"
                ));
            };
            let values = table.into_iter().map(|(key, value)| match read(value) {
                Ok(value) => Ok((key, value)),
                Err(what) => {
                    Err(format!("{component}: `{key}` is {what}, which no parameter takes"))
                }
            });
            let values = values.collect::<Result<ParameterValues, String>>()?;
            for key in values.keys() {
                let at = (component.clone(), key.clone());
                match file {
                    Some(file) => inner.files.insert(at, file.to_owned()),
                    None => inner.files.remove(&at),
                };
            }
            inner.given.entry(component).or_default().extend(values);
        }
        Ok(())
    }

    /// Gives a component values that its description writes. A configuration in TOML prevails.
    pub(crate) fn write(&self, component: &ObjectName, written: Vec<(String, String)>) {
        if written.is_empty() {
            return;
        }
        let mut inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let values = inner.given.entry(component.to_string()).or_default();
        for (key, text) in written {
            values.entry(key).or_insert(ParameterValue::Written(text));
        }
    }

    /// Returns all values of a component that its parameters do not take; it may have none.
    pub(crate) fn refused(
        &self,
        component: &ObjectName,
        takes: Option<ParametersType>,
    ) -> Vec<SpecError> {
        let inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(given) = inner.given.get(component.as_str()) else { return Vec::new() };
        let unknown = |key: &String| {
            let (key, known) = (key.clone(), Vec::new());
            ParameterError::Unknown { key, nearest: None, known }
        };
        let errors = match takes {
            Some(ParametersType { refused, .. }) => refused(given),
            None => given.keys().map(unknown).collect(),
        };
        errors.into_iter().map(|error| inner.refuse(component, error)).collect()
    }

    /// The parameters of this component, which has some.
    fn parameters<P: Parameters>(&self, component: &ObjectName) -> Result<P, SpecError> {
        let mut inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        inner.takers.insert(component.to_string());
        let given = inner.given.get(component.as_str()).into_iter().flatten();
        let parameters = P::from_values(given.map(|(key, value)| (key.as_str(), value)));
        parameters.map_err(|error| inner.refuse(component, error))
    }

    /// A component of this name is added later, and may take values.
    pub(crate) fn expect(&self, component: &str) {
        let mut inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        inner.takers.insert(component.to_owned());
    }

    /// Finds values for a component that takes none, and the file that they stand in.
    pub(crate) fn check(&self) -> Result<(), (Option<PathBuf>, String)> {
        let inner = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let Some(wrong) = inner.given.keys().find(|name| !inner.takers.contains(*name)) else {
            return Ok(());
        };
        let takers = inner.takers.iter().map(String::as_str);
        let reason = match suggestion::nearest(wrong, takers) {
            Some(nearest) => {
                format!("no component `{wrong}` has parameters: did you mean `{nearest}`?")
            }
            None => format!("no component `{wrong}` has parameters"),
        };
        let file = inner.files.iter().find(|((component, _), _)| component == wrong);
        Err((file.map(|(_, file)| file.clone()), reason))
    }
}

fn read(value: Value) -> Result<ParameterValue, &'static str> {
    match value {
        Value::Boolean(value) => Ok(ParameterValue::Bool(value)),
        Value::Integer(value) => Ok(ParameterValue::Integer(value)),
        Value::Float(value) => Ok(ParameterValue::Float(value)),
        Value::String(value) => Ok(ParameterValue::Text(value)),
        Value::Array(values) => {
            Ok(ParameterValue::List(values.into_iter().map(read).collect::<Result<_, _>>()?))
        }
        Value::Table(_) => Err("a table"),
        Value::Datetime(_) => Err("a date"),
    }
}

/// The parameters `P` of a component.
fn declare<C: Handle<P>, P: Parameters>(
    cell: &Arc<ComponentCell<C>>,
    configured: &Configured,
) -> Result<DeclaredVariable, SpecError> {
    let parameters = configured.parameters::<P>(&cell.record.name)?;
    let check = |parameters: &P| parameters.check().map_err(|error| error.to_string());
    let (owner, telling) = (Arc::downgrade(cell), Mutex::new(()));
    let changed = move || {
        // The last one that is told has been read last, however many threads set parameters. An
        // incarnation that begins later reads them itself.
        let _telling = telling.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(owner) = owner.upgrade()
            && let Some(incarnation) = owner.queue.owner()
            && let Ok(parameters) = owner.parameters::<P>()
        {
            owner.notify(incarnation, "", parameters);
        }
    };
    let observer = Some(Arc::new(changed) as _);
    Ok(declared(&parameters, RestorePolicy::Restore, check, observer))
}

impl<C: Component> ComponentCell<C> {
    /// The component's own parameters as they are now.
    pub(crate) fn parameters<P: Parameters>(&self) -> Result<P, DeliveryError> {
        let value =
            self.record.environment.feature::<VariableStore>().value(&self.record.name, P::NAME)?;
        Ok(codec::decode::<P>(&value)?)
    }
}

impl<P: Parameters> VariableRef<P> {
    /// Sets one parameter. Returns the new revision.
    ///
    /// # Errors
    /// As [`write_if`](VariableRef::write_if); [`DeliveryError::CheckFailed`] names the problem: the
    /// value's range, its type, or an unknown parameter, with the nearest name.
    pub async fn set(&self, key: &str, value: ParameterValue) -> Result<u64, DeliveryError> {
        loop {
            let reading = self.read().await?;
            let mut parameters = reading.value;
            let set = parameters.set(key, &value).and_then(|()| parameters.check());
            set.map_err(|error| DeliveryError::CheckFailed { reason: error.to_string() })?;
            match self.write_if(parameters, reading.revision).await {
                // Another one was set meanwhile.
                Err(DeliveryError::Changed { .. }) => {}
                written => return written,
            }
        }
    }
}

impl ComponentEnvironment {
    /// The values of parameters that the node is given; for the layers below this one.
    pub(crate) fn configured(&self) -> &Configured {
        self.feature()
    }
}

impl<C: Component> Ports<C> {
    /// Declares parameters, with the values that the
    /// [configuration](crate::NodeBuilder::parameters_from) gives them, or their defaults. The
    /// component reads them by [`Context::parameters`](crate::Context::parameters) in
    /// `on_initialize`, and receives the newest ones by its handler after a change, ahead of what
    /// waits in its queue. A component has one set of parameters.
    pub fn parameters<P: Parameters>(&mut self) -> &mut Self
    where
        C: Handle<P>,
    {
        let declare = |cell: &Arc<ComponentCell<C>>| {
            declare::<C, P>(cell, cell.record.environment.configured())
        };
        self.parameters = Some(ParametersType { describe: P::describe, refused: refused_by::<P> });
        let declare = Box::new(declare);
        let port = VariablePort { contract: P::NAME, is_parameters: true, declare };
        self.feature::<Vec<VariablePort<C>>>().push(port);
        self
    }
}
