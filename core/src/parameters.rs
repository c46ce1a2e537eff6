//! Parameters: settings of a component with a default, a unit and a range, read and checked by
//! name.
//!
//! `#[derive(Parameters)]` writes the impl; what it calls stands here.

use crate::Variable;
use crate::suggestion::nearest;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::ops::RangeBounds;

/// The settings of a component. Derived.
#[diagnostic::on_unimplemented(
    message = "`{Self}` is no set of parameters",
    note = "write `#[derive(Clone, Parameters)]` above the struct"
)]
pub trait Parameters: Variable + Default {
    /// The parameters, in the order in which they are declared.
    const FIELDS: &'static [ParameterField];

    /// Gives one parameter a value, which may still lie outside of its range.
    ///
    /// # Errors
    /// There is no such parameter, or its type is another.
    fn set(&mut self, key: &str, value: &ParameterValue) -> Result<(), ParameterError>;

    /// Checks all ranges.
    ///
    /// # Errors
    /// The first parameter that lies outside of its range.
    fn check(&self) -> Result<(), ParameterError>;

    /// The value of one parameter; `None` where there is no such parameter.
    fn value(&self, key: &str) -> Option<ParameterValue>;

    /// Describes all parameters, with their defaults.
    fn describe() -> Vec<ParameterDescription> {
        let defaults = Self::default();
        let described = |field: &ParameterField| {
            Some(ParameterDescription {
                name: field.name.to_owned(),
                takes: (field.takes)(),
                unit: field.unit.map(str::to_owned),
                range: field.range.map(str::to_owned),
                default: defaults.value(field.name)?,
            })
        };
        Self::FIELDS.iter().filter_map(described).collect()
    }

    /// Gives these parameters their values, and all others their defaults.
    ///
    /// # Errors
    /// The first that is unknown, of another type, or outside of its range.
    fn from_values<'a>(
        values: impl IntoIterator<Item = (&'a str, &'a ParameterValue)>,
    ) -> Result<Self, ParameterError> {
        let (mut parameters, mut given) = (Self::default(), Vec::new());
        for (key, value) in values {
            match value {
                ParameterValue::Written(text) => {
                    let number = without_unit(Self::FIELDS, key, text)?;
                    parameters.set(key, &ParameterValue::Written(number.to_owned()))?;
                }
                value => parameters.set(key, value)?,
            }
            given.push(key);
        }
        match parameters.check() {
            Ok(()) => Ok(parameters),
            Err(ParameterError::Range { key, found, range, unit }) if !given.contains(&key) => {
                Err(ParameterError::Default { key, found, range, unit })
            }
            Err(error) => Err(error),
        }
    }
}

/// What is declared of one parameter.
#[derive(Clone, Copy, Debug)]
pub struct ParameterField {
    /// The parameter's name.
    pub name: &'static str,
    /// Returns what it takes, in words.
    pub takes: fn() -> String,
    /// Its unit, if it has one.
    pub unit: Option<&'static str>,
    /// The range of its values, if it is bounded, as it is written. Each element of a list lies
    /// in it.
    pub range: Option<&'static str>,
}

/// What is declared of one parameter, as plain data.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ParameterDescription {
    /// The parameter's name.
    pub name: String,
    /// What it takes, in words: `a number`.
    pub takes: String,
    /// Its unit, if it has one.
    pub unit: Option<String>,
    /// The range of its values, if it is bounded, as it is written.
    pub range: Option<String>,
    /// Its value where none is given.
    pub default: ParameterValue,
}

/// A value before it is known whether the parameter takes it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ParameterValue {
    /// True or false.
    Bool(bool),
    /// A whole number.
    Integer(i64),
    /// A number with a fraction.
    Float(f64),
    /// A text, or the name of a variant.
    Text(String),
    /// A list of values.
    List(Vec<ParameterValue>),
    /// A value as a file or a command line writes it, such as `12 m` or `[0.1, 0.2] m`: the
    /// parameter's type says how it is read.
    Written(String),
}

impl fmt::Display for ParameterValue {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            ParameterValue::Bool(value) => write!(f, "{value}"),
            ParameterValue::Integer(value) => write!(f, "{value}"),
            ParameterValue::Float(value) => write!(f, "{value:?}"),
            ParameterValue::Text(value) => write!(f, "{value:?}"),
            ParameterValue::List(values) => {
                let values: Vec<_> = values.iter().map(ToString::to_string).collect();
                write!(f, "[{}]", values.join(", "))
            }
            ParameterValue::Written(value) => write!(f, "`{value}`"),
        }
    }
}

/// Why parameters are refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ParameterError {
    /// There is no parameter of this name.
    #[error("there is no parameter `{key}`: {}", suggestion(.nearest.as_ref(), .known))]
    Unknown {
        /// The name that was given.
        key: String,
        /// The name that may have been meant.
        nearest: Option<String>,
        /// All that there are.
        known: Vec<&'static str>,
    },
    /// The parameter is of another type.
    #[error("`{key}` is {found}, and must be {expected}")]
    Type {
        /// The name of the parameter.
        key: String,
        /// The value that was given.
        found: String,
        /// What it takes, and its range.
        expected: String,
    },
    /// The value was written without the parameter's unit, or with another one.
    #[error(
        "`{key}` is `{found}`, and is given in {unit}: write a {} and {unit}",
        if found.starts_with('[') { "list" } else { "number" }
    )]
    Unit {
        /// The name of the parameter.
        key: &'static str,
        /// The value that was given.
        found: String,
        /// The unit that it is given in.
        unit: &'static str,
    },
    /// The value lies outside of the parameter's range.
    #[error("`{key}` is {found}, and must be in {range}{}", in_unit(.unit))]
    Range {
        /// The name of the parameter.
        key: &'static str,
        /// The value that was given.
        found: String,
        /// The range, as it is declared.
        range: &'static str,
        /// The unit of both.
        unit: Option<&'static str>,
    },
    /// The parameter was given no value, and its default lies outside of its range.
    #[error(
        "the default of `{key}` in the code is {found}, and must be in {range}{}",
        in_unit(.unit)
    )]
    Default {
        /// The name of the parameter.
        key: &'static str,
        /// The default value, as text.
        found: String,
        /// The range, as it is declared.
        range: &'static str,
        /// The unit of both.
        unit: Option<&'static str>,
    },
}

impl ParameterError {
    /// The parameter that it is about, as it was written.
    pub fn key(&self) -> &str {
        match self {
            ParameterError::Unknown { key, .. } | ParameterError::Type { key, .. } => key,
            ParameterError::Unit { key, .. }
            | ParameterError::Range { key, .. }
            | ParameterError::Default { key, .. } => key,
        }
    }
}

fn suggestion(nearest: Option<&String>, known: &[&str]) -> String {
    match nearest {
        Some(nearest) => format!("did you mean `{nearest}`?"),
        None if known.is_empty() => "there are none".to_owned(),
        None => format!("there are `{}`", known.join("`, `")),
    }
}

fn in_unit(unit: &Option<&'static str>) -> String {
    unit.map(|unit| format!(" {unit}")).unwrap_or_default()
}

/// A type that a parameter may have.
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot be the type of a parameter",
    note = "parameters are `bool`, whole numbers up to 64 bits, `f32`, `f64`, `String`, enums with \
            `#[derive(ParameterType)]`, and a `Vec` of these"
)]
pub trait ParameterType: Sized {
    /// What a range bounds: the elements of a list, or the value itself.
    type Element;

    /// Returns what it is called in errors.
    fn expected() -> String;

    /// The value, where it is one of this type.
    fn of(value: &ParameterValue) -> Option<Self>;

    /// The same value as one of any type.
    fn value(&self) -> ParameterValue;

    /// Returns what a range bounds.
    fn elements(&self) -> &[Self::Element];
}

/// What all types but lists have in common, and what the value is called in errors.
macro_rules! single {
    ($expected:literal) => {
        type Element = Self;

        fn expected() -> String {
            $expected.to_owned()
        }

        fn elements(&self) -> &[Self] {
            std::slice::from_ref(self)
        }
    };
}

impl<T: ParameterType<Element = T>> ParameterType for Vec<T> {
    type Element = T;

    fn expected() -> String {
        format!("a list in `[]`, each {}", T::expected())
    }

    fn of(value: &ParameterValue) -> Option<Self> {
        match value {
            ParameterValue::List(values) => values.iter().map(T::of).collect(),
            ParameterValue::Written(text) => {
                let inner = text.strip_prefix('[')?.strip_suffix(']')?.trim();
                let elements = inner.split(',').map(str::trim);
                let written = |text: &str| ParameterValue::Written(text.to_owned());
                let read = |text: &str| T::of(&written(text)).filter(|_| !text.is_empty());
                if inner.is_empty() { Some(Vec::new()) } else { elements.map(read).collect() }
            }
            _ => None,
        }
    }

    fn value(&self) -> ParameterValue {
        ParameterValue::List(self.iter().map(T::value).collect())
    }

    fn elements(&self) -> &[T] {
        self
    }
}

impl ParameterType for bool {
    single!("true or false");

    fn of(value: &ParameterValue) -> Option<Self> {
        match value {
            ParameterValue::Bool(value) => Some(*value),
            ParameterValue::Written(text) => text.parse().ok(),
            _ => None,
        }
    }

    fn value(&self) -> ParameterValue {
        ParameterValue::Bool(*self)
    }
}

impl ParameterType for String {
    single!("a text");

    fn of(value: &ParameterValue) -> Option<Self> {
        match value {
            ParameterValue::Text(value) | ParameterValue::Written(value) => Some(value.clone()),
            _ => None,
        }
    }

    fn value(&self) -> ParameterValue {
        ParameterValue::Text(self.clone())
    }
}

impl ParameterType for f64 {
    single!("a number");

    fn of(value: &ParameterValue) -> Option<Self> {
        match value {
            ParameterValue::Float(value) => Some(*value),
            ParameterValue::Integer(value) => Some(*value as f64),
            ParameterValue::Written(text) => {
                text.parse().ok().filter(|value: &f64| value.is_finite())
            }
            _ => None,
        }
    }

    fn value(&self) -> ParameterValue {
        ParameterValue::Float(*self)
    }
}

impl ParameterType for f32 {
    single!("a number");

    fn of(value: &ParameterValue) -> Option<Self> {
        let wide = f64::of(value)?;
        let value = wide as f32;
        (value.is_finite() || !wide.is_finite()).then_some(value)
    }

    fn value(&self) -> ParameterValue {
        ParameterValue::Float(f64::from(*self))
    }
}

macro_rules! whole_numbers {
    ($($number:ty: $expected:literal),*) => {$(
        impl ParameterType for $number {
            single!($expected);

            fn of(value: &ParameterValue) -> Option<Self> {
                match value {
                    ParameterValue::Integer(value) => (*value).try_into().ok(),
                    ParameterValue::Written(text) => text.parse().ok(),
                    _ => None,
                }
            }

            fn value(&self) -> ParameterValue {
                let whole = i64::try_from(*self).map(ParameterValue::Integer);
                whole.unwrap_or(ParameterValue::Float(*self as f64))
            }
        }
    )*};
}

whole_numbers! {
    u8: "a whole number from 0 to 255",
    u16: "a whole number from 0 to 65535",
    u32: "a whole number from 0 to 4294967295",
    u64: "a whole number of 0 or more",
    i8: "a whole number from -128 to 127",
    i16: "a whole number from -32768 to 32767",
    i32: "a whole number from -2147483648 to 2147483647",
    i64: "a whole number"
}

/// The number of a value that is written with its unit.
fn without_unit<'a>(
    fields: &'static [ParameterField],
    key: &str,
    text: &'a str,
) -> Result<&'a str, ParameterError> {
    let field = fields.iter().find(|field| field.name == key);
    let Some(&ParameterField { name, unit: Some(unit), .. }) = field else { return Ok(text) };
    let number = text.strip_suffix(unit).map(str::trim_end);
    number
        .filter(|number| number.ends_with(|c: char| c.is_ascii_digit() || ".]".contains(c)))
        .ok_or_else(|| ParameterError::Unit { key: name, found: text.to_owned(), unit })
}

/// Reads the value of one parameter; called by what is derived.
///
/// # Errors
/// It is of another type.
pub fn read<T: ParameterType>(
    field: &ParameterField,
    value: &ParameterValue,
) -> Result<T, ParameterError> {
    T::of(value).ok_or_else(|| {
        let range = field.range.map(|range| format!(", in {range}{}", in_unit(&field.unit)));
        let expected = format!("{}{}", T::expected(), range.unwrap_or_default());
        ParameterError::Type { key: field.name.to_owned(), found: value.to_string(), expected }
    })
}

/// What to say of a parameter that does not exist; called by what is derived.
pub fn unknown(key: &str, fields: &'static [ParameterField]) -> ParameterError {
    let known: Vec<&'static str> = fields.iter().map(|field| field.name).collect();
    let nearest = nearest(key, known.iter().copied()).map(str::to_owned);
    ParameterError::Unknown { key: key.to_owned(), nearest, known }
}

/// Checks that a value, or each element of a list, lies in its range; called by what is derived.
///
/// # Errors
/// It does not.
pub fn check_range<T: ParameterType<Element: PartialOrd> + fmt::Debug>(
    field: &ParameterField,
    value: &T,
    range: impl RangeBounds<T::Element>,
) -> Result<(), ParameterError> {
    if value.elements().iter().all(|element| range.contains(element)) {
        return Ok(());
    }
    Err(ParameterError::Range {
        key: field.name,
        found: format!("{value:?}"),
        range: field.range.unwrap_or_default(),
        unit: field.unit,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_number_that_its_type_cannot_hold_is_refused() {
        let written = |text: &str| ParameterValue::Written(text.to_owned());
        assert_eq!(f32::of(&written("0.5")), Some(0.5));
        for text in ["1e60", "-1e39", "inf", "nan"] {
            assert_eq!(f32::of(&written(text)), None, "{text}");
        }
        assert_eq!(f64::of(&written("1e60")), Some(1e60));
        assert_eq!((f64::of(&written("inf")), f64::of(&written("nan"))), (None, None));
        // A program may say that there is no limit.
        assert_eq!(f32::of(&ParameterValue::Float(f64::INFINITY)), Some(f32::INFINITY));
    }
}
