//! The structure of a message as a value that travels to another node.

use crate::contract::layout::{Fields, Layout, LayoutOf, Shape, Text};
use crate::sorted::SortedMap;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// The most types that one description may hold. A rich message has about 30.
const TYPE_LIMIT: usize = 512;
/// The longest name or unit in a description, in bytes: it is shown to a person on one line.
const TEXT_LIMIT: usize = 128;
const UNPRINTABLE: &str = "the description holds a name or unit that cannot be shown";

/// A [`Layout`] as an owned value: a table of types, the described one first.
///
/// A type refers to the types inside of it by their places in the table, so that recursive types
/// are finite. Two layouts whose endless unfoldings are the same have the same description, however
/// the program is cut into types: equal rows are one row, and rows stand in the order in which a
/// walk, breadth first, meets them. The [fingerprint](crate::ContractIdentity::fingerprint) relies
/// on it.
///
/// A description that was decoded is sound, whichever peer sent it: its references lead to rows,
/// and its size, its names and its units are bounded and printable.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(try_from = "Vec<Shape<u32>>", into = "Vec<Shape<u32>>")]
pub struct LayoutDescription {
    types: Vec<Shape<u32>>,
}

impl LayoutDescription {
    /// The description of a type.
    pub fn of(layout: &Layout) -> Self {
        LayoutDescription { types: merged(collected(layout.shape.clone())) }
    }

    /// The description of a message. The name of the message's own type is left out: the contract's
    /// name stands for it.
    pub fn of_message(layout: &Layout) -> Self {
        let mut root = layout.shape.clone();
        if let Shape::Struct(name, _) | Shape::Enum(name, _) = &mut root {
            *name = Text::Borrowed("");
        }
        LayoutDescription { types: merged(collected(root)) }
    }

    /// The table of types; the described one is the first.
    pub fn types(&self) -> &[Shape<u32>] {
        &self.types
    }

    /// Whether the description keeps the bounds that its receiver holds it to.
    ///
    /// # Errors
    /// Says which bound is broken: the description is too large, or its sender is broken or hostile.
    pub fn check(&self) -> Result<(), String> {
        let count = self.types.len();
        if count == 0 {
            return Err("the description is empty".to_owned());
        }
        if count > TYPE_LIMIT {
            return Err(format!(
                "the description holds {count} types; at most {TYPE_LIMIT} are taken"
            ));
        }
        for shape in &self.types {
            if let Some(index) = shape.parts().into_iter().find(|&of| of as usize >= count) {
                return Err(format!("the description refers to type {index} of {count}"));
            }
            if !texts(shape).into_iter().all(printable) {
                return Err(UNPRINTABLE.to_owned());
            }
        }
        Ok(())
    }
}

impl TryFrom<Vec<Shape<u32>>> for LayoutDescription {
    type Error = String;

    fn try_from(types: Vec<Shape<u32>>) -> Result<Self, String> {
        let description = LayoutDescription { types };
        description.check()?;
        Ok(description)
    }
}

impl From<LayoutDescription> for Vec<Shape<u32>> {
    fn from(description: LayoutDescription) -> Self {
        description.types
    }
}

/// Every type that can be reached from `root`, which comes first; each once.
fn collected(root: Shape<LayoutOf>) -> Vec<Shape<u32>> {
    let mut types = Vec::new();
    let mut places = SortedMap::new();
    let mut open = VecDeque::from([root]);
    // The root has no identity here: inside of itself it is met again under its own name.
    let mut next_place = 1;
    while let Some(shape) = open.pop_front() {
        types.push(shape.map(|of| {
            let layout = of();
            *places.entry((layout.id)()).or_insert_with(|| {
                open.push_back(layout.shape.clone());
                next_place += 1;
                next_place - 1
            })
        }));
    }
    types
}

/// The same types with those that cannot be told apart made one, numbered breadth first.
fn merged(types: Vec<Shape<u32>>) -> Vec<Shape<u32>> {
    let classes = classes(&types);
    let class_of = |index: u32| classes[index as usize];
    let mut members = SortedMap::new();
    for (index, &class) in classes.iter().enumerate() {
        members.entry(class).or_insert(index);
    }

    let mut places = SortedMap::from([(classes[0], 0)]);
    let mut order = VecDeque::from([classes[0]]);
    let mut merged = Vec::new();
    while let Some(class) = order.pop_front() {
        merged.push(types[members[&class]].map(|&of| {
            let next_place = places.len() as u32;
            *places.entry(class_of(of)).or_insert_with(|| {
                order.push_back(class_of(of));
                next_place
            })
        }));
    }
    merged
}

/// For each type the number of its class; types of one class unfold to the same endless tree.
///
/// This is Moore's partition refinement: types are told apart by themselves first, then again and
/// again by the classes of their parts, until no class falls apart any more.
fn classes(types: &[Shape<u32>]) -> Vec<usize> {
    let parts: Vec<Vec<u32>> = types.iter().map(Shape::parts).collect();
    let mut classes = numbered(types.iter().map(|shape| shape.map(|_| 0)));
    loop {
        let finer = numbered(parts.iter().enumerate().map(|(index, parts)| {
            let parts: Vec<usize> = parts.iter().map(|&of| classes[of as usize]).collect();
            (classes[index], parts)
        }));
        if finer == classes {
            return classes;
        }
        classes = finer;
    }
}

/// For each key its number; equal keys have one number, counted in the order of first appearance.
fn numbered<K: Ord>(keys: impl Iterator<Item = K>) -> Vec<usize> {
    let mut numbers = SortedMap::new();
    keys.map(|key| {
        let next = numbers.len();
        *numbers.entry(key).or_insert(next)
    })
    .collect()
}

fn texts(shape: &Shape<u32>) -> Vec<&Text> {
    let mut texts = Vec::new();
    let of_fields = |texts: &mut Vec<_>, fields| {
        for field in Fields::as_slice(fields) {
            texts.push(&field.name);
            texts.extend(field.unit.iter().chain(&field.frame));
        }
    };
    match shape {
        Shape::Struct(name, fields) => {
            texts.push(name);
            of_fields(&mut texts, fields);
        }
        Shape::Enum(name, variants) => {
            texts.push(name);
            for variant in variants.iter() {
                texts.push(&variant.name);
                of_fields(&mut texts, &variant.fields);
            }
        }
        _ => {}
    }
    texts
}

fn printable(text: &Text) -> bool {
    text.len() <= TEXT_LIMIT && !text.chars().any(char::is_control)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::contract::layout::difference::{ContractPart, compare};
    use crate::contract::layout::{Field, Primitive, Variant};
    use proptest::prelude::*;

    /// Few kinds, few names and few types, so that equal and nearly equal tables are common.
    fn any_shape(types: u32) -> impl Strategy<Value = Shape<u32>> {
        let of = || 0..types;
        let fields = || {
            prop::collection::vec((of(), prop::option::of(Just("m"))), 0..3).prop_map(|fields| {
                let field = |(index, (of, unit)): (usize, (u32, Option<&'static str>))| Field {
                    name: index.to_string().into(),
                    unit: unit.map(Text::Borrowed),
                    frame: None,
                    of,
                };
                Fields::Named(fields.into_iter().enumerate().map(field).collect())
            })
        };
        prop_oneof![
            2 => prop_oneof![Just(Primitive::U8), Just(Primitive::Text)].prop_map(Shape::Leaf),
            1 => of().prop_map(Shape::Optional),
            1 => (of(), 0u32..3).prop_map(|(of, bound)| Shape::AtMost(of, bound)),
            2 => of().prop_map(Shape::Sequence),
            1 => (of(), of()).prop_map(|(key, value)| Shape::Map(key, value)),
            1 => prop::collection::vec(of(), 1..3).prop_map(|parts| Shape::Tuple(parts.into())),
            3 => fields().prop_map(|fields| Shape::Struct("S".into(), fields)),
            1 => fields().prop_map(|fields| {
                let variant = Variant { name: "V".into(), fields };
                Shape::Enum("E".into(), vec![variant].into())
            }),
        ]
    }

    fn any_description() -> impl Strategy<Value = LayoutDescription> {
        (1u32..5)
            .prop_flat_map(|types| prop::collection::vec(any_shape(types), types as usize))
            .prop_map(|types| LayoutDescription { types })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(2000))]

        #[test]
        fn a_difference_is_found_exactly_if_the_descriptions_are_not_the_same(
            a in any_description(),
            b in any_description(),
        ) {
            let same = merged(a.types.clone()) == merged(b.types.clone());
            let lines = compare(ContractPart::Message, &a, &b);
            prop_assert_eq!(lines.is_empty(), same, "{:?}", lines);
        }

        #[test]
        fn a_description_is_the_same_as_its_merged_form_which_merges_no_further(
            a in any_description(),
        ) {
            let merged_once = LayoutDescription { types: merged(a.types.clone()) };
            prop_assert!(compare(ContractPart::Message, &a, &merged_once).is_empty());
            prop_assert_eq!(merged(merged_once.types.clone()), merged_once.types);
        }
    }
}
