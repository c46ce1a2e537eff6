//! The structure of Rust's own types, and of the middleware's words that users put into messages.

use super::{Described, Field, Fields, Layout, Primitive, Shape, Variant};
use crate::{
    FaultId, FaultKind, FaultLocation, Incarnation, Lifecycle, NodeName, ObjectAddress, ObjectName,
    Severity,
};
use std::any::TypeId;
use std::borrow::Cow;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;
use std::time::Duration;

macro_rules! leaves {
    ($($type:ty => $leaf:ident),* $(,)?) => {$(
        impl Described for $type {
            fn layout() -> &'static Layout {
                const { &Layout { id: TypeId::of::<$type>, shape: Shape::Leaf(Primitive::$leaf) } }
            }
        }
    )*};
}

leaves! {
    bool => Bool, u8 => U8, u16 => U16, u32 => U32, u64 => U64, u128 => U128,
    i8 => I8, i16 => I16, i32 => I32, i64 => I64, i128 => I128, f32 => F32, f64 => F64,
    char => Char, String => Text, Box<str> => Text, Arc<str> => Text, Duration => Duration,
}

impl Described for () {
    const EMPTY: bool = true;

    fn layout() -> &'static Layout {
        const { &Layout { id: TypeId::of::<()>, shape: Shape::Leaf(Primitive::Unit) } }
    }
}

/// A pointer looks like what it points to.
macro_rules! pointers {
    ($($pointer:ident),*) => {$(
        impl<T: Described> Described for $pointer<T> {
            const EMPTY: bool = T::EMPTY;

            fn layout() -> &'static Layout {
                T::layout()
            }
        }
    )*};
}

pointers!(Box, Arc);

impl<T: Described> Described for Option<T> {
    fn layout() -> &'static Layout {
        const { &Layout { id: TypeId::of::<Self>, shape: Shape::Optional(T::layout) } }
    }
}

macro_rules! sequences {
    ($($type:ty => $shape:ident $(, $bound:ident)*;)*) => {$(
        impl<T: Described $(+ $bound)*> Described for $type {
            fn layout() -> &'static Layout {
                const {
                    assert!(
                        !T::EMPTY,
                        "a sequence of values that take no bytes: send their number as a u32 instead"
                    );
                    &Layout { id: TypeId::of::<Self>, shape: Shape::$shape(T::layout) }
                }
            }
        }
    )*};
}

sequences! {
    Vec<T> => Sequence;
    VecDeque<T> => Sequence;
    Box<[T]> => Sequence;
    Arc<[T]> => Sequence;
    BTreeSet<T> => Set, Ord;
}

impl<K: Described + Ord, V: Described> Described for BTreeMap<K, V> {
    fn layout() -> &'static Layout {
        const {
            assert!(
                !(K::EMPTY && V::EMPTY),
                "a map of values that take no bytes: send a bool instead"
            );
            &Layout { id: TypeId::of::<Self>, shape: Shape::Map(K::layout, V::layout) }
        }
    }
}

// One by one, because serde knows arrays up to 32 elements only, one by one too.
macro_rules! arrays {
    ($($length:literal)*) => {$(
        impl<T: Described> Described for [T; $length] {
            const EMPTY: bool = <Self as ArrayField>::EMPTY;

            fn layout() -> &'static Layout {
                <Self as ArrayField>::layout()
            }
        }
    )*};
}

arrays! {
    0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 24 25 26 27 28 29 30 31 32
}

/// An array of any length as a field of its own, where [`Described`], as serde, ends at 32
/// elements. The derives encode it through [`crate::contract::field::array`].
pub trait ArrayField {
    /// Whether it takes no bytes at all.
    const EMPTY: bool;

    /// The array's structure.
    fn layout() -> &'static Layout;
}

impl<T: Described, const N: usize> ArrayField for [T; N] {
    const EMPTY: bool = N == 0 || T::EMPTY;

    fn layout() -> &'static Layout {
        const {
            assert!(N <= u32::MAX as usize, "an array of more elements than a message has bytes");
            &Layout { id: TypeId::of::<[T; N]>, shape: Shape::Array(T::layout, N as u32) }
        }
    }
}

macro_rules! tuples {
    ($(($($part:ident)*))*) => {$(
        impl<$($part: Described),*> Described for ($($part,)*) {
            const EMPTY: bool = $($part::EMPTY)&&*;

            fn layout() -> &'static Layout {
                const {
                    &Layout {
                        id: TypeId::of::<Self>,
                        shape: Shape::Tuple(Cow::Borrowed(const { &[$($part::layout),*] })),
                    }
                }
            }
        }
    )*};
}

tuples! {
    (A) (A B) (A B C) (A B C D) (A B C D E) (A B C D E F) (A B C D E F G) (A B C D E F G H)
    (A B C D E F G H I) (A B C D E F G H I J) (A B C D E F G H I J K) (A B C D E F G H I J K L)
}

/// Describes an enumeration or a structure of this crate in the words of its definition.
macro_rules! describe {
    (struct $type:ident $fields:tt) => {
        impl Described for $type {
            fn layout() -> &'static Layout {
                const {
                    &Layout {
                        id: TypeId::of::<$type>,
                        shape: Shape::Struct(
                            Cow::Borrowed(stringify!($type)),
                            describe!(@variant $fields),
                        ),
                    }
                }
            }
        }
    };
    (enum $type:ident $(<$($generic:ident),*>)? {
        $($variant:ident $(($of:ty))? $({ $($name:ident: $field:ty),* $(,)? })?),* $(,)?
    }) => {
        impl $(<$($generic: Described),*>)? Described for $type $(<$($generic),*>)? {
            fn layout() -> &'static Layout {
                const {
                    &Layout {
                        id: TypeId::of::<Self>,
                        shape: Shape::Enum(
                            Cow::Borrowed(stringify!($type)),
                            Cow::Borrowed(const { &[$(Variant {
                                name: Cow::Borrowed(stringify!($variant)),
                                fields: describe!(@variant $(($of))? $({ $($name: $field),* })?),
                            }),*] }),
                        ),
                    }
                }
            }
        }
    };
    (@variant) => { Fields::Unit };
    (@variant ($of:ty)) => { Fields::Tuple(describe!(@fields 0: $of)) };
    (@variant { $($name:ident: $of:ty),* }) => { Fields::Named(describe!(@fields $($name: $of),*)) };
    (@fields $($name:tt: $of:ty),*) => {
        Cow::Borrowed(const { &[$(Field {
            name: Cow::Borrowed(stringify!($name)),
            unit: None,
            frame: None,
            of: <$of as Described>::layout,
        }),*] })
    };
}

pub(crate) use describe;

describe! { enum Result<T, E> { Ok(T), Err(E) } }
describe! { struct NodeName(String) }
describe! { struct ObjectName(String) }
describe! { struct ObjectAddress { node: NodeName, object: ObjectName } }
describe! { struct Incarnation(u64) }
describe! { struct FaultId(u64) }
describe! { enum Severity { Warning, Error, Critical } }
describe! { enum Lifecycle { Created, Initialized, Active, Error, Fatal, Finalized } }
describe! {
    enum FaultLocation {
        Object(ObjectAddress),
        Link { node: NodeName, link: Arc<str>, neighbour: Option<NodeName> },
        Node(NodeName),
    }
}
describe! {
    enum FaultKind {
        Panic, UnexpectedExit, Hang, Silence, ErrorState, InitializationFailed, Fatal, CheckFailed,
        Overload, ContractMismatch, LinkDown, LinkDegraded, NodeLost, RestartStorm,
        NodeFaulty, NameTaken, CommanderGone, NodeInSafeState, Unreplicated,
        StateLost, ServiceUnavailable, Unavailable, CrashLoop, NodePaused, Insecure, Forbidden,
        ConnectionLost, Custom(Arc<str>),
    }
}
