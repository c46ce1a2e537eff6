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
    let command: M = message_of(&command).map_err(|error| unreadable(&error))?;
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
    let as_text = Value::String(number.to_owned());
    let mut with = command.clone();
    with[name] = serde_json::from_str(number).unwrap_or_else(|_| as_text.clone());
    // A value of another type is found where it stands.
    if let Err(error) = message_of::<M>(&with) {
        with[name] = as_text;
        message_of::<M>(&with).map_err(|_| format!("`{name}` cannot be `{text}`: {error}"))?;
    }
    *command = with;
    Ok(())
}

/// The message that has these fields. They are read from text, which refuses a number that is too
/// large for an `f32` where it stands.
pub(crate) fn message_of<M: Contract>(fields: &Value) -> serde_json::Result<M> {
    serde_json::from_str(&fields.to_string())
}

#[cfg(test)]
mod tests {
    use super::*;
    use blastema_core::contract::codec;

    #[derive(Clone, Debug, PartialEq, crate::Request)]
    #[contract(reply = ())]
    struct Drive {
        speed: f32,
        mode: String,
    }

    #[test]
    fn a_number_that_is_too_large_is_refused_and_a_text_may_look_like_one() {
        let safe = Drive { speed: 0.0, mode: String::new() };
        let safe: Bytes = encoded(&safe).unwrap().into();
        let with = |name: &str, text: &str| {
            let command = with_fields::<Drive>(&safe, &[(name.to_owned(), text.to_owned())])
                .map_err(|refused| refused[0].why.clone())?;
            Ok::<Drive, String>(codec::decode(&command).unwrap())
        };
        for text in ["1e60", "-1e39", "inf", "fast"] {
            assert!(with("speed", text).is_err_and(|why| why.contains(text)), "{text}");
        }
        assert_eq!(with("speed", "0.5").unwrap().speed, 0.5);
        assert_eq!(with("mode", "12").unwrap().mode, "12");
        assert_eq!(with("mode", "\"12\"").unwrap().mode, "12");
    }
}
