//! Messages as ports: each field of a contract is a port of its name.
//!
//! A field that is a number, a truth value or a text has the port of that type. Any other field is
//! read and written as JSON, and a variant without fields by its name. A message that has no named
//! fields is one port, `message` or `reply`.

use super::task::LeafTask;
use blastema_core::contract::layout::{Field, Fields, Layout, LayoutOf, Primitive, Shape, Text};
use blastema_core::{Contract, Described};
use blastema_trees::{LeafError, Port, PortError, PortValue, Value};
use serde_json::Value as Json;
use std::borrow::Cow;

/// The ports that a message of this contract is made from.
pub(super) fn inputs<M: Contract>() -> Vec<Port> {
    let port = |name, of: &Shape<LayoutOf>| match of {
        Shape::Leaf(Primitive::Bool) => Port::input::<bool>(name),
        Shape::Leaf(Primitive::F32 | Primitive::F64) => Port::input::<f64>(name),
        Shape::Leaf(primitive) if is_integer(*primitive) => Port::input::<i64>(name),
        Shape::Optional(_) => Port::input::<String>(name).optional(),
        _ => Port::input::<String>(name),
    };
    ports(M::layout(), "message", port)
}

/// The ports that a value of this type is written to; of a result, the value where it is one.
pub(super) fn outputs<T: Described>() -> Vec<Port> {
    let port = |name, of: &Shape<LayoutOf>| match of {
        Shape::Leaf(Primitive::Bool) => Port::output::<bool>(name),
        Shape::Leaf(Primitive::F32 | Primitive::F64) => Port::output::<f64>(name),
        Shape::Leaf(primitive) if is_integer(*primitive) => Port::output::<i64>(name),
        _ => Port::output::<String>(name),
    };
    match fields_or_value(T::layout()) {
        Shape::Leaf(Primitive::Unit) => Vec::new(),
        _ => ports(T::layout(), "reply", port),
    }
}

fn is_integer(primitive: Primitive) -> bool {
    use Primitive::{I8, I16, I32, I64, I128, U8, U16, U32, U64, U128};
    matches!(primitive, U8 | U16 | U32 | U64 | U128 | I8 | I16 | I32 | I64 | I128)
}

/// The shape, but for a result that of its value.
fn fields_or_value(layout: &'static Layout) -> &'static Shape<LayoutOf> {
    match &layout.shape {
        Shape::Enum(name, variants) if name == "Result" => match variants.first() {
            Some(variant) => match &variant.fields {
                Fields::Tuple(fields) if fields.len() == 1 => &(fields[0].of)().shape,
                _ => &layout.shape,
            },
            None => &layout.shape,
        },
        shape => shape,
    }
}

fn named(shape: &'static Shape<LayoutOf>) -> Option<&'static [Field<LayoutOf>]> {
    match shape {
        Shape::Struct(_, Fields::Named(fields)) => Some(fields),
        // A structure without fields has no ports.
        Shape::Struct(_, Fields::Unit) => Some(&[]),
        _ => None,
    }
}

/// The name of a field of a type of this program.
fn name_of(name: &Text) -> Option<&'static str> {
    match name {
        Cow::Borrowed(name) => Some(name),
        Cow::Owned(_) => None,
    }
}

fn ports(
    layout: &'static Layout,
    whole: &'static str,
    port: impl Fn(&'static str, &Shape<LayoutOf>) -> Port,
) -> Vec<Port> {
    let shape = fields_or_value(layout);
    let Some(fields) = named(shape) else { return vec![port(whole, shape)] };
    let ports = fields.iter().filter_map(|field| {
        let made = port(name_of(&field.name)?, &(field.of)().shape);
        Some(match &field.unit {
            Some(Cow::Borrowed(unit)) => made.about(unit),
            _ => made,
        })
    });
    ports.collect()
}

impl LeafTask {
    /// The message that the leaf's ports make.
    pub(super) fn message<M: Contract>(&self) -> Result<M, LeafError> {
        let shape = &M::layout().shape;
        let json = match named(shape) {
            None => self.json("message", shape)?.unwrap_or(Json::Null),
            Some([]) => Json::Null,
            Some(fields) => {
                let mut object = serde_json::Map::new();
                for field in fields {
                    if let Some(value) = self.json(&field.name, &(field.of)().shape)? {
                        object.insert(field.name.to_string(), value);
                    }
                }
                Json::Object(object)
            }
        };
        serde_json::from_value(json).map_err(|error| format!("{}: {error}", M::NAME).into())
    }

    fn json(&self, port: &str, of: &Shape<LayoutOf>) -> Result<Option<Json>, PortError> {
        Ok(match of {
            Shape::Leaf(Primitive::Bool) => Some(self.input::<bool>(port)?.into()),
            Shape::Leaf(Primitive::F32 | Primitive::F64) => Some(self.input::<f64>(port)?.into()),
            Shape::Leaf(Primitive::Text | Primitive::Char) => {
                Some(self.input::<String>(port)?.into())
            }
            Shape::Leaf(primitive) if is_integer(*primitive) => {
                Some(self.input::<i64>(port)?.into())
            }
            // Anything else is JSON; the name of a variant stands without quotes.
            _ => self
                .optional_input::<String>(port)?
                .map(|text| serde_json::from_str(&text).unwrap_or_else(|_| Json::String(text))),
        })
    }

    /// Writes a reply or a variable's value to the leaf's ports. False if it is an error.
    pub(super) fn write<T: Described>(&self, value: &T) -> Result<bool, LeafError> {
        let mut json = serde_json::to_value(value)?;
        if let Shape::Enum(name, _) = &T::layout().shape
            && name == "Result"
        {
            match json.get_mut("Ok").map(Json::take) {
                Some(inner) => json = inner,
                None => return Ok(false),
            }
        }
        let shape = fields_or_value(T::layout());
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
        Json::Number(number) => match (number.as_i64(), number.as_f64()) {
            (Some(int), _) => Value::Int(int),
            (None, Some(real)) => Value::Real(real),
            (None, None) => Value::text(number.to_string()),
        },
        other => Value::text(other.to_string()),
    }
}
