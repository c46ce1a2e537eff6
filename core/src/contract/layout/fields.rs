//! The fields of a structure as a list for display.

use super::difference::type_text;
use crate::LayoutDescription;
use crate::contract::layout::{Primitive, Shape};
use serde::{Deserialize, Serialize};

/// The most fields that one list shows.
const FIELD_LIMIT: usize = 256;

/// One field of a message, for display.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FieldDescription {
    /// The path to the field: `pose.x`. Empty where the message has no fields.
    pub name: String,
    /// Its type in words: `sequence of f32`.
    pub takes: String,
    /// The unit of its value.
    pub unit: Option<String>,
    /// The coordinate frame that its value is given in.
    pub frame: Option<String>,
}

impl LayoutDescription {
    /// The fields in order, those of structures in place of the structures; at most 256.
    pub fn fields(&self) -> Vec<FieldDescription> {
        let mut fields = Vec::new();
        match &self.types()[0] {
            Shape::Leaf(Primitive::Unit) => {}
            Shape::Struct(..) => self.collect_fields(0, "", &mut vec![0], &mut fields),
            _ => fields.push(FieldDescription {
                name: String::new(),
                takes: type_text(self.types(), 0),
                unit: None,
                frame: None,
            }),
        }
        fields
    }

    /// `open` are the structures that this one stands in.
    fn collect_fields(
        &self,
        index: u32,
        path: &str,
        open: &mut Vec<u32>,
        fields: &mut Vec<FieldDescription>,
    ) {
        let Shape::Struct(_, own) = &self.types()[index as usize] else { return };
        for field in own.as_slice() {
            if fields.len() == FIELD_LIMIT {
                return;
            }
            let separator = if path.is_empty() { "" } else { "." };
            let name = format!("{path}{separator}{}", field.name);
            let is_structure = matches!(self.types()[field.of as usize], Shape::Struct(..));
            if is_structure && !open.contains(&field.of) {
                open.push(field.of);
                self.collect_fields(field.of, &name, open, fields);
                open.pop();
                continue;
            }
            fields.push(FieldDescription {
                name,
                takes: type_text(self.types(), field.of),
                unit: field.unit.as_ref().map(ToString::to_string),
                frame: field.frame.as_ref().map(ToString::to_string),
            });
        }
    }
}
