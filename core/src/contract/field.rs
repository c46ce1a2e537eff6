//! How the derives encode the fields of a structure.
//!
//! `#[derive(Structure)]`, `#[derive(Event)]` and `#[derive(Request)]` write code that calls what
//! stands here, and nowhere else. Each module has the pair of functions that serde's `with`
//! wants.

use crate::contract::layout::{Described, Layout, Shape};
use serde::{Deserializer, Serializer};
use std::any::TypeId;
use std::cell::Cell;
use std::collections::BTreeSet;
use std::marker::PhantomData;

/// How deep structures may nest in one message, counted by the types that are derived.
///
/// A recursive type makes the depth a matter of the bytes; without a limit a few hostile ones
/// overflow the stack. 32 levels of a large structure fit a thread's usual 2 MiB many times over.
pub const DEPTH_LIMIT: u32 = 32;

thread_local! {
    static DEPTH: Cell<u32> = const { Cell::new(0) };
}

/// Runs `inner`, the encoding or decoding of one structure, unless it stands too deep.
///
/// # Errors
/// What `inner` returns, or `too_deep` of a text that says so.
pub fn nested<T, E>(
    inner: impl FnOnce() -> Result<T, E>,
    too_deep: impl FnOnce(&'static str) -> E,
) -> Result<T, E> {
    /// Goes back up when the structure is done, also by a panic.
    struct Level(u32);

    impl Drop for Level {
        fn drop(&mut self) {
            DEPTH.set(self.0);
        }
    }

    let level = Level(DEPTH.get());
    if level.0 == DEPTH_LIMIT {
        return Err(too_deep("structures are nested more than 32 deep"));
    }
    DEPTH.set(level.0 + 1);
    inner()
}

/// Fields of any type that may stand in a contract.
pub mod plain {
    use crate::contract::layout::{Described, LayoutOf};
    use serde::{Deserializer, Serializer};

    /// Encodes the field.
    ///
    /// # Errors
    /// Those of the serializer.
    pub fn serialize<T: Described, S: Serializer>(value: &T, to: S) -> Result<S::Ok, S::Error> {
        value.serialize(to)
    }

    /// Decodes the field.
    ///
    /// # Errors
    /// Those of the deserializer.
    pub fn deserialize<'de, T: Described, D: Deserializer<'de>>(from: D) -> Result<T, D::Error> {
        // To mention the layout is to compile it, and with it the refusal of endless sequences of
        // nothing, also in a program that decodes a message without ever binding its contract.
        let _: LayoutOf = T::layout;
        T::deserialize(from)
    }
}

/// Fields that are written `Vec<u8>`: the same bytes as [`plain`] gives, copied as one piece, which
/// is 4.7 times as fast.
pub mod bytes {
    use crate::Blob;
    use serde::{Deserialize, Deserializer, Serializer};

    /// Encodes the field.
    ///
    /// # Errors
    /// Those of the serializer.
    pub fn serialize<S: Serializer>(value: &[u8], to: S) -> Result<S::Ok, S::Error> {
        to.serialize_bytes(value)
    }

    /// Decodes the field.
    ///
    /// # Errors
    /// Those of the deserializer.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<u8>, D::Error> {
        Blob::deserialize(from).map(Vec::from)
    }
}

/// What has so many bytes or elements that `#[contract(at_most = n)]` can bound them.
#[diagnostic::on_unimplemented(
    message = "`at_most` bounds a `String`, a `Vec` or a `BTreeSet`, and no `{Self}`",
    label = "this field has no bound"
)]
pub trait Boundable: Described {
    /// The bytes of a text, the elements of a vector or a set.
    fn count(&self) -> usize;
}

impl Boundable for String {
    fn count(&self) -> usize {
        self.len()
    }
}

impl<T: Described> Boundable for Vec<T> {
    fn count(&self) -> usize {
        self.len()
    }
}

impl<T: Described + Ord> Boundable for BTreeSet<T> {
    fn count(&self) -> usize {
        self.len()
    }
}

/// Fields with `#[contract(at_most = N)]`. A value with more is neither encoded nor decoded.
#[derive(Debug)]
pub struct AtMost<T, const N: u32>(PhantomData<T>);

impl<T: Boundable, const N: u32> AtMost<T, N> {
    fn check(value: &T) -> Result<(), String> {
        match value.count() {
            count if count > N as usize => {
                Err(format!("{count} where at most {N} may be: shorten it, or raise `at_most`"))
            }
            _ => Ok(()),
        }
    }

    /// The structure of the field.
    pub fn layout() -> &'static Layout {
        const { &Layout { id: TypeId::of::<Self>, shape: Shape::AtMost(T::layout, N) } }
    }

    /// Encodes the field.
    ///
    /// # Errors
    /// Those of the serializer, and that there are more than `N`.
    pub fn serialize<S: Serializer>(value: &T, to: S) -> Result<S::Ok, S::Error> {
        Self::check(value).map_err(serde::ser::Error::custom)?;
        value.serialize(to)
    }

    /// Decodes the field.
    ///
    /// # Errors
    /// Those of the deserializer, and that there are more than `N`.
    pub fn deserialize<'de, D: Deserializer<'de>>(from: D) -> Result<T, D::Error> {
        let value = T::deserialize(from)?;
        Self::check(&value).map_err(serde::de::Error::custom)?;
        Ok(value)
    }
}

/// Fields that are written `[T; N]`: arrays of any length, where serde itself ends at 32.
pub mod array {
    use crate::contract::layout::Described;
    use serde::de::{Error, SeqAccess, Visitor};
    use serde::ser::SerializeTuple;
    use serde::{Deserializer, Serializer};
    use std::fmt;
    use std::marker::PhantomData;

    /// Encodes the field.
    ///
    /// # Errors
    /// Those of the serializer.
    pub fn serialize<T: Described, S: Serializer, const N: usize>(
        value: &[T; N],
        to: S,
    ) -> Result<S::Ok, S::Error> {
        let mut tuple = to.serialize_tuple(N)?;
        for element in value {
            tuple.serialize_element(element)?;
        }
        tuple.end()
    }

    /// Decodes the field.
    ///
    /// # Errors
    /// Those of the deserializer.
    pub fn deserialize<'de, T: Described, D: Deserializer<'de>, const N: usize>(
        from: D,
    ) -> Result<[T; N], D::Error> {
        from.deserialize_tuple(N, Elements(PhantomData))
    }

    struct Elements<T, const N: usize>(PhantomData<T>);

    impl<'de, T: Described, const N: usize> Visitor<'de> for Elements<T, N> {
        type Value = [T; N];

        fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
            write!(f, "an array of {N} elements")
        }

        fn visit_seq<A: SeqAccess<'de>>(self, mut elements: A) -> Result<[T; N], A::Error> {
            let mut array = Vec::with_capacity(N);
            while array.len() < N {
                let missing = || A::Error::invalid_length(array.len(), &self);
                array.push(elements.next_element()?.ok_or_else(missing)?);
            }
            Ok(array.try_into().unwrap_or_else(|_| unreachable!("{N} elements were read")))
        }
    }
}
