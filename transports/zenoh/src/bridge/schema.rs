//! The structure of a contract as a JSON Schema (draft 2020-12).
//!
//! Units and coordinate frames are annotations, `x-unit` and `x-frame`, which validators ignore;
//! `x-contract` has what nodes compare when they bind.

use blastema::core::contract::layout::{Fields, Primitive, Shape, Variant};
use blastema::core::{ContractIdentity, LayoutDescription};
use serde_json::{Map, Value, json};

/// The schema of an event.
pub(super) fn of(
    identity: &ContractIdentity,
    layout: &LayoutDescription,
    max_size: usize,
    latched: bool,
) -> Value {
    let types = layout.types();
    let mut schema = Map::new();
    schema.insert("$schema".into(), "https://json-schema.org/draft/2020-12/schema".into());
    schema.insert("title".into(), identity.name.into());
    schema.insert(
        "x-contract".into(),
        json!({
            "name": identity.name,
            "version": identity.version,
            "fingerprint": format!("{:016x}", identity.fingerprint),
            "delivery": identity.delivery.to_string(),
            "max_size": max_size,
            "latched": latched,
        }),
    );
    schema.extend(whole(&types[0], types));
    // The others, where something refers to them by their place.
    let definitions = types.iter().enumerate().filter(|(_, shape)| !is_inline(shape));
    let definitions: Map<_, _> =
        definitions.map(|(at, shape)| (at.to_string(), whole(shape, types).into())).collect();
    schema.insert("$defs".into(), definitions.into());
    schema.into()
}

fn is_inline(shape: &Shape<u32>) -> bool {
    matches!(shape, Shape::Leaf(_))
}

/// A type where another one holds it.
fn held(of: u32, types: &[Shape<u32>]) -> Map<String, Value> {
    match &types[of as usize] {
        shape if is_inline(shape) => whole(shape, types),
        _ => object(json!({ "$ref": format!("#/$defs/{of}") })),
    }
}

fn object(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

fn whole(shape: &Shape<u32>, types: &[Shape<u32>]) -> Map<String, Value> {
    object(match shape {
        Shape::Leaf(leaf) => primitive(*leaf),
        Shape::Optional(of) => json!({ "anyOf": [held(*of, types), { "type": "null" }] }),
        Shape::Sequence(of) => json!({ "type": "array", "items": held(*of, types) }),
        Shape::Set(of) => {
            json!({ "type": "array", "items": held(*of, types), "uniqueItems": true })
        }
        Shape::AtMost(of, bound) => {
            let mut schema = whole(&types[*of as usize], types);
            // A text is bounded in bytes, and JSON Schema counts characters.
            if schema.contains_key("items") {
                schema.insert("maxItems".into(), (*bound).into());
            }
            schema.into()
        }
        Shape::Map(_, of) => {
            json!({ "type": "object", "additionalProperties": held(*of, types) })
        }
        Shape::Array(of, length) => {
            let of = held(*of, types);
            json!({ "type": "array", "items": of, "minItems": length, "maxItems": length })
        }
        Shape::Tuple(parts) => tuple(parts.iter().map(|of| held(*of, types))),
        Shape::Struct(name, shape) => {
            let mut schema = fields(shape, types);
            if !name.is_empty() {
                schema.insert("title".into(), (**name).into());
            }
            schema.into()
        }
        Shape::Enum(name, variants) => {
            let variants: Vec<_> = variants.iter().map(|one| variant(one, types)).collect();
            match name.is_empty() {
                true => json!({ "oneOf": variants }),
                false => json!({ "title": name, "oneOf": variants }),
            }
        }
        _ => json!({}),
    })
}

/// Serde writes a variant as its name, or as an object with the name and the value.
fn variant(variant: &Variant<u32>, types: &[Shape<u32>]) -> Value {
    let name = &variant.name;
    match &variant.fields {
        Fields::Unit => json!({ "const": name }),
        inner => json!({
            "type": "object",
            "properties": { &**name: fields(inner, types) },
            "required": [name],
            "additionalProperties": false,
        }),
    }
}

fn fields(shape: &Fields<u32>, types: &[Shape<u32>]) -> Map<String, Value> {
    let all = shape.as_slice();
    let annotated = all.iter().map(|field| {
        let mut schema = held(field.of, types);
        for (name, value) in [("x-unit", &field.unit), ("x-frame", &field.frame)] {
            if let Some(value) = value {
                schema.insert(name.into(), (**value).into());
            }
        }
        schema
    });
    object(match shape {
        Fields::Unit => json!({ "type": "null" }),
        Fields::Tuple(_) if all.len() == 1 => return annotated.flatten().collect(),
        Fields::Tuple(_) => tuple(annotated),
        Fields::Named(_) => {
            let names = all.iter().map(|field| field.name.to_string());
            let required = all.iter().filter(|field| {
                let shape = &types[field.of as usize];
                !matches!(shape, Shape::Optional(_))
            });
            let required: Vec<_> = required.map(|field| field.name.to_string()).collect();
            let properties: Map<_, Value> = names.zip(annotated.map(Value::from)).collect();
            json!({
                "type": "object",
                "properties": properties,
                "required": required,
                "additionalProperties": false,
            })
        }
    })
}

fn tuple(parts: impl Iterator<Item = Map<String, Value>>) -> Value {
    let parts: Vec<Value> = parts.map(Value::from).collect();
    let length = parts.len();
    json!({ "type": "array", "prefixItems": parts, "minItems": length, "maxItems": length })
}

fn primitive(leaf: Primitive) -> Value {
    match leaf {
        Primitive::Unit => json!({ "type": "null" }),
        Primitive::Bool => json!({ "type": "boolean" }),
        Primitive::F32 | Primitive::F64 => json!({ "type": "number", "x-type": leaf.name() }),
        Primitive::Char => json!({ "type": "string", "minLength": 1, "maxLength": 1 }),
        Primitive::Text => json!({ "type": "string" }),
        Primitive::Duration => json!({
            "type": "object",
            "properties": { "secs": primitive(Primitive::U64), "nanos": primitive(Primitive::U32) },
            "required": ["secs", "nanos"],
            "additionalProperties": false,
        }),
        // Numbers beyond 64 bits cannot stand in this schema.
        Primitive::U128 => json!({ "type": "integer", "minimum": 0, "x-type": leaf.name() }),
        Primitive::I128 => json!({ "type": "integer", "x-type": leaf.name() }),
        _ => {
            let narrow = |bound: i128| match i64::try_from(bound) {
                Ok(bound) => json!(bound),
                Err(_) => json!(u64::try_from(bound).unwrap_or(u64::MAX)),
            };
            let (low, high) = bounds(leaf).unwrap_or_default();
            let (low, high) = (narrow(low), narrow(high));
            json!({ "type": "integer", "minimum": low, "maximum": high, "x-type": leaf.name() })
        }
    }
}

/// Refuses what JSON cannot hold: keys of maps that are no texts, and values of which nothing
/// tells whether they are there.
pub(super) fn check(layout: &LayoutDescription) -> Result<(), String> {
    let types = layout.types();
    let seen_through = |mut at: u32| {
        // A structure around one value is written as that value. A table of types is finite.
        for _ in types {
            match &types[at as usize] {
                Shape::Struct(_, Fields::Tuple(fields)) if fields.len() == 1 => at = fields[0].of,
                _ => break,
            }
        }
        &types[at as usize]
    };
    for shape in types {
        match shape {
            Shape::Map(key, _) => match seen_through(*key) {
                Shape::Leaf(
                    Primitive::F32 | Primitive::F64 | Primitive::Unit | Primitive::Duration,
                )
                | Shape::Optional(_)
                | Shape::Sequence(_)
                | Shape::Set(_)
                | Shape::Map(..)
                | Shape::AtMost(..)
                | Shape::Array(..)
                | Shape::Tuple(_)
                | Shape::Struct(..)
                | Shape::Enum(..) => {
                    return Err("a map's keys are texts, integers or booleans there: publish a \
                                sequence of pairs instead"
                        .into());
                }
                _ => {}
            },
            Shape::Optional(of) => match seen_through(*of) {
                Shape::Optional(_)
                | Shape::Leaf(Primitive::Unit)
                | Shape::Struct(_, Fields::Unit) => {
                    return Err("an option of an option, or of nothing, cannot be told from none \
                                there: publish an enumeration instead"
                        .into());
                }
                _ => {}
            },
            _ => {}
        }
    }
    Ok(())
}

/// The least and the greatest value of an integer.
fn bounds(leaf: Primitive) -> Option<(i128, i128)> {
    Some(match leaf {
        Primitive::U8 => (0, u8::MAX.into()),
        Primitive::U16 => (0, u16::MAX.into()),
        Primitive::U32 => (0, u32::MAX.into()),
        Primitive::U64 => (0, u64::MAX.into()),
        Primitive::U128 => (0, i128::MAX),
        Primitive::I8 => (i8::MIN.into(), i8::MAX.into()),
        Primitive::I16 => (i16::MIN.into(), i16::MAX.into()),
        Primitive::I32 => (i32::MIN.into(), i32::MAX.into()),
        Primitive::I64 => (i64::MIN.into(), i64::MAX.into()),
        Primitive::I128 => (i128::MIN, i128::MAX),
        _ => return None,
    })
}
