//! Settings of an actuator that a robot's description gives, over those of the component's code.

use super::CommandTimeout;
use super::table::{DeclaredActuator, FieldError, FieldTexts};
use crate::registry::encoding::encoded;
use blastema_core::contract::codec;
use blastema_core::contract::layout::Shape;
use blastema_core::lease::StopBy;
use blastema_core::suggestion::nearest;
use blastema_core::{Contract, LayoutDescription};
use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::Value;
use std::time::Duration;

/// Changes an [`ActuatorSpec`](crate::ActuatorSpec) without touching the component's code; given
/// to [`ChildSpec::actuator`](crate::ChildSpec::actuator). What is left out stays as it is there.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ActuatorSettings {
    /// How long a commander may be silent. See [`ActuatorSpec::lease`](crate::ActuatorSpec::lease).
    pub lease: Option<Duration>,
    /// How long a command counts. See [`ActuatorSpec::new`](crate::ActuatorSpec::new).
    pub command_timeout: Option<CommandTimeout>,
    /// Fields of the safe command with their values, each with its unit, as in `0 m/s`.
    pub safe: Vec<(String, String)>,
}

/// Applies settings to an actuator. The errors say why they do not apply.
pub(super) fn apply(
    actuator: &mut DeclaredActuator,
    settings: &ActuatorSettings,
) -> Result<(), Vec<FieldError>> {
    if let Some(span) = settings.lease {
        actuator.rules.span = span;
    }
    if let Some(timeout) = settings.command_timeout {
        actuator.rules.command_timeout = timeout.span();
    }
    if settings.safe.is_empty() {
        return Ok(());
    }
    actuator.safe = (actuator.with_fields)(&actuator.safe, &settings.safe)?;
    if actuator.rules.stop_by == StopBy::SafeCommand {
        actuator.stop = actuator.safe.clone();
    }
    Ok(())
}

/// The safe command of an actuator with commands of type `M`, with other values of these fields.
pub(super) fn with_fields<M: Contract>(
    safe: &Bytes,
    fields: &FieldTexts,
) -> Result<Bytes, Vec<FieldError>> {
    let unreadable = |error: &dyn std::fmt::Display| {
        vec![FieldError { field: None, why: format!("its safe command: {error}") }]
    };
    let safe = codec::decode::<M>(safe).map_err(|error| unreadable(&error))?;
    let mut command = serde_json::to_value(&safe).map_err(|error| unreadable(&error))?;
    let set = |(name, text): &(String, String)| {
        let why = set_field::<M>(&mut command, name, text).err()?;
        Some(FieldError { field: Some(name.clone()), why })
    };
    let refused: Vec<FieldError> = fields.iter().filter_map(set).collect();
    if !refused.is_empty() {
        return Err(refused);
    }
    let command: M = serde_json::from_value(command).map_err(|error| unreadable(&error))?;
    Ok(encoded(&command).map_err(|error| unreadable(&error))?.into())
}

/// Sets one field of a command.
fn set_field<M: Contract>(command: &mut Value, name: &str, text: &str) -> Result<(), String> {
    let layout = LayoutDescription::of_message(M::layout());
    let fields = match layout.types() {
        [Shape::Struct(_, fields), ..] => fields.as_slice(),
        _ => &[],
    };
    let Some(field) = fields.iter().find(|field| field.name == name) else {
        let known = fields.iter().map(|field| &*field.name);
        let hint = match nearest(name, known.clone()) {
            Some(nearest) => format!("did you mean `{nearest}`?"),
            None => format!("there are `{}`", known.collect::<Vec<_>>().join("`, `")),
        };
        return Err(format!("{} has no field `{name}`: {hint}", M::NAME));
    };
    let number = match &field.unit {
        Some(unit) => text.strip_suffix(&**unit).map(str::trim_end).ok_or_else(|| {
            format!("`{name}` is `{text}`, and is given in {unit}: write a number and {unit}")
        })?,
        None => text,
    };
    let value = serde_json::from_str(number).unwrap_or_else(|_| Value::String(number.to_owned()));
    let mut with = command.clone();
    with[name] = value;
    // A value of another type is found where it stands.
    serde_json::from_value::<M>(with.clone())
        .map_err(|error| format!("`{name}` cannot be `{text}`: {error}"))?;
    *command = with;
    Ok(())
}
