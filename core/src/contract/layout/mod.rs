//! The structure of a message as data.
//!
//! A [`Layout`] is what a type looks like to a peer that must read its bytes: fields and variants
//! with their names, their order and their types, and the units and coordinate frames that were
//! declared for them. Two parties compare layouts before the first message crosses, because the
//! codec itself decodes a message with two fields swapped without complaint.
//!
//! A field's type is given as a function, so that a type which contains itself is no endless
//! constant. [`LayoutDescription`](crate::LayoutDescription) is the same thing as an owned value
//! that travels to another node.

mod described;

pub mod description;
pub mod difference;
pub mod fields;

pub use described::ArrayField;
pub(crate) use described::describe;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use std::any::TypeId;
use std::borrow::Cow;

/// Gives a type's structure.
pub type LayoutOf = fn() -> &'static Layout;

/// A name or a unit: borrowed in the program that declares it, owned where it came from a peer.
pub type Text = Cow<'static, str>;

/// The structure of one type.
#[derive(Clone, Debug)]
pub struct Layout {
    /// Which type it is. It tells a type that is met again while walking through a recursive one;
    /// it never leaves the process.
    pub id: fn() -> TypeId,
    /// What the type looks like.
    pub shape: Shape<LayoutOf>,
}

/// What a type looks like; `R` says how it refers to the types inside of it.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[non_exhaustive]
pub enum Shape<R: Clone + 'static> {
    /// A value without parts.
    Leaf(Primitive),
    /// A value or none.
    Optional(R),
    /// Any number of values, in order.
    Sequence(R),
    /// Any number of values, each once, sorted.
    Set(R),
    /// Values by key, sorted by key.
    Map(R, R),
    /// So many values, in order.
    Array(R, u32),
    /// Values of several types, in order.
    Tuple(Cow<'static, [R]>),
    /// A structure with a name.
    Struct(Text, Fields<R>),
    /// One of several variants.
    Enum(Text, Cow<'static, [Variant<R>]>),
    /// A text, a sequence or a set of at most so many bytes or elements.
    AtMost(R, u32),
}

/// A type without parts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[non_exhaustive]
#[expect(missing_docs, reason = "each is called as the type that it stands for")]
pub enum Primitive {
    Unit,
    Bool,
    U8,
    U16,
    U32,
    U64,
    U128,
    I8,
    I16,
    I32,
    I64,
    I128,
    F32,
    F64,
    Char,
    Text,
    Duration,
}

/// The fields of a structure or of a variant.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Fields<R: Clone + 'static> {
    /// None, and no parentheses.
    Unit,
    /// Fields without names.
    Tuple(Cow<'static, [Field<R>]>),
    /// Fields with names.
    Named(Cow<'static, [Field<R>]>),
}

/// One field of a structure or of a variant.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Field<R: Clone + 'static> {
    /// Its name; its number, where it has none.
    pub name: Text,
    /// The unit of its value, such as `m/s`.
    pub unit: Option<Text>,
    /// The coordinate frame that its value is given in, such as `laser`.
    pub frame: Option<Text>,
    /// The type of its value.
    pub of: R,
}

/// One variant of an enumeration.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Variant<R: Clone + 'static> {
    /// The variant's name.
    pub name: Text,
    /// What it carries.
    pub fields: Fields<R>,
}

/// A type that may stand in a contract: its structure is known, it is the same on every platform
/// and in every run, and it comes out of the codec as it went in.
///
/// Derive it with `#[derive(Structure)]`; do not implement it by hand.
///
/// # Examples
/// ```
/// # mod facade { pub(crate) use blastema_core::{self as core, serde}; }
/// # use blastema_macros::Structure;
/// #[derive(Clone, Debug, Structure)]
/// # #[contract(crate = "crate::facade")]
/// struct Pose {
///     #[contract(unit = "m", frame = "map")]
///     x: f64,
///     #[contract(unit = "m", frame = "map")]
///     y: f64,
/// }
/// # fn main() {}
/// ```
#[diagnostic::on_unimplemented(
    message = "`{Self}` cannot stand in a contract",
    label = "not allowed in a message",
    note = "derive it for a type of your own: `#[derive(Structure)]`",
    note = "types that differ between platforms or runs are left out on purpose: write `u32` or \
            `u64` for `usize`, `BTreeMap` for `HashMap`, `BTreeSet` for `HashSet`, and a \
            `Duration` since a stated event for `Instant`",
    note = "an array of more than 32 elements stands in a field of its own, not in a `Vec` or `Option`: \
            put it into a structure",
    note = "a message owns its data: write `String` for `&str`, `Vec<T>` for `&[T]`"
)]
pub trait Described: Serialize + DeserializeOwned + 'static {
    /// Whether a value takes no bytes at all. Such values cannot stand in a sequence: a few hostile
    /// bytes could announce 2^64 of them.
    const EMPTY: bool = false;

    /// The type's structure.
    fn layout() -> &'static Layout;
}

impl<R: Clone> Shape<R> {
    /// The same shape with every reference to another type replaced, in the order in which they
    /// stand.
    #[must_use]
    pub fn map<S: Clone>(&self, mut change: impl FnMut(&R) -> S) -> Shape<S> {
        match self {
            Shape::Leaf(leaf) => Shape::Leaf(*leaf),
            Shape::Optional(of) => Shape::Optional(change(of)),
            Shape::Sequence(of) => Shape::Sequence(change(of)),
            Shape::Set(of) => Shape::Set(change(of)),
            Shape::Map(key, value) => {
                let key = change(key);
                Shape::Map(key, change(value))
            }
            Shape::Array(of, length) => Shape::Array(change(of), *length),
            Shape::AtMost(of, bound) => Shape::AtMost(change(of), *bound),
            Shape::Tuple(parts) => Shape::Tuple(parts.iter().map(change).collect()),
            Shape::Struct(name, fields) => Shape::Struct(name.clone(), fields.map(&mut change)),
            Shape::Enum(name, variants) => {
                let variants = variants.iter().map(|variant| Variant {
                    name: variant.name.clone(),
                    fields: variant.fields.map(&mut change),
                });
                Shape::Enum(name.clone(), variants.collect())
            }
        }
    }

    /// The types that this one refers to, in the order in which they stand.
    pub fn parts(&self) -> Vec<R> {
        let mut parts = Vec::new();
        let _ = self.map(|of| parts.push(of.clone()));
        parts
    }
}

impl<R: Clone> Fields<R> {
    /// The fields in order, named or not.
    pub fn as_slice(&self) -> &[Field<R>] {
        match self {
            Fields::Unit => &[],
            Fields::Tuple(fields) | Fields::Named(fields) => fields,
        }
    }

    fn map<S: Clone>(&self, change: &mut impl FnMut(&R) -> S) -> Fields<S> {
        let changed = self.as_slice().iter().map(|field| Field {
            name: field.name.clone(),
            unit: field.unit.clone(),
            frame: field.frame.clone(),
            of: change(&field.of),
        });
        match self {
            Fields::Unit => Fields::Unit,
            Fields::Tuple(_) => Fields::Tuple(changed.collect()),
            Fields::Named(_) => Fields::Named(changed.collect()),
        }
    }
}

impl Primitive {
    /// The name by which differences and lists call it.
    pub fn name(self) -> &'static str {
        match self {
            Primitive::Unit => "()",
            Primitive::Bool => "bool",
            Primitive::U8 => "u8",
            Primitive::U16 => "u16",
            Primitive::U32 => "u32",
            Primitive::U64 => "u64",
            Primitive::U128 => "u128",
            Primitive::I8 => "i8",
            Primitive::I16 => "i16",
            Primitive::I32 => "i32",
            Primitive::I64 => "i64",
            Primitive::I128 => "i128",
            Primitive::F32 => "f32",
            Primitive::F64 => "f64",
            Primitive::Char => "char",
            Primitive::Text => "text",
            Primitive::Duration => "duration",
        }
    }
}
