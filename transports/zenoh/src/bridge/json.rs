//! JSON that comes from outside, held against the structure of a contract.
//!
//! Serde writes and reads the events themselves: every contract has its traits. What it says of a
//! text that does not fit names a line and a column, and it passes over unknown fields.
//! So the text is walked beside the structure first: each misfit is named by its place in the
//! event.

use blastema::core::contract::layout::{Fields, Primitive, Shape};
use blastema::core::{LayoutDescription, suggestion};
use serde_json::Value;

/// Where a value does not fit, and how.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Misfit {
    /// The place, from the outside: `arm`, `joints`, `[2]`.
    path: Vec<String>,
    what: String,
}

impl std::fmt::Display for Misfit {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.path.is_empty() {
            return write!(f, "it is {}", self.what);
        }
        f.write_str("`")?;
        for (at, part) in self.path.iter().rev().enumerate() {
            let dot = if at > 0 && !part.starts_with('[') { "." } else { "" };
            write!(f, "{dot}{part}")?;
        }
        write!(f, "` is {}", self.what)
    }
}

impl Misfit {
    fn new(what: impl Into<String>) -> Self {
        Misfit { path: Vec::new(), what: what.into() }
    }

    fn within(mut self, part: impl Into<String>) -> Self {
        self.path.push(part.into());
        self
    }
}

/// Refuses what JSON cannot hold: keys of maps that are no texts, and values of which nothing
/// tells whether they are there.
pub(super) fn check_layout(layout: &LayoutDescription) -> Result<(), String> {
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

/// Says where the value is not such a message, if anywhere.
pub(super) fn check(value: &Value, layout: &LayoutDescription) -> Result<(), Misfit> {
    Walk { types: layout.types() }.value(value, 0)
}

struct Walk<'a> {
    types: &'a [Shape<u32>],
}

impl Walk<'_> {
    /// The depth is that of the value, which the parser of JSON bounds.
    fn value(&self, value: &Value, of: u32) -> Result<(), Misfit> {
        match &self.types[of as usize] {
            Shape::Leaf(leaf) => self.leaf(value, *leaf),
            Shape::Optional(of) if !value.is_null() => self.value(value, *of),
            Shape::Optional(_) => Ok(()),
            // The receiver checks the bound.
            Shape::AtMost(of, _) => self.value(value, *of),
            Shape::Sequence(of) | Shape::Set(of) => {
                let all = array(value, None)?;
                all.iter().enumerate().try_for_each(|(at, one)| self.element(one, at, *of))
            }
            Shape::Array(of, length) => {
                let all = array(value, Some(*length as usize))?;
                all.iter().enumerate().try_for_each(|(at, one)| self.element(one, at, *of))
            }
            Shape::Tuple(parts) => {
                let all = array(value, Some(parts.len()))?;
                let mut parts = all.iter().zip(parts.iter()).enumerate();
                parts.try_for_each(|(at, (one, of))| self.element(one, at, *of))
            }
            Shape::Map(key, of) => {
                let map = value.as_object().ok_or_else(|| expected(value, "an object"))?;
                map.iter().try_for_each(|(name, value)| {
                    let misfit = |misfit: Misfit| misfit.within(short(name));
                    self.key(name, *key).and_then(|()| self.value(value, *of)).map_err(misfit)
                })
            }
            Shape::Struct(_, fields) => self.fields(value, fields),
            Shape::Enum(_, variants) => {
                let names = || variants.iter().map(|variant| &*variant.name);
                let known = || names().collect::<Vec<_>>().join(", ");
                let (name, inner) = match value {
                    Value::String(name) => (name, None),
                    Value::Object(map) if map.len() == 1 => {
                        let (name, inner) = map.iter().next().expect("it has one entry");
                        (name, Some(inner))
                    }
                    _ => {
                        let what = format!("a variant, one of {}", known());
                        return Err(expected(value, &what));
                    }
                };
                let Some(variant) = variants.iter().find(|variant| variant.name == *name) else {
                    let name = short(name);
                    return Err(Misfit::new(match suggestion::nearest(&name, names()) {
                        Some(nearest) => format!("{name:?}: is {nearest:?} meant?"),
                        None => format!("{name:?}, where one of {} is expected", known()),
                    }));
                };
                let within = |misfit: Misfit| misfit.within(&*variant.name);
                match (&variant.fields, inner) {
                    (Fields::Unit, None) => Ok(()),
                    (Fields::Unit, Some(_)) => {
                        Err(Misfit::new(format!("{name:?} with a value, which it does not have")))
                    }
                    (_, None) => {
                        Err(Misfit::new(format!("{name:?} without its value: {{{name:?}: …}}")))
                    }
                    (fields, Some(inner)) => self.fields(inner, fields).map_err(within),
                }
            }
            // Shapes that come to be later are left to serde.
            _ => Ok(()),
        }
    }

    fn element(&self, value: &Value, at: usize, of: u32) -> Result<(), Misfit> {
        self.value(value, of).map_err(|misfit| misfit.within(format!("[{at}]")))
    }

    fn fields(&self, value: &Value, fields: &Fields<u32>) -> Result<(), Misfit> {
        let fields = match fields {
            Fields::Unit if value.is_null() => return Ok(()),
            Fields::Unit => return Err(expected(value, "null")),
            Fields::Tuple(fields) if fields.len() == 1 => return self.value(value, fields[0].of),
            Fields::Tuple(fields) => {
                let all = array(value, Some(fields.len()))?;
                let mut all = all.iter().zip(fields.iter()).enumerate();
                return all.try_for_each(|(at, (one, field))| self.element(one, at, field.of));
            }
            Fields::Named(fields) => fields,
        };
        let map = value.as_object().ok_or_else(|| expected(value, "an object"))?;
        for field in fields.iter() {
            let within = |misfit: Misfit| misfit.within(&*field.name);
            match map.get(&*field.name) {
                Some(value) => self.value(value, field.of).map_err(within)?,
                None => return Err(within(Misfit::new("missing"))),
            }
        }
        let names = || fields.iter().map(|field| &*field.name);
        match map.keys().find(|name| !names().any(|known| known == *name)) {
            None => Ok(()),
            Some(name) => {
                let known = names().collect::<Vec<_>>().join(", ");
                let what = format!("no field: there are {known}");
                Err(Misfit::new(what).within(short(name)))
            }
        }
    }

    fn key(&self, name: &str, of: u32) -> Result<(), Misfit> {
        let whole = |what| Misfit::new(format!("no key: {what} is expected"));
        match &self.types[of as usize] {
            Shape::Struct(_, Fields::Tuple(fields)) => self.key(name, fields[0].of),
            Shape::Leaf(Primitive::Text) => Ok(()),
            Shape::Leaf(Primitive::Bool) if !matches!(name, "true" | "false") => {
                Err(whole("true or false"))
            }
            Shape::Leaf(Primitive::Char) if name.chars().count() != 1 => {
                Err(whole("one character"))
            }
            Shape::Leaf(leaf) => match bounds(*leaf) {
                Some((low, high)) => match name.parse::<i128>() {
                    Ok(number) if (low..=high).contains(&number) => Ok(()),
                    _ => Err(whole(leaf.name())),
                },
                None => Ok(()),
            },
            _ => Ok(()),
        }
    }

    fn leaf(&self, value: &Value, leaf: Primitive) -> Result<(), Misfit> {
        let number = |number: &serde_json::Number| {
            let signed = number.as_i64().map(i128::from);
            signed.or_else(|| number.as_u64().map(i128::from))
        };
        let fits = match (leaf, value) {
            (Primitive::Unit, Value::Null)
            | (Primitive::Bool, Value::Bool(_))
            | (Primitive::Text, Value::String(_))
            | (Primitive::F64, Value::Number(_))
            // What is beyond 64 bits is left to serde.
            | (Primitive::U128 | Primitive::I128, Value::Number(_)) => true,
            (Primitive::F32, Value::Number(number)) => {
                #[expect(clippy::cast_possible_truncation, reason = "that is what is looked at")]
                let narrow = number.as_f64().map(|wide| wide as f32);
                narrow.is_some_and(f32::is_finite)
            }
            (Primitive::Char, Value::String(text)) => text.chars().count() == 1,
            (Primitive::Duration, Value::Object(map)) => {
                let is_part = |name: &str| map.get(name).is_some_and(Value::is_u64);
                map.len() == 2 && is_part("secs") && is_part("nanos")
            }
            (leaf, Value::Number(value)) => match (bounds(leaf), number(value)) {
                (Some((low, high)), Some(value)) => (low..=high).contains(&value),
                _ => false,
            },
            _ => false,
        };
        let name = match leaf {
            Primitive::Duration => r#"a duration, {"secs": …, "nanos": …}"#,
            Primitive::Unit => "null",
            other => other.name(),
        };
        if fits { Ok(()) } else { Err(expected(value, name)) }
    }
}

/// The least and the greatest value of an integer.
pub(super) fn bounds(leaf: Primitive) -> Option<(i128, i128)> {
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

fn array(value: &Value, length: Option<usize>) -> Result<&Vec<Value>, Misfit> {
    match (value.as_array(), length) {
        (Some(all), Some(length)) if all.len() != length => {
            Err(Misfit::new(format!("an array of {}, where {length} are expected", all.len())))
        }
        (Some(all), _) => Ok(all),
        (None, _) => Err(expected(value, "an array")),
    }
}

fn expected(value: &Value, what: &str) -> Misfit {
    let found = match value {
        Value::Null => "null".to_owned(),
        Value::Bool(value) => value.to_string(),
        Value::Number(value) => value.to_string(),
        Value::String(text) => format!("{:?}", short(text)),
        Value::Array(_) => "an array".to_owned(),
        Value::Object(_) => "an object".to_owned(),
    };
    Misfit::new(format!("{found}, where {what} is expected"))
}

/// A text from outside, for display.
fn short(text: &str) -> String {
    const MOST: usize = 40;
    let mut short: String = text.chars().filter(|one| !one.is_control()).take(MOST).collect();
    if text.chars().count() > MOST {
        short.push('…');
    }
    short
}
