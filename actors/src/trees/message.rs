//! Messages as ports: each field of a contract is a port of its name.
//!
//! A field that is a number, a truth value or a text has the port of that type. Any other field is
//! read and written as JSON, and a variant without fields by its name. A message that has no named
//! fields is one port, `message` or `reply`.

use super::task::LeafTask;
use crate::actuator::settings::message_of;
use blastema_core::contract::layout::{Field, Fields, Layout, LayoutOf, Primitive, Shape};
use blastema_core::{Contract, Described};
use blastema_trees::{LeafError, Port, PortError, PortValue, Value};
use serde_json::Value as Json;
use std::borrow::Cow;

/// The ports that a message of this contract is made from.
pub(super) fn inputs<M: Contract>() -> Vec<Port> {
    ports("message", &M::layout().shape, true)
}

/// The ports that a value of this type is written to; of a result, the value where it is one.
pub(super) fn outputs<T: Described>() -> Vec<Port> {
    match value_shape(T::layout()) {
        Shape::Leaf(Primitive::Unit) => Vec::new(),
        shape => ports("reply", shape, false),
    }
}

/// The shape, but for a result that of its value.
fn value_shape(layout: &'static Layout) -> &'static Shape<LayoutOf> {
    if let Shape::Enum(name, variants) = &layout.shape
        && name == "Result"
        && let Some(Fields::Tuple(fields)) = variants.first().map(|variant| &variant.fields)
    {
        return &(fields[0].of)().shape;
    }
    &layout.shape
}

fn named(shape: &'static Shape<LayoutOf>) -> Option<&'static [Field<LayoutOf>]> {
    match shape {
        Shape::Struct(_, Fields::Named(fields)) => Some(fields),
        Shape::Struct(_, Fields::Unit) => Some(&[]),
        _ => None,
    }
}

fn ports(whole: &'static str, shape: &'static Shape<LayoutOf>, reads: bool) -> Vec<Port> {
    let typed = |name, of: &Shape<LayoutOf>| {
        let either = |input: fn(_) -> Port, output: fn(_) -> Port| {
            if reads { input(name) } else { output(name) }
        };
        match of {
            Shape::Leaf(Primitive::Bool) => either(Port::input::<bool>, Port::output::<bool>),
            Shape::Leaf(Primitive::F32 | Primitive::F64) => {
                either(Port::input::<f64>, Port::output::<f64>)
            }
            Shape::Leaf(primitive) if is_integer(*primitive) => {
                either(Port::input::<i64>, Port::output::<i64>)
            }
            Shape::Optional(_) if reads => Port::input::<String>(name).optional(),
            _ => either(Port::input::<String>, Port::output::<String>),
        }
    };
    let Some(fields) = named(shape) else { return vec![typed(whole, shape)] };
    let port = |field: &'static Field<LayoutOf>| match field.name {
        Cow::Borrowed(name) => Some(typed(name, &(field.of)().shape)),
        // No type of this program has such a field.
        Cow::Owned(_) => None,
    };
    fields.iter().filter_map(port).collect()
}

fn is_text(shape: &Shape<LayoutOf>) -> bool {
    match shape {
        Shape::AtMost(of, _) => is_text(&of().shape),
        _ => matches!(shape, Shape::Leaf(Primitive::Text | Primitive::Char)),
    }
}

fn is_integer(primitive: Primitive) -> bool {
    use Primitive::{Bool, Char, Duration, F32, F64, Text, Unit};
    !matches!(primitive, Unit | Bool | F32 | F64 | Char | Text | Duration)
}

impl LeafTask {
    /// The message that the leaf's ports make.
    pub(super) fn message<M: Contract>(&self) -> Result<M, LeafError> {
        let shape = &M::layout().shape;
        let json = match (shape, named(shape)) {
            (_, None) => self.json("message", shape)?.unwrap_or_default(),
            (Shape::Struct(_, Fields::Unit), _) => Json::Null,
            (_, Some(fields)) => {
                let mut object = serde_json::Map::new();
                for field in fields {
                    let value = self.json(&field.name, &(field.of)().shape)?;
                    // A field that may be left out is none.
                    object.insert(field.name.to_string(), value.unwrap_or_default());
                }
                Json::Object(object)
            }
        };
        message_of(&json).map_err(|error| format!("{}: {error}", M::NAME).into())
    }

    fn json(&self, port: &str, of: &Shape<LayoutOf>) -> Result<Option<Json>, PortError> {
        Ok(Some(match of {
            Shape::Leaf(Primitive::Bool) => self.input::<bool>(port)?.into(),
            Shape::Leaf(Primitive::F32 | Primitive::F64) => self.input::<f64>(port)?.into(),
            of if is_text(of) => self.input::<String>(port)?.into(),
            Shape::Leaf(primitive) if is_integer(*primitive) => self.input::<i64>(port)?.into(),
            Shape::Optional(inner) if is_text(&(inner)().shape) => {
                return Ok(self.optional_input::<String>(port)?.map(Json::String));
            }
            // Anything else is JSON; the name of a variant stands without quotes.
            _ => match self.optional_input::<String>(port)? {
                Some(text) => serde_json::from_str(&text).unwrap_or(Json::String(text)),
                None => return Ok(None),
            },
        }))
    }

    /// Writes a reply or a variable's value to the leaf's ports. False if it is an error.
    pub(super) fn write<T: Described>(&self, value: &T) -> Result<bool, LeafError> {
        let (shape, mut json) = (value_shape(T::layout()), serde_json::to_value(value)?);
        if !std::ptr::eq(shape, &T::layout().shape) {
            match json.get_mut("Ok").map(Json::take) {
                Some(inner) => json = inner,
                None => return Ok(false),
            }
        }
        match (named(shape), json) {
            (_, Json::Null) => {}
            (Some(_), Json::Object(fields)) => {
                for (name, value) in fields {
                    self.output(&name, value_of(value))?;
                }
            }
            (_, json) => self.output("reply", value_of(json))?,
        }
        Ok(true)
    }
}

fn value_of(json: Json) -> Value {
    match json {
        Json::Bool(holds) => holds.into_value(),
        Json::String(text) => Value::text(text),
        Json::Number(number) => match number.as_i64() {
            Some(int) => Value::Int(int),
            None => Value::Real(number.as_f64().unwrap_or_default()),
        },
        other => Value::text(other.to_string()),
    }
}
