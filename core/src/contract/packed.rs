//! A message as a packed C struct, for microcontrollers.
//!
//! ```text
//! bool, u8 … i128, f32, f64   as they are, little-endian
//! char                        u32
//! Duration                    u64 seconds, u32 nanoseconds
//! Option<T>                   u8, 0 or 1; T, zeros if absent
//! [T; n], tuple, struct       their parts
//! enum                        u8; the fields of the variant, zeros up to the largest
//! text, Vec, set with at_most  u8, how many; the elements, zeros up to the bound
//! ```
//!
//! The size is fixed. Types without a bound, such as `String` and `Vec`, have no packed form.

use crate::contract::codec;
use crate::contract::layout::{
    Described, Field, Fields, Layout, LayoutOf, Primitive, Shape, Variant,
};
use crate::{Contract, ContractIdentity, DecodeError, EncodeError, hash};

/// The largest packed message, in bytes: with a status before it, it fits into one packet.
pub const PACKED_MAX: usize = 239;

/// A type nested deeper than this is taken for one that contains itself.
const DEPTH_MAX: usize = 16;

/// The bytes that every value of this type takes.
///
/// # Errors
/// Says why the type cannot be sent to a device.
///
/// ```
/// use blastema_core::Described;
/// use blastema_core::contract::packed::size;
/// assert_eq!(size(<(u8, Option<f64>, [i16; 3])>::layout), Ok(1 + 9 + 6));
/// assert!(size(String::layout).is_err());
/// ```
pub fn size(of: LayoutOf) -> Result<usize, String> {
    match size_at(of, 0)? {
        size if size > PACKED_MAX => Err(format!(
            "it takes {size} bytes packed, and a packet holds {PACKED_MAX}: send it in parts"
        )),
        size => Ok(size),
    }
}

fn size_at(of: LayoutOf, depth: usize) -> Result<usize, String> {
    let endless = |what| {
        Err(format!(
            "a {what} has no fixed size: write an array, `[T; n]`, or `#[contract(at_most = n)]`"
        ))
    };
    if depth > DEPTH_MAX {
        return endless("type that contains itself");
    }
    let part = |of: &LayoutOf| size_at(*of, depth + 1);
    Ok(match &of().shape {
        Shape::Leaf(leaf) => return leaf_size(*leaf).map_or_else(|| endless("text"), Ok),
        Shape::Optional(of) => 1 + part(of)?,
        Shape::Array(of, length) => part(of)?.saturating_mul(*length as usize),
        Shape::Tuple(parts) => parts.iter().map(part).sum::<Result<_, _>>()?,
        Shape::Struct(_, fields) => fields_size(fields, depth)?,
        Shape::Enum(name, variants) if variants.len() > 256 => {
            return Err(format!("the enum {name} has more than 256 variants"));
        }
        Shape::Enum(_, variants) => {
            let sizes = variants.iter().map(|variant| fields_size(&variant.fields, depth));
            1 + sizes.collect::<Result<Vec<_>, _>>()?.into_iter().max().unwrap_or(0)
        }
        Shape::AtMost(of, bound) => {
            element_size(*of, depth + 1)?.saturating_mul(*bound as usize).saturating_add(1)
        }
        Shape::Sequence(_) => return endless("sequence"),
        Shape::Set(_) => return endless("set"),
        Shape::Map(..) => return endless("map"),
    })
}

/// The bytes of each element of a text, a sequence or a set.
fn element_size(of: LayoutOf, depth: usize) -> Result<usize, String> {
    match &of().shape {
        Shape::Sequence(of) | Shape::Set(of) => size_at(*of, depth + 1),
        _ => Ok(1),
    }
}

fn fields_size(fields: &Fields<LayoutOf>, depth: usize) -> Result<usize, String> {
    fields.as_slice().iter().map(|field| size_at(field.of, depth + 1)).sum()
}

fn leaf_size(leaf: Primitive) -> Option<usize> {
    Some(match leaf {
        Primitive::Unit => 0,
        Primitive::Bool | Primitive::U8 | Primitive::I8 => 1,
        Primitive::U16 | Primitive::I16 => 2,
        Primitive::U32 | Primitive::I32 | Primitive::F32 | Primitive::Char => 4,
        Primitive::U64 | Primitive::I64 | Primitive::F64 => 8,
        Primitive::Duration => 12,
        Primitive::U128 | Primitive::I128 => 16,
        Primitive::Text => return None,
    })
}

/// The fingerprint of the packed contract: 32 bits of a hash over name, version and structure,
/// units and frames included. The generated C header has the same number.
pub fn fingerprint<M: Contract>() -> u32 {
    narrow::<M>(ContractIdentity::of::<M>().fingerprint)
}

fn narrow<M: Contract>(structure: u64) -> u32 {
    let bytes = M::NAME.bytes().chain(M::VERSION.to_le_bytes());
    hash::of(bytes.chain(structure.to_le_bytes())) as u32
}

/// The types that a field is tried with.
const LEAVES: [LayoutOf; 14] = [
    bool::layout,
    u8::layout,
    u16::layout,
    u32::layout,
    u64::layout,
    u128::layout,
    i8::layout,
    i16::layout,
    i32::layout,
    i64::layout,
    i128::layout,
    f32::layout,
    f64::layout,
    char::layout,
];

/// Says which field differs in a contract with another fingerprint, which is all that a device
/// tells of it: tries each field of the message and of the reply with other types, without its
/// unit, without it, and in the place after the next one. `None` where more differs.
pub fn difference<M: Contract>(theirs: u32) -> Option<String> {
    let (message, reply) = (M::layout(), M::Reply::layout());
    let is_theirs = |changed: &Layout, in_reply: bool| {
        let pair = if in_reply { (message, changed) } else { (changed, reply) };
        narrow::<M>(super::fingerprint_of(pair.0, pair.1)) == theirs
    };
    for (of, in_reply) in [(message, false), (reply, true)] {
        let Shape::Struct(name, fields) = &of.shape else { continue };
        let own = fields.as_slice();
        let is_so = |changed: Vec<Field<LayoutOf>>| {
            let fields = match fields {
                Fields::Named(_) => Fields::Named(changed.into()),
                _ => Fields::Tuple(changed.into()),
            };
            is_theirs(&Layout { id: of.id, shape: Shape::Struct(name.clone(), fields) }, in_reply)
        };
        for (at, field) in own.iter().enumerate() {
            let with = |change: &dyn Fn(&mut Vec<Field<LayoutOf>>)| {
                let mut changed = own.to_vec();
                change(&mut changed);
                is_so(changed)
            };
            let mut leaves = LEAVES.iter();
            if let Some(leaf) = leaves.find(|leaf| with(&|fields| fields[at].of = **leaf)) {
                let Shape::Leaf(leaf) = leaf().shape else { continue };
                return Some(format!("the field `{}` is {} there", field.name, leaf.name()));
            }
            if with(&|fields| drop(fields.remove(at))) {
                return Some(format!("there is no field `{}` there", field.name));
            }
            if field.unit.is_some() && with(&|fields| fields[at].unit = None) {
                return Some(format!("the field `{}` has no unit there", field.name));
            }
            if at + 1 < own.len() && with(&|fields| fields.swap(at, at + 1)) {
                let next = &own[at + 1].name;
                return Some(format!("the field `{}` comes after `{next}` there", field.name));
            }
        }
    }
    None
}

/// Packs a value.
///
/// # Errors
/// [`EncodeError`]: its type has no packed form.
pub fn pack<T: Described>(value: &T) -> Result<Vec<u8>, EncodeError> {
    let from = codec::encode_fixed(value)?;
    let impossible = |reason| EncodeError::Impossible { reason };
    size(T::layout).map_err(impossible)?;
    let mut walk = Transcoder { from: &from, to: Vec::new(), packs: true };
    walk.value(T::layout).map_err(|error| impossible(error.to_string()))?;
    Ok(walk.to)
}

/// Reads a packed value. Its bytes come from a chip and are checked.
///
/// # Errors
/// [`DecodeError`]: the bytes are no value of the type.
pub fn unpack<T: Described>(bytes: &[u8]) -> Result<T, DecodeError> {
    size(T::layout).map_err(|error| malformed(&error))?;
    let mut walk = Transcoder { from: bytes, to: Vec::new(), packs: false };
    walk.value(T::layout)?;
    match walk.from.len() {
        0 => codec::decode_fixed(&walk.to),
        count => Err(DecodeError::Trailing { count }),
    }
}

fn malformed(reason: &str) -> DecodeError {
    DecodeError::Malformed { reason: reason.to_owned() }
}

/// Translates between the codec's form with integers of fixed size and the packed form.
struct Transcoder<'a> {
    from: &'a [u8],
    to: Vec<u8>,
    /// Into the packed form.
    packs: bool,
}

impl<'a> Transcoder<'a> {
    fn take(&mut self, count: usize) -> Result<&'a [u8], DecodeError> {
        let (taken, rest) = self.from.split_at_checked(count).ok_or(DecodeError::Truncated)?;
        self.from = rest;
        Ok(taken)
    }

    fn copy(&mut self, count: usize) -> Result<&'a [u8], DecodeError> {
        let taken = self.take(count)?;
        self.to.extend_from_slice(taken);
        Ok(taken)
    }

    /// The zeros in place of a part that is absent.
    fn pad(&mut self, count: usize) -> Result<(), DecodeError> {
        if self.packs {
            self.to.resize(self.to.len() + count, 0);
        } else if self.take(count)?.iter().any(|byte| *byte != 0) {
            return Err(malformed("an absent part is not all zeros"));
        }
        Ok(())
    }

    fn value(&mut self, of: LayoutOf) -> Result<(), DecodeError> {
        let too_large = |error: String| malformed(&error);
        match &of().shape {
            Shape::Leaf(Primitive::Char) => self.char()?,
            Shape::Leaf(leaf) => drop(self.copy(leaf_size(*leaf).unwrap_or(0))?),
            Shape::Optional(of) => match self.copy(1)? {
                [0] => self.pad(size_at(*of, 0).map_err(too_large)?)?,
                [1] => self.value(*of)?,
                _ => return Err(malformed("an option is neither 0 nor 1")),
            },
            Shape::Array(of, length) => (0..*length).try_for_each(|_| self.value(*of))?,
            Shape::Tuple(parts) => parts.iter().try_for_each(|of| self.value(*of))?,
            Shape::Struct(_, fields) => self.fields(fields)?,
            Shape::Enum(name, variants) => {
                let variant = self.variant(variants)?;
                let Some(variant) = variant else {
                    return Err(malformed(&format!("{name} has no such variant")));
                };
                self.fields(&variant.fields)?;
                let largest = size_at(of, 0).map_err(too_large)? - 1;
                self.pad(largest - fields_size(&variant.fields, 0).map_err(too_large)?)?;
            }
            Shape::AtMost(of, bound) => {
                let bound = *bound as usize;
                let count = usize::from(self.copy(1)?[0]);
                match self.packs {
                    // The codec counts in 64 bits.
                    true => drop(self.take(7)?),
                    false => self.to.extend_from_slice(&[0; 7]),
                }
                if count > bound {
                    return Err(malformed(&format!("{count} where at most {bound} may be")));
                }
                match &of().shape {
                    Shape::Sequence(of) | Shape::Set(of) => {
                        (0..count).try_for_each(|_| self.value(*of))?;
                    }
                    _ => drop(self.copy(count)?),
                }
                self.pad((bound - count) * element_size(*of, 0).map_err(too_large)?)?;
            }
            Shape::Sequence(_) | Shape::Set(_) | Shape::Map(..) => {
                return Err(malformed("a sequence without a bound"));
            }
        }
        Ok(())
    }

    fn fields(&mut self, fields: &Fields<LayoutOf>) -> Result<(), DecodeError> {
        fields.as_slice().iter().try_for_each(|field| self.value(field.of))
    }

    /// The codec counts variants in 32 bits, the packed form in 8.
    fn variant<'v>(
        &mut self,
        variants: &'v [Variant<LayoutOf>],
    ) -> Result<Option<&'v Variant<LayoutOf>>, DecodeError> {
        let index = self.copy(1)?[0];
        match self.packs {
            true => drop(self.take(3)?),
            false => self.to.extend_from_slice(&[0; 3]),
        }
        Ok(variants.get(usize::from(index)))
    }

    /// The codec writes UTF-8, the packed form 32 bits.
    fn char(&mut self) -> Result<(), DecodeError> {
        let wrong = || malformed("no such character");
        if self.packs {
            let width = match self.from.first() {
                Some(..0x80) => 1,
                Some(..0xe0) => 2,
                Some(..0xf0) => 3,
                _ => 4,
            };
            let text = std::str::from_utf8(self.take(width)?).map_err(|_| wrong())?;
            let code = text.chars().next().ok_or_else(wrong)?;
            self.to.extend_from_slice(&u32::from(code).to_le_bytes());
        } else {
            let code =
                self.take(4)?.iter().rev().fold(0, |code, byte| code << 8 | u32::from(*byte));
            let code = char::from_u32(code).ok_or_else(wrong)?;
            self.to.extend_from_slice(code.encode_utf8(&mut [0; 4]).as_bytes());
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::time::Duration;

    #[track_caller]
    fn check<T: Described + PartialEq + std::fmt::Debug>(value: T, bytes: &[u8]) {
        assert_eq!(size(T::layout), Ok(bytes.len()));
        assert_eq!(pack(&value).expect("it has a packed form"), bytes);
        assert_eq!(unpack::<T>(bytes), Ok(value));
    }

    #[test]
    fn every_kind_of_value_has_the_bytes_of_the_c_struct() {
        check((true, -2i16, 0x0102_0304u32), &[1, 0xfe, 0xff, 4, 3, 2, 1]);
        check((1.5f32, -0.5f64), &[0, 0, 0xc0, 0x3f, 0, 0, 0, 0, 0, 0, 0xe0, 0xbf]);
        check('ä', &[0xe4, 0, 0, 0]);
        check('🦎', &[0x8e, 0xf9, 1, 0]);
        check(Duration::new(3, 9), &[3, 0, 0, 0, 0, 0, 0, 0, 9, 0, 0, 0]);
        check((Some(7u16), None::<u16>), &[1, 7, 0, 0, 0, 0]);
        check(([1u8, 2], ()), &[1, 2]);
        check(Some(Some(1u8)), &[1, 1, 1]);
        check(Some(None::<u8>), &[1, 0, 0]);
    }

    #[test]
    fn bytes_that_are_no_value_are_refused() {
        let refused = |bytes: &[u8]| unpack::<(bool, Option<char>)>(bytes).is_err();
        assert!(!refused(&[1, 1, 65, 0, 0, 0]));
        assert!(refused(&[2, 1, 65, 0, 0, 0]), "no bool");
        assert!(refused(&[1, 2, 65, 0, 0, 0]), "no option");
        assert!(refused(&[1, 0, 65, 0, 0, 0]), "a value in place of none");
        assert!(refused(&[1, 1, 0, 0xd8, 0, 0]), "no character");
        assert!(refused(&[1, 1, 65, 0, 0]), "too short");
        assert!(refused(&[1, 1, 65, 0, 0, 0, 0]), "too long");
    }

    #[test]
    fn types_without_a_fixed_size_are_named() {
        let error = |of: LayoutOf| size(of).expect_err("no fixed size").to_string();
        assert_eq!(
            error(<(u8, Vec<u8>)>::layout),
            "a sequence has no fixed size: write an array, `[T; n]`, or `#[contract(at_most = n)]`"
        );
        assert!(error(<([u64; 30],)>::layout).starts_with("it takes 240 bytes packed"));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_are_a_value_exactly_if_it_packs_to_them(
            bytes in prop::collection::vec(0u8..4, 0..9),
        ) {
            if let Ok(value) = unpack::<(Option<u8>, bool, Option<[bool; 2]>, char)>(&bytes) {
                prop_assert_eq!(pack(&value).expect("a value"), bytes);
            }
        }
    }
}
